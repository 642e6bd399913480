"""The thin lens: distance to blur and back.

Everything here is written with ``+ - * / **`` and ``abs`` only, so one function serves a float, a NumPy
array and a torch tensor alike, element by element, and gradients flow through it; what takes a ``float`` is for
numbers alone. No array library is imported. Symbols, units and signs are those of ``docs/conventions.md``; "eq."
numbers are the paper's.
"""

import math
from typing import Any, Protocol, TypeVar


class Arithmetic(Protocol):
    """What passes through the formulas: float, ndarray and Tensor differ in their stubs, not in this."""

    def __add__(self, other: Any, /) -> Any: ...
    def __sub__(self, other: Any, /) -> Any: ...
    def __rsub__(self, other: Any, /) -> Any: ...
    def __mul__(self, other: Any, /) -> Any: ...
    def __rmul__(self, other: Any, /) -> Any: ...
    def __truediv__(self, other: Any, /) -> Any: ...
    def __rtruediv__(self, other: Any, /) -> Any: ...
    def __abs__(self) -> Any: ...


Q = TypeVar("Q", bound=Arithmetic)
K_R_OF_DISC = 4.0  # diameter of the circle of confusion over its standard deviation along an axis
SHRUNK_GAMMA_PX = 0.45  # as soft as pictures are that were made small, whatever made them so
PIXEL_BOX_VARIANCE = 1 / 12  # of a box one pixel wide, per axis, px^2


def k_cam(
    focal_length_m: float,
    f_number: float,
    focus_distance_m: float,
    pixel_pitch_m: float,
    width_ratio: float = 1.0,
    k_r: float = K_R_OF_DISC,
) -> float:
    """Blur in pixels per unit of relative defocus, from lens specs (eq. 2 and 3).

    ``width_ratio`` is image width over sensor width, in pixels: linear, never a pixel count.
    ``k_r`` turns the diameter of the circle of confusion into a standard deviation; a uniform disc has 4.
    Raises ``ValueError`` if the lens cannot focus there (f >= s1).
    """
    if focal_length_m >= focus_distance_m:
        raise ValueError("the focal length must be shorter than the focus distance")
    aperture_m = focal_length_m / f_number
    return aperture_m * focal_length_m / (focus_distance_m - focal_length_m) / pixel_pitch_m * width_ratio / k_r


def relative_defocus(depth_m: Q, focus_distance_m: Q | float) -> Q:
    """x = |s1 - z| / z, without unit: 0 in focus, unbounded nearer, below 1 beyond."""
    return abs(focus_distance_m - depth_m) / depth_m


def signed_defocus(depth_m: Q, focus_distance_m: Q | float) -> Q:
    """d = 1 - s1 / z: negative nearer than focus, 0 in focus, positive (below 1) beyond."""
    return (depth_m - focus_distance_m) / depth_m


def defocus_at_depth(depth_m: Q, focus_distance_m: Q | float, k_cam_px: Q | float) -> Q:
    """sigma in pixels of a point at depth z (eq. 3)."""
    return relative_defocus(depth_m, focus_distance_m) * k_cam_px


def blur_from_defocus(defocus_px: Q, gamma_px: Q | float) -> Q:
    """lambda = sqrt(sigma^2 + gamma^2) in pixels: what the image shows (eq. 5)."""
    return (defocus_px * defocus_px + gamma_px * gamma_px) ** 0.5


def averaging_variance(from_px: int, to_px: int) -> float:
    """What averaging areas, a side of ``from_px`` to ``to_px``, adds to blur's variance, in px^2 of the smaller copy.

    Its own pixel's box is not in it. A pixel that an area's border cuts counts in both areas: a sixth of the larger
    picture's px^2 on average over the places of borders, nothing where all borders lie between pixels.
    """
    places = to_px // math.gcd(from_px, to_px)
    return (1 - 1 / places**2) / 6 * (to_px / from_px) ** 2


