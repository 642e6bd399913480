"""Blur of one printed disc's edge: a robust fit of the whole picture of a blurred ellipse, in linear light.

The disc's blurred picture is known exactly for a circle: under a Gaussian it is the chance that a point scattered
about a pixel falls inside (a noncentral chi-square law), under a uniform disc it is the overlap of two circles. An
ellipse is taken for a circle at the same distance from its edge. The blur found is the total lambda, in which the
pixel's own box and all else that is gamma has its part.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache, lru_cache

import numpy as np
from numpy.typing import NDArray

from service.calibration.numerics import (
    RectBivariateSpline,
    chndtr,
    correlate1d,
    least_squares,
    minimize_scalar,
    ndtr,
)
from service.calibration.report import Shape
from service.optics import thin_lens

Array = NDArray[np.float64]

ALL_RIM = 0.97  # softness over blur from which there is no disc left to see
STRAIGHT_BELOW = 1 / 12  # sigmas over radius: an edge's curvature no longer shows
WIDEST = 1.5
FAR_SIGMAS = 7.0
REACH_RADII = 1.9
LEAST_RADIUS_PX = 4.0
LEAST_CONTRAST = 0.08
MOST_RESIDUAL = 0.1
MOST_STRETCH = 2.5
MOST_SHIFT, OTHER_SIZE = 0.5, 1.6
OUTER_RADII, DARK, DARK_PART, ONE_SIDED = 1.4, 0.7, 0.05, 0.4  # white that ends: where, to what, how much, which way
PROFILE_POINTS = 256
BOX_SHOWS_BELOW_PX = 1.2  # a wider blur is as good as a Gaussian of its own width
LEAST_REST_PX = 0.1
PIXEL_BOX = ((-math.sqrt(0.15), 5 / 18), (0.0, 8 / 18), (math.sqrt(0.15), 5 / 18))  # the mean over a pixel by Gauss
MOST_PIXELS = 2500
ALIKE_BELOW_PX = 0.9
SMALL = 1e-3
NEIGHBOURS = np.array([[0, 1, -1, 0, 0], [0, 0, 0, 1, -1]])  # of log radius and log blur: what slopes are seen from
PRECISION = 1e-5
SLICE_LEVEL = 0.95
HALO = (1.5, 3.5)  # blurs from an edge, where sharpening leaves a ring
SPREAD_DISCS = 24
SPREAD_FROM = 1.4  # gammas of blur that tell shapes apart
SOFTNESS_BOUNDS, SOFTNESS_STEP = (0.5, 2.0), 0.03  # in gammas
CLEARLY = 0.9  # a small blur looks alike under both, and the Gaussian is then nearer to what pixels do
ROBUST_SCALE = 0.02
PARAMETERS = ("x", "y", "log_radius", "stretch", "slant", "log_blur", "contrast", "white", "white_x", "white_y")


class EdgeError(Exception):
    """Why a disc's edge cannot be measured, in words for the user."""


@dataclass(frozen=True, slots=True)
class PointSpread:
    """The shape of a camera's defocus; a disc's rim is a Gaussian of ``softness_px``."""

    shape: Shape
    softness_px: float = 0.6


@dataclass(frozen=True, slots=True)
class Patch:
    """Pixels about one disc: their light and places [n], within a square of ``side`` px whose corner is given."""

    light: NDArray[np.float32]
    columns: NDArray[np.int16]
    rows: NDArray[np.int16]
    side: int
    left: int
    top: int


@dataclass(frozen=True, slots=True)
class EdgeFit:
    """One disc: centre and mean radius in px, semi-axes, and lambda with its standard error, all in px.

    ``contrast`` is the part of the light that the black takes away; ``residual`` is the rms of what the fit leaves,
    as a part of the white. ``values`` are the parameters themselves, to begin from at the next disc, and ``patch`` the
    pixels, to fit again.
    """

    x_px: float
    y_px: float
    radius_px: float
    semi_axes_px: tuple[float, float]
    blur_px: float
    blur_error_px: float
    shape: Shape
    contrast: float
    residual: float
    values: tuple[float, ...] = field(repr=False)
    patch: Patch = field(repr=False)


