"""Blur of one printed disc's edge: a robust fit of the whole picture of a blurred ellipse, in linear light.

The disc's blurred picture is known exactly for a circle: under a Gaussian it is the chance that a point scattered
about a pixel falls inside (a noncentral chi-square law), under a uniform disc it is the overlap of two circles. An
ellipse is taken for a circle at the same distance from its edge. The blur found is the total lambda, in which the
pixel's own box and all else that is gamma has its part.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import chndtr, ndtr

Shape = Literal["gaussian", "disc"]
Array = NDArray[np.float64]

SOFTNESS_PX = 0.6  # of a disc's rim: pixel, demosaic and diffraction are no disc
STRAIGHT_FROM = 12.0  # radii in sigmas from which an edge's curvature no longer shows
REACH_RADII = 1.9
LEAST_RADIUS_PX = 4.0
LEAST_CONTRAST = 0.08
MOST_RESIDUAL = 0.1
MOST_STRETCH = 2.5
PROFILE_POINTS = 512
CLEARLY = 0.9  # a small blur looks alike under both, and the Gaussian is then nearer to what pixels do
ROBUST_SCALE = 0.02
PARAMETERS = ("x", "y", "log_radius", "stretch", "slant", "log_blur", "contrast", "white", "white_x", "white_y")


class EdgeError(Exception):
    """Why a disc's edge cannot be measured, in words for the user."""


@dataclass(frozen=True, slots=True)
class EdgeFit:
    """One disc: centre and mean radius in px, semi-axes, and lambda with its standard error, all in px.

    ``contrast`` is the part of the light that the black takes away; ``residual`` is the rms of what the fit leaves,
    as a part of the white.
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


def fit_edge(light: NDArray[np.float32], x_px: float, y_px: float, radius_px: float) -> EdgeFit:
    """Measure the dark disc near (x, y) of a picture [h,w] in linear light; the better of both point spreads.

    ``radius_px`` is about that of the disc. Raises ``EdgeError`` for one that is too small, cut off by the border,
    too faint, or unlike a blurred disc.
    """
    patch, left, top = _patch(light, x_px, y_px, radius_px)
    start = _start(patch, x_px - left, y_px - top, radius_px)
    gaussian, disc = _fitted(patch, start, "gaussian"), _fitted(patch, start, "disc")
    best = disc if disc.residual < CLEARLY * gaussian.residual else gaussian
    _check(best, radius_px)
    return replace(best, x_px=best.x_px + left, y_px=best.y_px + top)


def _patch(light: NDArray[np.float32], x_px: float, y_px: float, radius_px: float) -> tuple[Array, int, int]:
    if radius_px < LEAST_RADIUS_PX:
        raise EdgeError(f"the circle is {2 * radius_px:.1f} px across, too small: {2 * LEAST_RADIUS_PX:g} are needed")
    reach = REACH_RADII * radius_px
    left, right = math.floor(x_px - reach), math.ceil(x_px + reach) + 1
    top, bottom = math.floor(y_px - reach), math.ceil(y_px + reach) + 1
    if left < 0 or top < 0 or bottom > light.shape[0] or right > light.shape[1]:
        raise EdgeError("the circle is too near the border of the picture")
    return np.asarray(light[top:bottom, left:right], np.float64), left, top


def _start(patch: Array, x: float, y: float, radius: float) -> Array:
    white = float(np.quantile(patch, 0.95))
    if white <= 0:
        raise EdgeError("there is no light around the circle")
    black = float(np.quantile(patch, 0.05))
    contrast = min(max(1 - black / white, 0.02), 0.999)
    return np.array([x, y, math.log(radius), 0, 0, math.log(0.15 * radius), contrast, white, 0, 0])


def _fitted(patch: Array, start: Array, shape: Shape) -> EdgeFit:
    places: Array = np.indices(patch.shape, dtype=np.float64)
    white = start[7]

    def left_over(values: Array) -> Array:
        return np.asarray((_picture(values, places[1], places[0], shape) - patch) / white).ravel()

    span = max(patch.shape)
    low = np.array([0, 0, math.log(2), -0.8, -0.8, math.log(0.15), 0.0, 0.2 * white, -white, -white])
    high = np.array([span, span, math.log(span), 0.8, 0.8, math.log(span / 3), 1.2, 3 * white, white, white])
    found = least_squares(
        left_over,
        np.clip(start, low + 1e-6, high - 1e-6),
        bounds=(low, high),
        x_scale=np.array([1, 1, 0.1, 0.1, 0.1, 0.2, 0.1, white, 0.1 * white, 0.1 * white]),
        loss="soft_l1",
        f_scale=ROBUST_SCALE,
        max_nfev=60,
    )
    values, rest = found.x, left_over(found.x)
    slopes: Array = np.asarray(found.jac, np.float64)
    spread = np.linalg.pinv(slopes.T @ slopes) * 2 * found.cost / max(rest.size - values.size, 1)
    blur_px = math.exp(values[5])
    radius = math.exp(values[2])
    axes = _semi_axes(radius, values[3], values[4])
    return EdgeFit(
        *(float(values[0]), float(values[1]), radius, axes, blur_px),
        blur_error_px=blur_px * math.sqrt(max(float(spread[5, 5]), 0.0)),
        shape=shape,
        contrast=float(values[6]),
        residual=float(np.sqrt(np.mean(rest**2))),
    )


def _semi_axes(radius: float, stretch: float, slant: float) -> tuple[float, float]:
    amount = min(math.hypot(stretch, slant), 0.99)
    return radius / math.sqrt(1 - amount), radius / math.sqrt(1 + amount)


def _picture(values: Array, columns: Array, rows: Array, shape: Shape) -> Array:
    """The light that the parameters (in the order of ``PARAMETERS``) make, over all pixels."""
    x, y, log_radius, stretch, slant, log_blur, contrast, white, white_x, white_y = values
    radius, blur_px = math.exp(log_radius), math.exp(log_blur)
    u, v = columns - x, rows - y
    # F = sqrt(w' M w) is 1 on the ellipse; (F - 1) / |grad F| is the distance to it, to first order
    across, along = ((1 + stretch) * u + slant * v) / radius, (slant * u + (1 - stretch) * v) / radius
    level = np.sqrt(np.maximum((across * u + along * v) / radius, 1e-12))
    slope = np.maximum(np.hypot(across, along) / (radius * level), 0.2 / radius)
    distance = (level - 1) / slope
    span = float(np.abs(distance).max()) + 1
    at = np.linspace(-min(span, radius), span, PROFILE_POINTS)
    inside = np.interp(distance, at, _profile(at, radius, blur_px, shape))
    side = max(columns.shape)
    return np.asarray((white + white_x * u / side + white_y * v / side) * (1 - contrast * inside))


def _profile(at: Array, radius: float, blur_px: float, shape: Shape) -> Array:
    """How much of a point spread at signed distance ``at`` from a circle's edge (outside positive) lies inside it."""
    if shape == "gaussian":
        return _gaussian_profile(at, radius, blur_px)
    rim = min(SOFTNESS_PX, 0.7 * blur_px)
    hard = _disc_profile(at, radius, 2 * math.sqrt(blur_px**2 - rim**2))
    step = at[1] - at[0]
    half = math.ceil(4 * rim / step)
    kernel = np.exp(-0.5 * (np.arange(-half, half + 1) * step / rim) ** 2)
    padded = np.pad(hard, half, mode="edge")
    return np.convolve(padded, kernel / kernel.sum(), mode="valid")


