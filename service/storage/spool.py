"""The spool: a folder for each calibration that has not ended, with its photographs under numbers of our own.

One process at a time works a spool off, and all that share it fill it; it is told from the spools of other machines by
an id in a file. A folder is locked while it is filled, from before it has its name until the database knows it.
"""

import re
import shutil
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO
from uuid import uuid4

from service.principal import LOCAL
from service.storage.calibrations import ID_PATTERN
from service.storage.disk import make_private, storing, sync_folder, try_lock, write_through

ID_FILE = "spool-id"
LOCK_FILE = "lock"
# far longer than it takes to name a folder that was made; who takes longer is told to come again
LEFT_BEHIND_AFTER_S = 10.0


class Spool:
    """The photographs below one folder, which is made if it is not there."""

    def __init__(self, folder: Path) -> None:
        make_private(folder)
        self._folder = folder
        self._lock: BinaryIO | None = None
        self._incoming: Counter[str] = Counter()
        self.id = _id_in(folder)

    @property
    def incoming(self) -> Counter[str]:
        """How many calibrations this process is receiving now, by owner."""
        return self._incoming.copy()

    @contextmanager
    def receiving(self, calibration_id: str, owner: str = LOCAL) -> Iterator[Path]:
        """A new folder to be filled; it is removed again where that fails.

        Raises ``InsufficientStorage`` and ``NotReady`` where it cannot be made.
        """
        draft, lock = f".{calibration_id}", None
        self._incoming[owner] += 1
        try:
            with storing():
                (self._folder / draft).mkdir(mode=0o700)
                lock = try_lock(self._folder / draft / LOCK_FILE)
                folder = (self._folder / draft).rename(self._folder / calibration_id)
            yield folder
        except BaseException:
            self.remove(draft)
            self.remove(calibration_id)
            raise
        finally:
            if lock is not None:
                lock.close()
            self._incoming[owner] -= 1

    def seal(self, calibration_id: str) -> None:
        """Put the folder on the disk; its files were before, each with ``write_through``. Raises as ``receiving``."""
        with storing():
            sync_folder(self._folder / calibration_id)
            sync_folder(self._folder)

    def paths(self, calibration_id: str, count: int) -> list[Path]:
        """Where the photographs are, in the order they came in."""
        return [self._folder / calibration_id / picture_file(number) for number in range(count)]

    def remove(self, calibration_id: str) -> None:
        """Remove a calibration's photographs, if they are here."""
        shutil.rmtree(self._folder / calibration_id, ignore_errors=True)

    def ids(self) -> list[str]:
        """The calibrations that have a folder, but for those being received: the database may not know them yet."""
        return [
            path.name
            for path in self._folder.iterdir()
            if re.fullmatch(ID_PATTERN, path.name) and not _is_being_filled(path)
        ]

    def remove_drafts(self) -> None:
        """Remove folders whose process ended between making and naming them."""
        for draft in self._folder.glob(".*/"):
            with suppress(FileNotFoundError):
                if time.time() - draft.stat().st_mtime > LEFT_BEHIND_AFTER_S:
                    self.remove(draft.name)

    def acquire(self) -> bool:
        """Become the one process that works this spool off; False while another is. Ends with the process."""
        if self._lock is None:
            self._lock = try_lock(self._folder / LOCK_FILE)
        return self._lock is not None

    def release(self) -> None:
        """Let another process work the spool off."""
        if self._lock is not None:
            self._lock.close()
            self._lock = None


def picture_file(number: int) -> str:
    """The file name of a calibration's n-th photograph; what the user calls it is never part of a path."""
    return f"{number:04d}"


def known_id(folder: Path) -> str | None:
    """The id of the spool in a folder; None where there is none yet, and none is made."""
    path = folder / ID_FILE
    return path.read_text() if path.exists() else None


def _id_in(folder: Path) -> str:
    """The folder's id; the first process that comes makes it, whole or not at all. Raises ``OSError``, in words."""
    path = folder / ID_FILE
    if not path.exists():
        draft = folder / f".{uuid4().hex}"
        try:
            with draft.open("wb") as file:
                file.write(uuid4().hex.encode())
                write_through(file)
            with suppress(FileExistsError):
                path.hardlink_to(draft)
        except OSError as exc:
            raise OSError(f"No file can be made in the folder {folder}: {exc.strerror}.") from exc
        finally:
            draft.unlink(missing_ok=True)
        sync_folder(folder)
    return path.read_text()


def _is_being_filled(folder: Path) -> bool:
    """Whether a process fills it now; what once was not being filled never will be."""
    try:
        lock = try_lock(folder / LOCK_FILE, is_shared=True)
    except FileNotFoundError:
        return False  # it was removed meanwhile
    if lock is not None:
        lock.close()
    return lock is None
