"""The repository keeps every number and every revision, on SQLite and on PostgreSQL, under a race too."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime

import pytest
from sqlalchemy import Engine
from sqlmodel import col, select

from service.errors import Conflict, NotFound, PreconditionFailed
from service.optics.camera import Camera, Intrinsics, Lens
from service.storage.cameras import CameraDraft, CameraRecord, Cameras
from service.storage.engine import reading
from service.storage.tables import CameraRevisionRow

LENS = Lens(35.0, 2.8, 6.05, 3872, 3.9)
INTRINSICS = Intrinsics(963.7, 963.1, 321.5, 215.25, (0.1, -0.2, 0.0, 1e-9, 0.3))
DRAFT = CameraDraft(
    "d200",
    Camera(645, 432, 2.0, LENS.k_cam_px(2.0, 645), 0.1 + 0.2, LENS.focal_length_m, INTRINSICS, 2.8),
    "lens",
    LENS,
    "Größe, 👍",
)
PLAIN = CameraDraft("plain", Camera(640, 480, 1.5, 3.81, 0.0), "given")


CALIBRATED = replace(PLAIN, source="calibration", camera=replace(PLAIN.camera, f_number=5.6))


@pytest.mark.parametrize("draft", [DRAFT, PLAIN, CALIBRATED])
def test_nothing_is_lost(cameras: Cameras, draft: CameraDraft) -> None:
    before = datetime.now(UTC)
    added = cameras.add(draft)
    read = cameras.get(draft.name)
    assert read.draft == draft
    assert read.camera == draft.camera
    assert read == added
    assert read.revision == 1
    assert before <= read.created_at == read.updated_at <= datetime.now(UTC)
    assert read.created_at.utcoffset() == UTC.utcoffset(None)


def test_no_revision_is_overwritten(cameras: Cameras, engine: Engine) -> None:
    cameras.add(DRAFT)
    cameras.replace(replace(PLAIN, name="d200"))
    cameras.delete("d200")
    assert cameras.add(DRAFT).revision == 3
    with reading(engine) as session:
        rows = session.exec(select(CameraRevisionRow).order_by(col(CameraRevisionRow.revision))).all()
        assert [(row.revision, row.k_cam_px) for row in rows] == [
            (1, DRAFT.camera.k_cam_px),
            (2, 3.81),
            (3, DRAFT.camera.k_cam_px),
        ]


def test_revisions_are_read_from_the_newest_down(cameras: Cameras) -> None:
    cameras.add(DRAFT)
    for k_cam_px in (5.0, 6.0):
        cameras.replace(replace(DRAFT, camera=replace(DRAFT.camera, k_cam_px=k_cam_px)))
    newest, has_more = cameras.revisions(DRAFT.name, 2)
    assert ([one.revision for one in newest], has_more) == ([3, 2], True)
    assert newest[0].camera == cameras.get(DRAFT.name).camera
    assert newest[0].created_at > newest[1].created_at
    oldest, has_more = cameras.revisions(DRAFT.name, 2, before=2)
    assert ([one.draft for one in oldest], has_more) == ([DRAFT], False)
    assert not cameras.revisions(DRAFT.name, 3)[1]


def test_a_name_that_is_registered_anew_is_as_old_as_that(cameras: Cameras) -> None:
    first = cameras.add(PLAIN)
    ways: list[Callable[[], CameraRecord]] = [
        lambda: cameras.add(PLAIN),
        lambda: cameras.store_calibrated(PLAIN.name, PLAIN.camera),
    ]
    for register in ways:
        cameras.delete(PLAIN.name)
        again = register()
        assert first.created_at < again.created_at == again.updated_at
        assert cameras.get(PLAIN.name) == again
        first = again


def test_revisions_are_those_of_one_camera(cameras: Cameras) -> None:
    cameras.add(PLAIN)
    cameras.add(DRAFT)
    cameras.replace(PLAIN)
    assert [one.draft for one in cameras.revisions(DRAFT.name, 9)[0]] == [DRAFT]
    assert [(one.draft, one.revision) for one in cameras.revisions(PLAIN.name, 9)[0]] == [(PLAIN, 2), (PLAIN, 1)]


def test_a_taken_name_is_a_conflict(cameras: Cameras) -> None:
    cameras.add(PLAIN)
    with pytest.raises(Conflict):
        cameras.add(PLAIN)


def test_a_stale_revision_changes_nothing(cameras: Cameras) -> None:
    cameras.add(PLAIN)
    with pytest.raises(PreconditionFailed):
        cameras.replace(PLAIN, expected=[2])
    with pytest.raises(PreconditionFailed):
        cameras.delete("plain", expected=[])
    assert cameras.get("plain").revision == 1


@pytest.mark.parametrize("name", ["nobody", "", "a\x00b", "a'; drop table cameras; --", "x" * 65])
def test_an_unknown_name_is_not_found(cameras: Cameras, name: str) -> None:
    actions: list[Callable[[], object]] = [
        lambda: cameras.get(name),
        lambda: cameras.delete(name),
        lambda: cameras.replace(replace(PLAIN, name=name)),
    ]
    for action in actions:
        with pytest.raises(NotFound):
            action()


def test_pages_follow_one_another(cameras: Cameras) -> None:
    for number in range(5):
        cameras.add(replace(PLAIN, name=f"camera-{number}"))
    cameras.delete("camera-3")
    first, has_more = cameras.page(2)
    assert ([record.name for record in first], has_more) == (["camera-0", "camera-1"], True)
    last, has_more = cameras.page(2, after="camera-1")
    assert ([record.name for record in last], has_more) == (["camera-2", "camera-4"], False)
    assert not cameras.page(4)[1]


def test_one_of_many_wins_a_name(cameras: Cameras) -> None:
    def add(_: int) -> str:
        try:
            return f"revision {cameras.add(PLAIN).revision}"
        except Conflict:
            return "conflict"

    with ThreadPoolExecutor(8) as pool:
        outcomes = sorted(pool.map(add, range(8)))
    assert outcomes == ["conflict"] * 7 + ["revision 1"]


def test_one_of_many_replaces_a_known_revision(cameras: Cameras) -> None:
    cameras.add(PLAIN)

    def put(_: int) -> str:
        try:
            return f"revision {cameras.replace(PLAIN, expected=[1]).revision}"
        except PreconditionFailed:
            return "stale"

    with ThreadPoolExecutor(8) as pool:
        outcomes = sorted(pool.map(put, range(8)))
    assert outcomes == ["revision 2"] + ["stale"] * 7


def test_replacements_at_once_each_get_a_revision(cameras: Cameras) -> None:
    cameras.add(PLAIN)
    with ThreadPoolExecutor(8) as pool:
        revisions = sorted(pool.map(lambda _: cameras.replace(PLAIN).revision, range(8)))
    assert revisions == list(range(2, 10))
