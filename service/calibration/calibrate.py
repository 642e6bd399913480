"""Photographs of a printed grid to a camera's constants: find, place, measure, fit."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.calibration.report import Method, PictureReport, Report, Role
from service.calibration.target import CircleGrid


@dataclass(frozen=True, slots=True)
class Picture:
    """One photograph, decoded when it is its turn: ``load`` gives RGB uint8 [h,w,3] as the sensor had it.

    ``load`` may raise ``CamindError`` (the picture is then reported as not readable, with its words).
    """

    name: str
    role: Role
    load: Callable[[], NDArray[np.uint8]]


@dataclass(frozen=True, slots=True)
class Task:
    """What is asked: the printed grid, the focus distance if it is known, and how to read blur."""

    grid: CircleGrid
    focus_distance_m: float | None = None
    method: Method = "edge"


def calibrate(
    task: Task,
    pictures: Sequence[Picture],
    *,
    tell: Callable[[float, tuple[PictureReport, ...]], None] = lambda progress, pictures: None,
    check: Callable[[], None] = lambda: None,
) -> Report:
    """Calibrate. ``tell(progress in 0..1, reports so far)`` is called at least every two seconds of work.

    ``check`` is called as often and may raise to stop the work; what it raises comes out. What is wrong with the
    pictures is in the report, never raised.
    """
    raise NotImplementedError
