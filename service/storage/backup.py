"""Copies of an SQLite database: made while services use it, and put in its place while none does.

A file gets its name when it is whole, checked and on the disk: whatever ends this, what had the name before still has
it, or the new one has.
"""

import os
import shutil
import sqlite3
import stat
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from sqlalchemy import URL, Select, column, func, make_url, select, table

from service.errors import NotReady
from service.storage import schema
from service.storage.calibrations import Calibrations
from service.storage.disk import make_private, sync_folder, try_lock, write_through
from service.storage.engine import SQLITE_DAMAGED, open_engine

BUSY_TIMEOUT_S = 30.0
READ_BYTES = 1 << 20
# how its custom format, its SQL and its tar begin
OF_PG_DUMP = (b"PGDMP", b"--\n-- PostgreSQL database", b"toc.dat")
# what SQLite keeps beside a database; of another database they would be played into it
WAL = "-wal"
SIDE_FILES = ("-journal", WAL, "-shm")
# what only writing can end with
UNWRITTEN = (sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR_WRITE, sqlite3.SQLITE_IOERR_FSYNC, sqlite3.SQLITE_IOERR_TRUNCATE)


class DatabaseFileError(OSError):
    """A file that is not, or cannot become, the database; the message says which and what to do."""


@dataclass(frozen=True, slots=True)
class Contents:
    """What a database file holds: its schema's last migration, and how many rows by table."""

    revision: str | None
    rows: dict[str, int]

    def __str__(self) -> str:
        rows = ", ".join(f"{name} {count}" for name, count in self.rows.items())
        return f"{rows or 'no tables'}; schema {self.revision}"


def database_file(database_url: str | URL) -> Path | None:
    """The file of an SQLite database, links followed; None for one on a server or in memory."""
    url = make_url(database_url)
    is_file = url.get_backend_name() == "sqlite" and url.database not in (None, "", ":memory:")
    return Path(str(url.database)).resolve() if is_file else None


@contextmanager
def using(database_url: str | URL) -> Iterator[None]:
    """Nobody restores the database meanwhile. Raises ``NotReady`` where somebody does, ``DatabaseFileError`` where it
    has become empty, which SQLite would take for new.
    """
    file = database_file(database_url)
    if file is None:
        yield
        return
    make_private(file.parent)
    lock = try_lock(_lock_file(file), is_shared=True)
    if lock is None:
        raise NotReady(f"The database {file} is being restored: start again when that is done.")
    with lock:
        if _is_emptied(file):
            raise DatabaseFileError(
                f"The database {file} is damaged (it is empty, and its log {_beside(file, WAL)} is not): "
                "put a backup in its place with `camind restore FILE`, which keeps both."
            )
        yield


def require_sound(database: Path) -> None:
    """Read the whole file, if there is one. Raises ``DatabaseFileError`` where it is damaged."""
    if not database.exists():
        return
    _read_ahead(database)
    damage = _damage(database)
    if damage is not None:
        raise DatabaseFileError(
            f"The database {database} is damaged ({damage}): put a backup in its place with `camind restore FILE`."
        )


def backup(database: Path, target: Path, *, is_forced: bool = False) -> Contents:
    """Copy the database as it is at one moment; services may go on writing to it.

    Raises ``DatabaseFileError`` where there is none, where it is damaged, and where ``target`` is there already;
    ``NotReady`` while it is being restored.
    """
    if not database.is_file():
        raise DatabaseFileError(f"There is no database at {database}.")
    if target.exists() and target.samefile(database):
        raise DatabaseFileError(f"{target} is the database itself: choose another name.")
    if target.exists() and not target.is_file():
        raise DatabaseFileError(f"{target} is no file, and would be one afterwards: choose another name.")
    if target.exists() and not is_forced:
        raise DatabaseFileError(f"{target} is there already: choose another name, or overwrite it with --force.")
    with using(URL.create("sqlite", database=str(database))), _draft_beside(target) as draft:
        contents = _copied(database, draft, target)
        _put_in_place(draft, target)
    return contents


