"""What a calibration is asked, and how it tells how far it is."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.calibration.report import Method, PictureReport, Role
from service.calibration.target import CircleGrid

Tell = Callable[[float, tuple[PictureReport, ...]], None]


@dataclass(frozen=True, slots=True)
class Shot:
    """A decoded photograph: RGB uint8 [h,w,3] as the sensor had it, and the aperture it says it was taken with."""

    rgb: NDArray[np.uint8]
    f_number: float | None = None


@dataclass(frozen=True, slots=True)
class Picture:
    """One photograph, decoded by ``load`` when it is its turn.

    ``load`` may raise ``CamindError`` (the picture is then reported as not readable, with its words).
    """

    name: str
    role: Role
    load: Callable[[], Shot]


@dataclass(frozen=True, slots=True)
class Task:
    """What is asked: the printed grid, the focus distance if it is known, and how to read blur."""

    grid: CircleGrid
    focus_distance_m: float | None = None
    method: Method = "edge"
