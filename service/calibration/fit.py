"""Blur of many circles at known depths to the camera's constants: lambda^2 = gamma^2 + k_cam^2 (s1/z - 1)^2.

Circles of a picture that was focused on the sheet itself show gamma alone.

With depths on both sides of the plane in focus all three are found together; from one side, or from one distance,
they trade against each other, and the intervals and warnings say so.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from service.calibration.numerics import least_squares, stdtrit
from service.calibration.report import CurvePoint, Interval
from service.metres import in_words
from service.optics import thin_lens

Array = NDArray[np.float64]

LEAST_CIRCLES = 4
FLOOR_PX = 0.02
FLOOR_PART = 0.02
RESAMPLES = 200
# as simulated lenses show them: of all blur, and more for every doubling of it, of gamma, of the focus distance; and of
# one picture's blur, and how it changes over a standard deviation of its depths
SHAPE_ERROR, TREND_ERROR, PIXEL_ERROR_PX, FOCUS_ERROR = 0.003, 0.005, 0.005, 5e-4
PICTURE_ERROR, SLOPE_ERROR = 0.005, 0.0015
PRIOR_PICTURES = 4  # that these count as, beside what the pictures at hand show of their own
MOST_SPAN = 10.0  # of an interval of k_cam, high over low: beyond, the pictures do not tell it
CONFIDENCE = 0.95
OUTLIER = 5.0
LOOSE = 0.2
BETTER = "lock the focus, and take more of them both nearer and farther than it"
CHECKS = 40  # resamples for what the circles say of a focus distance that is given
OFF, FAR_OFF = 1.02, 1.08  # of a focus distance that is given: from where it is warned of, and from where refused
UNCHECKED = (
    "all circles are on one side of the plane in focus, where they do not check focus_distance_m: k_cam_px is off by "
    "twice as much as that is, or more; photograph both sides"
)
CURVE_POINTS, CURVE_BEYOND = 60, 1.05
FENCE = 1.5  # quartile ranges beyond the quartiles: outliers as a box plot has them
# from where on a circle tells k_cam alone: so far from focus, or by a large k_cam so clearly blurred (in gamma)
LEAST_EXCESS, CLEARLY_BLURRED = 0.05, 3.0
MISFIT = 0.1
MUST_SHOW = 0.5  # of gamma, that the largest defocus must reach
GAMMA_BOUNDS_PX = (0.02, 20.0)
K_CAM_BOUNDS_PX = (1e-6, 2000.0)  # of a lens focused at infinity next to nothing
FOCUS_REACH = 300.0  # times the farthest sheet, and below the nearest: an interval must not end where a search does
FOCUS_STARTS = 9


class FitError(Exception):
    """Why no constants can be had from these circles, in words for the user."""


@dataclass(frozen=True, slots=True)
class Circles:
    """Measured circles, each array [n]: depth along the axis, lambda with its standard error, and which picture.

    ``is_focused`` marks those of pictures for which the lens was focused on the sheet.
    """

    depth_m: Array
    blur_px: Array
    blur_error_px: Array
    picture: NDArray[np.int64]
    is_focused: NDArray[np.bool_]

    def only(self, where: NDArray[np.int64] | NDArray[np.bool_]) -> "Circles":
        """Those at the given places."""
        return Circles(*(getattr(self, column.name)[where] for column in fields(self)))

    def excess(self, focus_m: float) -> Array:
        """|s1/z - 1|, 0 where the lens was focused on the sheet."""
        return np.where(self.is_focused, 0.0, thin_lens.relative_defocus(self.depth_m, focus_m))


Fit = Callable[[Circles, Array | None], Array]  # to constants, from others near by


@dataclass(frozen=True, slots=True)
class Constants:
    """What the circles say of the camera; ``is_outlier`` [n] marks circles that fit nothing, shown, not dropped."""

    k_cam_px: Interval
    gamma_px: Interval
    focus_distance_m: Interval
    rms_px: float
    is_outlier: NDArray[np.bool_]
    curve: tuple[CurvePoint, ...]
    warnings: tuple[str, ...]


def fit_constants(
    circles: Circles,
    focus_distance_m: float | None = None,
    *,
    depth_error: float = 0.0,
    resamples: int = RESAMPLES,
    tick: Callable[[], None] = lambda: None,
) -> Constants:
    """The constants with 95 % intervals by a parametric bootstrap; the focus distance is fitted unless given.

    ``depth_error`` is the relative standard error that all depths have in common, as from the focal length; without
    ``resamples`` the intervals have no width. ``tick`` is called now and then. Raises ``FitError`` for fewer than four
    circles, for circles that show no blur by defocus or surely another focus than the one given, and where k_cam may
    be more than ten times as much as not.
    """
    defocused = ~circles.is_focused
    if defocused.sum() < LEAST_CIRCLES:
        raise FitError(f"{defocused.sum()} defocused circles were measured; at least {LEAST_CIRCLES} are needed")

    def fit_at(focus_m: float | None, some: Circles, start: Array | None) -> Array:
        tick()
        return _fitted(some, focus_m, start)

    doubt = None
    if focus_distance_m is not None:
        doubt = _doubt(circles, focus_distance_m, partial(fit_at, None), depth_error)
    found = _constants(circles, partial(fit_at, focus_distance_m), focus_distance_m, depth_error, resamples)
    told, is_sure = doubt or ("", False)
    _check_span(found.k_cam_px, told if is_sure else "")
    return replace(found, warnings=(told, *found.warnings)) if told else found


def _check_span(k_cam: Interval, instead: str = "") -> None:
    """Constants that may be anything are none: ``FitError``, which says what else is to blame where that is known."""
    if k_cam.high <= MOST_SPAN * k_cam.low:
        return
    raise FitError(
        instead
        or f"k_cam_px may be anything from {k_cam.low:.2g} to {k_cam.high:.2g} by these photographs, which is no "
        f"calibration: {BETTER}, so far that the circles are clearly blurred; where the lens is focused too far away "
        "for that, focus it nearer, or give focus_distance_m"
    )


def _doubt(circles: Circles, given_m: float, fit: Fit, depth_error: float) -> tuple[str, bool] | None:
    """What circles say against a focus distance that was given, and whether they are sure: on both sides of it.

    ``FitError`` where they are, and it is quite another. On one side alone they may tell it none the less; where they
    do not, that is said.
    """
    best = fit(circles, None)
    depth_m = circles.depth_m[~circles.is_focused]
    is_sure = bool(depth_m.min() < best[2] < depth_m.max())
    drawn = _resampled(circles, fit, best, None, depth_error, CHECKS)
    k_cam, own = (_interval(best[i], drawn[:, i], _widening(circles)) for i in (0, 2))
    if max(k_cam.relative_width, own.relative_width) >= LOOSE:
        return None if is_sure else (UNCHECKED, False)
    if own.low / OFF <= given_m <= own.high * OFF:
        return None
    value, low, high = (in_words(depth_m, own.value) for depth_m in (own.value, own.low, own.high))
    told = (
        f"the photographs say {value} m ({low} to {high}), not the "
        f"{given_m:g} m given: check focus_distance_m, or leave it out, and the sheet's spacing"
    )
    if is_sure and not 1 / FAR_OFF < given_m / own.value < FAR_OFF:
        raise FitError(told)
    return told, is_sure


def odd_pictures(circles: Circles, constants: Constants) -> list[int]:
    """The pictures of which most circles are outliers, and as far off as no curve may be."""
    found = np.array([constants.k_cam_px.value, constants.gamma_px.value, constants.focus_distance_m.value])
    off = np.abs(blur_of(found, circles) / circles.blur_px - 1)
    return [
        int(picture)
        for picture in np.unique(circles.picture)
        if constants.is_outlier[circles.picture == picture].mean() > 1 / 2
        and float(np.median(off[circles.picture == picture])) > MISFIT
    ]


def fit_as_paper(circles: Circles, focus_distance_m: float, *, depth_error: float, resamples: int) -> Constants:
    """The paper's procedure: gamma from the focused pictures, k_cam of each defocused circle, outliers out, median.

    Raises ``FitError`` without focused and defocused circles, and where these show no blur by defocus, or hardly any.
    """
    if circles.is_focused.sum() < LEAST_CIRCLES or (~circles.is_focused).sum() < LEAST_CIRCLES:
        raise FitError("the paper's method needs circles of focused and of defocused pictures")

    def fit(some: Circles, start: Array | None) -> Array:
        sharp = some.blur_px[some.is_focused]
        gamma = float(np.median(sharp)) if sharp.size or start is None else float(start[1])
        k_cam = per_circle_k_cam(some, gamma, focus_distance_m)
        k_cam = k_cam[np.isfinite(k_cam)]
        if k_cam.size == 0:
            return np.array([math.nan, gamma, focus_distance_m]) if start is None else start
        low, high = np.quantile(k_cam, [0.25, 0.75])
        kept = k_cam[(k_cam >= low - FENCE * (high - low)) & (k_cam <= high + FENCE * (high - low))]
        return np.array([float(np.median(kept)), gamma, focus_distance_m])

    found = _constants(circles, fit, focus_distance_m, depth_error, resamples)
    _check_span(found.k_cam_px)
    return found


def per_circle_k_cam(circles: Circles, gamma_px: float, focus_m: float) -> Array:
    """What each circle alone says of k_cam [n]; NaN where it is focused, or too near the plane in focus."""
    excess = circles.excess(focus_m)
    sigma = thin_lens.defocus_from_blur(circles.blur_px, gamma_px)
    says = (excess > 0) & (sigma > 0) & ((excess > LEAST_EXCESS) | (sigma > CLEARLY_BLURRED * gamma_px))
    return np.divide(sigma, excess, out=np.full_like(sigma, np.nan), where=says)


def _constants(circles: Circles, fit: Fit, focus_m: float | None, depth_error: float, resamples: int) -> Constants:
    best = fit(circles, None)
    if not best[0] * circles.excess(best[2]).max() > MUST_SHOW * best[1]:
        raise FitError(
            "no circle is blurred by defocus: photograph the sheet well nearer and farther than the plane in focus, "
            "with the aperture open"
        )
    rest = _left_over(best, circles)
    scale = max(1.4826 * float(np.median(np.abs(rest))), 1e-6)
    drawn = _resampled(circles, fit, best, focus_m, depth_error, resamples) if resamples else best[None]
    widen = _widening(circles)
    k_cam, gamma, focus = (_interval(best[i], drawn[:, i], widen) for i in range(3))
    return Constants(
        k_cam_px=k_cam,
        gamma_px=gamma,
        focus_distance_m=focus,
        rms_px=float(np.sqrt(np.mean((blur_of(best, circles) - circles.blur_px) ** 2))),
        is_outlier=np.abs(rest) > OUTLIER * scale,
        curve=tuple(_curve(circles.depth_m, best, drawn, widen)),
        warnings=tuple(_warnings(circles, (k_cam, gamma, focus), is_focus_given=focus_m is not None)),
    )


def blur_of(constants: Array, circles: Circles) -> Array:
    """The blur [n] that k_cam, gamma and focus distance give the circles."""
    return np.asarray(thin_lens.blur_from_defocus(constants[0] * circles.excess(constants[2]), constants[1]))


def _left_over(constants: Array, circles: Circles) -> Array:
    error = np.sqrt(circles.blur_error_px**2 + FLOOR_PX**2 + (FLOOR_PART * circles.blur_px) ** 2)
    return np.asarray((blur_of(constants, circles) - circles.blur_px) / error)


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
    x = circles.excess(focus_m)
    sigma = thin_lens.defocus_from_blur(circles.blur_px, gamma)
    k_cam = float(np.median(sigma[x > np.median(x) / 2] / np.maximum(x[x > np.median(x) / 2], 1e-3)))
    return np.array([max(k_cam, 2 * K_CAM_BOUNDS_PX[0]), gamma, focus_m])


def _resampled(circles: Circles, fit: Fit, best: Array, focus_m: float | None, depth_error: float, count: int) -> Array:
    """Constants [count, 3] of pictures as the camera that was found might as well have given, always the same.

    Each has errors of its own, as large as pictures' are that one curve is laid through. What all have in common no
    picture shows: depths and blur are in doubt alike, gamma by what cannot be told from the pixel itself, and the focus
    distance unless it is given.
    """
    rng = np.random.default_rng(0)
    focus_error = 0.0 if focus_m is not None else FOCUS_ERROR
    shown = replace(circles, blur_px=blur_of(best, circles))
    _, number = np.unique(circles.picture, return_inverse=True)
    errors, offset = errors_of(circles, shown.blur_px, number)
    doublings = np.log2(shown.blur_px / np.median(shown.blur_px))
    rows = []
    for _ in range(count):
        depth, shape, trend = np.array([depth_error, SHAPE_ERROR, TREND_ERROR]) * rng.standard_normal(3)
        of_picture, slope = (error * rng.standard_normal(number.max() + 1)[number] for error in errors[:2])
        off = shape + trend * doublings + of_picture + slope * offset + errors[2] * rng.standard_normal(number.size)
        some = replace(shown, depth_m=shown.depth_m * math.exp(depth), blur_px=shown.blur_px * np.exp(off))
        row = fit(some, best).copy()
        row[1] += PIXEL_ERROR_PX * rng.standard_normal()
        row[2] *= 1 + focus_error * rng.standard_normal()
        rows.append(row)
    return np.array(rows)


def errors_of(circles: Circles, shown_px: Array, number: NDArray[np.int64]) -> tuple[tuple[float, float, float], Array]:
    """Relative errors of blur: of a picture's, of how it changes over its depths, of a circle's; and those depths [n].

    The depths are in standard deviations of each picture's. A curve that is laid through few pictures leaves none of
    their errors to see: simulated ones count as some more pictures.
    """
    rest = np.log(circles.blur_px / shown_px)
    offset, own = np.zeros_like(rest), np.zeros_like(rest)
    medians, slopes = [], []
    for picture in range(number.max() + 1):
        of_it = number == picture
        log_depth = np.log(circles.depth_m[of_it])
        offset[of_it] = (log_depth - log_depth.mean()) / max(float(log_depth.std()), 1e-6)
        medians.append(float(np.median(rest[of_it])))
        slopes.append(float(np.median((rest[of_it] - medians[-1]) * offset[of_it])))
        own[of_it] = rest[of_it] - medians[-1] - slopes[-1] * offset[of_it]
    picture_error, slope_error = (
        math.sqrt((PRIOR_PICTURES * usual**2 + float(np.square(seen).sum())) / _freedom(circles))
        for usual, seen in ((PICTURE_ERROR, medians), (SLOPE_ERROR, slopes))
    )
    return (picture_error, slope_error, 1.4826 * float(np.median(np.abs(own)))), offset


def _freedom(circles: Circles) -> int:
    return PRIOR_PICTURES + max(np.unique(circles.picture).size - 3, 0)


def _widening(circles: Circles) -> float:
    """Student's law over the normal one: the errors of pictures are known from few."""
    return float(stdtrit(_freedom(circles), (1 + CONFIDENCE) / 2) / 1.96)


