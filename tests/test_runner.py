"""The runner brings every calibration to an end, whatever happens to the photographs, the service or the code."""

import math
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from uuid import uuid4

import numpy as np
import pytest
import structlog
from pydantic import JsonValue
from sqlalchemy import Engine

from service.calibration.report import Interval, Result
from service.errors import Busy, NotReady
from service.inference.images import ImageLimits
from service.runner import MOST_ATTEMPTS, Calibrate, Runner
from service.storage import schema
from service.storage.calibrations import CalibrationDraft, CalibrationRecord, Calibrations, Ending, StoredPicture
from service.storage.cameras import Cameras
from service.storage.engine import open_engine, writing
from service.storage.spool import Spool, picture_file
from tests.fake_calibration import RESULT, SETTINGS, FakeCalibration, without_calibrations
from tests.inference.photographs import corners, jpeg, png

PATIENCE_S = 15.0


@pytest.fixture
def engine(tmp_path: Path) -> Iterator[Engine]:
    scratch = open_engine(f"sqlite:///{tmp_path / 'scratch.sqlite3'}")
    schema.upgrade(scratch)
    yield scratch
    scratch.dispose()


@pytest.fixture
def calibrations(engine: Engine) -> Calibrations:
    return Calibrations(engine)


@pytest.fixture
def spool(tmp_path: Path) -> Spool:
    return Spool(tmp_path / "calibrations")


class Bench:
    """Queues calibrations and runs them with a stand-in."""

    def __init__(self, calibrations: Calibrations, spool: Spool) -> None:
        self.calibrations = calibrations
        self.spool = spool
        self.runners: list[Runner] = []
        self.problems: list[str] = []

    def queue(self, *pictures: bytes, register: bool = False) -> str:
        calibration_id = uuid4().hex
        names = tuple(StoredPicture(f"{number}.png", "defocused") for number in range(len(pictures)))
        with self.spool.receiving(calibration_id) as folder:
            for number, picture in enumerate(pictures):
                (folder / picture_file(number)).write_bytes(picture)
        settings: JsonValue = {**SETTINGS, "register": register}
        self.calibrations.add(CalibrationDraft(calibration_id, self.spool.id, "bench", settings, names))
        return calibration_id

    def run(self, calibrate: Calibrate) -> Runner:
        runner = Runner(self.calibrations, self.spool, ImageLimits(max_pixels=64 * 48), calibrate, self.problems.append)
        runner.start()
        self.runners.append(runner)
        return runner

    def ended(self, calibration_id: str) -> CalibrationRecord:
        self.until(lambda: self.calibrations.get(calibration_id).has_ended)
        return self.calibrations.get(calibration_id)

    def until(self, is_so: Callable[[], bool]) -> None:
        give_up_s = time.monotonic() + PATIENCE_S
        while not is_so():
            assert time.monotonic() < give_up_s
            time.sleep(0.01)


@pytest.fixture
def bench(calibrations: Calibrations, spool: Spool) -> Iterator[Bench]:
    made = Bench(calibrations, spool)
    yield made
    for runner in made.runners:
        runner.close()


def test_what_waits_is_calibrated_in_its_order(bench: Bench, engine: Engine) -> None:
    first, second = bench.queue(png(corners())), bench.queue(png(corners()), b"nonsense", register=True)
    fake = FakeCalibration()
    bench.run(fake)
    records = [bench.ended(each) for each in (first, second)]
    assert [record.state for record in records] == ["succeeded", "succeeded"]
    assert [len(pictures) for pictures in fake.pictures] == [1, 2]
    task = fake.tasks[0]
    assert (task.grid.rows, task.grid.spacing_mm, task.focus_distance_m, task.method) == (11, 20.0, None, "edge")
    images = records[1].images
    assert isinstance(images, list)
    assert [image["found"] for image in images if isinstance(image, dict)] == [True, False]
    assert [record.camera_revision for record in records] == [None, 1]
    assert Cameras(engine).get("bench").camera.k_cam_px == RESULT.k_cam_px.value
    bench.until(lambda: bench.spool.ids() == [])


def test_pictures_are_as_the_sensor_had_them(bench: Bench) -> None:
    fake = FakeCalibration(is_held=True)
    bench.queue(jpeg(corners(), orientation=6))
    bench.run(fake)
    assert fake.has_begun.wait(PATIENCE_S)
    pixels = fake.pictures[0][0].load().rgb
    assert pixels.shape == (48, 64, 3)
    assert np.abs(pixels[4, 4].astype(int) - (255, 0, 0)).max() <= 6


def test_a_picture_of_too_many_pixels_is_told_of(bench: Bench) -> None:
    fake = FakeCalibration()
    record = bench_ended(bench, fake, bench.queue(png(corners(48, 65))))
    assert "65x48" in str(record.images)
    assert record.state == "succeeded"


