"""What a camera did to its photographs before they became files, as their circles show it.

Blur spreads an edge evenly to both sides, and never beyond the light there was. Sharpening leaves the paper brighter
right around a circle than farther off. A tone curve moves the middle of an edge, by the more the wider it is: circles
look larger or smaller the more they are blurred.
"""

from collections.abc import Sequence

import numpy as np
from scipy.stats import theilslopes

from service.calibration.edge import EdgeFit, PointSpread, halo
from service.calibration.measure import FAR_RADII, Measured

SHARPEST = 24  # circles, whose edges sharpening changes most
MOST = 0.75  # of them, that show a ring: real ink and paper scatter by some 0.03 from circle to circle
MOST_HALO = 0.01  # of a circle's contrast
MOST_MOVE = 0.03  # of an edge's middle, in blurs; from there on blur is off by up to 4 %


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
    """A warning where circles look larger, or smaller, the more they are blurred."""
    seen = [
        (edge.blur_px / radius, edge.radius_px / radius)
        for one in measured
        if one.grid
        for edge, radius in zip(one.edges, one.grid.radii_px[one.circles], strict=True)
        if edge.blur_px < FAR_RADII * radius
    ]
    if len(seen) < 2:
        return ()
    blur, size = np.array(seen).T
    _, _, low, high = theilslopes(size, blur)
    if low <= MOST_MOVE and high >= -MOST_MOVE:
        return ()
    return (
        f"circles look {'larger' if low > 0 else 'smaller'} the more they are blurred, as a tone curve (contrast, a "
        "picture style, HDR) makes them: k_cam_px and gamma_px may be off by more than their intervals say; choose a "
        "neutral picture style, or send raw (.dng)",
    )
