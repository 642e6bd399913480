"""The one thread that calibrates: takes what waits in the database, and brings every calibration to an end.

A stop leaves the calibration in the queue, and a process that dies leaves it running: both are run again at the
next start, the second three times at most, for some photographs may be what ends the process.
"""

import json
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TypeVar

import structlog
from pydantic import ConfigDict, JsonValue, TypeAdapter
from pydantic.dataclasses import dataclass

from service.calibration.report import Method, PictureReport, Report, Result, Role
from service.calibration.target import CircleGrid
from service.calibration.task import Picture, Shot, Task, Tell
from service.errors import CamindError
from service.inference.cancellation import Cancelled
from service.inference.images import ImageLimits, read_stored_frame
from service.storage.calibrations import CalibrationRecord, Calibrations, Ending
from service.storage.spool import Spool

T = TypeVar("T")

MOST_ATTEMPTS = 3
LOOK_S = 5.0
WRITE_S = 1.0
RETRY_S = 1.0
GIVE_UP_S = 3600.0  # between looks for what other processes left behind
CLOSE_S = 10.0

# ``service.calibration.calibrate.calibrate``, or what stands in for it
Calibrate = Callable[[Task, Sequence[Picture], Tell, Callable[[], None]], Report]

log = structlog.stdlib.get_logger("camind.calibration")


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class JobSettings:
    """What a calibration is told, in the form it is stored."""

    pattern: CircleGrid
    focus_distance_m: float | None
    method: Method
    register: bool


SETTINGS = TypeAdapter(JobSettings)
ROLE: TypeAdapter[Role] = TypeAdapter(Role)
REPORTS = TypeAdapter(tuple[PictureReport, ...])
RESULT = TypeAdapter(Result)


class Runner:
    """Works a spool off in a thread of its own, between ``start`` and ``close``."""

    def __init__(
        self,
        calibrations: Calibrations,
        spool: Spool,
        limits: ImageLimits,
        calibrate: Calibrate,
        count_problem: Callable[[str], None],
    ) -> None:
        self._calibrations = calibrations
        self._spool = spool
        self._limits = limits
        self._calibrate = calibrate
        self._count_problem = count_problem
        self._gave_up_s = -GIVE_UP_S
        self._wake = threading.Event()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="calibration", daemon=True)

    def start(self) -> None:
        """Begin with what an earlier process left."""
        self._thread.start()

    def wake(self) -> None:
        """Something was queued or cancelled: look at once."""
        self._wake.set()

    def close(self) -> None:
        """Stop; the calibration at work is queued again."""
        self._stop.set()
        self._wake.set()
        self._thread.join(CLOSE_S)
        self._spool.release()

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                is_done = not self._step()
            except CamindError as exc:
                log.warning("calibrations_wait", detail=exc.detail, cause=repr(exc.__cause__))
                is_done = True
            except Exception:
                log.exception("calibrations_wait")
                self._count_problem(CamindError.code)
                is_done = True
            if is_done:
                self._wake.wait(LOOK_S)
                self._wake.clear()

    def _step(self) -> bool:
        """Run the next calibration; False where there is none, or another process works this spool off."""
        if not self._spool.acquire():
            return False
        # whatever runs by the database's word, nobody works on it
        self._calibrations.recover(self._spool.id)
        if time.monotonic() - self._gave_up_s >= GIVE_UP_S:
            self._calibrations.give_up(self._spool.id)
            self._gave_up_s = time.monotonic()
        self._sweep()
        record = self._calibrations.take(self._spool.id)
        if record is None:
            return False
        self._bring_to_end(record)
        self._sweep()
        return True

    def _sweep(self) -> None:
        """Remove the photographs of what has ended, and of what was never received whole."""
        self._spool.remove_drafts()
        ids = self._spool.ids()
        for calibration_id in set(ids) - self._calibrations.live(ids):
            self._spool.remove(calibration_id)

    def _bring_to_end(self, record: CalibrationRecord) -> None:
        """Work on a calibration until it has ended, or leave it for later: where the service stops, and where the
        database forgot that it was begun, as one may that was put in another's place.
        """
        with structlog.contextvars.bound_contextvars(calibration=record.id):
            try:
                ending = self._worked(record)
            except Cancelled:
                if self._stop.is_set():
                    self._calibrations.put_back(record.id)
                return
            except Exception:
                log.exception("calibration_failed")
                self._count_problem(CamindError.code)
                ending = Ending(
                    "failed", problem="Something went wrong here; the log has it under the calibration's id."
                )
            self._insist(lambda: self._calibrations.finish(record.id, ending))

    def _worked(self, record: CalibrationRecord) -> Ending:
        paths = self._spool.paths(record.id, len(record.draft.pictures))
        if not all(path.is_file() for path in paths):
            return Ending("failed", problem="Its photographs are gone: send them again.")
        if record.attempts > MOST_ATTEMPTS:
            return Ending("failed", problem=f"The service stopped {MOST_ATTEMPTS} times while it worked on this.")
        settings = SETTINGS.validate_python(record.draft.settings)
        pictures = [
            Picture(stored.name, ROLE.validate_python(stored.role), partial(_shot, path, self._limits))
            for stored, path in zip(record.draft.pictures, paths, strict=True)
        ]
        progress = _Progress(self._calibrations, record, self._stop)
        task = Task(settings.pattern, settings.focus_distance_m, settings.method)
        report = self._calibrate(task, pictures, progress.tell, progress.check)
        return _ending(report, is_registered=settings.register)

    def _insist(self, write: Callable[[], object]) -> None:
        """Write until the database takes it or the service stops."""
        while True:
            try:
                write()
            except CamindError as exc:
                cause = repr(exc.__cause__)
                log.warning("calibration_waits_for_the_database", detail=exc.detail, cause=cause)
            else:
                return
            if self._stop.wait(RETRY_S):
                return


