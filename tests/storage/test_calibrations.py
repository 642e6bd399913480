"""The queue of calibrations keeps its order and its promises, on SQLite and on PostgreSQL, under a race too."""

import sqlite3
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, cast
from uuid import uuid4

import pytest
from sqlalchemy import Engine, update
from sqlalchemy.exc import StatementError

from service.errors import Conflict, NotFound
from service.optics.camera import Camera, Intrinsics
from service.storage import schema
from service.storage.calibrations import (
    CalibrationDraft,
    CalibrationRecord,
    Calibrations,
    Ending,
    EndState,
    StoredPicture,
)
from service.storage.cameras import CameraDraft, Cameras
from service.storage.engine import open_engine, writing
from service.storage.tables import CalibrationRow
from tests.fake_calibration import SETTINGS

SPOOL, OTHER_SPOOL = "a" * 32, "b" * 32
CAMERA = Camera(64, 48, 1.5, 6.5, 0.75, intrinsics=Intrinsics(80.0, 81.0, 31.5, 23.5, (0.1, 0.2, 0.0, 0.0, 0.3)))
PICTURES = (StoredPicture("Größe 👍.jpg", "focused"), StoredPicture("near.jpg", "defocused"))
SUCCESS = Ending("succeeded", [{"name": "near.jpg"}], {"k_cam_px": {"value": 6.5}})


@pytest.fixture
def calibrations(engine: Engine) -> Calibrations:
    return Calibrations(engine)


def draft(spool: str = SPOOL, camera: str = "bench") -> CalibrationDraft:
    return CalibrationDraft(uuid4().hex, spool, camera, dict(SETTINGS), PICTURES)


def running(calibrations: Calibrations, camera: str = "bench") -> str:
    calibration_id = calibrations.add(draft(camera=camera)).id
    taken = calibrations.take(SPOOL)
    assert taken is not None
    assert taken.id == calibration_id
    return calibration_id


def ended(calibrations: Calibrations, state: EndState) -> str:
    calibration_id = running(calibrations)
    if state == "cancelled":
        calibrations.cancel(calibration_id)
    else:
        calibrations.finish(calibration_id, Ending(state))
    return calibration_id


def test_nothing_is_lost(calibrations: Calibrations) -> None:
    before = datetime.now(UTC)
    wanted = draft()
    added = calibrations.add(wanted)
    read = calibrations.get(wanted.id)
    assert read == added
    assert read.draft == wanted
    assert (read.state, read.progress, read.images, read.result, read.problem) == ("queued", 0.0, [], None, None)
    assert before <= read.created_at == read.updated_at <= datetime.now(UTC)


def test_the_first_to_come_is_the_first_to_run(calibrations: Calibrations) -> None:
    ids = [calibrations.add(draft()).id for _ in range(3)]
    calibrations.add(draft(OTHER_SPOOL))
    assert calibrations.waiting(SPOOL).total() == 3
    assert calibrations.live_counts(SPOOL) == {"queued": 3, "running": 0}
    taken = [calibrations.take(SPOOL) for _ in range(4)]
    assert [record and record.id for record in taken] == [*ids, None]
    assert calibrations.waiting(SPOOL).total() == 0
    assert calibrations.waiting(OTHER_SPOOL).total() == 1


def test_owners_take_turns(calibrations: Calibrations, engine: Engine) -> None:
    owners = {name: Calibrations(engine, name) for name in ("lab", "guest")}
    owners["lab"].add(draft(OTHER_SPOOL))
    assert calibrations.take(OTHER_SPOOL) is not None
    came = [(owner, owners[owner].add(draft()).id) for owner in ("lab", "guest", "guest", "guest", "lab")]
    assert calibrations.waiting(SPOOL) == {"lab": 2, "guest": 3}
    taken = [record.id for record in (calibrations.take(SPOOL) for _ in came) if record is not None]
    assert taken == [came[number][1] for number in (0, 1, 4, 2, 3)]


def test_one_of_many_takes_what_waits(calibrations: Calibrations) -> None:
    calibrations.add(draft())
    with ThreadPoolExecutor(4) as pool:
        taken = list(pool.map(lambda _: calibrations.take(SPOOL), range(4)))
    assert sum(record is not None for record in taken) == 1