def gamma_after_averaging(gamma_px: float, from_px: int, to_px: int) -> float:
    """gamma in pixels of a copy that averages areas, ``to_px`` wide of ``from_px``.

    gamma contains a pixel's box, which is a pixel wide in either; the rest of it scales.
    """
    rest = max(gamma_px**2 - PIXEL_BOX_VARIANCE, 0.0) * (to_px / from_px) ** 2
    return math.sqrt(rest + averaging_variance(from_px, to_px) + PIXEL_BOX_VARIANCE)


def gamma_after_shrinking(gamma_px: float, ratio: float) -> float:
    """gamma in pixels of a copy ``ratio`` (up to 1) of the size, made small by a filter that is not known.

    It is again as soft by the pixel as such copies are, as far as gamma was, and the rest of it scales. Measured, on
    photographs that box, bilinear, bicubic and Lanczos filters made two to six times as small (docs/findings.md).
    """
    own = min(SHRUNK_GAMMA_PX, gamma_px) ** 2
    return math.sqrt((gamma_px**2 - own) * ratio**2 + own)


def gamma_before_averaging(gamma_px: float, from_px: int, to_px: int) -> float:
    """gamma of the picture whose copy has ``gamma_px``; that of a pixel's box alone where none is so sharp."""
    rest = gamma_px**2 - averaging_variance(from_px, to_px) - PIXEL_BOX_VARIANCE
    return math.sqrt(max(rest, 0.0) * (from_px / to_px) ** 2 + PIXEL_BOX_VARIANCE)


def blur_before_sharpening(blur_px: float, amount: float, spread_px: float) -> float:
    """lambda that looks like ``blur_px`` after an unsharp mask, which adds ``amount`` of what a Gaussian takes away.

    By the slope of an edge in its middle, which is 1 / lambda but for a factor: (1 + a) / l - a / sqrt(l^2 + s^2).
    """
    before = blur_px
    for _ in range(20):
        before = (1 + amount) / (1 / blur_px + amount / math.hypot(before, spread_px))
    return before


def blur_at_depth(depth_m: Q, focus_distance_m: Q | float, k_cam_px: Q | float, gamma_px: Q | float) -> Q:
    """lambda in pixels of a point at depth z (eq. 3 and 5)."""
    return blur_from_defocus(defocus_at_depth(depth_m, focus_distance_m, k_cam_px), gamma_px)


def defocus_from_blur(blur_px: Q, gamma_px: Q | float, floor_px: float = 0.0) -> Q:
    """sigma = sqrt(max(lambda^2 - gamma^2, 0)) in pixels (eq. 6).

    ``floor_px`` is added in quadrature: the square root has an infinite gradient at 0, so training passes
    a small positive floor; a request passes none.
    """
    variance = blur_px * blur_px - gamma_px * gamma_px
    return ((variance + abs(variance)) / 2.0 + floor_px * floor_px) ** 0.5


def relative_defocus_from_blur(blur_px: Q, gamma_px: Q | float, k_cam_px: Q | float, floor_px: float = 0.0) -> Q:
    """x = sqrt(lambda^2 - gamma^2) / k_cam, without unit (eq. 7)."""
    return defocus_from_blur(blur_px, gamma_px, floor_px) / k_cam_px


def relative_defocus_if_softer(relative_defocus: Q, gamma_px: float, softer_px: float, k_cam_px: float) -> Q:
    """x where gamma is ``softer_px``, from the x that was found by ``gamma_px``, which is less than that.

    Where x^2 is much more than d = (softer^2 - gamma^2) / k_cam^2, d less (eq. 7). Else x^2 / (x^2 + d) of it, as of a
    signal with noise of that variance (Wiener): what is about as blurred as the softer gamma is close to focus, and not
    all in it. The sign of x stays.
    """
    noise = (softer_px**2 - gamma_px**2) / k_cam_px**2
    return relative_defocus * abs(relative_defocus) / (relative_defocus * relative_defocus + noise) ** 0.5


