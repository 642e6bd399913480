"""The answer to one photograph, and how raw maps become it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from service.inference.pair import RawMaps, Side
from service.inference.part import Part
from service.inference.resampling import Axis, sample
from service.optics import thin_lens
from service.optics.camera import Camera

MAX_RELATIVE_ERROR = 1.0
SIGMA_OF_LAPLACE = np.float32(2**0.5)
ROWS_AT_ONCE = 128

Array = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class DepthMap:
    """Maps [height, width] of the upright photograph, in metres along the optical axis if not said otherwise.

    ``depth_m`` and ``sigma_m`` are NaN where there is no answer (``valid`` is false), ``depth_alt_m`` there
    and where no other hypothesis exists. ``p_near`` is 0..1; ``blur_px`` is in pixels of the photograph.
    ``camera`` is the one used, at the photograph's size; ``scales`` are the copies read, 1 being full size.
    """

    depth_m: Array
    depth_alt_m: Array
    p_near: Array
    sigma_m: Array
    blur_px: Array
    valid: NDArray[np.bool_]
    camera: Camera
    scales: tuple[float, ...]
    warnings: tuple[str, ...]
    timings_ms: Mapping[str, float]

    @property
    def width_px(self) -> int:
        return int(self.depth_m.shape[1])

    @property
    def height_px(self) -> int:
        return int(self.depth_m.shape[0])

    def cut(self, part: Part) -> "DepthMap":
        """The maps of a part alone, with the camera behind it."""
        maps: dict[str, Any] = {name: part.of(getattr(self, name)) for name in (*Layers.__slots__, "valid")}
        return replace(self, **maps, camera=part.behind(self.camera))

    @property
    def valid_fraction(self) -> float:
        return float(self.valid.mean())


@dataclass(frozen=True, slots=True)
class Reading:
    """Raw maps of one copy of the photograph, with the camera at that copy's size, and what they say at their cells.

    ``near_m`` and ``far_m`` are both hypotheses, the far one NaN where there is none, and ``error`` that of depth,
    relative.
    """

    maps: RawMaps
    camera: Camera
    scale: float
    near_m: Array
    far_m: Array
    error: Array
    rows: Axis
    columns: Axis

    @classmethod
    def of(cls, maps: RawMaps, camera: Camera, photograph_size: tuple[int, int], stride: int) -> Self:
        """``photograph_size`` is (height, width)."""
        height, width = photograph_size
        map_rows, map_columns = maps["blur_px"].shape
        x = thin_lens.relative_defocus_from_blur(maps["blur_px"], camera.gamma_px, camera.k_cam_px)
        focus_m = np.float32(camera.focus_distance_m)
        return cls(
            maps,
            camera,
            camera.image_width_px / width,
            np.exp(maps["log_ratio_near"]) * focus_m,
            np.where(x < 1, np.exp(maps["log_ratio_far"]) * focus_m, np.float32(np.nan)),
            np.exp(maps["log_scale"]) * SIGMA_OF_LAPLACE,
            Axis.between(height, camera.image_height_px, stride, map_rows),
            Axis.between(width, camera.image_width_px, stride, map_columns),
        )


@dataclass(frozen=True, slots=True)
class Layers:
    """The float maps of a photograph, or of some of its rows."""

    depth_m: Array
    depth_alt_m: Array
    p_near: Array
    sigma_m: Array
    blur_px: Array

    @classmethod
    def empty(cls, height: int, width: int) -> Self:
        return cls(*(np.empty((height, width), np.float32) for _ in cls.__slots__))

    def rows(self, start: int, stop: int) -> "Layers":
        """Views of some rows."""
        return Layers(*(getattr(self, name)[start:stop] for name in self.__slots__))

    def take(self, other: "Layers", where: NDArray[np.bool_] | None = None) -> None:
        """Copy layers of the same size, everywhere or where told."""
        for name in self.__slots__:
            np.copyto(getattr(self, name), getattr(other, name), where=True if where is None else where)

    def hide_unanswered(self) -> NDArray[np.bool_]:
        """Which pixels have an answer; NaN goes where there is none."""
        with np.errstate(invalid="ignore"):
            valid = (self.sigma_m <= MAX_RELATIVE_ERROR * self.depth_m) & np.isfinite(self.depth_m)
        if not valid.all():
            for hidden in (self.depth_m, self.depth_alt_m, self.sigma_m):
                hidden[~valid] = np.nan
        return valid


def decide(readings: list[Reading], size: tuple[int, int], side: Side) -> tuple[Layers, NDArray[np.bool_]]:
    """Layers (height, width) and which pixels have an answer; the surest reading wins, pixel by pixel.

    Rows are done in bands: a photograph of 12 megapixels would need a gigabyte at once.
    """
    height, width = size
    layers, valid = Layers.empty(height, width), np.empty((height, width), np.bool_)
    for start in range(0, height, ROWS_AT_ONCE):
        stop = min(start + ROWS_AT_ONCE, height)
        band, best = layers.rows(start, stop), None
        for reading in readings:
            told, error = _band(reading, start, stop, side)
            band.take(told, None if best is None else error < best)
            best = error if best is None else np.fmin(best, error)
        valid[start:stop] = band.hide_unanswered()
    return layers, valid


def _band(reading: Reading, start: int, stop: int, side: Side) -> tuple[Layers, Array]:
    """Layers of some rows from one reading, and the relative error of depth there."""
    rows, columns = reading.rows.part(start, stop), reading.columns
    near_m, far_m = sample(reading.near_m, rows, columns), sample(reading.far_m, rows, columns)
    error = sample(reading.error, rows, columns)
    p_near = _p_near(sample(reading.maps["p_near"], rows, columns), np.isfinite(far_m), side)
    is_near = p_near >= 0.5
    depth_m = np.where(is_near, near_m, far_m)
    blur_px = sample(reading.maps["blur_px"], rows, columns)
    blur_px /= np.float32(reading.scale)
    return Layers(depth_m, np.where(is_near, far_m, near_m), p_near, error * depth_m, blur_px), error


def _p_near(told: Array, has_far: NDArray[np.bool_], side: Side) -> Array:
    """What the network tells unless the side is given; where no far answer can exist it is near, always."""
    if side == "near":
        return np.ones_like(told)
    asked = np.zeros_like(told) if side == "far" else np.clip(told, 0, 1)
    return np.where(has_far, asked, np.float32(1))