def bench_ended(bench: Bench, calibrate: Calibrate, calibration_id: str) -> CalibrationRecord:
    bench.run(calibrate)
    return bench.ended(calibration_id)


def test_a_report_without_a_result_fails_with_its_words(bench: Bench) -> None:
    record = bench_ended(bench, FakeCalibration(lambda: None), bench.queue(png(corners()), register=True))
    assert (record.state, record.result, record.camera_revision) == ("failed", None, None)
    assert record.problem == "The grid was found in none of the pictures."
    assert record.images


def test_a_defect_fails_in_plain_words_and_tells_the_log(bench: Bench) -> None:
    def break_down() -> Result:
        raise RuntimeError("the password is 1234")

    with structlog.testing.capture_logs(processors=[structlog.contextvars.merge_contextvars]) as events:
        first = bench.queue(png(corners()))
        second = bench.queue(png(corners()))
        record = bench_ended(bench, FakeCalibration(break_down), first)
        bench.ended(second)
    assert record.state == "failed"
    assert "1234" not in str(record)
    assert "Traceback" not in str(record)
    assert bench.problems == ["internal-error"] * 2
    failures = [event for event in events if event["event"] == "calibration_failed"]
    assert [event["calibration"] for event in failures] == [first, second]
    assert failures[0]["exc_info"]


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_result_that_is_no_number_is_a_defect(bench: Bench, value: float) -> None:
    broken = replace(RESULT, k_cam_px=Interval(value, 1.0, 2.0))
    record = bench_ended(bench, FakeCalibration(lambda: broken), bench.queue(png(corners()), register=True))
    assert (record.state, record.result) == ("failed", None)


def test_a_camera_that_cannot_be_is_a_defect(bench: Bench, engine: Engine) -> None:
    broken = replace(RESULT, k_cam_px=Interval(-1.0, -2.0, 0.0))
    record = bench_ended(bench, FakeCalibration(lambda: broken), bench.queue(png(corners()), register=True))
    assert (record.state, record.result) == ("failed", None)
    assert Cameras(engine).page(1) == ([], False)


def test_progress_is_told_while_it_runs(bench: Bench) -> None:
    fake = FakeCalibration(is_held=True)
    calibration_id = bench.queue(*[png(corners())] * 2)
    bench.run(fake)
    bench.until(lambda: bench.calibrations.get(calibration_id).progress > 0)
    record = bench.calibrations.get(calibration_id)
    assert record.state == "running"
    assert record.images


def test_a_cancelled_one_stops_and_the_next_begins(bench: Bench) -> None:
    fake = FakeCalibration(is_held=True)
    first, second = bench.queue(png(corners())), bench.queue(png(corners()))
    bench.run(fake)
    assert fake.has_begun.wait(PATIENCE_S)
    assert bench.calibrations.cancel(first) == "running"
    bench.until(lambda: len(fake.pictures) == 2)
    fake.go.set()
    assert bench.ended(second).state == "succeeded"
    assert bench.calibrations.get(first).state == "cancelled"
    bench.until(lambda: bench.spool.ids() == [])


def test_a_stop_leaves_it_for_the_next_start(bench: Bench) -> None:
    fake = FakeCalibration(is_held=True)
    first, second = bench.queue(png(corners())), bench.queue(png(corners()))
    runner = bench.run(fake)
    assert fake.has_begun.wait(PATIENCE_S)
    runner.close()
    for each in (first, second):
        record = bench.calibrations.get(each)
        assert (record.state, record.attempts) == ("queued", 0)
    assert set(bench.spool.ids()) == {first, second}
    bench.run(FakeCalibration())
    assert {bench.ended(each).state for each in (first, second)} == {"succeeded"}


def test_what_lost_its_photographs_fails_and_says_so(bench: Bench) -> None:
    waiting, left_running = bench.queue(png(corners())), bench.queue(png(corners()))
    bench.calibrations.take(bench.spool.id)
    bench.spool.remove(waiting)
    bench.spool.paths(left_running, 1)[0].unlink()
    bench.run(FakeCalibration())
    for each in (waiting, left_running):
        record = bench.ended(each)
        assert record.state == "failed"
        assert "photographs are gone" in (record.problem or "")


def test_what_ends_the_process_is_not_tried_for_ever(bench: Bench) -> None:
    calibration_id = bench.queue(png(corners()))
    for _ in range(MOST_ATTEMPTS):
        bench.calibrations.take(bench.spool.id)
        bench.calibrations.recover(bench.spool.id)
    fake = FakeCalibration()
    record = bench_ended(bench, fake, calibration_id)
    assert record.state == "failed"
    assert f"stopped {MOST_ATTEMPTS} times" in (record.problem or "")
    assert fake.tasks == []


