"""A photograph and its camera to depth: chooses the scale, reads, decides. No answer depends on another."""

import threading
from typing import Self

import numpy as np
from numpy.typing import NDArray

from service.inference.artifact import Interval, Manifest, ModelFolder
from service.inference.cancellation import Cancellation
from service.inference.depth_map import DepthMap, Reading, all_layers, decide
from service.inference.pair import GraphPair, Side, Stopwatch
from service.inference.part import Part
from service.inference.tiles import OVERLAP_PX, PIXEL_BUDGET, read_in_tiles
from service.opencv import cv2
from service.optics.camera import Camera

# by a k_cam of 10.7 px, RMSE at full size and on the copy where it is 8: indoor frames 0.174 and 0.181 m, table tops
# 0.163 and 0.115 m
WELL_READ_K_CAM_PX = 8.0
# of a picture larger than this the network sees too little at a time, and reads it as well where k_cam is this:
WIDE_PX, FINE_K_CAM_PX = 640, 5.0
HIGH_BLUR = 0.8
HIGH_BLUR_FRACTION = 0.02
SECOND_SCALE = 1 / 3
LEAST_CHANGE_OF_SCALE = 0.7
FEW_ANSWERS = 0.5
SMALL_PX = 600_000
KEPT_S = 10.0
WARM_UP_PX = 64


