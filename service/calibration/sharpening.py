"""Sharpening by a camera, as it shows about circles: blur alone leaves no paper brighter than the light there was."""

from collections.abc import Sequence

import numpy as np

from service.calibration.edge import EdgeFit, PointSpread, halo

SHARPEST = 24  # circles, whose edges sharpening changes most
MOST = 0.75  # of them, that show a ring: real ink and paper scatter by some 0.03 from circle to circle
MOST_HALO = 0.01  # of a circle's contrast


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