def test_folders_that_nothing_waits_for_are_removed(bench: Bench, tmp_path: Path) -> None:
    kept = bench.queue(png(corners()))
    orphan = tmp_path / "calibrations" / uuid4().hex
    orphan.mkdir()
    (orphan / "0000").write_bytes(b"part of an upl")
    cancelled = bench.queue(png(corners()))
    bench.calibrations.cancel(cancelled)
    fake = FakeCalibration(is_held=True)
    bench.run(fake)
    assert fake.has_begun.wait(PATIENCE_S)
    assert bench.spool.ids() == [kept]


def test_a_spool_that_another_process_works_off_is_left_to_it(bench: Bench, tmp_path: Path) -> None:
    other = Spool(tmp_path / "calibrations")
    assert other.acquire()
    calibration_id = bench.queue(png(corners()))
    runner = bench.run(FakeCalibration())
    time.sleep(0.1)
    assert bench.calibrations.get(calibration_id).state == "queued"
    other.release()
    runner.wake()
    assert bench.ended(calibration_id).state == "succeeded"


class Moody(Calibrations):
    """A database that is busy the first times it is asked for something."""

    def __init__(self, engine: Engine) -> None:
        super().__init__(engine)
        self.refusals = {"recover": 1, "take": 1, "is_running": 1, "finish": 1}
        self._lock = threading.Lock()

    def _sulk(self, name: str) -> None:
        with self._lock:
            if self.refusals[name] > 0:
                self.refusals[name] -= 1
                raise Busy("The database is busy: try again in a second.")

    def recover(self, spool: str) -> None:
        self._sulk("recover")
        super().recover(spool)

    def take(self, spool: str) -> CalibrationRecord | None:
        self._sulk("take")
        return super().take(spool)

    def is_running(self, calibration_id: str) -> bool:
        self._sulk("is_running")
        return super().is_running(calibration_id)

    def finish(self, calibration_id: str, ending: Ending) -> bool:
        self._sulk("finish")
        return super().finish(calibration_id, ending)


def test_a_busy_database_costs_time_and_nothing_else(engine: Engine, spool: Spool) -> None:
    bench = Bench(Moody(engine), spool)
    calibration_id = bench.queue(png(corners()), register=True)
    runner = bench.run(FakeCalibration())
    for _ in range(2):
        time.sleep(0.2)
        runner.wake()
    record = bench.ended(calibration_id)
    runner.close()
    assert (record.state, record.camera_revision) == ("succeeded", 1)


class Severed(Calibrations):
    """A database whose connection ends between the first commit and the word of it."""

    is_severed = False

    def take(self, spool: str) -> CalibrationRecord | None:
        record = super().take(spool)
        if record is not None and not self.is_severed:
            self.is_severed = True
            raise NotReady("The database cannot be used: the service's log says why.")
        return record


def test_what_was_begun_and_not_told_of_is_begun_again(engine: Engine, spool: Spool) -> None:
    bench = Bench(Severed(engine), spool)
    calibration_id = bench.queue(png(corners()))
    runner = bench.run(FakeCalibration())
    bench.until(lambda: bench.calibrations.get(calibration_id).state == "running")
    time.sleep(0.1)
    runner.wake()
    assert bench.ended(calibration_id).state == "succeeded"
    runner.close()


@pytest.mark.parametrize("has_ended", [False, True])
def test_what_the_database_forgot_was_begun_is_begun_again(bench: Bench, engine: Engine, *, has_ended: bool) -> None:
    """As after a failover: the one that takes over may lack the last writes."""
    calibration_id = bench.queue(png(corners()))

    def forget() -> None:
        with writing(engine) as session:
            session.connection().exec_driver_sql("UPDATE calibrations SET state = 'queued', attempts = 0")

    def outcome() -> Result:
        if has_ended and len(fake.tasks) == 1:
            forget()
        return RESULT

    fake = FakeCalibration(outcome, is_held=not has_ended)
    bench.run(fake)
    if not has_ended:
        assert fake.has_begun.wait(PATIENCE_S)
        forget()
        bench.until(lambda: len(fake.tasks) == 2)
        fake.go.set()
    assert bench.ended(calibration_id).state == "succeeded"
    assert len(fake.tasks) == 2
    bench.until(lambda: bench.spool.ids() == [])


def test_the_log_says_why_calibrations_wait_for_the_database(bench: Bench, engine: Engine) -> None:
    fake = FakeCalibration(is_held=True)
    calibration_id = bench.queue(png(corners()))
    with structlog.testing.capture_logs() as events:

        def until_told(name: str) -> None:
            bench.until(lambda: any(event["event"] == name for event in events))

        with without_calibrations(engine):
            runner = bench.run(fake)
            until_told("calibrations_wait")
        runner.wake()
        assert fake.has_begun.wait(PATIENCE_S)
        with without_calibrations(engine):
            fake.go.set()
            until_told("calibration_waits_for_the_database")
        assert bench.ended(calibration_id).state == "succeeded"
    assert all("no such table: calibrations" in event["cause"] for event in events)
