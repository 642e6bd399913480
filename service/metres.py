"""Metres as people read them."""

import math

from service.optics.camera import FOCUS_DISTANCES_M

CLOSE_M = 0.5
CLOSE_DIGITS = 4
MOST_IN_DIGITS_M = 1000.0


def in_words(depth_m: float, like_m: float | None = None) -> str:
    """To a millimetre, what is close to four digits; with as many decimals as another has, if one is given."""
    like_m = depth_m if like_m is None else like_m
    is_close = 0 < like_m < CLOSE_M
    return f"{depth_m:.{CLOSE_DIGITS - 1 - math.floor(math.log10(like_m)) if is_close else 3}f}"


def focus_in_words(focus_distance_m: float) -> str:
    """To four digits, or whole metres, with its unit; what stands for infinity by that name."""
    if focus_distance_m >= FOCUS_DISTANCES_M[1]:
        return "infinity"
    return f"{focus_distance_m:.0f} m" if focus_distance_m >= MOST_IN_DIGITS_M else f"{focus_distance_m:.4g} m"
