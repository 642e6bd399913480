"""The spool: a folder for each calibration that has not ended, with its photographs under numbers of our own.

One process at a time works a spool off; it is told from the spools of other machines by an id in a file.
"""

import fcntl
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO
from uuid import uuid4

from service.storage.calibrations import ID_PATTERN

ID_FILE = "spool-id"
LOCK_FILE = "lock"


class Spool:
    """The photographs below one folder, which is made if it is not there."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self._lock: BinaryIO | None = None
        self._incoming: set[str] = set()
        self.id = _id_in(folder)

    @property
    def incoming(self) -> int:
        """How many calibrations are being received now."""
        return len(self._incoming)

    @contextmanager
    def receiving(self, calibration_id: str) -> Iterator[Path]:
        """A new folder to be filled; it is removed again where that fails."""
        folder = self._folder / calibration_id
        self._incoming.add(calibration_id)
        try:
            folder.mkdir()
            yield folder
        except BaseException:
            self.remove(calibration_id)
            raise
        finally:
            self._incoming.discard(calibration_id)

    def seal(self, calibration_id: str) -> None:
        """Put the folder on the disk; its files were before, each with ``write_through``."""
        _sync_folder(self._folder / calibration_id)
        _sync_folder(self._folder)

    def paths(self, calibration_id: str, count: int) -> list[Path]:
        """Where the photographs are, in the order they came in."""
        return [self._folder / calibration_id / picture_file(number) for number in range(count)]

    def remove(self, calibration_id: str) -> None:
        """Remove a calibration's photographs, if they are here."""
        shutil.rmtree(self._folder / calibration_id, ignore_errors=True)

    def ids(self) -> list[str]:
        """The calibrations that have a folder, but for those being received: the database may not know them yet."""
        names = [path.name for path in self._folder.iterdir() if re.fullmatch(ID_PATTERN, path.name)]
        return [name for name in names if name not in self._incoming]

    def acquire(self) -> bool:
        """Become the one process that works this spool off; False while another is. Ends with the process."""
        if self._lock is None:
            lock = (self._folder / LOCK_FILE).open("ab")
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                lock.close()
                return False
            self._lock = lock
        return True

    def release(self) -> None:
        """Let another process work the spool off."""
        if self._lock is not None:
            self._lock.close()
            self._lock = None


def picture_file(number: int) -> str:
    """The file name of a calibration's n-th photograph; what the user calls it is never part of a path."""
    return f"{number:04d}"


def write_through(file: BinaryIO) -> None:
    """Put a file's content on the disk."""
    file.flush()
    os.fsync(file.fileno())


def _id_in(folder: Path) -> str:
    """The folder's id; the first process that comes makes it, whole or not at all."""
    path = folder / ID_FILE
    if not path.exists():
        draft = folder / f".{uuid4().hex}"
        with draft.open("wb") as file:
            file.write(uuid4().hex.encode())
            write_through(file)
        with suppress(FileExistsError):
            path.hardlink_to(draft)
        draft.unlink()
        _sync_folder(folder)
    return path.read_text()


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