def fit_edge(
    light: NDArray[np.float32], x_px: float, y_px: float, radius_px: float, like: EdgeFit | None = None
) -> EdgeFit:
    """Measure the dark disc near (x, y) of a picture [h,w] in linear light; the better of both point spreads.

    ``radius_px`` is about that of the disc; ``like``, another disc of the picture, is where to begin. Raises
    ``EdgeError`` for one that is too small, cut off by the border, too faint, or unlike a blurred disc.
    """
    patch = _patch(light, x_px, y_px, radius_px)
    start = _start(patch, x_px - patch.left, y_px - patch.top, radius_px)
    if like is not None:
        start[2:7] = like.values[2:7]
    best = _fitted(patch, start, PointSpread("gaussian"))
    if best.blur_px > ALIKE_BELOW_PX:
        disc = _fitted(patch, np.array(best.values), PointSpread("disc"))
        best = disc if disc.residual < CLEARLY * best.residual else best
    _check(best, x_px, y_px, radius_px)
    return best


def fit_again(edge: EdgeFit, spread: PointSpread) -> EdgeFit:
    """The same disc under a point spread that is known for its camera.

    Small blur, which looks alike under all, is right only under the right one: a wrong one costs up to 8 %.
    """
    return _fitted(edge.patch, np.array(edge.values), spread)


def find_spread(edges: Sequence[EdgeFit], gamma_px: float, tick: Callable[[], None]) -> PointSpread:
    """The point spread that fits the most blurred of a camera's discs best; a Gaussian if none is clearly blurred.

    A lens's disc is about as soft as gamma, in focus or not. ``tick`` is called now and then.
    """
    blurred = sorted(edges, key=lambda edge: edge.blur_px)[-SPREAD_DISCS:]
    blurred = [edge for edge in blurred if edge.blur_px > SPREAD_FROM * gamma_px]

    def left_over(spread: PointSpread) -> float:
        tick()
        return sum(math.log(max(fit_again(edge, spread).residual, 1e-9)) for edge in blurred)

    def of_disc(softness: float) -> float:
        return left_over(PointSpread("disc", softness * gamma_px))

    best = minimize_scalar(of_disc, bounds=SOFTNESS_BOUNDS, method="bounded", options={"xatol": SOFTNESS_STEP})
    is_disc = best.fun < left_over(PointSpread("gaussian"))
    return PointSpread("disc", float(best.x) * gamma_px) if is_disc else PointSpread("gaussian")


def halo(edge: EdgeFit, spread: PointSpread) -> float:
    """How much brighter a ring of paper right around the disc is than the fit has it, as a part of the contrast."""
    values, patch = np.array(edge.values), edge.patch
    distance, _ = _distance(patch.columns - values[0], patch.rows - values[1], edge.radius_px, *values[3:5].tolist())
    ring = (distance > HALO[0] * edge.blur_px) & (distance < HALO[1] * edge.blur_px)
    rest = (patch.light - _picture(values, patch, spread)[0])[ring]
    return float(rest.mean() / (values[7] * edge.contrast)) if rest.size else 0.0


def slice_blur(light: NDArray[np.float32], x_px: float, y_px: float, radius_px: float) -> float:
    """The paper's estimate of lambda (eq. 9), for comparison: it reads 1.329 lambda, and higher with noise.

    A horizontal slice through the disc's middle is scaled to 0..1 (the disc being 1); what is below 0.95 is taken for
    two halves of a Gaussian, whose integral is lambda sqrt(2 pi). It is half of two error functions, of 1.6657 lambda
    each. Raises ``EdgeError`` for a disc at the border, or for none.
    """
    reach = REACH_RADII * radius_px
    left, right, row = math.floor(x_px - reach), math.ceil(x_px + reach) + 1, round(y_px)
    if left < 0 or right > light.shape[1] or not 0 <= row < light.shape[0]:
        raise EdgeError("the circle is too near the border of the picture")
    along = np.asarray(light[row, left:right], np.float64)
    span = float(np.ptp(along))
    if span <= 0:
        raise EdgeError("there is no circle in the slice")
    scaled = (along.max() - along) / span
    return float(scaled[scaled < SLICE_LEVEL].sum()) / math.sqrt(2 * math.pi)


