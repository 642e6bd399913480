"""Metres as people read them."""

import math

from service.optics.camera import FOCUS_DISTANCES_M

CLOSE_M = 0.5
CLOSE_DIGITS = 4


def in_words(depth_m: float, like_m: float | None = None) -> str:
    """To a millimetre, what is close to four digits; with as many decimals as another has, if one is given."""
    like_m = depth_m if like_m is None else like_m
    is_close = 0 < like_m < CLOSE_M
    return f"{depth_m:.{CLOSE_DIGITS - 1 - math.floor(math.log10(like_m)) if is_close else 3}f}"


def focus_in_words(focus_distance_m: float) -> str:
    """To four digits, with its unit; what stands for infinity by that name."""
    return "infinity" if focus_distance_m >= FOCUS_DISTANCES_M[1] else f"{focus_distance_m:.4g} m"
