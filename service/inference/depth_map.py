"""The answer to one photograph, and how raw maps become it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from service.inference.artifact import BLUR_ERROR_RANGE, Manifest
from service.inference.hypotheses import SIGMA_OF_LAPLACE, in_metres, merged
from service.inference.pair import RawMaps, Side
from service.inference.part import Part
from service.inference.resampling import WHOLE_PX, Lines, Ratio, bands, sample, shrunk_size
from service.opencv import cv2, exp, where
from service.optics import thin_lens
from service.optics.camera import Camera

MAX_RELATIVE_ERROR = 1.0
MOST_STATED = 0.999  # of depth: an answer that doubts its side states no more, and is one all the same
NO_ANSWER = np.float32(1e3)  # a relative error that no reading states
LEAST_BLUR_ERROR_PX = 0.05  # nobody reads blur better: no stated error is below what it does to depth

Array = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Reading:
    """What the photograph says at the cells of the copy that was read, with the camera at that copy's size.

    ``depth_m`` is the answer of both hypotheses together, ``other_m`` the less likely one: NaN where blur is too strong
    for a far one by more than two standard deviations (beyond focus x stays below 1). ``error`` is that of depth,
    relative: ``NO_ANSWER`` where blur, depth or the error itself is beyond what the model knows. ``blur_px`` is in
    pixels of the photograph.
    """

    depth_m: Array
    other_m: Array
    p_near: Array
    error: Array
    blur_px: Array
    camera: Camera
    scale: float
    ratio: Ratio

    @classmethod
    def of(
        cls,
        maps: RawMaps,
        camera: Camera,
        photograph_size: tuple[int, int],
        manifest: Manifest,
        side: Side,
        most_blur_px: float,
    ) -> Self:
        """``photograph_size`` is (height, width). The maps are taken over and written over: they may be large.

        Where the side is given its hypothesis is the answer, or nothing where no far one can exist; nothing of blur
        over ``most_blur_px``. No error is stated below the floor of optics, nor beyond focus below what blur's makes.
        """
        blur_px, p_near = maps["blur_px"], maps["p_near"]
        depth_m, other_m, error = maps["log_ratio_near"], maps["log_ratio_far"], maps["log_scale"]
        focus_m, scale = np.float32(camera.focus_distance_m), camera.image_width_px / photograph_size[1]
        infinitely_far_px = thin_lens.blur_from_defocus(camera.k_cam_px, camera.gamma_px)
        nearest, farthest = manifest.ranges.depth_ratio
        if side != "auto":
            p_near.fill(side == "near")
        for rows in bands(blur_px.shape):
            blur_error = SIGMA_OF_LAPLACE * np.clip(exp(maps["blur_log_error"][rows]), *BLUR_ERROR_RANGE)
            has_far = blur_px[rows] * exp(-2 * blur_error) < infinitely_far_px
            near_m = exp(depth_m[rows]) * focus_m
            far_m = where(has_far, exp(other_m[rows]) * focus_m, near_m)
            if side != "far":
                p_near[rows] = where(has_far, p_near[rows], 1)
            own = stated_error(error[rows], camera, manifest)
            answer_m, deviation, is_far = merged(near_m, far_m, p_near[rows], own)
            by_blur = _by_blur(answer_m, blur_px[rows], blur_error, camera)
            deviation = where(is_far, np.maximum(deviation, by_blur), deviation)
            least = least_error(answer_m, camera)
            is_known = (np.fmax(own, least) <= MAX_RELATIVE_ERROR) & (blur_px[rows] <= most_blur_px)
            is_known &= (nearest * focus_m <= answer_m) & (answer_m <= farthest * focus_m)
            is_known &= has_far | (side != "far")
            depth_m[rows] = answer_m
            other_m[rows] = where(is_far, near_m, where(has_far, far_m, np.nan))
            error[rows] = where(is_known, np.minimum(np.maximum(deviation, least), MOST_STATED), NO_ANSWER)
        return cls(
            depth_m,
            other_m,
            p_near,
            error,
            np.divide(blur_px, np.float32(scale), out=blur_px),
            camera,
            scale,
            Ratio.between(photograph_size, (camera.image_height_px, camera.image_width_px), manifest.stride),
        )

    def leave_out(self, hidden: NDArray[np.bool_]) -> None:
        """Answer nothing in cells whose middles are hidden pixels [height, width] of what was read, in place."""
        self.error[Lines.spread(hidden.shape, self.error.shape).of(hidden)] = NO_ANSWER

    def at_focus(self, focus_distance_m: float, farthest_m: float) -> "Reading":
        """What it is where the camera is focused there and blurs alike: depths and errors, none beyond ``farthest_m``.

        ``camera`` stays the one that was read by. A change of inverse depth is a larger part of a farther depth: errors
        are stated accordingly.
        """
        told_m = self.camera.focus_distance_m
        if focus_distance_m == told_m:
            return self
        # float32 is not exact enough about a focus distance that is many times the other; at infinity it divides by 0
        with np.errstate(divide="ignore"):
            depth_m, other_m = (
                thin_lens.depth_at_focus(values.astype(np.float64), told_m, focus_distance_m).astype(np.float32)
                for values in (self.depth_m, self.other_m)
            )
        is_seen, is_other = ((values > 0) & (values <= np.float32(farthest_m)) for values in (depth_m, other_m))
        error = np.minimum(self.error * (depth_m / self.depth_m), np.float32(MOST_STATED))
        return replace(
            self,
            depth_m=np.where(is_seen, depth_m, np.float32(farthest_m)),
            other_m=np.where(is_other, other_m, np.float32(np.nan)),
            error=np.where(is_seen & (self.error <= MAX_RELATIVE_ERROR), error, NO_ANSWER),
        )


def least_error(depth_m: Array, camera: Camera) -> Array:
    """The floor of optics: no relative error below it is stated of a depth."""
    per_metre = thin_lens.depth_error(1.0, camera.focus_distance_m, camera.k_cam_px, LEAST_BLUR_ERROR_PX)
    return np.float32(per_metre) * depth_m


def _by_blur(depth_m: Array, blur_px: Array, blur_error: Array, camera: Camera) -> Array:
    """The relative error of depth that one of blur, relative too, makes on either side of focus.

    Beyond it, where x nears 1 and blur tells less and less, the depth graph states too little by itself.
    """
    k_cam_px = camera.k_cam_px
    spread_px = thin_lens.relative_defocus_spread(blur_px, blur_error, camera.gamma_px, k_cam_px) * k_cam_px
    return np.asarray(thin_lens.depth_error(depth_m, camera.focus_distance_m, k_cam_px, spread_px) / depth_m)


def stated_error(log_scale: Array, camera: Camera, manifest: Manifest) -> Array:
    """The relative standard deviation that the depth graph states of either hypothesis by its ``log_scale``.

    Below those k_cam that the model knows it is the larger, as what blur tells is the less.
    """
    times = manifest.temperature * max(1.0, manifest.ranges.k_cam_px.low / camera.k_cam_px)
    return exp(log_scale) * (SIGMA_OF_LAPLACE * np.float32(times))


@dataclass(frozen=True, slots=True)
class Layers:
    """The float maps of a photograph, or of some of its rows."""

    depth_m: Array
    depth_alt_m: Array
    p_near: Array
    sigma_m: Array
    blur_px: Array


@dataclass(frozen=True)
class DepthMap:
    """Maps [height, width] of the upright photograph, in metres along the optical axis if not said otherwise.

    ``depth_m`` and ``sigma_m`` are NaN where there is no answer (``valid`` is false), ``depth_alt_m`` there
    and where no other hypothesis exists. ``p_near`` is 0..1; ``blur_px`` is in pixels of the photograph.
    Maps but ``depth_m`` come from ``layers_at`` some lines, when first asked for: most answers need none of them.
    ``camera`` is the one used, at the photograph's size; ``scales`` are the copies read, 1 being full size.
    """

    depth_m: Array
    valid: NDArray[np.bool_]
    layers_at: Callable[[Lines], Layers]
    camera: Camera
    scales: tuple[float, ...]
    warnings: tuple[str, ...]
    timings_ms: Mapping[str, float]

    @cached_property
    def _layers(self) -> Layers:
        return self.layers_at(Lines.between(0, self.height_px, 0, self.width_px))

    @property
    def depth_alt_m(self) -> Array:
        return self._layers.depth_alt_m

    @property
    def p_near(self) -> Array:
        return self._layers.p_near

    @property
    def sigma_m(self) -> Array:
        return self._layers.sigma_m

    @property
    def blur_px(self) -> Array:
        return self._layers.blur_px

    @property
    def width_px(self) -> int:
        return int(self.depth_m.shape[1])

    @property
    def height_px(self) -> int:
        return int(self.depth_m.shape[0])

    def cut(self, part: Part) -> "DepthMap":
        """The maps of a part alone, with the camera behind it."""
        lines = Lines.between(part.top, part.bottom, part.left, part.right)
        maps = part.of(self.depth_m), part.of(self.valid)
        return self._at(lines, maps, part.behind(self.camera))

    def shrunk(self, longest_px: int) -> "DepthMap":
        """Of larger maps those pixels in which a smaller copy's have their centres, with the camera behind the copy.

        ``blur_px`` stays in pixels of the photograph.
        """
        whole = self.height_px, self.width_px
        size = shrunk_size(whole, longest_px)
        if size == whole:
            return self
        lines = Lines.spread(whole, size)
        maps = lines.of(self.depth_m), lines.of(self.valid)
        return self._at(lines, maps, self.camera.resized(size[1], size[0]))

    def _at(self, lines: Lines, maps: tuple[Array, NDArray[np.bool_]], camera: Camera) -> "DepthMap":
        depth_m, valid = maps
        return replace(
            self,
            depth_m=depth_m,
            valid=valid,
            layers_at=lambda some: self.layers_at(some.within(lines)),
            camera=camera,
        )

    @property
    def valid_fraction(self) -> float:
        return fraction(self.valid)


def fraction(where: NDArray[np.bool_]) -> float:
    """How much of a map that is, counted: NumPy's mean makes numbers of it first."""
    return np.count_nonzero(where) / where.size


