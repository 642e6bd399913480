"""A stand-in for ``calibrate`` with a fixed answer, which can be held back, told in steps, or made to fail.

And what is sent to it, and a database that fails meanwhile.
"""

import json
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from httpx2 import Request
from pydantic import JsonValue
from sqlalchemy import Engine

from service.calibration.report import CurvePoint, Interval, PictureReport, Report, Result, Sample
from service.calibration.task import Picture, Task
from service.errors import CamindError
from service.optics.camera import Intrinsics
from service.storage.engine import writing

RESULT = Result(
    image_width_px=64,
    image_height_px=48,
    k_cam_px=Interval(6.5, 6.25, 6.75),
    gamma_px=Interval(0.75, 0.5, 1.0),
    focus_distance_m=Interval(1.5, 1.25, 1.75),
    point_spread="disc",
    intrinsics=Intrinsics(80.0, 81.0, 31.5, 23.5, (0.125, -0.25, 0.0, 0.0, 0.5)),
    reprojection_rms_px=0.125,
    samples=(
        Sample(0, "near.png", 20.0, 12.0, 1.0, 3.25, 0.0625, 6.5, used=True),
        Sample(1, "near.png", 40.0, 12.0, 1.5, 0.75, 0.0625, None, used=False),
    ),
    curve=(CurvePoint(1.0, 3.25, 3.0, 3.5),),
    warnings=("fewer than three pictures: the intervals are guesses",),
)
SETTINGS: dict[str, JsonValue] = {
    "pattern": {"kind": "asymmetric_circles", "rows": 11, "columns": 4, "spacing_mm": 20.0, "diameter_mm": 12.0},
    "focus_distance_m": None,
    "method": "edge",
    "register": False,
}


def calibration_form(*pictures: bytes, register: bool = False) -> Request:
    """A form with so many defocused photographs, for its content and the content type that goes with it."""
    settings = (None, json.dumps({**SETTINGS, "register": register}), "application/json")
    files: list[tuple[str, Any]] = [("defocused", ("near.png", picture, "image/png")) for picture in pictures]
    request = Request("POST", "http://service/calibrate", files=[("settings", settings), *files])
    request.read()
    return request


@contextmanager
def without_calibrations(engine: Engine) -> Iterator[None]:
    """The database cannot answer for its calibrations meanwhile."""
    _rename(engine, "calibrations", "calibrations_elsewhere")
    try:
        yield
    finally:
        _rename(engine, "calibrations_elsewhere", "calibrations")


def _rename(engine: Engine, table: str, name: str) -> None:
    with writing(engine) as session:
        session.connection().exec_driver_sql(f"ALTER TABLE {table} RENAME TO {name}")


class FakeCalibration:
    """Looks at every picture, waits until ``go`` is set, and answers ``RESULT``, or what ``outcome`` makes of it."""

    def __init__(self, outcome: Callable[[], Result | None] = lambda: RESULT, *, is_held: bool = False) -> None:
        self.go = threading.Event()
        self.has_begun = threading.Event()
        self.tasks: list[Task] = []
        self.pictures: list[Sequence[Picture]] = []
        self._outcome = outcome
        if not is_held:
            self.go.set()

    def release_after(self, seconds: float) -> None:
        """Let it go on later, from another thread."""
        threading.Timer(seconds, self.go.set).start()

    def __call__(
        self,
        task: Task,
        pictures: Sequence[Picture],
        tell: Callable[[float, tuple[PictureReport, ...]], None],
        check: Callable[[], None],
    ) -> Report:
        self.tasks.append(task)
        self.pictures.append(pictures)
        reports: tuple[PictureReport, ...] = ()
        for number, picture in enumerate(pictures, 1):
            reports += (_looked_at(picture),)
            tell(number / len(pictures) / 2, reports)
            check()
        self.has_begun.set()
        while not self.go.is_set():
            check()
            time.sleep(0.01)
        result = self._outcome()
        return Report(reports, result, None if result else "The grid was found in none of the pictures.")


def _looked_at(picture: Picture) -> PictureReport:
    try:
        height, width, _ = picture.load().rgb.shape
    except CamindError as exc:
        return PictureReport(picture.name, picture.role, found=False, warnings=(exc.detail,))
    return PictureReport(picture.name, picture.role, found=True, circles=44, warnings=(f"{width}x{height}",))
