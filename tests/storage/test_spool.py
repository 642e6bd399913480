"""The spool keeps photographs under names of its own, and is worked off by one process at a time."""

import os
import resource
import time
from pathlib import Path
from uuid import uuid4

import pytest

from service.errors import NotReady
from service.storage.spool import LEFT_BEHIND_AFTER_S, Spool, picture_file


@pytest.fixture
def spool(tmp_path: Path) -> Spool:
    return Spool(tmp_path / "data" / "calibrations")


def test_a_spool_has_one_id_for_ever(spool: Spool, tmp_path: Path) -> None:
    assert Spool(tmp_path / "data" / "calibrations").id == spool.id
    assert Spool(tmp_path / "other").id != spool.id
    assert len(spool.id) == 32


def test_a_start_without_room_leaves_no_file(tmp_path: Path) -> None:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, before[1]))
    try:
        with pytest.raises(OSError, match=r"^No file can be made in the folder .*: File too large\.$"):
            Spool(tmp_path / "calibrations")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list((tmp_path / "calibrations").iterdir()) == []


def test_what_was_received_stays_until_it_is_removed(spool: Spool) -> None:
    calibration_id = uuid4().hex
    with spool.receiving(calibration_id) as folder:
        assert spool.incoming.total() == 1
        (folder / picture_file(0)).write_bytes(b"picture")
        spool.seal(calibration_id)
    assert spool.incoming.total() == 0
    assert spool.ids() == [calibration_id]
    assert [path.read_bytes() for path in spool.paths(calibration_id, 1)] == [b"picture"]
    spool.remove(calibration_id)
    spool.remove(calibration_id)
    assert spool.ids() == []


def test_what_was_not_received_whole_is_gone(spool: Spool) -> None:
    def receive() -> None:
        with spool.receiving(uuid4().hex) as folder:
            (folder / picture_file(0)).write_bytes(b"pic")
            raise ConnectionError

    with pytest.raises(ConnectionError):
        receive()
    assert (spool.ids(), spool.incoming.total()) == ([], 0)


def test_one_at_a_time_works_it_off(spool: Spool, tmp_path: Path) -> None:
    other = Spool(tmp_path / "data" / "calibrations")
    assert spool.acquire()
    assert spool.acquire()
    assert not other.acquire()
    other.release()
    assert not other.acquire()
    spool.release()
    assert other.acquire()
    other.release()


def test_what_is_being_received_is_nobody_s_orphan(spool: Spool, tmp_path: Path) -> None:
    """A start's cleaning once took a folder whose row was about to be stored."""
    other = Spool(tmp_path / "data" / "calibrations")
    with spool.receiving("a" * 32):
        assert spool.ids() == other.ids() == []
        assert (spool.incoming.total(), other.incoming.total()) == (1, 0)
    assert spool.ids() == other.ids() == ["a" * 32]


def test_folders_that_never_got_their_name_are_removed(spool: Spool, tmp_path: Path) -> None:
    old, new = (tmp_path / "data" / "calibrations" / f".{uuid4().hex}" for _ in range(2))
    for draft in (old, new):
        draft.mkdir()
        (draft / "lock").touch()
    long_ago_s = time.time() - LEFT_BEHIND_AFTER_S - 1
    os.utime(old, (long_ago_s, long_ago_s))
    spool.remove_drafts()
    assert (old.exists(), new.exists()) == (False, True)


def test_a_spool_that_is_gone_takes_nothing(spool: Spool, tmp_path: Path) -> None:
    (tmp_path / "data").rename(tmp_path / "elsewhere")
    with pytest.raises(NotReady), spool.receiving(uuid4().hex):
        pass
    assert spool.incoming.total() == 0
