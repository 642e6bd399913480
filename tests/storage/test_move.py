"""From SQLite to PostgreSQL: every row comes out as it went in, and counting goes on behind it."""

import threading
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from pydantic import JsonValue
from sqlalchemy import JSON, Engine, Text, cast, select
from sqlalchemy.exc import DatabaseError
from typer.testing import CliRunner, Result

from service import cli
from service.commands.serve import require_key
from service.config import Settings
from service.errors import Conflict, NotReady
from service.optics.camera import Camera, Intrinsics, Lens
from service.storage import schema
from service.storage.backup import DatabaseFileError, backup, using
from service.storage.calibrations import CalibrationDraft, Calibrations, Ending, StoredPicture
from service.storage.cameras import CameraDraft, Cameras
from service.storage.engine import open_engine
from service.storage.idempotency import Once
from service.storage.keys import Keys
from service.storage.move import move
from service.storage.tables import metadata

LENS = Lens(35.0, 2.8, 6.05, 3872)
SEEN = Intrinsics(1000.1, 1000.2, 322.3, 215.4, (0.1, -0.2, 1e-17, 0.0))


def draft(name: str, k_cam_px: float = 2.0, description: str | None = None) -> CameraDraft:
    return CameraDraft(name, Camera(645, 432, 1.0, k_cam_px, 0.1 + 0.2, intrinsics=SEEN), "lens", LENS, description)


def waiting(number: int, spool: str = "here") -> CalibrationDraft:
    pictures = (StoredPicture("ä b.jpg", "focused"), StoredPicture("2.jpg", "defocused"))
    return CalibrationDraft(f"{number:032x}", spool, "bench", {"rows": 11, "spacing_mm": 20.1}, pictures)


def fill(engine: Engine) -> None:
    """Two owners' cameras, replaced, deleted and come again; calibrations in every state; good and revoked keys."""
    for owner in ("local", "robot"):
        cameras = Cameras(engine, owner)
        cameras.add(draft("bench", description="80 % grün\n\t'quoted' \\ :name"), Once("again", "f" * 64))
        cameras.replace(draft("bench", 1 / 3))
        cameras.add(draft("gone"))
        cameras.delete("gone")
    cameras.add(draft("gone", 4.0))
    calibrations = Calibrations(engine, "robot")
    found: JsonValue = [{"u_px": 1 / 3, "tiny": 5e-324, "said": "naïve \u2028 \\u0000"}]
    endings = (
        Ending("succeeded", found, {"k_cam_px": 0.1}, camera=Camera(4, 3, 1.0, 0.1, 0.5)),
        Ending("failed", found, problem="blurred"),
        Ending("cancelled"),
    )
    for number, ending in enumerate(endings):
        calibrations.add(waiting(number))
        calibrations.take("here")
        calibrations.finish(waiting(number).id, ending)
    calibrations.add(waiting(3))
    calibrations.add(waiting(4, "elsewhere"))
    Keys(engine).create("k", "robot", ["depth"], datetime.now(UTC) + timedelta(days=9))
    revoked, _ = Keys(engine).create("r", "local", ["admin", "depth"], None)
    Keys(engine).revoke(revoked.id)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    engine = open_engine(f"sqlite:///{tmp_path / 'camind.sqlite3'}")
    schema.upgrade(engine)
    fill(engine)
    engine.dispose()
    return tmp_path / "camind.sqlite3"


@pytest.fixture
def server(postgres_url: str) -> Iterator[Engine]:
    engine = open_engine(postgres_url)
    schema.upgrade(engine)
    yield engine
    engine.dispose()


def rows_of(engine: Engine) -> dict[str, list[tuple[Any, ...]]]:
    """Every row by table, JSON as the text that it is."""
    with engine.connect() as connection:
        return {
            table.name: [
                tuple(row)
                for row in connection.execute(
                    select(*(cast(each, Text) if isinstance(each.type, JSON) else each for each in table.c)).order_by(
                        *table.primary_key
                    )
                )
            ]
            for table in metadata.sorted_tables
        }


def moved(source: Path, server: Engine, spool: str | None = "here") -> list[tuple[int, int]]:
    told: list[tuple[int, int]] = []
    move(source, server, source.with_name("camind.sqlite3"), spool, lambda done, total: told.append((done, total)))
    return told


@pytest.mark.parametrize("is_backup", [True, False])
def test_every_row_comes_out_as_it_went_in(file: Path, server: Engine, tmp_path: Path, is_backup: bool) -> None:
    origin = open_engine(f"sqlite:///{file}")
    Calibrations(origin).give_up("here", timedelta(0))  # as a restore does
    expected = rows_of(origin)
    origin.dispose()
    source = tmp_path / "copy" if is_backup else file
    if is_backup:
        backup(file, source)
    told = moved(source, server)
    assert rows_of(server) == expected
    assert all(expected.values())
    total = sum(map(len, expected.values()))
    assert told[-1] == (total, total)
    assert not list(tmp_path.glob(".*"))


