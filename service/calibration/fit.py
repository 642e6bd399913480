"""Blur of many circles at known depths to the camera's constants: lambda^2 = gamma^2 + k_cam^2 (s1/z - 1)^2.

With depths on both sides of the plane in focus all three are found together; from one side, or from one distance,
they trade against each other, and the intervals and warnings say so.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.stats import t as student

from service.optics import thin_lens

Array = NDArray[np.float64]

LEAST_CIRCLES = 4
FLOOR_PX = 0.02
FLOOR_PART = 0.02
RESAMPLES = 200
CONFIDENCE = 0.95
OUTLIER = 5.0
LOOSE = 0.2
GAMMA_BOUNDS_PX = (0.02, 20.0)
K_CAM_BOUNDS_PX = (0.01, 2000.0)
FOCUS_REACH = 3.0
FOCUS_STARTS = 9


class FitError(Exception):
    """Why no constants can be had from these circles, in words for the user."""


@dataclass(frozen=True, slots=True)
class Circles:
    """Measured circles, each array [n]: depth along the axis, lambda with its standard error, and which picture."""

    depth_m: Array
    blur_px: Array
    blur_error_px: Array
    picture: NDArray[np.int64]

    def only(self, where: NDArray[np.int64] | NDArray[np.bool_]) -> "Circles":
        """Those at the given places."""
        return Circles(self.depth_m[where], self.blur_px[where], self.blur_error_px[where], self.picture[where])


@dataclass(frozen=True, slots=True)
class Interval:
    """A value and where it lies with a confidence of 95 %."""

    value: float
    low: float
    high: float

    @property
    def relative_width(self) -> float:
        return (self.high - self.low) / self.value


@dataclass(frozen=True, slots=True)
class Constants:
    """What the circles say of the camera; ``is_outlier`` [n] marks circles that fit nothing, shown, not dropped."""

    k_cam_px: Interval
    gamma_px: Interval
    focus_distance_m: Interval
    rms_px: float
    is_outlier: NDArray[np.bool_]
    warnings: tuple[str, ...]


def fit_constants(
    circles: Circles, focus_distance_m: float | None = None, *, resamples: int = RESAMPLES, seed: int = 0
) -> Constants:
    """The constants with 95 % intervals by a bootstrap over pictures; the focus distance is fitted unless given.

    Raises ``FitError`` for fewer than four circles or for circles that show no blur to measure.
    """
    if circles.depth_m.size < LEAST_CIRCLES:
        raise FitError(f"{circles.depth_m.size} circles were measured; at least {LEAST_CIRCLES} are needed")
    best = _fitted(circles, focus_distance_m, None)
    rest = _left_over(best, circles)
    scale = max(1.4826 * float(np.median(np.abs(rest))), 1e-6)
    drawn = _resampled(circles, focus_distance_m, best, resamples, seed)
    pictures = np.unique(circles.picture).size
    widen = _widening(pictures if pictures > 1 else circles.depth_m.size)
    k_cam, gamma, focus = (_interval(best[i], drawn[:, i], widen) for i in range(3))
    model = thin_lens.blur_at_depth(circles.depth_m, best[2], best[0], best[1])
    return Constants(
        k_cam_px=k_cam,
        gamma_px=gamma,
        focus_distance_m=focus,
        rms_px=float(np.sqrt(np.mean((model - circles.blur_px) ** 2))),
        is_outlier=np.abs(rest) > OUTLIER * scale,
        warnings=tuple(_warnings(circles, (k_cam, gamma, focus), is_focus_given=focus_distance_m is not None)),
    )


def _left_over(constants: Array, circles: Circles) -> Array:
    k_cam_px, gamma_px, focus_m = constants
    model = thin_lens.blur_at_depth(circles.depth_m, focus_m, k_cam_px, gamma_px)
    error = np.sqrt(circles.blur_error_px**2 + FLOOR_PX**2 + (FLOOR_PART * circles.blur_px) ** 2)
    return np.asarray((model - circles.blur_px) / error)


def _fitted(circles: Circles, focus_m: float | None, start: Array | None) -> Array:
    """k_cam, gamma and focus distance with the least robust cost."""
    nearest, farthest = float(circles.depth_m.min()), float(circles.depth_m.max())
    if focus_m is not None:
        guesses = [focus_m]
    elif start is not None:
        guesses = [float(start[2])]
    else:
        guesses = np.geomspace(nearest / 1.5, farthest * 1.5, FOCUS_STARTS).tolist()
    low = np.log([K_CAM_BOUNDS_PX[0], GAMMA_BOUNDS_PX[0], nearest / FOCUS_REACH])
    high = np.log([K_CAM_BOUNDS_PX[1], GAMMA_BOUNDS_PX[1], farthest * FOCUS_REACH])
    free = 2 if focus_m is not None else 3
    found = []
    for guess in guesses:

        def rest(logs: Array, guess: float = guess) -> Array:
            return _left_over(np.exp(np.append(logs, math.log(guess)) if free == 2 else logs), circles)

        first = np.log(start) if start is not None else np.log(_start(circles, guess))
        first = np.clip(first[:free], low[:free] + 1e-9, high[:free] - 1e-9)
        fit = least_squares(rest, first, bounds=(low[:free], high[:free]), loss="soft_l1", max_nfev=200)
        constants = np.exp(np.append(fit.x, math.log(guess)) if free == 2 else fit.x)
        found.append((float(fit.cost), constants))
    return min(found, key=lambda pair: pair[0])[1]


def _start(circles: Circles, focus_m: float) -> Array:
    gamma = max(0.9 * float(circles.blur_px.min()), 2 * GAMMA_BOUNDS_PX[0])
    x = thin_lens.relative_defocus(circles.depth_m, focus_m)
    sigma = thin_lens.defocus_from_blur(circles.blur_px, gamma)
    k_cam = float(np.median(sigma[x > np.median(x) / 2] / np.maximum(x[x > np.median(x) / 2], 1e-3)))
    return np.array([max(k_cam, 2 * K_CAM_BOUNDS_PX[0]), gamma, focus_m])


def _resampled(circles: Circles, focus_m: float | None, best: Array, count: int, seed: int) -> Array:
    """Constants [count, 3] of pictures drawn with replacement (of circles, if there is one picture)."""
    rng = np.random.default_rng(seed)
    labels = np.unique(circles.picture)
    groups = [np.flatnonzero(circles.picture == label) for label in labels]
    if len(groups) == 1:
        groups = [np.array([i]) for i in range(circles.depth_m.size)]
    rows = []
    for _ in range(count):
        picked = rng.integers(0, len(groups), len(groups))
        rows.append(_fitted(circles.only(np.concatenate([groups[i] for i in picked])), focus_m, best))
    return np.array(rows)


def _widening(groups: int) -> float:
    """What a bootstrap over few groups is too narrow by."""
    return float(student.ppf((1 + CONFIDENCE) / 2, groups - 1) / 1.96 * math.sqrt(groups / (groups - 1)))


def _interval(value: float, drawn: Array, widen: float) -> Interval:
    low, high = np.quantile(drawn, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Interval(
        float(value),
        float(max(value - widen * max(value - low, 0.0), 0.0)),
        float(value + widen * max(high - value, 0.0)),
    )


def _warnings(circles: Circles, found: tuple[Interval, Interval, Interval], *, is_focus_given: bool) -> list[str]:
    k_cam, gamma, focus = found
    told = []
    if np.unique(circles.picture).size < 3:
        told.append("fewer than three pictures: the intervals are guesses")
    near, far = (circles.depth_m < focus.value).any(), (circles.depth_m > focus.value).any()
    if not is_focus_given and not (near and far):
        side = "nearer than" if near else "beyond"
        told.append(f"all circles are {side} the focus: photograph both sides, or give the focus distance")
    if max(k_cam.relative_width, focus.relative_width) > LOOSE:
        told.append("the pictures do not separate k_cam_px and focus_distance_m well: see their intervals")
    if k_cam.value * float(thin_lens.relative_defocus(circles.depth_m, focus.value).max()) < gamma.value:
        told.append("no circle is blurred clearly by defocus: move nearer or farther, or open the aperture")
    return told