def test_every_change_has_a_version(calibrations: Calibrations) -> None:
    calibrations.add(draft(OTHER_SPOOL))
    calibration_id = calibrations.add(draft()).id
    versions = [calibrations.version(calibration_id)]
    for change in (
        lambda: calibrations.take(SPOOL),
        lambda: calibrations.tell(calibration_id, 0.5, [{"name": "near.jpg"}]),
        lambda: calibrations.finish(calibration_id, SUCCESS),
    ):
        change()
        versions.append(calibrations.version(calibration_id))
    assert versions == [1, 2, 3, 4]
    read = calibrations.get(calibration_id)
    assert (read.version, read.state, read.progress) == (4, "succeeded", 1.0)
    assert (read.images, read.result) == (SUCCESS.images, SUCCESS.result)
    assert read.updated_at > read.created_at


@pytest.mark.parametrize(("told", "kept"), [(-1.0, 0.0), (0.25, 0.25), (7.0, 1.0)])
def test_progress_stays_within_bounds(calibrations: Calibrations, told: float, kept: float) -> None:
    calibration_id = running(calibrations)
    calibrations.tell(calibration_id, told, [])
    assert calibrations.get(calibration_id).progress == kept


@pytest.mark.parametrize("state", ["succeeded", "failed", "cancelled"])
def test_what_has_ended_never_changes_again(calibrations: Calibrations, cameras: Cameras, state: EndState) -> None:
    running_elsewhere(calibrations)
    calibration_id = ended(calibrations, state)
    before = calibrations.get(calibration_id)
    assert before.state == state
    assert before.has_ended
    assert not calibrations.tell(calibration_id, 0.9, [])
    assert not calibrations.put_back(calibration_id)
    assert not calibrations.is_running(calibration_id)
    assert not calibrations.finish(calibration_id, replace(SUCCESS, camera=CAMERA))
    assert calibrations.cancel(calibration_id) == state
    calibrations.recover(SPOOL)
    calibrations.give_up("c" * 32, timedelta(0))
    assert calibrations.get(calibration_id) == before
    with pytest.raises(NotFound):
        cameras.get("bench")


def test_what_waits_can_be_cancelled_and_is_not_taken(calibrations: Calibrations) -> None:
    calibration_id = calibrations.add(draft()).id
    before = calibrations.version(calibration_id)
    assert calibrations.cancel(calibration_id) == "queued"
    assert calibrations.take(SPOOL) is None
    assert calibrations.get(calibration_id).state == "cancelled"
    assert calibrations.version(calibration_id) > before


def test_what_is_put_back_was_not_tried(calibrations: Calibrations) -> None:
    calibration_id = running(calibrations)
    calibrations.tell(calibration_id, 0.5, [{"name": "near.jpg"}])
    assert calibrations.put_back(calibration_id)
    read = calibrations.get(calibration_id)
    assert (read.state, read.attempts, read.progress, read.images) == ("queued", 0, 0.0, [])


def test_what_a_dead_process_left_is_tried_again(calibrations: Calibrations) -> None:
    calibration_id = running(calibrations)
    calibrations.recover(OTHER_SPOOL)
    assert calibrations.get(calibration_id).state == "running"
    calibrations.recover(SPOOL)
    assert calibrations.get(calibration_id).state == "queued"
    again = calibrations.take(SPOOL)
    assert again is not None
    assert (again.id, again.attempts) == (calibration_id, 2)


def test_what_is_tried_again_changes_nothing_else(calibrations: Calibrations) -> None:
    others = [ended(calibrations, "succeeded"), running_elsewhere(calibrations).id]
    before = [calibrations.get(each) for each in others]
    calibration_id = running(calibrations)
    calibrations.recover(SPOOL)
    assert calibrations.get(calibration_id).state == "queued"
    assert [calibrations.get(each) for each in others] == before


def test_what_is_tried_again_begins_anew_and_who_follows_it_is_told(calibrations: Calibrations, engine: Engine) -> None:
    calibration_id = running(calibrations)
    calibrations.tell(calibration_id, 0.5, [{"name": "near.jpg"}])
    with writing(engine) as session:
        session.connection().execute(update(CalibrationRow).values(updated_at=datetime.now(UTC) - timedelta(days=2)))
    before = calibrations.version(calibration_id)
    calibrations.recover(SPOOL)
    calibrations.give_up(OTHER_SPOOL)
    read = calibrations.get(calibration_id)
    assert (read.state, read.progress, read.images) == ("queued", 0.0, [])
    assert read.version > before


def test_what_was_told_of_before_a_failure_stays(calibrations: Calibrations) -> None:
    calibration_id = running(calibrations)
    calibrations.tell(calibration_id, 0.5, [{"name": "near.jpg"}])
    calibrations.finish(calibration_id, Ending("failed", problem="no grid"))
    read = calibrations.get(calibration_id)
    assert (read.problem, read.progress, read.images) == ("no grid", 0.5, [{"name": "near.jpg"}])


