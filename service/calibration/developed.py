"""What a camera did to its photographs before they became files, as their circles show it.

Blur spreads an edge evenly to both sides, and never beyond the light there was. Sharpening leaves the paper brighter
right around a circle than farther off. A tone curve moves the middle of an edge, by the more the wider it is: circles
look larger or smaller the more they are blurred.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from service.calibration.edge import EdgeFit, PointSpread, halo
from service.calibration.measure import FAR_RADII, Measured

SHARPEST = 24  # circles, whose edges sharpening changes most
MOST = 0.75  # of them, that show a ring: real ink and paper scatter by some 0.03 from circle to circle
MOST_HALO = 0.01  # of a circle's contrast
MOST_MOVE = 0.03  # of an edge's middle, in blurs; from there on blur is off by up to 4 %
LEAST_APART = 0.1  # of the thirds' blurs, in radii: sizes may differ by a little else
SURELY = 2.0  # standard errors


def sharpened(edges: Sequence[EdgeFit], spread: PointSpread) -> tuple[str, ...]:
    """A warning where the paper right around most of the least blurred circles is brighter than blur leaves it."""
    sharpest = sorted(edges, key=lambda edge: edge.blur_px)[:SHARPEST]
    least, ring = np.quantile([halo(edge, spread) for edge in sharpest], (1 - MOST, 0.5))
    if least < MOST_HALO:
        return ()
    return (
        f"the paper is brighter right around circles than farther off, by {ring:.1%} of their contrast, as sharpening "
        "leaves it: gamma_px and k_cam_px are too small by more than their intervals say; set sharpening to 0, or send "
        "raw (.dng)",
    )


def toned(measured: Sequence[Measured]) -> tuple[str, ...]:
    """A warning where the more blurred third of the circles look larger, or smaller, than the less blurred one."""
    seen = [
        (edge.blur_px / radius, edge.radius_px / radius)
        for one in measured
        if one.grid
        for edge, radius in zip(one.edges, one.grid.radii_px[one.circles], strict=True)
        if edge.blur_px < FAR_RADII * radius
    ]
    third = len(seen) // 3
    if third == 0:
        return ()
    seen.sort()
    (blur, _), (size, error) = (_middle(part) for part in np.array(seen[:third]).T)
    (wider, _), (other, error_there) = (_middle(part) for part in np.array(seen[-third:]).T)
    if abs(other - size) <= MOST_MOVE * max(wider - blur, LEAST_APART) + SURELY * math.hypot(error, error_there):
        return ()
    return (
        f"circles look {'larger' if other > size else 'smaller'} the more they are blurred, as a tone curve (contrast, "
        "a picture style, HDR) makes them: k_cam_px and gamma_px may be off by more than their intervals say; choose a "
        "neutral picture style, or send raw (.dng)",
    )


def _middle(values: NDArray[np.float64]) -> tuple[float, float]:
    """The median and about its standard error."""
    middle = float(np.median(values))
    return middle, 1.25 * 1.4826 * float(np.median(np.abs(values - middle))) / math.sqrt(values.size)
