"""A backup is of one moment, whole and checked; a restore leaves the old database or the new one, never a mixture."""

import os
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from service.errors import NotReady
from service.optics.camera import Camera
from service.storage import schema
from service.storage.backup import DatabaseFileError, backup, database_file, require_sound, restore, using
from service.storage.calibrations import CalibrationDraft, Calibrations
from service.storage.cameras import CameraDraft, Cameras
from service.storage.engine import open_engine

FIRST_SCHEMA = "2026_11_21_cameras"
PAGE_BYTES = 4096
OLD = [f"old-{number}" for number in range(8)]

# Restores in copies of a folder, ended before the n-th thing that an interpreter is told of while it does: opening,
# renaming, removing and copying files, connecting. Every moment between two of them is like one of the two.
KILLED_RESTORES = """
import os, shutil, signal, sys
from pathlib import Path
from service.storage import backup

source, folder, step = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])

def end_at(moment):
    left = moment

    def count(event, arguments):
        nonlocal left
        if event.startswith(("os.", "shutil.", "sqlite3.", "tempfile.")) or event == "open":
            left -= 1
            if left == -1:
                os.kill(os.getpid(), signal.SIGKILL)

    return count

moment, status = 0, None
while status != 0:
    data = Path(shutil.copytree(folder, folder.with_name(f"killed-{moment:05d}")))
    child = os.fork()
    if child == 0:
        sys.addaudithook(end_at(moment))
        backup.restore(source, data / "camind.sqlite3")
        os._exit(0)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert status in (0, -signal.SIGKILL), status
    moment += step
"""

# A command of camind's that is sent a signal where it has made its copy's file and opens a database.
ENDED_COMMAND = """
import os, sys
from service.cli import main

number = int(sys.argv.pop(1))
sys.addaudithook(lambda event, _: event == "sqlite3.connect" and os.kill(os.getpid(), number))
main()
"""


def fill(database: Path, *names: str) -> None:
    engine = open_engine(f"sqlite:///{database}")
    schema.upgrade(engine)
    for name in names:
        Cameras(engine).add(draft(name))
    engine.dispose()


def draft(name: str) -> CameraDraft:
    return CameraDraft(name, Camera(4, 3, 1.0, 2.0, 0.5), "given", description="x" * 900)


def names_in(database: Path) -> list[str]:
    with closing(sqlite3.connect(database)) as connection:
        assert connection.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
        return [name for (name,) in connection.execute("SELECT name FROM cameras ORDER BY name")]