def _gaussian_profile(at: Array, radius: float, sigma: float) -> Array:
    if radius > STRAIGHT_FROM * sigma:
        return np.asarray(ndtr(-at / sigma - sigma / (2 * radius)))
    from_centre = np.maximum(radius + at, 0)
    return np.asarray(chndtr((radius / sigma) ** 2, 2, (from_centre / sigma) ** 2))


def _disc_profile(at: Array, radius: float, spread_radius: float) -> Array:
    """Area common to two circles, over that of the point spread."""
    apart = np.maximum(radius + at, 1e-9)
    r, s = radius, spread_radius
    with np.errstate(invalid="ignore"):
        a = np.arccos(np.clip((apart**2 + r**2 - s**2) / (2 * apart * r), -1, 1))
        b = np.arccos(np.clip((apart**2 + s**2 - r**2) / (2 * apart * s), -1, 1))
    common = r**2 * (a - np.sin(2 * a) / 2) + s**2 * (b - np.sin(2 * b) / 2)
    common = np.where(apart <= abs(r - s), math.pi * min(r, s) ** 2, np.where(apart >= r + s, 0, common))
    return common / (math.pi * s**2)


def _check(fit: EdgeFit, radius_px: float) -> None:
    if fit.contrast < LEAST_CONTRAST:
        raise EdgeError(f"the circle is too faint: it takes away {fit.contrast:.0%} of the light")
    if fit.residual > MOST_RESIDUAL:
        raise EdgeError("what is there does not look like a blurred circle")
    if not 1 / 1.6 < fit.radius_px / radius_px < 1.6 or fit.semi_axes_px[0] > MOST_STRETCH * fit.semi_axes_px[1]:
        raise EdgeError("what is there is not the circle that was looked for")