def decide(reading: Reading, size: tuple[int, int]) -> tuple[Array, NDArray[np.bool_]]:
    """Depth (height, width) and which pixels have an answer."""
    depth_m, valid = np.empty(size, np.float32), np.empty(size, np.bool_)
    for rows in bands(size, WHOLE_PX):
        sampled_m, error = _sampled(reading, rows, size[1], "depth_m", "error")
        np.less_equal(error, MAX_RELATIVE_ERROR, out=valid[rows])
        depth_m[rows] = np.nan
        cv2.copyTo(sampled_m, valid[rows].view(np.uint8), depth_m[rows])
    return depth_m, valid


def layers_at(reading: Reading, width: int, lines: Lines) -> Layers:
    """All maps at some pixels of a photograph so many of them wide."""
    size, columns = (len(lines.rows), len(lines.columns)), lines.columns
    # side by side they are no copy
    is_side_by_side = columns[-1] - columns[0] + 1 == len(columns)
    across = slice(columns[0], columns[-1] + 1) if is_side_by_side else columns
    layers = Layers(*(np.empty(size, np.float32) for _ in Layers.__slots__))
    for rows in bands(size):
        sampled = _sampled(reading, lines.rows[rows], width, "error", "depth_m", "other_m", "p_near", "blur_px")
        error, *maps = (values[:, across] for values in sampled)
        layers.depth_m[rows], layers.depth_alt_m[rows], layers.p_near[rows], layers.blur_px[rows] = maps
        layers.sigma_m[rows] = in_metres(error) * maps[0]
        for hidden in (layers.depth_m, layers.depth_alt_m, layers.sigma_m):
            hidden[rows][error > MAX_RELATIVE_ERROR] = np.nan
    return layers


def _sampled(reading: Reading, rows: slice | NDArray[np.intp], width: int, *names: str) -> list[Array]:
    return [sample(getattr(reading, name), reading.ratio, rows, width) for name in names]
