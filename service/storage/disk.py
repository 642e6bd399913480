"""The disk: locks that end with the process that holds them, content that is really there, and what can go wrong."""

import errno
import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from service.errors import InsufficientStorage, NotReady

NO_ROOM = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})


def make_private(folder: Path) -> None:
    """Make a folder that its owner alone can look into; one that is there stays as it is.

    Raises ``OSError``, whose message says what to do.
    """
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as exc:
        told = f"The folder {folder} cannot be made ({exc.strerror}): set CAMIND_DATA_DIR or CAMIND_DATABASE_URL."
        raise OSError(told) from exc


def try_lock(path: Path, *, is_shared: bool = False) -> BinaryIO | None:
    """The file, made for its owner alone if it is not there, locked until it is closed; None while others hold it.

    Raises ``OSError``, whose message says what to do, where the disk knows no locks.
    """
    # on NFS who shares a lock must be able to read, who has it alone to write
    file = os.fdopen(os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o600), "ab")
    try:
        fcntl.flock(file, (fcntl.LOCK_SH if is_shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        file.close()
        return None
    except OSError as exc:
        file.close()
        told = f"{path} cannot be locked ({exc.strerror}): set CAMIND_DATA_DIR to a folder on this machine's own disk."
        raise OSError(told) from exc
    return file


def write_through(file: BinaryIO) -> None:
    """Put a file's content on the disk."""
    file.flush()
    os.fsync(file.fileno())


def sync_folder(folder: Path) -> None:
    """Put a folder's list of names on the disk."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def storing() -> Iterator[None]:
    """Raises ``InsufficientStorage`` where photographs find no room, ``NotReady`` where the disk fails otherwise."""
    try:
        yield
    except OSError as exc:
        if exc.errno in NO_ROOM:
            raise InsufficientStorage("There is no room for the photographs: try again when there is.") from exc
        raise NotReady("The photographs cannot be stored: the service's log says why.") from exc