def test_what_a_lost_service_held_fails_after_a_day(calibrations: Calibrations, engine: Engine) -> None:
    ids = [calibrations.add(draft()).id, running_elsewhere(calibrations).id]
    calibrations.give_up("c" * 32)
    assert [calibrations.get(each).state for each in ids] == ["queued", "running"]
    with writing(engine) as session:
        yesterday = datetime.now(UTC) - timedelta(days=1, minutes=1)
        session.connection().execute(update(CalibrationRow).values(updated_at=yesterday))
    calibrations.give_up(SPOOL)
    assert [calibrations.get(each).state for each in ids] == ["queued", "failed"]
    before = calibrations.version(ids[0])
    calibrations.give_up("c" * 32)
    assert calibrations.version(ids[0]) > before
    for each in ids:
        read = calibrations.get(each)
        assert read.state == "failed"
        assert read.updated_at > yesterday + timedelta(hours=1)
        assert "did not come back" in (read.problem or "")


def running_elsewhere(calibrations: Calibrations) -> CalibrationRecord:
    calibrations.add(draft(OTHER_SPOOL))
    record = calibrations.take(OTHER_SPOOL)
    assert record is not None
    return record


def test_a_camera_is_made_with_the_end(calibrations: Calibrations, cameras: Cameras) -> None:
    calibration_id = running(calibrations, "new")
    assert calibrations.finish(calibration_id, replace(SUCCESS, camera=CAMERA))
    camera = cameras.get("new")
    assert camera.draft == CameraDraft("new", CAMERA, "calibration")
    assert camera.revision == calibrations.get(calibration_id).camera_revision == 1


def test_a_camera_gets_a_revision_and_keeps_its_description(calibrations: Calibrations, cameras: Cameras) -> None:
    cameras.add(CameraDraft("bench", Camera(640, 480, 2.0, 3.0), "given", description="on the shelf"))
    first = running(calibrations)
    calibrations.finish(first, replace(SUCCESS, camera=CAMERA))
    assert cameras.get("bench").draft == CameraDraft("bench", CAMERA, "calibration", description="on the shelf")
    cameras.delete("bench")
    second = running(calibrations)
    calibrations.finish(second, replace(SUCCESS, camera=CAMERA))
    assert cameras.get("bench").draft.description is None
    assert [calibrations.get(each).camera_revision for each in (first, second)] == [2, 3]


def test_an_end_that_cannot_be_stored_leaves_no_camera(calibrations: Calibrations, cameras: Cameras) -> None:
    calibration_id = running(calibrations, "new")
    no_json: Any = object()
    with pytest.raises((TypeError, StatementError)):
        calibrations.finish(calibration_id, Ending("succeeded", result=no_json, camera=CAMERA))
    assert calibrations.get(calibration_id).state == "running"
    assert cameras.page(10) == ([], False)


def test_ends_at_once_make_one_camera(calibrations: Calibrations, cameras: Cameras) -> None:
    ids = [running(calibrations, "new") for _ in range(4)]
    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(lambda each: calibrations.finish(each, replace(SUCCESS, camera=CAMERA)), ids))
    assert sorted(calibrations.get(each).camera_revision or 0 for each in ids) == [1, 2, 3, 4]
    assert cameras.get("new").revision == 4


def test_one_of_cancel_and_finish_wins(calibrations: Calibrations) -> None:
    for _ in range(5):
        calibration_id = running(calibrations)
        with ThreadPoolExecutor(2) as pool:
            finished = pool.submit(calibrations.finish, calibration_id, SUCCESS)
            before = pool.submit(calibrations.cancel, calibration_id)
            is_finished = finished.result()
            assert before.result() == ("succeeded" if is_finished else "running")
        assert calibrations.get(calibration_id).state == ("succeeded" if is_finished else "cancelled")


def test_pages_follow_one_another_from_the_newest(calibrations: Calibrations) -> None:
    ids = [calibrations.add(draft(camera=f"camera-{number}")).id for number in range(5)]
    first, has_more = calibrations.page(2)
    assert ([item.id for item in first], has_more) == ([ids[4], ids[3]], True)
    assert (first[0].camera, first[0].state) == ("camera-4", "queued")
    middle, _ = calibrations.page(2, after=first[-1].id)
    last, has_more = calibrations.page(2, after=middle[-1].id)
    assert ([item.id for item in last], has_more) == ([ids[0]], False)
    assert not calibrations.page(5)[1]
    assert calibrations.page(2, after=uuid4().hex) == ([], False)


