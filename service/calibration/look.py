"""One photograph of the sheet looked at on its own, while the next one can still be taken better."""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from service.calibration.measure import Measured, measure, otherwise_sized
from service.calibration.pose import View, stand
from service.calibration.report import PictureReport
from service.calibration.target import CircleGrid
from service.optics.camera import Intrinsics

Exposure = Literal["good", "over", "under"]

WHITE_LEVEL = 255
MOST_MEASURED = 12


@dataclass(frozen=True, slots=True)
class Circle:
    """Where a printed circle is in the picture, and about how large."""

    u_px: float
    v_px: float
    radius_px: float


@dataclass(frozen=True, slots=True)
class Look:
    """What one photograph shows; None for what it does not tell.

    ``circles`` are all of the grid, row by row, those too that were filled in from their neighbours. At most a dozen,
    in all columns, are measured; ``measured`` gave a blur, and ``blur_px`` is its median. ``paper_level`` is how bright
    the white between them is, 0 to 1.
    """

    width_px: int
    height_px: int
    circles: tuple[Circle, ...] = ()
    measured: int = 0
    blur_px: float | None = None
    distance_m: float | None = None
    tilt_deg: float | None = None
    exposure: Exposure | None = None
    paper_level: float | None = None
    warnings: tuple[str, ...] = ()

    @property
    def found(self) -> bool:
        return bool(self.circles)


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
