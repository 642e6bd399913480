"""The database engine: SQLite by default, PostgreSQL by the same URL, both with durable commits."""

import os
import sqlite3
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import ParamSpec, TypeVar

from sqlalchemy import URL, Connection, Engine, create_engine, event, make_url
from sqlalchemy.exc import DatabaseError, DataError, IntegrityError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError
from sqlalchemy.pool import ConnectionPoolEntry
from sqlmodel import Session

from service.errors import Busy, CamindError, InsufficientStorage, NotReady
from service.storage.disk import make_private

P = ParamSpec("P")
T = TypeVar("T")

BUSY_TIMEOUT_MS = 5_000
POOL_TIMEOUT_S = 5.0
# older ones can corrupt a database when two connections write and checkpoint at the same instant
FIRST_SAFE_WAL = (3, 51, 3)
IS_WRITE = "camind_is_write"
SQLITE_DAMAGED = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
POSTGRESQL_DISK_FULL = "53100"
POSTGRESQL_READ_ONLY = "25006"
# a lock, or an answer, that took too long
POSTGRESQL_BUSY = ("55P03", "57014")


def open_engine(database_url: str | URL) -> Engine:
    """An engine for the URL; the folder of an SQLite file is made. Nothing is connected yet.

    Raises ``NotReady`` where it names PostgreSQL and the extra is not installed.
    """
    url = make_url(database_url)
    if url.get_backend_name() != "sqlite":
        return _open_postgresql(url)
    make_private(Path(str(url.database)).parent)
    engine = create_engine(url, pool_timeout=POOL_TIMEOUT_S, hide_parameters=True)
    event.listen(engine, "do_connect", _make_file_private)
    event.listen(engine, "connect", _prepare_sqlite)
    event.listen(engine, "begin", _begin_sqlite)
    return engine


def _make_file_private(_dialect: object, _record: object, arguments: Sequence[str], _options: object) -> None:
    """What SQLite would make for all to read is made for its owner alone; its journals get the same rights.

    A file that is there is not opened: closing it would take the locks from under this process' other connections
    (https://www.sqlite.org/howtocorrupt.html, 2.2).
    """
    # SQLite says better why a file cannot be made
    with suppress(OSError):
        os.close(os.open(os.path.realpath(arguments[0]), os.O_RDONLY | os.O_CREAT | os.O_EXCL, 0o600))


def _open_postgresql(url: URL) -> Engine:
    try:
        from service.storage import postgresql
    except ImportError as exc:
        raise NotReady("What speaks to PostgreSQL is not installed: pip install 'camind[postgres]'.") from exc

    engine = create_engine(
        url,
        pool_timeout=POOL_TIMEOUT_S,
        pool_pre_ping=True,
        hide_parameters=True,
        # whatever the server's default: who waited for a row's lock goes on with what is there then
        isolation_level="READ COMMITTED",
        connect_args=postgresql.connect_args(url),
    )
    postgresql.bound(engine)
    return engine


def journal_mode(version: tuple[int, ...] = sqlite3.sqlite_version_info) -> str:
    """Write-ahead log where SQLite's is sound, rollback journal elsewhere."""
    return "WAL" if version >= FIRST_SAFE_WAL else "DELETE"


@contextmanager
def reading(engine: Engine) -> Iterator[Session]:
    """A session that only reads. Raises ``Busy`` or ``NotReady`` where the database does not answer."""
    with _translated(), Session(engine) as session:
        yield session


@contextmanager
def writing(engine: Engine) -> Iterator[Session]:
    """A session that writes: the lock is taken at its begin, and it is committed whole or not at all.

    Raises ``Busy`` or ``NotReady`` where the database does not answer, and ``InsufficientStorage`` where its disk is
    full; ``IntegrityError`` passes through.
    """
    with _translated(), Session(engine.execution_options(**{IS_WRITE: True})) as session, session.begin():
        yield session


def again_if_beaten(write: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Write once more where another process was faster between the look and the insert: its row is there now."""
    try:
        return write(*args, **kwargs)
    except IntegrityError:
        return write(*args, **kwargs)


@contextmanager
def unhurried(connection: Connection) -> Iterator[None]:
    """A transaction that may take as long as it needs, as a migration does."""
    if connection.dialect.name == "sqlite":
        with connection.begin():
            yield
        return
    from service.storage import postgresql

    with postgresql.unhurried(connection):
        yield


def require_writable(engine: Engine) -> None:
    """Raise ``NotReady`` where the database takes no writes: a full disk, a read-only file or replica.

    And where it keeps none, as a file that was removed, or replaced without a restart.
    """
    if engine.dialect.name == "sqlite" and _is_removed(str(engine.url.database)):
        raise NotReady("The database's file was removed or replaced: what is stored now is lost, until a restart.")
    try:
        with writing(engine) as session:
            session.connection().exec_driver_sql("UPDATE cameras SET revision = revision WHERE id = -1")
            if engine.dialect.name == "sqlite":
                # the journal of a change needs room, though the change is taken back
                session.connection().exec_driver_sql("UPDATE alembic_version SET version_num = version_num")
                session.rollback()
    except InsufficientStorage as exc:
        raise NotReady(exc.detail) from exc


def _is_removed(file: str) -> bool:
    """Whether nothing has this name, or this process has a file open that had it; Linux alone tells that."""
    removed = Path(f"{os.path.realpath(file)} (deleted)")
    for descriptor in Path("/proc/self/fd").glob("*"):
        with suppress(OSError):
            if descriptor.readlink() == removed:
                return True
    return not Path(file).exists()


def _prepare_sqlite(connection: sqlite3.Connection, _: ConnectionPoolEntry) -> None:
    connection.isolation_level = None  # the driver would begin too late; _begin_sqlite does it
    for pragma in (
        f"busy_timeout = {BUSY_TIMEOUT_MS}",
        f"journal_mode = {journal_mode()}",
        "synchronous = FULL",
        "foreign_keys = ON",
        # Debian's SQLite blanks what is deleted, and needs room for a copy until it is: 7 MB for fifty calibrations
        # of 140 kB, which so need 70 kB
        "secure_delete = FAST",
    ):
        connection.execute(f"PRAGMA {pragma}").close()


def _begin_sqlite(connection: Connection) -> None:
    # a transaction that reads first and locks later can meet another and deadlock
    is_write = connection.get_execution_options().get(IS_WRITE, False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if is_write else "BEGIN")


@contextmanager
def _translated() -> Iterator[None]:
    try:
        yield
    except PoolTimeoutError as exc:
        raise Busy("Every connection to the database is taken: try again in a second.") from exc
    except DatabaseError as exc:
        if isinstance(exc, IntegrityError | DataError):
            raise
        raise _unavailable(exc) from exc


def _unavailable(error: DatabaseError) -> CamindError:
    primary, state = getattr(error.orig, "sqlite_errorcode", 0) & 0xFF, getattr(error.orig, "sqlstate", None)
    if primary == sqlite3.SQLITE_FULL or state == POSTGRESQL_DISK_FULL:
        return InsufficientStorage(
            "The database's disk is full and nothing was changed: even to delete takes some room."
        )
    if primary in SQLITE_DAMAGED:
        return NotReady("The database is damaged: stop the service, and `camind restore` a backup.")
    if primary == sqlite3.SQLITE_READONLY or state == POSTGRESQL_READ_ONLY:
        return NotReady("The database takes no writes.")
    if "locked" in str(error.orig) or state in POSTGRESQL_BUSY:
        return Busy("The database is busy: try again in a second.")
    return NotReady("The database cannot be used: the service's log says why.")