def test_a_page_costs_no_look_at_the_calibrations_of_others(tmp_path: Path) -> None:
    engine = open_engine(f"sqlite:///{tmp_path / 'camind.sqlite3'}")
    schema.upgrade(engine)
    calibrations = Calibrations(engine, "lab")
    wanted = calibrations.add(draft()).id
    with engine.connect() as connection:
        driver = cast(sqlite3.Connection, connection.connection.driver_connection)
    steps = []
    driver.set_progress_handler(lambda: steps.append(1), 10)
    calibrations.page(10)
    alone = len(steps)
    for _ in range(100):
        Calibrations(engine, "others").add(draft())
    steps.clear()
    assert [summary.id for summary in calibrations.page(10)[0]] == [wanted]
    assert len(steps) < alone + 10
    engine.dispose()


def test_what_has_ended_or_is_unknown_is_not_live(calibrations: Calibrations) -> None:
    live, over, unknown = calibrations.add(draft()).id, calibrations.add(draft()).id, uuid4().hex
    calibrations.cancel(over)
    assert calibrations.live([live, over, unknown]) == {live}
    assert calibrations.live([]) == set()


@pytest.mark.parametrize("owner", [None, "lab"])
def test_what_ended_long_ago_is_forgotten_and_nothing_else(
    engine: Engine, cameras: Cameras, monkeypatch: pytest.MonkeyPatch, owner: str | None
) -> None:
    monkeypatch.setattr("service.storage.calibrations.FORGOTTEN_AT_A_TIME", 2)
    everybody, lab = Calibrations(engine), Calibrations(engine, "lab")
    old = [ended(lab, state) for state in ("succeeded", "failed", "cancelled")]
    others = running(everybody)
    everybody.finish(others, replace(SUCCESS, camera=CAMERA))
    waiting = everybody.add(draft()).id
    now = datetime.now(UTC)
    with writing(engine) as session:
        session.connection().execute(update(CalibrationRow).values(updated_at=now - timedelta(days=2)))
    new = everybody.add(draft()).id
    everybody.cancel(new)
    assert Calibrations(engine, owner).forget(now - timedelta(days=1)) == (4 if owner is None else 3)
    kept = {summary.id for summary in everybody.page(10)[0]}
    assert kept == {waiting, new} | ({others} if owner else set())
    assert not kept & set(old)
    assert cameras.get("bench").camera == CAMERA


@pytest.mark.parametrize("name", ["nobody", "", "a\x00b", "A" * 32, "x" * 65, "f" * 32])
def test_an_unknown_id_is_not_found(calibrations: Calibrations, name: str) -> None:
    actions: list[Callable[[], object]] = [lambda: calibrations.get(name), lambda: calibrations.cancel(name)]
    for action in actions:
        with pytest.raises(NotFound):
            action()


def test_another_owner_s_is_as_if_not_there(calibrations: Calibrations, engine: Engine) -> None:
    calibration_id, others = running(calibrations), Calibrations(engine, "others")
    actions: list[Callable[[], object]] = [
        lambda: others.get(calibration_id),
        lambda: others.cancel(calibration_id),
        lambda: others.accept(calibration_id, "bench", CAMERA),
    ]
    for action in actions:
        with pytest.raises(NotFound):
            action()
    assert others.page(9) == ([], False)
    assert calibrations.get(calibration_id).state == "running"


def test_what_an_owner_accepts_becomes_that_owner_s_camera(cameras: Cameras, engine: Engine) -> None:
    lab = Calibrations(engine, "lab")
    lab.accept(ended(lab, "succeeded"), "bench", CAMERA)
    assert Cameras(engine, "lab").get("bench").camera == CAMERA
    assert cameras.page(9) == ([], False)


def test_accepted_by_many_at_once_it_is_stored_once(calibrations: Calibrations, engine: Engine) -> None:
    calibration_id = running(calibrations)
    calibrations.finish(calibration_id, SUCCESS)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: calibrations.accept(calibration_id, "bench", CAMERA), range(8)))
    assert {(one.draft.camera, one.camera_revision) for one in found} == {("bench", 1)}
    stored = Cameras(engine).get("bench")
    assert (stored.camera, stored.draft.source, stored.revision) == (CAMERA, "calibration", 1)
    with pytest.raises(Conflict, match="bench"):
        calibrations.accept(calibration_id, "other", CAMERA)
