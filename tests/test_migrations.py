"""Migrations run from nothing to the tables and back, on both databases, and are named by date."""

import re
import shutil
import sqlite3
import subprocess
import sys
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext
from sqlalchemy import Engine, inspect, text

import migrations
from service.errors import NotReady
from service.optics.camera import Camera
from service.storage import schema
from service.storage.cameras import CameraDraft, Cameras
from service.storage.engine import open_engine
from service.storage.tables import metadata

VERSIONS = Path(migrations.__file__).parent / "versions"
FIRST = "2026_11_21_cameras"
NAMES = [f"camera-{number}" for number in range(5)]
ROUNDS, SOAK_ROUNDS = 12, 300

# `camind migrate` in forks of one process that has everything loaded, so that a kill is hardly ever before it begins;
# each on a copy of a folder, and killed after a random part of the time that the first one took
KILLED_MIGRATIONS = """
import os, random, shutil, signal, sys, time
from pathlib import Path
import sqlalchemy.dialects.sqlite, service.storage.backup, service.storage.schema, service.inference.artifact
from service import cli

folder, rounds, seed = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
random.seed(seed)

def migrate(number):
    data = shutil.copytree(folder, folder.with_name(f"killed-{number:05d}"))
    child = os.fork()
    if child == 0:
        os.environ["CAMIND_DATA_DIR"] = str(data)
        cli.app(["migrate"])
    return child

started_s = time.monotonic()
assert os.waitpid(migrate(0), 0)[1] == 0
duration_s = time.monotonic() - started_s
for number in range(1, rounds + 1):
    child = migrate(number)
    time.sleep(random.random() * duration_s)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
"""


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


def test_the_schema_of_a_later_version_is_no_matter_of_migrating(engine: Engine) -> None:
    with engine.begin() as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = '2099_01_01_later'"))
    for step in (schema.upgrade, schema.require_head):
        with pytest.raises(NotReady, match=r"at schema 2099_01_01_later, .* install the version that made it"):
            step(engine)


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


@pytest.mark.timeout(3600)
@pytest.mark.parametrize("begin", [None, FIRST])
def test_a_killed_migration_leaves_the_old_schema_or_the_new(tmp_path: Path, begin: str | None, is_soak: bool) -> None:
    data = tmp_path / "data"
    data.mkdir()
    if begin:
        _make_first_schema(data / "camind.sqlite3")
    rounds = SOAK_ROUNDS if is_soak else ROUNDS
    subprocess.run([sys.executable, "-c", KILLED_MIGRATIONS, data, str(rounds), "1"], check=True)
    found = Counter(_checked(folder / "camind.sqlite3") for folder in tmp_path.glob("killed-*"))
    # the first was not killed
    assert found.total() == rounds + 1
    assert set(found) <= {begin, schema.head_revision()}
    assert found[begin] > 0 or not is_soak
    print(f"killed migrations from {begin}: {dict(found)}")
    for folder in tmp_path.glob("killed-*"):
        engine = open_engine(f"sqlite:///{folder / 'camind.sqlite3'}")
        schema.upgrade(engine)
        names = [record.name for record in Cameras(engine).page(10)[0]]
        engine.dispose()
        assert names == (NAMES if begin else [])
        assert _checked(folder / "camind.sqlite3") == schema.head_revision()
        shutil.rmtree(folder)


def _make_first_schema(database: Path) -> None:
    engine = open_engine(f"sqlite:///{database}")
    schema.upgrade(engine, FIRST)
    # as the tables were then: what the code writes today has other columns
    camera = "INSERT INTO cameras (name, revision, created_at, updated_at) VALUES (:name, 1, :now, :now)"
    revision = (
        "INSERT INTO camera_revisions (camera_id, revision, created_at, source, image_width_px, image_height_px, "
        "focus_distance_m, k_cam_px, gamma_px, k_r) SELECT id, 1, :now, 'given', 4, 3, 1, 2, 0.5, 4 FROM cameras "
        "WHERE name = :name"
    )
    with engine.begin() as connection:
        for name in NAMES:
            for statement in (camera, revision):
                connection.execute(text(statement), {"name": name, "now": datetime.now(UTC)})
    engine.dispose()


def _checked(database: Path) -> str | None:
    """The schema of a database, all of which can be read and fits together."""
    with closing(sqlite3.connect(database)) as connection:
        assert connection.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
        tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if "alembic_version" not in tables:
            assert tables == set()
            return None
        revisions: list[str] = [row[0] for row in connection.execute("SELECT version_num FROM alembic_version")]
    assert len(revisions) == 1
    assert ("calibrations" in tables) == (revisions != [FIRST])
    return revisions[0]
