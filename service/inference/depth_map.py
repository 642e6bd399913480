"""The answer to one photograph, and how raw maps become it."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Self

import numpy as np
from numpy.typing import NDArray

from service.inference.artifact import Manifest
from service.inference.hypotheses import SIGMA_OF_LAPLACE, merged
from service.inference.pair import RawMaps, Side
from service.inference.part import Part
from service.inference.resampling import Ratio, bands, sample
from service.optics import thin_lens
from service.optics.camera import Camera

MAX_RELATIVE_ERROR = 1.0
NO_ANSWER = np.float32(1e3)  # a relative error that no reading states
LEAST_BLUR_ERROR_PX = 0.05  # nobody reads blur better: no stated error is below what it does to depth

Array = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Reading:
    """What one copy of the photograph says at its cells, with the camera at that copy's size.

    ``near_m`` and ``far_m`` are both hypotheses, the far one NaN where blur is too strong for it by more than two
    standard deviations (beyond focus x stays below 1). ``error`` is that of depth, relative: ``NO_ANSWER`` where the
    copy shows more blur than the model was trained on. ``trained_m`` are the nearest and the farthest depth it knows.
    """

    near_m: Array
    far_m: Array
    p_near: Array
    error: Array
    blur_px: Array
    camera: Camera
    scale: float
    trained_m: tuple[float, float]
    ratio: Ratio

    @classmethod
    def of(cls, maps: RawMaps, camera: Camera, photograph_size: tuple[int, int], manifest: Manifest) -> Self:
        """``photograph_size`` is (height, width). The maps are taken over and written over: they may be large."""
        blur_px, near_m, far_m = maps["blur_px"], maps["log_ratio_near"], maps["log_ratio_far"]
        error = maps["log_scale"]
        focus_m = np.float32(camera.focus_distance_m)
        for rows in bands(blur_px.shape):
            at_least_px = blur_px[rows] * np.exp(-2 * SIGMA_OF_LAPLACE * np.exp(maps["blur_log_error"][rows]))
            least_x = thin_lens.relative_defocus_from_blur(at_least_px, camera.gamma_px, camera.k_cam_px)
            near_m[rows] = np.exp(near_m[rows]) * focus_m
            far_m[rows] = np.where(least_x < 1, np.exp(far_m[rows]) * focus_m, np.float32(np.nan))
            error[rows] = np.exp(error[rows]) * (SIGMA_OF_LAPLACE * np.float32(manifest.temperature))
            error[rows][blur_px[rows] > manifest.ranges.blur_px.high] = NO_ANSWER
        nearest, farthest = manifest.ranges.depth_ratio
        return cls(
            near_m,
            far_m,
            maps["p_near"],
            error,
            blur_px,
            camera,
            camera.image_width_px / photograph_size[1],
            (nearest * camera.focus_distance_m, farthest * camera.focus_distance_m),
            Ratio.between(photograph_size, (camera.image_height_px, camera.image_width_px), manifest.stride),
        )


@dataclass(frozen=True, slots=True)
class Layers:
    """The float maps of a photograph, or of some of its rows."""

    depth_m: Array
    depth_alt_m: Array
    p_near: Array
    sigma_m: Array
    blur_px: Array

    def cut(self, part: Part) -> "Layers":
        """A part of all layers, not copied."""
        return Layers(*(part.of(getattr(self, name)) for name in self.__slots__))

    def take(self, other: "Layers", where: NDArray[np.bool_]) -> None:
        """Copy layers of the same size where told."""
        for name in self.__slots__:
            np.copyto(getattr(self, name), getattr(other, name), where=where)

    def put(self, rows: slice, told: "Layers") -> None:
        """Fill in those rows."""
        for name in self.__slots__:
            getattr(self, name)[rows] = getattr(told, name)

    def hide_unanswered(self) -> NDArray[np.bool_]:
        """Which pixels have an answer; NaN goes where there is none."""
        valid = np.isfinite(self.sigma_m)
        if not valid.all():
            for hidden in (self.depth_m, self.depth_alt_m, self.sigma_m):
                hidden[~valid] = np.nan
        return valid


@dataclass(frozen=True, slots=True)
class DepthMap:
    """Maps [height, width] of the upright photograph, in metres along the optical axis if not said otherwise.

    ``depth_m`` and ``sigma_m`` are NaN where there is no answer (``valid`` is false), ``depth_alt_m`` there
    and where no other hypothesis exists. ``p_near`` is 0..1; ``blur_px`` is in pixels of the photograph.
    Maps but ``depth_m`` are in ``layers``, made when first asked for: most answers need none of them.
    ``camera`` is the one used, at the photograph's size; ``scales`` are the copies read, 1 being full size.
    """

    depth_m: Array
    valid: NDArray[np.bool_]
    layers: Callable[[], Layers]
    camera: Camera
    scales: tuple[float, ...]
    warnings: tuple[str, ...]
    timings_ms: Mapping[str, float]

    @property
    def depth_alt_m(self) -> Array:
        return self.layers().depth_alt_m

    @property
    def p_near(self) -> Array:
        return self.layers().p_near

    @property
    def sigma_m(self) -> Array:
        return self.layers().sigma_m

    @property
    def blur_px(self) -> Array:
        return self.layers().blur_px

    @property
    def width_px(self) -> int:
        return int(self.depth_m.shape[1])

    @property
    def height_px(self) -> int:
        return int(self.depth_m.shape[0])

    def cut(self, part: Part) -> "DepthMap":
        """The maps of a part alone, with the camera behind it."""
        return replace(
            self,
            depth_m=part.of(self.depth_m),
            valid=part.of(self.valid),
            layers=lambda: self.layers().cut(part),
            camera=part.behind(self.camera),
        )

    @property
    def valid_fraction(self) -> float:
        return float(self.valid.mean())


def decide(readings: list[Reading], size: tuple[int, int], side: Side) -> tuple[Array, NDArray[np.bool_]]:
    """Depth (height, width) and which pixels have an answer; the surest reading wins, pixel by pixel."""
    depth_m, valid = np.empty(size, np.float32), np.empty(size, np.bool_)
    for rows, told, known in _decided(readings, size, side):
        depth_m[rows], valid[rows] = told.depth_m, known
    return depth_m, valid


def all_layers(readings: list[Reading], size: tuple[int, int], side: Side) -> Callable[[], Layers]:
    """What makes all maps when first called, and gives the same ones after."""

    @cache
    def made() -> Layers:
        layers = Layers(*(np.empty(size, np.float32) for _ in Layers.__slots__))
        for rows, told, _ in _decided(readings, size, side):
            layers.put(rows, told)
        return layers

    return made


def _decided(
    readings: list[Reading], size: tuple[int, int], side: Side
) -> Iterator[tuple[slice, Layers, NDArray[np.bool_]]]:
    """Rows, what they show, and which of their pixels have an answer."""
    for rows in bands(size):
        told, *others = (_told(_sampled(reading, rows, size[1]), reading, side) for reading in readings)
        for other in others:
            told.take(other, other.sigma_m < told.sigma_m)
        np.multiply(told.sigma_m, told.depth_m, out=told.sigma_m)
        yield rows, told, told.hide_unanswered()


def _sampled(reading: Reading, rows: slice, width: int) -> Layers:
    """What one reading says at every pixel: as depth the near hypothesis yet, as the other the far one."""
    maps = reading.near_m, reading.far_m, reading.p_near, reading.error, reading.blur_px
    return Layers(*(sample(values, reading.ratio, rows, width) for values in maps))


def _told(layers: Layers, reading: Reading, side: Side) -> Layers:
    """The layers with depth where it is, ``sigma_m`` relative yet and infinite where there is no answer.

    Depth and error are those of both hypotheses together, unless the side is given; where no far answer can exist it is
    near, always. No error is stated below the floor of optics.
    """
    near_m, far_m, p_near, error = layers.depth_m, layers.depth_alt_m, layers.p_near, layers.sigma_m
    if side != "auto":
        p_near.fill(side == "near")
    has_no_far = np.isnan(far_m)
    np.copyto(p_near, 1, where=has_no_far)
    depth_m, merged_error, is_far = merged(near_m, np.where(has_no_far, near_m, far_m), p_near, error)
    np.copyto(far_m, near_m, where=is_far)
    near_m[:] = depth_m
    camera = reading.camera
    floor = thin_lens.depth_error(1.0, camera.focus_distance_m, camera.k_cam_px, LEAST_BLUR_ERROR_PX)
    least_error = np.float32(floor) * depth_m
    nearest_m, farthest_m = reading.trained_m
    is_unknown = (error > MAX_RELATIVE_ERROR) | (least_error > MAX_RELATIVE_ERROR)
    is_unknown |= (depth_m < nearest_m) | (depth_m > farthest_m)
    np.clip(merged_error, least_error, MAX_RELATIVE_ERROR, out=error)
    error[is_unknown] = np.inf
    np.divide(layers.blur_px, np.float32(reading.scale), out=layers.blur_px)
    return layers