def _interval(value: float, drawn: Array, widen: float) -> Interval:
    low, high = np.quantile(drawn, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Interval(
        float(value),
        float(max(value - widen * max(value - low, 0.0), 0.0)),
        float(value + widen * max(high - value, 0.0)),
    )


def _curve(depth_m: Array, best: Array, drawn: Array, widen: float) -> Iterator[CurvePoint]:
    """The fitted curve over the depths there are, a little beyond, at equal steps of 1/z."""
    near, far = float(depth_m.min()) / CURVE_BEYOND, float(depth_m.max()) * CURVE_BEYOND
    for z in 1 / np.linspace(1 / near, 1 / far, CURVE_POINTS):
        value = float(thin_lens.blur_at_depth(z, best[2], best[0], best[1]))
        interval = _interval(value, thin_lens.blur_at_depth(z, drawn[:, 2], drawn[:, 0], drawn[:, 1]), widen)
        yield CurvePoint(float(z), value, interval.low, interval.high)


def _warnings(circles: Circles, found: tuple[Interval, Interval, Interval], *, is_focus_given: bool) -> list[str]:
    k_cam, gamma, focus = found
    told = []
    if np.unique(circles.picture).size < 3:
        told.append("fewer than three pictures: the intervals rest on what simulated ones are off by")
    depth_m = circles.depth_m[~circles.is_focused]
    near, far = (depth_m < focus.value).any(), (depth_m > focus.value).any()
    if not is_focus_given and not (near and far):
        side = "nearer than" if near else "beyond"
        told.append(f"all circles are {side} the focus: photograph both sides, or give the focus distance")
    if max(k_cam.relative_width, focus.relative_width) > LOOSE:
        told.append(
            f"the pictures do not tell k_cam_px well, see its interval: {BETTER}"
            if is_focus_given
            else f"the pictures do not separate k_cam_px and focus_distance_m well, see their intervals: {BETTER}"
        )
    model = blur_of(np.array([k_cam.value, gamma.value, focus.value]), circles)
    off = float(np.median(np.abs(model / circles.blur_px - 1)))
    if off > MISFIT:
        told.append(
            f"no one curve fits: half of the circles are more than {off:.0%} off it; were all photographs taken by one "
            "camera, with focus, zoom and aperture locked?"
        )
    if k_cam.value * float(circles.excess(focus.value).max()) < gamma.value:
        told.append("little is blurred by defocus: move nearer or farther, or open the aperture")
    return told