class _Progress:
    """A calibration's line to the database: at most a write and a look a second."""

    def __init__(self, calibrations: Calibrations, record: CalibrationRecord, stop: threading.Event) -> None:
        self._calibrations = calibrations
        self._id = record.id
        self._stop = stop
        self._is_wanted = True
        self._written_s = -WRITE_S
        self._looked_s = -WRITE_S

    def tell(self, progress: float, pictures: tuple[PictureReport, ...]) -> None:
        """Note how far it is, unless that was done just now."""
        now_s = time.monotonic()
        if now_s - self._written_s < WRITE_S:
            return
        self._written_s = self._looked_s = now_s
        # a database that is busy is no reason to stop
        with suppress(CamindError):
            self._is_wanted = self._calibrations.tell(self._id, progress, _as_json(REPORTS, pictures))

    def check(self) -> None:
        """Raise ``Cancelled`` where the service stops, or somebody cancelled the calibration, here or elsewhere."""
        now_s = time.monotonic()
        if self._is_wanted and now_s - self._looked_s >= WRITE_S / 2:
            self._looked_s = now_s
            with suppress(CamindError):
                self._is_wanted = self._calibrations.is_running(self._id)
        if self._stop.is_set() or not self._is_wanted:
            raise Cancelled


def _shot(path: Path, limits: ImageLimits) -> Shot:
    frame = read_stored_frame(path.read_bytes(), limits)
    return Shot(frame.rgb, frame.exif.f_number)


def _ending(report: Report, *, is_registered: bool) -> Ending:
    images, result = _as_json(REPORTS, report.pictures), report.result
    if result is None:
        return Ending("failed", images, problem=report.problem or "The photographs do not give a calibration.")
    return Ending("succeeded", images, _as_json(RESULT, result), camera=result.to_camera() if is_registered else None)


def _as_json(form: TypeAdapter[T], value: T) -> JsonValue:
    """What will be stored; ``ValueError`` for what would not come back, such as a NaN where a number must be."""
    text = form.dump_json(value)
    form.validate_json(text)
    stored: JsonValue = json.loads(text)
    return stored
