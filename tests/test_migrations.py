"""Migrations run from nothing to the tables and back, on both databases, and are named by date."""

import re
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path

from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext
from sqlalchemy import Engine, inspect, text

import migrations
from service.optics.camera import Camera
from service.storage import schema
from service.storage.cameras import CameraDraft, Cameras
from service.storage.tables import metadata

VERSIONS = Path(migrations.__file__).parent / "versions"


def test_an_empty_database_gets_every_table(empty_engine: Engine) -> None:
    assert schema.current_revision(empty_engine) is None
    schema.upgrade(empty_engine)
    assert schema.current_revision(empty_engine) == schema.head_revision()
    assert set(inspect(empty_engine).get_table_names()) == {*metadata.tables, "alembic_version"}


def test_upgrading_again_changes_nothing(engine: Engine) -> None:
    schema.upgrade(engine)
    assert schema.current_revision(engine) == schema.head_revision()


def test_the_way_back_leaves_nothing(engine: Engine) -> None:
    schema.downgrade(engine)
    assert inspect(engine).get_table_names() == ["alembic_version"]
    schema.upgrade(engine)
    assert schema.current_revision(engine) == schema.head_revision()


def test_the_migrations_make_the_tables_and_no_others(engine: Engine) -> None:
    with engine.connect() as connection:
        context = MigrationContext.configure(connection, opts={"compare_server_default": True})
        assert compare_metadata(context, metadata) == []


def test_every_constraint_has_the_name_the_tables_give_it(engine: Engine) -> None:
    inspector = inspect(engine)
    for name, table in metadata.tables.items():
        declared = {str(constraint.name) for constraint in table.constraints}
        found = {str(inspector.get_pk_constraint(name)["name"])}
        found |= {str(item["name"]) for item in inspector.get_unique_constraints(name)}
        found |= {str(item["name"]) for item in inspector.get_foreign_keys(name)}
        assert found == declared


def test_processes_that_migrate_at_once_wait_for_each_other(empty_engine: Engine) -> None:
    with ThreadPoolExecutor(3) as pool:
        list(pool.map(lambda _: schema.upgrade(empty_engine), range(3)))
    assert schema.current_revision(empty_engine) == schema.head_revision()


def test_foreign_keys_hold_again_after_migrating(engine: Engine) -> None:
    if engine.dialect.name == "sqlite":
        with engine.connect() as connection:
            assert connection.exec_driver_sql("PRAGMA foreign_keys").scalar() == 1


def test_what_was_there_before_owners_is_local_and_stays(empty_engine: Engine) -> None:
    schema.upgrade(empty_engine, "2026_11_22_calibrations")
    now = datetime.now(UTC)
    with empty_engine.begin() as connection:
        for name in ("here", "gone"):
            row = {"name": name, "now": now, "gone": now if name == "gone" else None}
            words = "INSERT INTO cameras (name, revision, created_at, updated_at, deleted_at)"
            connection.execute(text(f"{words} VALUES (:name, 3, :now, :now, :gone)"), row)
    schema.upgrade(empty_engine)
    with empty_engine.connect() as connection:
        rows = connection.exec_driver_sql("SELECT owner, name, revision FROM cameras ORDER BY id").all()
    assert [tuple(row) for row in rows] == [("local", "here", 3), ("local", "gone", 3)]


def test_the_way_back_keeps_what_was_made_without_keys(engine: Engine) -> None:
    draft = CameraDraft("bench", Camera(640, 480, 1.5, 3.81), "given")
    for owner in ("local", "lab"):
        Cameras(engine, owner).add(draft)
    schema.downgrade(engine, "2026_11_22_calibrations")
    schema.upgrade(engine)
    assert Cameras(engine).get("bench").draft == draft
    assert Cameras(engine, "lab").page(1) == ([], False)


def test_migrations_are_named_by_date() -> None:
    names = [path.stem for path in VERSIONS.glob("*.py")]
    assert names
    for name in names:
        assert re.fullmatch(r"20\d\d_[01]\d_[0-3]\d_[a-z0-9_]+", name)
        assert f'revision = "{name}"' in (VERSIONS / f"{name}.py").read_text()
