"""The two graphs and the correction between them: one RGB array and its camera to raw maps.

Maps are those of the graphs: ``stride`` pixels of the image to one of theirs, depth as a ratio to the focus
distance, nothing decided yet.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from service.inference.artifact import (
    BLUR_ERROR_RANGE,
    BLUR_OUTPUTS,
    DEPTH_OUTPUTS,
    LAYOUT_MAP,
    LAYOUT_ODDS,
    Manifest,
    ModelFolder,
)
from service.inference.cancellation import Cancellation
from service.inference.layout import add_odds, shrunk
from service.inference.resampling import bands
from service.inference.session import Graph
from service.opencv import cv2, exp
from service.optics import thin_lens
from service.optics.camera import Camera

Side = Literal["auto", "near", "far"]
SIDE_HINTS: dict[Side, float] = {"auto": 0.0, "near": -1.0, "far": 1.0}
SIDE_RANGES: dict[Side, tuple[float, float]] = {"auto": (0.0, np.inf), "near": (0.0, 1.0), "far": (1.0, np.inf)}  # z/s1
MAPS = BLUR_OUTPUTS + DEPTH_OUTPUTS
REMEMBERED = 4

RawMaps = dict[str, NDArray[np.float32]]


@dataclass(slots=True)
class Stopwatch:
    """Milliseconds by stage, added up over tiles and scales."""

    elapsed_ms: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        started = time.perf_counter()
        try:
            yield
        finally:
            self.add({name: (time.perf_counter() - started) * 1e3})

    def add(self, elapsed_ms: Mapping[str, float]) -> None:
        for name, spent in elapsed_ms.items():
            self.elapsed_ms[name] = self.elapsed_ms.get(name, 0.0) + spent


class Sights:
    """What the blur graph said of the last few pictures, to be corrected for one camera after the other."""

    def __init__(self) -> None:
        self._seen: dict[tuple[tuple[int, ...], bytes], RawMaps] = {}

    def of(self, rgb: NDArray[np.uint8], see: Callable[[], RawMaps]) -> RawMaps:
        """Of a picture, which is seen if it was not; its maps may be written over."""
        picture = (rgb.shape, rgb.tobytes())
        if picture not in self._seen:
            if len(self._seen) == REMEMBERED:
                self._seen.pop(next(iter(self._seen)))
            self._seen[picture] = see()
        return {name: values.copy() if name in MAPS else values for name, values in self._seen[picture].items()}


class GraphPair:
    """blur.onnx and depth.onnx, and layout.onnx where there is one, loaded; holds no state between calls."""

    def __init__(self, folder: ModelFolder, intra_op_threads: int) -> None:
        graphs = folder.manifest.graphs
        self.manifest: Manifest = folder.manifest
        self._blur = Graph(folder.blur_graph, graphs.blur, intra_op_threads)
        self._depth = Graph(folder.depth_graph, graphs.depth, intra_op_threads)
        self._layout = None
        if graphs.layout and folder.layout_graph:
            self._layout = Graph(folder.layout_graph, graphs.layout, intra_op_threads)

    def read(
        self,
        rgb: NDArray[np.uint8],
        camera: Camera,
        side: Side,
        cancellation: Cancellation,
        stopwatch: Stopwatch,
        *,
        is_tile: bool = False,
        sights: Sights | None = None,
    ) -> RawMaps:
        """Raw maps, each float32 [ceil(h/stride), ceil(w/stride)], of an image uint8 [h, w, 3].

        ``camera`` is at the scale of the image, of which this may be a part: a crop changes no blur. Of a tile
        ``p_near`` is without what its own layout says: ``lay_out`` adds the whole's, of the map [c,h,w] that is there.
        What ``sights`` has is not seen again.
        """
        with stopwatch.stage("blur"):
            seen = sights.of(rgb, lambda: self.see(rgb, cancellation)) if sights else self.see(rgb, cancellation)
        with stopwatch.stage("correct"):
            feeds = _corrected(seen, camera, side, self._nearest_focus_m)
        with stopwatch.stage("depth"):
            told = self._depth.run(feeds, cancellation)
        rows, columns = (-(-size // self.manifest.stride) for size in rgb.shape[:2])
        maps = {name: (seen | told)[name][0, 0, :rows, :columns] for name in MAPS}
        if is_tile and self._layout is not None:
            with stopwatch.stage("correct"):
                add_odds(maps["p_near"], -told[LAYOUT_ODDS][0, 0], told["p_near"].shape[2:])
            maps[LAYOUT_MAP] = told[LAYOUT_MAP][0]
        return maps

    def lay_out(self, maps: RawMaps, times: float, cancellation: Cancellation, stopwatch: Stopwatch) -> None:
        """Add to ``p_near`` what the layout of all tiles says, seen so many times as large; its map is taken away."""
        layout_map = maps.pop(LAYOUT_MAP, None)
        if self._layout is None or layout_map is None:
            return
        with stopwatch.stage("depth"):
            told = self._layout.run({LAYOUT_MAP: shrunk(layout_map, times)[np.newaxis]}, cancellation)
        with stopwatch.stage("correct"):
            height, width = (cells * self.manifest.multiple // self.manifest.stride for cells in layout_map.shape[1:])
            add_odds(maps["p_near"], told[LAYOUT_ODDS][0, 0], (height, width))

    def free_memory(self) -> None:
        """Give back what large pictures have taken, through a run on a tiny one."""
        tiny = np.zeros((self.manifest.multiple, self.manifest.multiple, 3), np.uint8)
        seen = self._blur.run({"image": self._padded(tiny)}, Cancellation(), free_memory=True)
        camera = Camera(tiny.shape[1], tiny.shape[0], 1.0, 1.0)
        self._depth.run(_corrected(seen, camera, "auto", self._nearest_focus_m), Cancellation(), free_memory=True)

    @property
    def _nearest_focus_m(self) -> float:
        return self.manifest.ranges.focus_distance_m.low

    def see(self, rgb: NDArray[np.uint8], cancellation: Cancellation) -> RawMaps:
        """What the blur graph says of an image: the same for every camera."""
        seen = self._blur.run({"image": self._padded(rgb)}, cancellation)
        return seen | {"blur_px": seen["blur_px"] * np.float32(self.manifest.blur_gain)}

    def _padded(self, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        """float32 [1, 3, h, w] in 0..1, mirrored at the right and bottom up to the next multiple."""
        bottom, right = (-size % self.manifest.multiple for size in rgb.shape[:2])
        padded = cv2.copyMakeBorder(rgb, 0, bottom, 0, right, cv2.BORDER_REFLECT) if bottom or right else rgb
        image = np.empty((1, 3, *padded.shape[:2]), np.float32)
        for channel, plane in enumerate(cv2.split(padded)):
            np.divide(plane, np.float32(255), out=image[0, channel])
        return image


def _corrected(seen: RawMaps, camera: Camera, side: Side, nearest_focus_m: float) -> RawMaps:
    """What the depth graph is given: blur with the camera taken out (eq. 6 and 7), and the camera itself.

    It answers ratios to the focus distance, which are those of the same scene larger, farther away and as blurred: of a
    focus nearer than it knows it is told the nearest that it does.
    """
    blur_px = seen["blur_px"]
    gamma_px, k_cam_px = camera.gamma_px, camera.k_cam_px
    defocus, spread = np.empty_like(blur_px), np.empty_like(blur_px)
    for rows in bands(blur_px.shape[-2:]):
        cells = (..., rows, slice(None))
        error = np.clip(exp(seen["blur_log_error"][cells]), *BLUR_ERROR_RANGE)
        defocus[cells] = thin_lens.relative_defocus_from_blur(blur_px[cells], gamma_px, k_cam_px)
        spread[cells] = thin_lens.relative_defocus_spread(blur_px[cells], error, gamma_px, k_cam_px)
    focal_length_px = camera.intrinsics.fx_px if camera.intrinsics else 0.0
    return {
        **{name: value for name, value in seen.items() if name not in ("blur_px", "blur_log_error")},
        "relative_defocus": defocus,
        "relative_defocus_spread": spread,
        "focus_distance_m": np.array([max(camera.focus_distance_m, nearest_focus_m)], np.float32),
        "focal_length_px": np.array([focal_length_px], np.float32),
        "side": np.array([SIDE_HINTS[side]], np.float32),
    }
