"""Tones other than sRGB's, as they show about circles: the more one is blurred the larger or the smaller it looks.

Half the light of a blurred edge is then read as more or as less than half, which moves what is seen as the edge. How
large a circle is in the picture is known from what is between it and its neighbours, whose middles no tones move.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from service.calibration.grid import homography, projected, radii_through
from service.calibration.measure import Measured
from service.calibration.target import CircleGrid

Array = NDArray[np.float64]

# pixels of radius to one of blur: of sRGB within 0.02, by S-shaped curves -0.03 to -0.16, linear light 0.65 to 0.74
LEAST_GROWTH, LINEAR_GROWTH = 0.04, 0.45
LEAST_SPREAD = 0.02  # of blur, in radii: a standard deviation below which growth is not told from a circle's own size
CERTAIN = 2.0  # standard errors, as if a photograph told as much as one circle
CUBIC = [(i, j) for i in range(4) for j in range(4 - i)]  # powers along the sheet and across it
LEAST_CIRCLES = 2 * len(CUBIC)  # of a photograph that tells how large its circles are


def otherwise_toned(grid: CircleGrid, measured: Sequence[Measured]) -> tuple[str, ...]:
    """A warning where circles grow or shrink with their blur, as by linear light or a camera's own tone curve."""
    shown = [one for one in measured if len(one.circles) >= LEAST_CIRCLES]
    if not shown:
        return ()
    told_px = np.concatenate([radii_by_middles(grid, one.circles, np.array(one.centres_px)) for one in shown])
    seen_px, blur_px = np.array([(edge.radius_px, edge.blur_px) for one in shown for edge in one.edges]).T
    blur, size = blur_px / told_px, seen_px / told_px
    spread = float(blur.std())
    if spread < LEAST_SPREAD:
        return ()
    growth = float(np.cov(blur, size, bias=True)[0, 1]) / spread**2
    error = float((size - growth * blur).std()) / spread / len(shown) ** 0.5
    if abs(growth) < max(LEAST_GROWTH, CERTAIN * error):
        return ()
    how = f"circles look the {'larger' if growth > 0 else 'smaller'} the more they are blurred, by {abs(growth):.2f} px"
    if growth - CERTAIN * error > LINEAR_GROWTH:
        return (
            f"{how} for each, as in linear light (gamma 1) that is read as sRGB: k_cam_px and gamma_px are too small "
            "by far more than their intervals say; encode the files as sRGB",
        )
    return (
        f"{how} for each, as by a tone curve that is not sRGB's (contrast, a picture style, HDR): k_cam_px and "
        "gamma_px may be off by more than their intervals say; choose a neutral style, or send raw (.dng)",
    )


def radii_by_middles(grid: CircleGrid, circles: Sequence[int], centres_px: Array) -> Array:
    """How large circles [n] of the sheet are in the picture by their middles: the geometric mean of their semi-axes.

    The sheet goes into the picture by a homography and what a cubic adds to it: distortion, a bend.
    """
    points = grid.points_mm()[list(circles)]
    middle = points.mean(0)
    half_mm = float(np.abs(points - middle).max())
    flat = homography(points, centres_px)
    added = np.linalg.lstsq(_powers((points - middle) / half_mm), centres_px - projected(flat, points), rcond=None)[0]

    def seen(at: Array) -> Array:
        return np.asarray(projected(flat, at) + _powers((at - middle) / half_mm) @ added)

    return radii_through(seen, points, grid.diameter_mm)


def _powers(at: Array) -> Array:
    return np.stack([at[:, 0] ** i * at[:, 1] ** j for i, j in CUBIC], 1)