def relative_defocus_spread(
    blur_px: Q, relative_error: Q, gamma_px: Q | float, k_cam_px: Q | float, floor_px: float = 0.0
) -> Q:
    """Half the change of x when lambda moves up and down by ``relative_error`` (a fraction of lambda).

    A finite difference and not a derivative, because at focus the derivative is infinite and the spread is not.
    """
    low = blur_px / (relative_error + 1.0)
    high = blur_px * (relative_error + 1.0)
    x_low = relative_defocus_from_blur(low, gamma_px, k_cam_px, floor_px)
    x_high = relative_defocus_from_blur(high, gamma_px, k_cam_px, floor_px)
    return (x_high - x_low) / 2.0


def depth_near(relative_defocus: Q, focus_distance_m: Q | float) -> Q:
    """z = s1 / (1 + x) in metres: the answer on the near side, for every x >= 0."""
    return focus_distance_m / (relative_defocus + 1.0)


def depth_far(relative_defocus: Q, focus_distance_m: Q | float) -> Q:
    """z = s1 / (1 - x) in metres: the answer on the far side, which exists only for x < 1."""
    return focus_distance_m / (1.0 - relative_defocus)


def depth_error(depth_m: Q, focus_distance_m: Q | float, k_cam_px: Q | float, defocus_error_px: Q | float) -> Q:
    """dz = z^2 / (s1 k_cam) dsigma in metres: the floor under every depth error."""
    return depth_m * depth_m / (focus_distance_m * k_cam_px) * defocus_error_px


def farthest_depth(
    focus_distance_m: float, k_cam_px: float, defocus_error_px: float, relative_depth_error: float
) -> float:
    """The depth in metres up to which ``defocus_error_px`` moves z by less than the given fraction of z."""
    return relative_depth_error * focus_distance_m * k_cam_px / defocus_error_px


def k_cam_at_focus(k_cam_px: float, focal_length_m: float, old_focus_m: float, new_focus_m: float) -> float:
    """k_cam after the same lens is focused elsewhere: it scales with 1 / (s1 - f) (eq. 2).

    Raises ``ValueError`` if the lens cannot focus there (f >= s1).
    """
    if focal_length_m >= min(old_focus_m, new_focus_m):
        raise ValueError("the focal length must be shorter than the focus distance")
    return k_cam_px * (old_focus_m - focal_length_m) / (new_focus_m - focal_length_m)


def depth_at_focus(depth_m: Q, old_focus_m: float, new_focus_m: float) -> Q:
    """The depth in metres as blurred at another focus distance, of the same aperture, as ``depth_m`` at the old one.

    sigma is k_cam s1 |1/z - 1/s1| (eq. 3): with k_cam s1 kept, what is as far from focus in inverse depth is as
    blurred. What would be farther than infinity is no positive number.
    """
    return depth_m / (depth_m * (1 / new_focus_m - 1 / old_focus_m) + 1.0)


def image_distance_in_focal_lengths(focus_distance_m: float, focal_length_m: float) -> float:
    """s2 / f = s1 / (s1 - f), without unit: how far behind a thin lens the plane in focus has its image."""
    return focus_distance_m / (focus_distance_m - focal_length_m)


def focus_from_lens(focus_from_sensor_m: float, focal_length_m: float) -> float:
    """s1 in metres from the lens, where a ring or EXIF counts it from the sensor: s1 + s2 = D with 1/s1 + 1/s2 = 1/f.

    Of the two such lenses the one nearer to the sensor. Raises ``ValueError`` below D = 4 f, nearer than which a thin
    lens forms no image.
    """
    if focus_from_sensor_m < 4 * focal_length_m:
        raise ValueError("a lens forms no image of what is nearer to the sensor than four focal lengths")
    return focus_from_sensor_m / 2 * (1 + math.sqrt(1 - 4 * focal_length_m / focus_from_sensor_m))