def _patch(light: NDArray[np.float32], x_px: float, y_px: float, radius_px: float) -> Patch:
    if radius_px < LEAST_RADIUS_PX:
        raise EdgeError(f"the circle is {2 * radius_px:.1f} px across, too small: {2 * LEAST_RADIUS_PX:g} are needed")
    reach = REACH_RADII * radius_px
    left, right = math.floor(x_px - reach), math.ceil(x_px + reach) + 1
    top, bottom = math.floor(y_px - reach), math.ceil(y_px + reach) + 1
    if left < 0 or top < 0 or bottom > light.shape[0] or right > light.shape[1]:
        raise EdgeError("the circle is too near the border of the picture")
    square = np.asarray(light[top:bottom, left:right], np.float64)
    rows, columns = (np.asarray(places, np.float64).ravel() for places in np.indices(square.shape))
    round_ = np.hypot(columns + left - x_px, rows + top - y_px) <= reach
    chosen = np.flatnonzero(round_)
    if chosen.size > MOST_PIXELS:  # evenly over the disc: any fixed step of pixels would fall in with their rows
        chosen = np.random.default_rng(0).choice(chosen, MOST_PIXELS, replace=False)
    return Patch(
        np.asarray(square.ravel()[chosen], np.float32),
        columns[chosen].astype(np.int16),
        rows[chosen].astype(np.int16),
        max(square.shape),
        left,
        top,
    )


def _start(patch: Patch, x: float, y: float, radius: float) -> Array:
    white = float(np.quantile(patch.light, 0.95))
    if white <= 0:
        raise EdgeError("there is no light around the circle")
    black = float(np.quantile(patch.light, 0.05))
    contrast = min(max(1 - black / white, 0.02), 0.999)
    return np.array([x, y, math.log(radius), 0, 0, math.log(0.15 * radius), contrast, white, 0, 0])


def _fitted(patch: Patch, start: Array, spread: PointSpread) -> EdgeFit:
    white, span = start[7], patch.side
    # no circle is blacker than black: where it may be, it and the spread of a disc change roles
    low = np.array([0, 0, math.log(2), -0.8, -0.8, math.log(0.15), 0.0, 0.2 * white, -white, -white])
    high = np.array([span, span, math.log(span), 0.8, 0.8, math.log(span / 3), 1.0, 3 * white, white, white])

    @lru_cache(maxsize=2)
    def picture(values: bytes) -> tuple[Array, Array]:
        return _picture(np.frombuffer(values), patch, spread)

    def left_over(values: Array) -> Array:
        return np.asarray((picture(values.tobytes())[0] - patch.light) / white)

    def slopes(values: Array) -> Array:
        return np.asarray(picture(values.tobytes())[1] / white)

    found = least_squares(
        left_over,
        np.clip(start, low + 1e-6, high - 1e-6),
        jac=slopes,
        bounds=(low, high),
        x_scale=np.array([1, 1, 0.1, 0.1, 0.1, 0.2, 0.1, white, 0.1 * white, 0.1 * white]),
        loss="soft_l1",
        f_scale=ROBUST_SCALE,
        xtol=PRECISION,
        ftol=PRECISION,
        max_nfev=60,
    )
    values, rest = found.x, left_over(found.x)
    at_end: Array = np.asarray(found.jac, np.float64)
    covariance = np.linalg.pinv(at_end.T @ at_end) * 2 * found.cost / max(rest.size - values.size, 1)
    blur_px = math.exp(values[5])
    radius = math.exp(values[2])
    axes = _semi_axes(radius, values[3], values[4])
    return EdgeFit(
        *(float(values[0]) + patch.left, float(values[1]) + patch.top, radius, axes, blur_px),
        blur_error_px=blur_px * math.sqrt(max(float(covariance[5, 5]), 0.0)),
        shape=spread.shape,
        contrast=float(values[6]),
        residual=float(np.sqrt(np.mean(rest**2))),
        values=tuple(values.tolist()),
        patch=patch,
    )


def _semi_axes(radius: float, stretch: float, slant: float) -> tuple[float, float]:
    amount = min(math.hypot(stretch, slant), 0.99)
    return radius / math.sqrt(1 - amount), radius / math.sqrt(1 + amount)


