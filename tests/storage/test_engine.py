"""Commits are durable, references hold, and what the database cannot do is told apart."""

from datetime import UTC, datetime
from pathlib import Path

import pytest
from sqlalchemy import Engine
from sqlalchemy.exc import IntegrityError

from service.errors import Busy, NotReady
from service.storage import schema
from service.storage.engine import journal_mode, open_engine, reading, require_writable, writing
from service.storage.tables import CameraRevisionRow

FULL = 2


@pytest.fixture
def sqlite(tmp_path: Path) -> Engine:
    engine = open_engine(f"sqlite:///{tmp_path / 'new' / 'folder' / 'a.sqlite3'}")
    schema.upgrade(engine)
    return engine


def test_sqlite_is_set_to_keep_what_it_acknowledged(sqlite: Engine) -> None:
    with sqlite.connect() as connection:

        def pragma(name: str) -> object:
            return connection.exec_driver_sql(f"PRAGMA {name}").scalar()

        assert pragma("synchronous") == FULL
        assert pragma("foreign_keys") == 1
        assert pragma("busy_timeout") == 5_000
        assert str(pragma("journal_mode")).upper() == journal_mode()


def test_the_write_ahead_log_waits_for_a_sound_sqlite() -> None:
    assert journal_mode((3, 40, 1)) == journal_mode((3, 51, 2)) == "DELETE"
    assert journal_mode((3, 51, 3)) == journal_mode((4, 0, 0)) == "WAL"


def test_a_revision_needs_its_camera(engine: Engine) -> None:
    orphan = CameraRevisionRow(
        camera_id=99,
        revision=1,
        created_at=datetime.now(UTC),
        source="given",
        image_width_px=1,
        image_height_px=1,
        focus_distance_m=1,
        k_cam_px=1,
        gamma_px=1,
        k_r=4,
    )
    with pytest.raises(IntegrityError), writing(engine) as session:
        session.add(orphan)


def test_a_database_without_tables_is_not_ready(empty_engine: Engine) -> None:
    with pytest.raises(NotReady):
        require_writable(empty_engine)
    with pytest.raises(NotReady, match="camind migrate"):
        schema.require_head(empty_engine)


def test_an_unreachable_server_is_not_ready(tmp_path: Path) -> None:
    pytest.importorskip("psycopg")
    engine = open_engine(f"postgresql+psycopg://nobody@/none?host={tmp_path}")
    with pytest.raises(NotReady), reading(engine) as session:
        session.connection()


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