def test_what_is_new_is_counted_behind_what_came(file: Path, server: Engine) -> None:
    moved(file, server)
    cameras = Cameras(server, "robot")
    assert cameras.add(draft("new")).revision == 1
    assert cameras.replace(draft("bench", 9.0)).revision == 4  # the calibration's was the third
    assert Cameras(server).add(draft("gone")).revision == 2
    assert [each.camera.k_cam_px for each in cameras.revisions("bench", 9)[0]] == [9.0, 0.1, 1 / 3, 2.0]
    Calibrations(server, "robot").add(waiting(9))
    newest = Calibrations(server, "robot").page(9)[0]
    assert [each.id for each in newest] == [waiting(number).id for number in (9, 4, 3, 2, 1, 0)]


@pytest.mark.parametrize(("spool", "states"), [("here", ["failed", "queued"]), (None, ["failed", "failed"])])
def test_what_waits_goes_on_where_its_photographs_are(
    file: Path, server: Engine, spool: str | None, states: list[str]
) -> None:
    moved(file, server, spool)
    assert [each.state for each in Calibrations(server).page(2)[0]] == states


def test_a_database_that_is_not_empty_is_left_as_it_is(file: Path, server: Engine) -> None:
    Keys(server).create("k", "robot", ["depth"], None)
    before = rows_of(server)
    with pytest.raises(Conflict, match=r"api_keys 1\)"):
        moved(file, server)
    assert rows_of(server) == before


def test_all_rows_come_or_none(file: Path, server: Engine) -> None:
    with server.begin() as connection:
        connection.exec_driver_sql("ALTER TABLE camera_revisions ADD CHECK (revision < 3)")
    with pytest.raises(Exception, match="check"):
        moved(file, server)
    assert not any(rows_of(server).values())


def test_who_writes_is_waited_for_and_nobody_does_meanwhile(file: Path, postgres_url: str) -> None:
    engine = open_engine(f"{postgres_url}&options=-c%20lock_timeout%3D50")
    schema.upgrade(engine)
    writer = engine.connect()
    writer.exec_driver_sql("LOCK TABLE cameras IN ROW EXCLUSIVE MODE")
    ending = threading.Timer(1, writer.close)
    ending.start()

    def write(*_: int) -> None:
        with engine.connect() as other, pytest.raises(DatabaseError, match="could not obtain lock"):
            other.exec_driver_sql("LOCK TABLE api_keys IN ROW EXCLUSIVE MODE NOWAIT")

    move(file, engine, file.with_name("camind.sqlite3"), None, write)
    ending.join()
    assert all(rows_of(engine).values())
    engine.dispose()


def test_an_older_backup_comes_to_the_newest_schema(file: Path, server: Engine) -> None:
    engine = open_engine(f"sqlite:///{file}")
    schema.downgrade(engine, "2026_11_22_calibrations")
    engine.dispose()
    moved(file, server)
    assert Cameras(server).get("bench").revision == 2


def test_a_database_without_tables_is_migrated_first(file: Path, postgres_url: str) -> None:
    engine = open_engine(postgres_url)
    told = "The database has no tables yet: run `camind migrate`"
    with pytest.raises(NotReady, match=told):
        moved(file, engine)
    with pytest.raises(NotReady, match=told):
        require_key(Settings(), engine)
    engine.dispose()


def test_a_file_in_use_is_not_moved(file: Path, server: Engine) -> None:
    with using(f"sqlite:///{file}"), pytest.raises(DatabaseFileError, match="in use"):
        moved(file, server)
    assert not any(rows_of(server).values())


def test_the_command_line_moves_it_once(file: Path, postgres_url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def camind(*arguments: str) -> Result:
        return CliRunner().invoke(cli.app, arguments)

    monkeypatch.setenv("CAMIND_DATA_DIR", str(file.parent))
    monkeypatch.setenv("CAMIND_DATABASE_URL", postgres_url)
    early = camind("restore", str(file))
    assert (early.exit_code, "camind migrate" in early.stderr) == (1, True)
    assert camind("migrate").exit_code == 0
    absent = camind("restore", str(file.with_name("absent")))
    assert (absent.exit_code, "There is no backup" in absent.stderr) == (1, True)
    done = camind("restore", str(file))
    assert (done.exit_code, done.stderr.split("\r")[-1]) == (0, "21 of 21 rows\n")
    assert "api_keys 2, calibrations 5, " in done.stdout
    assert "gone\tr2" in camind("cameras", "list", "--owner", "robot").stdout
    again = camind("restore", str(file))
    assert (again.exit_code, again.stdout, "restore into an empty one" in again.stderr) == (1, "", True)
