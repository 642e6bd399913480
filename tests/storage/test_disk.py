"""Locks are to be had on network disks too, or it is said that they are not."""

import errno
import fcntl
from pathlib import Path
from typing import IO

import pytest

from service.storage.disk import try_lock


def test_a_lock_is_one_that_a_network_disk_grants(tmp_path: Path) -> None:
    for is_shared, kind in ((True, fcntl.LOCK_SH), (False, fcntl.LOCK_EX)):
        lock = try_lock(tmp_path / "lock", is_shared=is_shared)
        assert lock is not None
        with lock:
            fcntl.lockf(lock, kind | fcntl.LOCK_NB)  # what NFS makes of it (flock(2))


def test_a_disk_without_locks_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def flock(_file: IO[bytes], _kind: int) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", flock)
    with pytest.raises(OSError, match=r"lock cannot be locked \(No locks available\): set CAMIND_DATA_DIR"):
        try_lock(tmp_path / "lock")