def restore(source: Path, database: Path, spool: str | None = None) -> tuple[Contents, Path | None]:
    """Put a backup in the database's place, at the newest schema; what it holds, and where the replaced one is kept.

    Calibrations that have not ended fail, but for those whose photographs are in the ``spool`` with this id.
    Raises ``DatabaseFileError`` where the backup is damaged, is none of this service's or of a later version's, and
    while the database is used.
    """
    if database.exists() and source.exists() and source.samefile(database):
        raise DatabaseFileError(f"{source} is the database itself: name a backup.")
    with newest(source, database, spool) as (draft, contents):
        kept = _keep(database)
        if kept is not None:
            _take_owner(draft, kept)
        _put_in_place(draft, database)
    return contents, kept


@contextmanager
def newest(source: Path, database: Path, spool: str | None) -> Iterator[tuple[Path, Contents]]:
    """A copy of a backup at the newest schema, beside the database that nobody uses meanwhile; gone afterwards.

    Calibrations that have not ended, and raised errors: as ``restore``.
    """
    if not source.is_file():
        raise DatabaseFileError(f"There is no backup at {source}.")
    _require_no_dump(source)
    with _replacing(database), _draft_beside(database) as draft:
        _require_known(_copied(source, draft, database), source)
        _make_ready(draft, spool)
        yield draft, _contents(draft)


def _is_emptied(database: Path) -> bool:
    """Whether a log of writes is all that is left: SQLite would remove it when it opens the file."""
    sizes = [path.stat().st_size if path.exists() else 0 for path in (database, _beside(database, WAL))]
    return sizes[0] == 0 < sizes[1]


def _lock_file(database: Path) -> Path:
    return database.with_name(f"{database.name}.lock")


@contextmanager
def _replacing(database: Path) -> Iterator[None]:
    make_private(database.parent)
    lock = try_lock(_lock_file(database))
    if lock is None:
        raise DatabaseFileError(f"The database {database} is in use: stop the service first.")
    with lock:
        for left_behind in database.parent.glob(f".{database.name}.*"):
            left_behind.unlink()
        yield


@contextmanager
def _draft_beside(target: Path) -> Iterator[Path]:
    """An empty file that is to get the target's name, readable by its owner alone; gone afterwards if it did not."""
    try:
        descriptor, name = tempfile.mkstemp(prefix=f".{target.name}.", dir=target.parent)
    except OSError as exc:
        raise DatabaseFileError(f"No file can be made in the folder {target.parent}: {exc.strerror}.") from exc
    os.close(descriptor)
    draft = Path(name)
    try:
        yield draft
    finally:
        for suffix in ("", *SIDE_FILES):
            _beside(draft, suffix).unlink(missing_ok=True)


def _put_in_place(draft: Path, target: Path) -> None:
    with draft.open("rb+") as file:
        write_through(file)
    for suffix in SIDE_FILES:
        _beside(target, suffix).unlink(missing_ok=True)
    draft.replace(target)
    sync_folder(target.parent)


def _beside(file: Path, suffix: str) -> Path:
    return file.with_name(file.name + suffix)


@contextmanager
def _opened(file: Path) -> Iterator[sqlite3.Connection]:
    """A connection that makes no file. Raises ``DatabaseFileError`` for what SQLite cannot read or write."""
    try:
        connection = sqlite3.connect(
            f"{file.absolute().as_uri()}?mode=rw", uri=True, timeout=BUSY_TIMEOUT_S, isolation_level=None
        )
        with closing(connection):
            yield connection
    except sqlite3.Error as exc:
        raise DatabaseFileError(f"{file} cannot be used by SQLite: {exc}.") from exc


def _copied(source: Path, draft: Path, target: Path) -> Contents:
    """Copy a database, and check the copy, which is to become the target: what is damaged is damaged in both."""
    with _opened(source) as connection, _opened(draft) as copy:
        try:
            # nobody can write to the source meanwhile: the disk is waited for afterwards, by _put_in_place
            copy.execute("PRAGMA synchronous = OFF")
            connection.backup(copy)
            # a write-ahead log would be a second file
            copy.execute("PRAGMA journal_mode = DELETE")
        except sqlite3.Error as exc:
            if getattr(exc, "sqlite_errorcode", None) in UNWRITTEN:
                raise DatabaseFileError(f"{target} cannot be written: {exc}.") from exc
            raise DatabaseFileError(f"{source} cannot be copied: {exc}.") from exc
    damage = _damage(draft)
    if damage is not None:
        raise DatabaseFileError(f"{source} is damaged ({damage}): nothing was changed.")
    return _contents(draft)


