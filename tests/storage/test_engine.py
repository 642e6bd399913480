"""Commits are durable, references hold, and what the database cannot do is told apart."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from uuid import uuid4

import pytest
from sqlalchemy import Engine
from sqlalchemy.exc import DatabaseError, IntegrityError

from service.errors import Busy, NotReady
from service.storage import postgresql, schema
from service.storage.backup import using
from service.storage.cameras import Cameras
from service.storage.engine import journal_mode, open_engine, reading, require_writable, writing
from service.storage.seeds import seed_drafts
from service.storage.spool import Spool
from service.storage.tables import CameraRevisionRow

FULL = 2


@pytest.fixture
def sqlite(tmp_path: Path) -> Engine:
    engine = open_engine(f"sqlite:///{tmp_path / 'new' / 'folder' / 'a.sqlite3'}")
    schema.upgrade(engine)
    return engine


def test_sqlite_is_set_to_keep_what_it_acknowledged(sqlite: Engine) -> None:
    sqlite.dispose()  # as after a restart: what migrated it is gone
    with sqlite.connect() as connection:

        def pragma(name: str) -> object:
            return connection.exec_driver_sql(f"PRAGMA {name}").scalar()

        assert pragma("synchronous") == FULL
        assert pragma("foreign_keys") == 1
        assert pragma("busy_timeout") == 5_000
        assert str(pragma("journal_mode")).upper() == journal_mode()


def test_what_a_link_leads_to_is_made_for_its_owner_alone(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to("a.sqlite3")
    schema.upgrade(open_engine(f"sqlite:///{tmp_path / 'link'}"))
    assert (tmp_path / "a.sqlite3").stat().st_mode & 0o777 == 0o600


def test_what_is_stored_is_for_its_owner_alone(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        open_folder = tmp_path / "open"
        open_folder.mkdir()
        for folder in (tmp_path / "new", open_folder):
            engine = open_engine(f"sqlite:///{folder / 'a.sqlite3'}")
            schema.upgrade(engine)
            with using(engine.url), writing(engine):
                assert {path.stat().st_mode & 0o777 for path in folder.iterdir()} == {0o600}
        Spool(open_folder / "calibrations")
        # as made by a version that left it to be looked into
        open_spool = tmp_path / "open" / "spool"
        open_spool.mkdir()
        with Spool(open_spool).receiving(uuid4().hex) as photographs:
            received = photographs.stat().st_mode & 0o777
    finally:
        os.umask(before)
    private, kept = (folder.stat().st_mode & 0o777 for folder in (tmp_path / "new", open_folder))
    assert received == 0o700
    assert (private, kept, (open_folder / "calibrations").stat().st_mode & 0o777) == (0o700, 0o777, 0o700)


def test_another_connection_leaves_a_writer_its_lock(tmp_path: Path) -> None:
    file = tmp_path / "a.sqlite3"
    engine = open_engine(f"sqlite:///{file}")
    schema.upgrade(engine)
    other_process = "import sqlite3, sys; sqlite3.connect(sys.argv[1], timeout=0).execute('BEGIN IMMEDIATE')"
    with writing(engine) as session:
        session.connection()
        with engine.connect():
            pass
        ended = subprocess.run([sys.executable, "-c", other_process, file], capture_output=True, check=False)
    assert b"database is locked" in ended.stderr


def test_the_write_ahead_log_waits_for_a_sound_sqlite() -> None:
    assert journal_mode((3, 40, 1)) == journal_mode((3, 51, 2)) == "DELETE"
    assert journal_mode((3, 51, 3)) == journal_mode((4, 0, 0)) == "WAL"


def test_a_revision_needs_its_camera(engine: Engine) -> None:
    orphan = CameraRevisionRow(
        camera_id=99,
        revision=1,
        created_at=datetime.now(UTC),
        description="lens of a secret prototype",
        source="given",
        image_width_px=1,
        image_height_px=1,
        focus_distance_m=1,
        k_cam_px=1,
        gamma_px=1,
        k_r=4,
    )
    with pytest.raises(IntegrityError) as refused, writing(engine) as session:
        session.add(orphan)
    assert "lens of a secret prototype" not in str(refused.value)  # which a traceback in the log would show


def test_a_database_without_tables_is_not_ready(empty_engine: Engine) -> None:
    with pytest.raises(NotReady):
        require_writable(empty_engine)
    with pytest.raises(NotReady, match="camind migrate"):
        schema.require_head(empty_engine)


def test_an_unreachable_server_is_not_ready(tmp_path: Path) -> None:
    engine = open_engine(f"postgresql+psycopg://nobody@/none?host={tmp_path}")
    with pytest.raises(NotReady, match="The database cannot be used"), reading(engine) as session:
        session.connection()


def test_a_missing_extra_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr("service.storage.postgresql")
    monkeypatch.setitem(sys.modules, "service.storage.postgresql", None)
    with pytest.raises(NotReady, match=r"pip install 'camind\[postgres\]'"):
        open_engine("postgresql+psycopg://nobody@/none")


def test_no_free_connection_is_busy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.storage.engine.POOL_TIMEOUT_S", 0.05)
    engine = open_engine(f"sqlite:///{tmp_path / 'a.sqlite3'}")
    taken = [engine.connect() for _ in range(15)]
    with pytest.raises(Busy), reading(engine) as session:
        session.connection()
    for connection in taken:
        connection.close()
    engine.dispose()


def test_a_migrated_database_is_ready(engine: Engine) -> None:
    schema.require_head(engine)
    require_writable(engine)


@pytest.fixture
def hurried(postgres_url: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[Engine]:
    """An engine on PostgreSQL that waits for nothing for long."""
    monkeypatch.setattr(postgresql, "LOCK_TIMEOUT_MS", 200)
    monkeypatch.setattr(postgresql, "STATEMENT_TIMEOUT_MS", 400)
    monkeypatch.setattr(postgresql, "ANSWER_TIMEOUT_S", 0.8)
    engine = open_engine(postgres_url)
    yield engine
    engine.dispose()


def test_a_table_that_stays_locked_is_busy(hurried: Engine) -> None:
    schema.upgrade(hurried)
    with hurried.begin() as connection:
        connection.exec_driver_sql("LOCK TABLE cameras IN ACCESS EXCLUSIVE MODE")
        with pytest.raises(Busy):
            Cameras(hurried).page(1)
        with pytest.raises(Busy):
            require_writable(hurried)
    assert Cameras(hurried).page(1) == ([], False)


def test_a_server_that_only_reads_takes_no_writes(hurried: Engine) -> None:
    schema.upgrade(hurried)
    only_read(hurried, "on")
    hurried.dispose()
    with pytest.raises(NotReady, match="takes no writes"):
        require_writable(hurried)
    assert Cameras(hurried).page(1) == ([], False)


def test_a_server_that_takes_writes_again_gets_them(hurried: Engine) -> None:
    """As after a failover: what the pool holds began while the server only read, and stays so."""
    schema.upgrade(hurried)
    only_read(hurried, "on")
    hurried.dispose()
    with hurried.connect() as one, hurried.connect() as two:
        assert [each.exec_driver_sql("SHOW transaction_read_only").scalar() for each in (one, two)] == ["on", "on"]
    only_read(hurried, "off")
    with pytest.raises(NotReady, match="takes no writes"):
        require_writable(hurried)
    for _ in range(3):
        require_writable(hurried)


def only_read(engine: Engine, setting: str) -> None:
    """Let sessions that begin from now on only read, or write again."""
    with engine.connect() as connection, connection.begin():
        connection.exec_driver_sql("SET TRANSACTION READ WRITE")
        database = engine.url.database
        connection.exec_driver_sql(f"ALTER DATABASE {database} SET default_transaction_read_only = {setting}")


def test_a_statement_that_takes_too_long_is_busy(hurried: Engine) -> None:
    with pytest.raises(Busy), reading(hurried) as session:
        session.connection().exec_driver_sql("SELECT pg_sleep(30)")


def test_a_server_that_stands_still_is_not_ready(hurried: Engine) -> None:
    schema.upgrade(hurried)  # which waits for as long as it takes, and nothing after it on the same connection
    with reading(hurried) as session:
        backend = session.connection().exec_driver_sql("SELECT pg_backend_pid()").scalar_one()
        try:
            os.kill(backend, signal.SIGSTOP)
            with pytest.raises(DatabaseError, match="timeout"):
                session.connection().exec_driver_sql("SELECT 1")
        finally:
            os.kill(backend, signal.SIGCONT)
    with reading(hurried) as session:
        assert session.connection().exec_driver_sql("SELECT pg_backend_pid()").scalar_one() != backend


def test_a_migration_waits_as_long_as_it_takes(hurried: Engine) -> None:
    other = hurried.connect()
    other.exec_driver_sql(f"SELECT pg_advisory_lock({schema.LOCK})")
    started_s = time.monotonic()
    releasing = threading.Timer(2, other.exec_driver_sql, [f"SELECT pg_advisory_unlock({schema.LOCK})"])
    releasing.start()
    schema.upgrade(hurried)
    assert time.monotonic() - started_s > 1.5
    releasing.join()
    other.close()
    with pytest.raises(Busy), reading(hurried) as session:
        session.connection().exec_driver_sql("SELECT pg_sleep(30)")


def test_what_a_server_is_used_to_is_no_matter(postgres_url: str) -> None:
    server = open_engine(postgres_url)
    name = f"{server.url.database}_ascii"
    with server.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
        connection.exec_driver_sql(f"CREATE DATABASE {name} TEMPLATE template0 ENCODING 'SQL_ASCII' LOCALE 'C'")
        connection.exec_driver_sql(f"ALTER DATABASE {name} SET datestyle = 'German'")
        connection.exec_driver_sql(f"ALTER DATABASE {name} SET default_transaction_isolation = 'serializable'")
    engine = open_engine(server.url.set(database=name))
    schema.upgrade(engine)
    draft = replace(seed_drafts()[0], description="Küche")
    assert Cameras(engine).add(draft) == Cameras(engine).get(draft.name)
    with engine.connect() as connection:
        assert connection.exec_driver_sql("SHOW transaction_isolation").scalar() == "read committed"
    engine.dispose()
    server.dispose()


def test_a_url_s_own_parameters_win(postgres_url: str) -> None:
    engine = open_engine(f"{postgres_url}&connect_timeout=9&options=-c%20lock_timeout%3D77")
    assert "connect_timeout" not in postgresql.connect_args(engine.url)
    with engine.connect() as connection:
        assert connection.exec_driver_sql("SHOW lock_timeout").scalar() == "77ms"
        assert connection.exec_driver_sql("SHOW statement_timeout").scalar() == "8s"
    engine.dispose()