def _picture(values: Array, patch: Patch, spread: PointSpread) -> tuple[Array, Array]:
    """The light [n] that the parameters (in the order of ``PARAMETERS``) make, and its slopes [n, parameters]."""
    x, y, log_radius, stretch, slant, log_blur, contrast, white, white_x, white_y = values
    radius = math.exp(log_radius)
    u, v = patch.columns - x, patch.rows - y
    distance, by_shape = _distance(u, v, radius, stretch, slant)
    far = FAR_SIGMAS * math.exp(log_blur) + 1
    at = np.linspace(-min(float(-distance.min()) + 1, radius, far), min(float(distance.max()) + 1, far), PROFILE_POINTS)

    radii, blurs = np.exp([[log_radius], [log_blur]] + SMALL * NEIGHBOURS)
    middle, larger, smaller, wider, narrower = _profiles(at, radii, blurs, spread)
    by_radius, by_blur = (larger - smaller) / (2 * SMALL), (wider - narrower) / (2 * SMALL)
    columns = np.stack([middle, np.gradient(middle, at[1] - at[0]), by_radius, by_blur], 1)
    place = np.clip((distance - at[0]) / (at[1] - at[0]), 0, PROFILE_POINTS - 1.001)
    before = place.astype(np.intp)
    part = (place - before)[:, None]
    inside, steepness, by_radius, by_blur = (columns[before] * (1 - part) + columns[before + 1] * part).T
    paper = white + (white_x * u + white_y * v) / patch.side
    dark = paper * -contrast
    slopes = np.empty((len(PARAMETERS), u.size))
    slopes[:5] = dark * steepness * by_shape
    slopes[2] += dark * by_radius
    slopes[5] = dark * by_blur
    slopes[6] = -paper * inside
    lit = 1 - contrast * inside
    slopes[0] -= white_x / patch.side * lit
    slopes[1] -= white_y / patch.side * lit
    slopes[7], slopes[8], slopes[9] = lit, lit * u / patch.side, lit * v / patch.side
    return paper * lit, slopes.T


def _distance(u: Array, v: Array, radius: float, stretch: float, slant: float) -> tuple[Array, Array]:
    """Signed distance [n] from the ellipse w' M w = 1, to first order, and its slopes [5, n]: x, y, log radius, shape.

    With F = sqrt(w' M w), which is 1 on the ellipse, it is (F - 1) / |grad F|.
    """
    m_x = ((1 + stretch) * u + slant * v) / radius**2
    m_y = (slant * u + (1 - stretch) * v) / radius**2
    square = np.maximum(u * m_x + v * m_y, 1e-9)
    level, length = np.sqrt(square), np.maximum(np.hypot(m_x, m_y), 1e-9)
    slope = length / level
    distance = (level - 1) / slope
    by_shape = np.empty((5, u.size))
    changes: tuple[tuple[Array, Array | float, Array | float], ...] = (  # of w' M w, and of M w
        (-2 * m_x, -(1 + stretch) / radius**2, -slant / radius**2),
        (-2 * m_y, -slant / radius**2, -(1 - stretch) / radius**2),
        (-2 * square, -2 * m_x, -2 * m_y),
        ((u**2 - v**2) / radius**2, u / radius**2, -v / radius**2),
        (2 * u * v / radius**2, v / radius**2, u / radius**2),
    )
    for i, (of_square, of_x, of_y) in enumerate(changes):
        of_level = of_square / (2 * level)
        of_slope = (m_x * of_x + m_y * of_y) / (length * level) - length * of_level / square
        by_shape[i] = of_level / slope - distance * of_slope / slope
    return distance, by_shape


def _profiles(at: Array, radius: Array, blur_px: Array, spread: PointSpread) -> Array:
    """How much of point spreads at signed distance ``at`` [n] from circles' edges (outside positive) is inside: [k, n].

    Those are nearly alike: the first says which law is asked.
    """
    radius, blur_px = radius[:, None], blur_px[:, None]
    rim = min(spread.softness_px, float(blur_px[0, 0]))
    if spread.shape == "gaussian" or rim > ALL_RIM * blur_px[0, 0]:
        if blur_px[0, 0] > BOX_SHOWS_BELOW_PX:
            return _gaussian_profiles(at, radius, blur_px)
        rest_px = np.sqrt(np.maximum(blur_px**2 - thin_lens.PIXEL_BOX_VARIANCE, LEAST_REST_PX**2))
        parts = [weight * _gaussian_profiles(at + place, radius, rest_px) for place, weight in PIXEL_BOX]
        return np.asarray(sum(parts))
    hard = _disc_profiles(at, radius, 2 * np.sqrt(blur_px**2 - rim**2))
    step = at[1] - at[0]
    inwards = rim**2 / (2 * radius[0, 0])  # an edge's middle, by a Gaussian of a circle's edge
    half = math.ceil((4 * rim + inwards) / step)
    kernel = np.exp(-0.5 * ((np.arange(-half, half + 1) * step - inwards) / rim) ** 2)
    return np.asarray(correlate1d(hard, kernel / kernel.sum(), mode="nearest"))