def _read_ahead(file: Path) -> None:
    """Read a file from front to back, so that SQLite, which goes to and fro in it by pages, need not ask the disk.

    No connection of this process may have it open: SQLite's locks end with the first descriptor that is closed.
    """
    with suppress(OSError), file.open("rb", buffering=0) as whole:  # SQLite says it better
        while whole.read(READ_BYTES):
            pass


def _damage(file: Path) -> str | None:
    """What is wrong with a database, in a line; None where all of it can be read and fits together."""
    with _opened(file) as connection:
        try:
            found: str = connection.execute("PRAGMA integrity_check(1)").fetchone()[0]
        except sqlite3.DatabaseError as exc:
            if exc.sqlite_errorcode & 0xFF not in SQLITE_DAMAGED:
                raise
            found = str(exc)
    return None if found == "ok" else found.splitlines()[-1]


def _contents(file: Path) -> Contents:
    with _opened(file) as connection:
        found = connection.execute("SELECT name FROM sqlite_master WHERE type = 'table' ORDER BY name").fetchall()
        # the names are the migrations' own, or those of a file that is about to be refused
        names = [name for (name,) in found if name.isidentifier() and not name.startswith("sqlite_")]
        revision = None
        if schema.VERSION_TABLE in names:
            names.remove(schema.VERSION_TABLE)
            revision = _first(connection, select(column("version_num")).select_from(table(schema.VERSION_TABLE)))
        counts = {name: _first(connection, select(func.count()).select_from(table(name))) for name in names}
    return Contents(revision, counts)


def _first(connection: sqlite3.Connection, query: Select[Any]) -> Any:
    """The first value of the first row; None without a row."""
    row = connection.execute(str(query)).fetchone()
    return row and row[0]


def _require_no_dump(source: Path) -> None:
    with source.open("rb") as file:
        if file.read(64).startswith(OF_PG_DUMP):
            raise DatabaseFileError(
                f"{source} is a PostgreSQL database that pg_dump wrote: nothing was changed; put it into an empty "
                "PostgreSQL database with pg_restore (psql, where it is SQL), and run `camind migrate`."
            )


def _require_known(contents: Contents, source: Path) -> None:
    if contents.revision is None:
        raise DatabaseFileError(f"{source} is no backup of this service's: it names no schema. Nothing was changed.")
    if contents.revision not in schema.known_revisions():
        raise DatabaseFileError(
            f"{source} is at schema {contents.revision}, which this version does not know: nothing was changed; "
            "restore it with the version that made it, or a later one."
        )


def _make_ready(file: Path, spool: str | None) -> None:
    engine = open_engine(URL.create("sqlite", database=str(file)))
    try:
        schema.upgrade(engine)
        # other folders' photographs do not come back with a backup
        Calibrations(engine).give_up(spool or "", timedelta(0))
    finally:
        engine.dispose()


def _keep(database: Path) -> Path | None:
    """A copy of the database under a dated name, damaged as it may be; None where there is none."""
    if not database.exists():
        return None
    if not _is_emptied(database):
        with suppress(DatabaseFileError), _opened(database) as connection:
            # what a killed process left in a journal belongs to the copy
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            connection.execute("BEGIN IMMEDIATE")
            connection.execute("ROLLBACK")
    kept = database.with_name(f"{database.name}.replaced-{datetime.now(UTC):%Y%m%dT%H%M%S.%fZ}")
    for suffix in SIDE_FILES:
        if _beside(database, suffix).exists():
            _copy_through(_beside(database, suffix), _beside(kept, suffix))
    with _draft_beside(kept) as draft:
        _copy_through(database, draft)
        _take_owner(draft, database)
        draft.replace(kept)
    sync_folder(kept.parent)
    return kept


def _copy_through(source: Path, target: Path) -> None:
    shutil.copyfile(source, target)
    with target.open("rb+") as file:
        write_through(file)


def _take_owner(file: Path, model: Path) -> None:
    """Let those use a file who may use the other one."""
    status = model.stat()
    file.chmod(stat.S_IMODE(status.st_mode))
    with suppress(PermissionError):
        os.chown(file, status.st_uid, status.st_gid)
