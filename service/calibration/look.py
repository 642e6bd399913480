"""One photograph of the sheet looked at on its own, while the next one can still be taken better."""

import itertools
import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from service.calibration.measure import Measured, measure, otherwise_sized
from service.calibration.pose import View, stand
from service.calibration.report import Circle, Look, PictureReport
from service.calibration.target import CircleGrid
from service.optics.camera import Intrinsics

WHITE_LEVEL = 255
MOST_MEASURED = 12


def look(
    rgb: NDArray[np.uint8], grid: CircleGrid, intrinsics: Intrinsics | None, check: Callable[[], None] = lambda: None
) -> Look:
    """Find and measure the grid in a photograph as the sensor had it; without intrinsics it has no distance.

    ``check`` is called circle by circle and may raise to stop the work.
    """
    height_px, width_px = rgb.shape[:2]
    seen = Measured(PictureReport("", "defocused", found=False))
    measure(seen, rgb, grid, lambda _: check(), every=_stride(grid))
    if seen.grid is None:
        return Look(width_px, height_px, warnings=seen.report.warnings)
    distance_m, tilt_deg = None, None
    if intrinsics is not None:
        every_circle = np.arange(grid.rows * grid.columns)
        distance_m, tilt_deg = stand(grid, View(every_circle, seen.grid.centres_px), intrinsics)
    places = zip(seen.grid.centres_px.tolist(), seen.grid.radii_px.tolist(), strict=True)
    return Look(
        width_px,
        height_px,
        circles=tuple(Circle(u, v, radius) for (u, v), radius in places),
        measured=len(seen.circles),
        blur_px=seen.report.blur_px,
        distance_m=distance_m,
        tilt_deg=tilt_deg,
        exposure="over" if seen.is_clipped else "under" if seen.is_dark else "good",
        paper_level=float(np.median(seen.paper_levels)) / WHITE_LEVEL,
        warnings=(*seen.report.warnings, *otherwise_sized([seen])),
    )


def _stride(grid: CircleGrid) -> int:
    """The step that visits at most a dozen circles, and every column in turn."""
    least = math.ceil(grid.rows * grid.columns / MOST_MEASURED)
    return next(step for step in itertools.count(least) if math.gcd(step, grid.columns) == 1)