def damage(database: Path, page: int) -> None:
    """Garbage in the middle of a file's page, as a failing disk leaves it."""
    with database.open("rb+") as file:
        file.seek(page * PAGE_BYTES)
        file.write(b"\xa5" * (PAGE_BYTES // 2))


def leave_journal(database: Path) -> None:
    """A process that is killed while it writes."""
    crash = (
        "import os, sqlite3, sys; c = sqlite3.connect(sys.argv[1]); c.execute('PRAGMA cache_size = 1');"
        "c.execute('UPDATE camera_revisions SET description = zeroblob(9000)'); os._exit(1)"
    )
    subprocess.run([sys.executable, "-c", crash, database], check=False)
    assert (database.parent / f"{database.name}-journal").stat().st_size > 0


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two databases, to be copied by every test: to make them takes a while."""
    folder = tmp_path_factory.mktemp("made")
    fill(folder / "old.sqlite3", *OLD)
    fill(folder / "new.sqlite3", "new")
    return folder


@pytest.fixture
def database(made: Path, tmp_path: Path) -> Path:
    (tmp_path / "data").mkdir()
    return Path(shutil.copyfile(made / "old.sqlite3", tmp_path / "data" / "camind.sqlite3"))


@pytest.fixture
def copy(made: Path, tmp_path: Path) -> Path:
    """A backup of another database, with the camera ``new``."""
    backup(made / "new.sqlite3", tmp_path / "copy.sqlite3")
    return tmp_path / "copy.sqlite3"


def files_of(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


@pytest.fixture
def writer(database: Path) -> Iterator[list[str]]:
    """The names that a thread has registered so far, and goes on registering."""
    engine, is_over, done = open_engine(f"sqlite:///{database}"), threading.Event(), list[str]()

    def write() -> None:
        while not is_over.is_set():
            name = f"while-{len(done):04d}"
            Cameras(engine).add(draft(name))
            done.append(name)

    thread = threading.Thread(target=write)
    thread.start()
    yield done
    is_over.set()
    thread.join()
    engine.dispose()


def test_a_backup_under_writes_is_of_one_moment(database: Path, writer: list[str], tmp_path: Path) -> None:
    for number in range(5):
        target, before = tmp_path / f"{number}.sqlite3", len(writer)
        contents = backup(database, target)
        found = [name for name in names_in(target) if name.startswith("while")]
        assert len(found) >= before
        assert found == [f"while-{each:04d}" for each in range(len(found))]
        assert contents.rows["cameras"] == contents.rows["camera_revisions"] == len(OLD) + len(found)
        assert contents.revision == schema.head_revision()
    assert files_of(tmp_path) == {"data", *(f"{number}.sqlite3" for number in range(5))}


def test_a_backup_overwrites_only_by_force(database: Path, tmp_path: Path) -> None:
    target = tmp_path / "copy.sqlite3"
    target.write_bytes(b"mine")
    with pytest.raises(DatabaseFileError, match="--force"):
        backup(database, target)
    assert target.read_bytes() == b"mine"
    backup(database, target, is_forced=True)
    assert names_in(target) == OLD
    os.mkfifo(tmp_path / "device")
    with pytest.raises(DatabaseFileError, match="no file"):
        backup(database, tmp_path / "device", is_forced=True)
    (tmp_path / "link").symlink_to(database)
    for itself in (database, tmp_path / "link"):
        with pytest.raises(DatabaseFileError, match="the database itself"):
            backup(database, itself, is_forced=True)


def test_a_target_without_room_is_named(database: Path, tmp_path: Path) -> None:
    limited = (
        "import resource, sys; from pathlib import Path; from service.storage.backup import backup;"
        f"resource.setrlimit(resource.RLIMIT_FSIZE, ({PAGE_BYTES}, {PAGE_BYTES})); backup(*map(Path, sys.argv[1:]))"
    )
    target = tmp_path / "copy.sqlite3"
    done = subprocess.run(
        [sys.executable, "-c", limited, database, target], check=False, capture_output=True, text=True
    )
    assert f"DatabaseFileError: {target} cannot be written" in done.stderr
    assert files_of(tmp_path) == {"data"}


def test_a_folder_that_takes_no_file_is_named(database: Path, tmp_path: Path) -> None:
    told = f"No file can be made in the folder {tmp_path / 'absent'}: No such file or directory."
    with pytest.raises(DatabaseFileError, match=re.escape(told)):
        backup(database, tmp_path / "absent" / "copy.sqlite3")


@pytest.mark.parametrize("begin", [b"PGDMP\x01\x0e", b"--\n-- PostgreSQL database dump\n--\n", b"toc.dat\0"])
def test_what_pg_dump_wrote_is_no_matter_of_a_restore(tmp_path: Path, begin: bytes) -> None:
    (tmp_path / "dump").write_bytes(begin + bytes(1000))
    with pytest.raises(DatabaseFileError, match=r"that pg_dump wrote: .* with pg_restore"):
        restore(tmp_path / "dump", tmp_path / "data" / "camind.sqlite3")
    assert files_of(tmp_path) == {"dump"}


def test_nothing_is_not_backed_up(tmp_path: Path) -> None:
    with pytest.raises(DatabaseFileError, match="no database"):
        backup(tmp_path / "absent.sqlite3", tmp_path / "copy.sqlite3")
    assert files_of(tmp_path) == set()


def test_a_backup_is_one_file_where_the_database_has_a_log_beside_it(database: Path, tmp_path: Path) -> None:
    target = tmp_path / "copy.sqlite3"
    with closing(sqlite3.connect(database)) as connection:
        assert connection.execute("PRAGMA journal_mode = WAL").fetchone() == ("wal",)
    backup(database, target)
    with closing(sqlite3.connect(target)) as connection:
        assert connection.execute("PRAGMA journal_mode").fetchone() == ("delete",)


def test_a_backup_is_for_its_owner_s_eyes(database: Path, tmp_path: Path) -> None:
    backup(database, tmp_path / "copy.sqlite3")
    assert (tmp_path / "copy.sqlite3").stat().st_mode & 0o077 == 0


@pytest.mark.parametrize("page", [0, 1, 4, 8])
def test_a_damaged_page_is_found_and_backed_up_by_nobody(database: Path, tmp_path: Path, page: int) -> None:
    require_sound(database)
    damage(database, page)
    with pytest.raises(DatabaseFileError, match=re.escape(str(database))):
        require_sound(database)
    with pytest.raises(DatabaseFileError, match=re.escape(str(database))):
        backup(database, tmp_path / "copy.sqlite3")
    assert files_of(tmp_path) == {"data"}


def test_a_file_cut_short_is_found(database: Path) -> None:
    with database.open("rb+") as file:
        file.truncate(database.stat().st_size - PAGE_BYTES)
    with pytest.raises(DatabaseFileError, match="camind restore"):
        require_sound(database)


def test_the_log_of_an_emptied_database_is_kept(database: Path, copy: Path) -> None:
    log = database.with_name(f"{database.name}-wal")
    log.write_bytes(b"what was written")
    os.truncate(database, 0)
    with pytest.raises(DatabaseFileError, match=r"it is empty, .*`camind restore"), using(f"sqlite:///{database}"):
        pass
    _, kept = restore(copy, database)
    assert kept is not None
    assert kept.with_name(f"{kept.name}-wal").read_bytes() == b"what was written"
    assert (names_in(database), log.exists()) == (["new"], False)


def test_what_is_not_there_yet_is_sound(tmp_path: Path) -> None:
    require_sound(tmp_path / "absent.sqlite3")
    assert files_of(tmp_path) == set()


def test_a_restore_keeps_what_was_there(database: Path, copy: Path) -> None:
    database.chmod(0o640)
    contents, kept = restore(copy, database)
    assert kept is not None
    assert names_in(database) == ["new"]
    assert contents.rows["cameras"] == 1
    assert names_in(kept) == OLD
    assert re.fullmatch(r"camind\.sqlite3\.replaced-\d{8}T\d{6}\.\d{6}Z", kept.name)
    assert files_of(database.parent) == {database.name, kept.name, f"{database.name}.lock"}
    assert database.stat().st_mode & 0o777 == kept.stat().st_mode & 0o777 == 0o640
    restore(kept, database)
    assert names_in(database) == OLD


def test_a_restore_makes_what_was_not_there(tmp_path: Path, copy: Path) -> None:
    assert restore(copy, tmp_path / "new" / "camind.sqlite3")[1] is None
    assert names_in(tmp_path / "new" / "camind.sqlite3") == ["new"]


def test_an_older_backup_comes_to_the_newest_schema(database: Path, copy: Path) -> None:
    engine = open_engine(f"sqlite:///{copy}")
    schema.downgrade(engine, FIRST_SCHEMA)
    engine.dispose()
    contents, _ = restore(copy, database)
    assert contents.revision == schema.head_revision()
    assert contents.rows["calibrations"] == 0
    assert names_in(database) == ["new"]


def test_calibrations_whose_photographs_are_elsewhere_fail(database: Path, copy: Path) -> None:
    engine = open_engine(f"sqlite:///{copy}")
    for id_, spool in (("a" * 32, "here"), ("b" * 32, "elsewhere")):
        Calibrations(engine).add(CalibrationDraft(id_, spool, "bench", {}, ()))
    engine.dispose()
    for known, states in (("here", ["failed", "queued"]), (None, ["failed", "failed"])):
        restore(copy, database, known)
        engine = open_engine(f"sqlite:///{database}")
        found = Calibrations(engine).page(2)[0]
        engine.dispose()
        assert [each.state for each in found] == states
        assert "send them again" in str(found[0].problem)


def test_a_damaged_database_is_replaced_and_kept(database: Path, copy: Path) -> None:
    damage(database, 0)
    broken = database.read_bytes()
    _, kept = restore(copy, database)
    assert kept is not None
    assert kept.read_bytes() == broken
    assert names_in(database) == ["new"]


def test_a_journal_of_the_old_database_does_not_get_into_the_new_one(database: Path, copy: Path) -> None:
    """What a kill left beside the old file would be played back into whatever has its name."""
    leave_journal(database)
    _, kept = restore(copy, database)
    assert kept is not None
    assert names_in(database) == ["new"]
    assert names_in(kept) == OLD
    assert not [name for name in files_of(database.parent) if name.endswith("-journal")]


def test_a_journal_of_an_older_backup_does_not_get_into_the_new_one(database: Path, made: Path) -> None:
    leave_journal(database)
    backup(made / "new.sqlite3", database, is_forced=True)
    assert names_in(database) == ["new"]


@pytest.mark.parametrize("what", ["text", "empty", "foreign", "later", "damaged", "absent", "itself", "link"])
def test_what_is_no_sound_backup_changes_nothing(database: Path, copy: Path, what: str) -> None:
    before = database.read_bytes()
    with closing(sqlite3.connect(copy)) as connection, connection:
        if what == "foreign":
            connection.execute("DROP TABLE alembic_version")
        if what == "later":
            connection.execute("UPDATE alembic_version SET version_num = '2999_01_01_later'")
    if what in ("text", "empty"):
        copy.write_bytes(b"no database, but long enough to be taken for one" * 100 if what == "text" else b"")
    if what == "damaged":
        damage(copy, 3)
    if what in ("absent", "link"):
        copy.unlink()
    if what == "link":
        copy.symlink_to(database)
    with pytest.raises(DatabaseFileError, match="2999" if what == "later" else None):
        restore(database if what == "itself" else copy, database)
    assert database.read_bytes() == before
    assert files_of(database.parent) <= {database.name, f"{database.name}.lock"}


def test_a_database_in_use_is_not_replaced(database: Path, copy: Path) -> None:
    url = f"sqlite:///{database}"
    with using(url), using(url), pytest.raises(DatabaseFileError, match="in use"):
        restore(copy, database)
    with using("sqlite://"), using("postgresql+psycopg://x@/y"):
        restore(copy, database)


def test_a_database_that_is_being_replaced_is_not_used(database: Path) -> None:
    hold = "import fcntl, sys; f = open(sys.argv[1], 'ab'); fcntl.flock(f, 2); print(flush=True); sys.stdin.read()"
    lock = database.with_name(f"{database.name}.lock")
    with subprocess.Popen(
        [sys.executable, "-c", hold, lock], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as holder:
        assert holder.stdout
        assert holder.stdin
        holder.stdout.readline()
        with pytest.raises(NotReady, match="being restored"), using(f"sqlite:///{database}"):
            pass
        holder.stdin.close()
    with using(f"sqlite:///{database}"):
        pass


def test_only_a_file_is_a_database_file(tmp_path: Path) -> None:
    assert database_file("sqlite://") is database_file("sqlite:///:memory:") is None
    assert database_file("postgresql+psycopg://x@/y") is None
    (tmp_path / "link").symlink_to(tmp_path / "real")
    assert database_file(f"sqlite:///{tmp_path / 'link'}") == tmp_path / "real"


def test_a_kill_at_any_moment_of_a_restore_leaves_the_old_or_the_new(database: Path, copy: Path, is_soak: bool) -> None:
    step = "1" if is_soak else "11"
    subprocess.run([sys.executable, "-c", KILLED_RESTORES, copy, database.parent, step], check=True)
    found = []
    for data in sorted(database.parent.parent.glob("killed-*")):
        found.append(names_in(data / database.name))
        for kept in data.glob("camind.sqlite3.replaced-*"):
            assert names_in(kept) == OLD
        restore(copy, data / database.name)
        assert names_in(data / database.name) == ["new"]
        assert not [name for name in files_of(data) if name.startswith(".")]
    assert len(found) > 10
    assert found == sorted(found, reverse=True)
    assert (found[0], found[-1]) == (OLD, ["new"])
    assert all(names in (OLD, ["new"]) for names in found)


@pytest.mark.parametrize(("command", "number"), [("backup", signal.SIGTERM), ("restore", signal.SIGHUP)])
def test_a_signal_to_end_leaves_no_half_copy(database: Path, copy: Path, command: str, number: signal.Signals) -> None:
    file = copy if command == "restore" else copy.with_name("another.sqlite3")
    environment = {**os.environ, "CAMIND_DATA_DIR": str(database.parent)}
    arguments = [sys.executable, "-c", ENDED_COMMAND, str(int(number)), command, str(file)]
    assert subprocess.run(arguments, env=environment, check=False).returncode == 128 + number
    assert files_of(copy.parent) == {"data", copy.name}
    assert files_of(database.parent) == {database.name, f"{database.name}.lock"}
    assert names_in(database) == OLD
