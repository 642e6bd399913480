"""Depth for the eye: turbo colours, logarithmic, with a legend in metres."""

import numpy as np
from numpy.typing import NDArray

from service.opencv import cv2

PERCENTILES = (2.0, 98.0)
LEAST_RATIO = 1.02
NO_ANSWER = 64
LEGEND_NEEDS_PX = 160
MARGIN_PX = 8


def render_preview(depth_m: NDArray[np.float32]) -> NDArray[np.uint8]:
    """RGB uint8 [h, w, 3]: red is near, blue is far, dark grey is no answer."""
    known = depth_m[np.isfinite(depth_m)]
    if known.size == 0:
        return np.full((*depth_m.shape, 3), NO_ANSWER, np.uint8)
    near_m, far_m = (float(value) for value in np.percentile(known, PERCENTILES))
    far_m = max(far_m, near_m * LEAST_RATIO)
    nearness = 1 - np.log(depth_m / near_m) / np.log(far_m / near_m)
    levels = np.rint(255 * np.nan_to_num(np.clip(nearness, 0, 1))).astype(np.uint8)
    pixels = _turbo(levels)
    pixels[~np.isfinite(depth_m)] = NO_ANSWER
    if min(depth_m.shape) >= LEGEND_NEEDS_PX:
        _draw_legend(pixels, near_m, far_m)
    return pixels


def _turbo(levels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    coloured = cv2.applyColorMap(levels, cv2.COLORMAP_TURBO)
    return np.asarray(cv2.cvtColor(coloured, cv2.COLOR_BGR2RGB), np.uint8)


def _draw_legend(pixels: NDArray[np.uint8], near_m: float, far_m: float) -> None:
    """A bar at the bottom left, its ends labelled, drawn in place."""
    height, width = pixels.shape[:2]
    length, thickness = width // 3, max(6, height // 60)
    size = max(0.4, height / 1200)
    top = height - MARGIN_PX - thickness
    bar = _turbo(np.linspace(255, 0, length).astype(np.uint8)[np.newaxis])
    pixels[top : top + thickness, MARGIN_PX : MARGIN_PX + length] = bar
    for text, is_right in ((f"{near_m:.3g} m", False), (f"{far_m:.3g} m", True)):
        (text_width, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, 1)
        at = (MARGIN_PX + (length - text_width if is_right else 0), top - 6)
        # a dark rim keeps the text legible on every colour
        cv2.putText(pixels, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, (0, 0, 0), 3, cv2.LINE_AA)
        cv2.putText(pixels, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, (255, 255, 255), 1, cv2.LINE_AA)