class Estimator:
    """Made once from a model folder; ``estimate`` may be called from several threads at once."""

    def __init__(self, pair: GraphPair, pixel_budget: int = PIXEL_BUDGET, kept_s: float = KEPT_S) -> None:
        self._pair = pair
        self._pixel_budget = pixel_budget
        self._kept_s = kept_s
        self._freeing = threading.Timer(0, pair.free_memory)

    @classmethod
    def from_folder(cls, folder: ModelFolder, *, intra_op_threads: int = 1) -> Self:
        """Load both graphs; raises ``ModelFolderError`` where they are not what the manifest says."""
        return cls(GraphPair(folder, intra_op_threads))

    @property
    def manifest(self) -> Manifest:
        return self._pair.manifest

    def warm_up(self) -> None:
        """Answer one small grey picture, so that the first request does not pay for preparing the graphs."""
        grey = np.full((WARM_UP_PX, WARM_UP_PX, 3), 128, np.uint8)
        middle = float(np.mean(self.manifest.ranges.focus_distance_m))
        self.estimate(grey, Camera(WARM_UP_PX, WARM_UP_PX, middle, self.manifest.ranges.k_cam_px.high))

    def close(self) -> None:
        """Nothing happens later any more."""
        self._freeing.cancel()

    def estimate(
        self,
        rgb: NDArray[np.uint8],
        camera: Camera,
        side: Side = "auto",
        cancellation: Cancellation | None = None,
        part: Part | None = None,
    ) -> DepthMap:
        """Depth of an upright photograph, uint8 [h, w, 3] sRGB, whose camera is at exactly that size.

        Of a ``part`` alone it costs what the part and its surroundings cost. Raises ``ValueError`` for a camera of
        another size and ``Cancelled`` when asked to stop.
        """
        height, width = rgb.shape[:2]
        if (width, height) != (camera.image_width_px, camera.image_height_px):
            raise ValueError(f"the camera must be that of a {width}x{height} image: resize it first")
        cancellation = cancellation or Cancellation()
        scale = self._base_scale(camera)
        if part is None:
            return self._estimate(rgb, camera, scale, side, cancellation)
        around = part.widened(round(OVERLAP_PX / scale), self.manifest.multiple, width, height)
        read = self._estimate(around.of(rgb), around.behind(camera), scale, side, cancellation)
        return read.cut(part.within(around))

    def _estimate(
        self, rgb: NDArray[np.uint8], camera: Camera, scale: float, side: Side, cancellation: Cancellation
    ) -> DepthMap:
        height, width = rgb.shape[:2]
        stopwatch = Stopwatch()
        readings = [self._read(rgb, camera, scale, side, cancellation, stopwatch)]
        second = self._second_scale(readings[0])
        if second is not None:
            readings.append(self._read(rgb, camera, second, side, cancellation, stopwatch))
        if height * width > SMALL_PX:
            self._free_memory_later()
        cancellation.check()
        with stopwatch.stage("encode"):
            depth_m, valid = decide(readings, (height, width))
        return DepthMap(
            depth_m=depth_m,
            valid=valid,
            layers=all_layers(readings, (height, width)),
            camera=camera,
            scales=tuple(reading.scale for reading in readings),
            warnings=(*self._warnings(readings), *_sparseness(valid)),
            timings_ms=stopwatch.elapsed_ms,
        )

    def _free_memory_later(self) -> None:
        """What a large picture has taken is kept for the next one, but for a while only."""
        self._freeing.cancel()
        self._freeing = threading.Timer(self._kept_s, self._pair.free_memory)
        self._freeing.daemon = True
        self._freeing.start()

    def _base_scale(self, camera: Camera) -> float:
        """The largest copy whose k_cam the model reads well, or a smaller one of a large picture; never enlarged."""
        at_most = min(WELL_READ_K_CAM_PX, self.manifest.ranges.k_cam_px.high) / camera.k_cam_px
        longer_px = max(camera.image_width_px, camera.image_height_px)
        return min(1.0, at_most, max(WIDE_PX / longer_px, FINE_K_CAM_PX / camera.k_cam_px))

    def _second_scale(self, first: Reading) -> float | None:
        """A smaller copy, where the first shows more blur than the model reads well; None without need."""
        ranges = self.manifest.ranges
        if (first.blur_px > HIGH_BLUR * ranges.blur_px.high / first.scale).mean() <= HIGH_BLUR_FRACTION:
            return None
        change = max(SECOND_SCALE, ranges.k_cam_px.low / first.camera.k_cam_px)
        return first.scale * change if change <= LEAST_CHANGE_OF_SCALE else None

    def _read(
        self,
        rgb: NDArray[np.uint8],
        camera: Camera,
        scale: float,
        side: Side,
        cancellation: Cancellation,
        stopwatch: Stopwatch,
    ) -> Reading:
        working = camera.averaged(
            max(1, round(camera.image_width_px * scale)), max(1, round(camera.image_height_px * scale))
        )
        size = (working.image_width_px, working.image_height_px)
        copy = rgb if working is camera else cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
        maps = read_in_tiles(
            np.asarray(copy, np.uint8),
            lambda tile: self._pair.read(tile, working, side, cancellation, stopwatch),
            multiple=self.manifest.multiple,
            stride=self.manifest.stride,
            pixel_budget=self._pixel_budget,
        )
        return Reading.of(maps, working, rgb.shape[:2], self.manifest, side)

    def _warnings(self, readings: list[Reading]) -> list[str]:
        first, last, ranges = readings[0], readings[-1], self.manifest.ranges
        told = [
            f"read at {reading.scale:.3g} of full size "
            f"({reading.camera.image_width_px}x{reading.camera.image_height_px})"
            for reading in readings
            if reading.scale != 1
        ]
        told += _outside("k_cam_px at that size", first.camera.k_cam_px, ranges.k_cam_px)
        told += _outside("gamma_px at that size", first.camera.gamma_px, ranges.gamma_px)
        told += _outside("focus_distance_m", first.camera.focus_distance_m, ranges.focus_distance_m)
        if first.camera.intrinsics:
            told += _outside("fx_px at that size", first.camera.intrinsics.fx_px, ranges.focal_length_px)
        blurrier = float((last.blur_px > ranges.blur_px.high / last.scale).mean())
        if blurrier > HIGH_BLUR_FRACTION:
            told.append(f"{blurrier:.0%} of the pixels show more blur than the model was trained on")
        return told


def _outside(name: str, value: float, trained: Interval) -> list[str]:
    # a copy's size is a whole number of pixels, so its constants may miss the range by a rounding
    if trained.low * 0.99 <= value <= trained.high * 1.01:
        return []
    return [f"{name} is {value:.4g}, outside {trained.low:g} to {trained.high:g} that the model was trained on"]


def _sparseness(valid: NDArray[np.bool_]) -> list[str]:
    fraction = float(valid.mean())
    return [f"only {fraction:.0%} of the pixels have an answer"] if fraction < FEW_ANSWERS else []