def _gaussian_profiles(at: Array, radius: Array, sigma: Array) -> Array:
    ratio = sigma / radius
    if ratio[0, 0] < STRAIGHT_BELOW:
        return np.asarray(ndtr(-at / sigma - ratio / 2))
    within = np.clip(at, np.maximum(-radius, -FAR_SIGMAS * sigma), FAR_SIGMAS * sigma) / sigma
    return np.asarray(_gaussian_table().ev(within, np.minimum(ratio, WIDEST)))


@cache
def _gaussian_table() -> RectBivariateSpline:
    """How much of a Gaussian at t sigmas from a circle's edge lies inside it, over t and sigma over the radius."""
    t = np.linspace(-FAR_SIGMAS, FAR_SIGMAS, 141)
    ratio = np.geomspace(0.9 * STRAIGHT_BELOW, WIDEST, 40)
    from_centre = np.maximum(1 / ratio + t[:, None], 0)
    return RectBivariateSpline(t, ratio, chndtr(1 / ratio**2, 2, from_centre**2))


def _disc_profiles(at: Array, radius: Array, spread_radius: Array) -> Array:
    """Area common to two circles, over that of the point spread."""
    apart = np.maximum(radius + at, 1e-9)
    r, s = radius, spread_radius
    with np.errstate(invalid="ignore"):
        a = np.arccos(np.clip((apart**2 + r**2 - s**2) / (2 * apart * r), -1, 1))
        b = np.arccos(np.clip((apart**2 + s**2 - r**2) / (2 * apart * s), -1, 1))
    common = r**2 * (a - np.sin(2 * a) / 2) + s**2 * (b - np.sin(2 * b) / 2)
    common = np.where(apart <= abs(r - s), math.pi * np.minimum(r, s) ** 2, np.where(apart >= r + s, 0, common))
    return np.asarray(common / (math.pi * s**2))


def _check(fit: EdgeFit, x_px: float, y_px: float, radius_px: float) -> None:
    if fit.contrast < LEAST_CONTRAST:
        raise EdgeError(f"the circle is too faint: it takes away {fit.contrast:.0%} of the light")
    if fit.residual > MOST_RESIDUAL:
        if _is_dark_beside(fit):
            raise EdgeError("the paper ends too near the circle: leave a white margin of a circle's diameter")
        raise EdgeError("what is there does not look like a blurred circle")
    if fit.semi_axes_px[0] > MOST_STRETCH * fit.semi_axes_px[1]:
        raise EdgeError("the sheet is too tilted: the circle is seen as a narrow ellipse")
    if math.dist((fit.x_px, fit.y_px), (x_px, y_px)) > MOST_SHIFT * radius_px:
        raise EdgeError("what is there is not the circle that was looked for")
    if not 1 / OTHER_SIZE < fit.radius_px / radius_px < OTHER_SIZE:
        raise EdgeError("the circle there is of quite another size than spacing_mm and diameter_mm say: check both")


def _is_dark_beside(fit: EdgeFit) -> bool:
    """Whether what is about the disc is dark, on one side: paper that ends, where there should be white all around."""
    patch = fit.patch
    away = np.stack([patch.columns + patch.left - fit.x_px, patch.rows + patch.top - fit.y_px])
    distance = np.hypot(*away)
    is_outer = distance > OUTER_RADII * fit.radius_px
    is_dark = is_outer & (patch.light < DARK * np.quantile(patch.light, 0.9))
    if not is_dark.any() or is_dark.sum() < DARK_PART * is_outer.sum():
        return False
    towards = (away[:, is_dark] / distance[is_dark]).mean(1)
    return bool(np.hypot(*towards) > ONE_SIDED)
