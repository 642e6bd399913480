"""The command line, run as people run it."""

import json
import os
import re
import signal
import socket
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from datetime import timedelta
from importlib.metadata import EntryPoint, version
from pathlib import Path
from uuid import uuid4

import cv2
import numpy as np
import pytest
import typer
from sqlalchemy import Engine, event, update
from sqlmodel import col
from typer.testing import CliRunner, Result

from service import cli, server
from service.api.camera_schemas import LENS_EXAMPLE
from service.config import Settings
from service.storage import schema
from service.storage.calibrations import CalibrationDraft, Calibrations
from service.storage.engine import open_engine, writing
from service.storage.tables import CalibrationRow
from tests.inference.oracle_pair import brightness_for
from tests.simulated_sheets import CAMERA, FEW_DEPTHS_M, sheet_photos

CAMIND = Path(sys.executable).parent / "camind"


def camind(data_dir: Path, *arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "CAMIND_DATA_DIR": str(data_dir), **variables}
    return subprocess.run([CAMIND, *arguments], env=environment, capture_output=True, text=True, check=False)


def at_once(*arguments: str, said: str = "", **variables: str) -> Result:
    """As ``camind`` does, in this process: what is refused, and most else, needs no other."""
    return CliRunner().invoke(cli.app, arguments, input=said, env=variables)


@pytest.fixture
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A data folder, which commands in this process use."""
    monkeypatch.setenv("CAMIND_DATA_DIR", str(tmp_path))
    return tmp_path


def test_seeds_are_stored_once_and_listed(own_folder: Path) -> None:
    seeded = camind(own_folder, "cameras", "seed")
    assert seeded.returncode == 0, seeded.stderr
    assert len(seeded.stdout.split()) == 17
    assert "already" in at_once("cameras", "seed").stdout
    listed = at_once("cameras", "list").stdout.splitlines()
    assert len(listed) == 17
    assert "canon-t7-50mm-f1.2\tr1\t71.8 px\t2 m\t6000x4000" in listed


@pytest.mark.usefixtures("own_folder")
def test_migrate_says_where_the_database_is_however_it_is_served() -> None:
    done = at_once("migrate", CAMIND_PORT="http", CAMIND_WORKERS="64", CAMIND_INTRA_OP_THREADS="64")
    assert (done.exit_code, done.stdout) == (0, f"The database is at {schema.head_revision()}.\n")


@pytest.mark.usefixtures("own_folder")
def test_a_signal_amid_a_migration_is_no_fault_of_the_database() -> None:
    def end(*heard: object) -> None:
        if str(heard[2]).startswith("INSERT INTO _alembic_tmp"):
            sys.exit(7)

    event.listen(Engine, "before_cursor_execute", end)
    try:
        done = at_once("migrate")
    finally:
        event.remove(Engine, "before_cursor_execute", end)
    assert (done.exit_code, done.stderr) == (7, "")


def test_a_backup_of_nothing_says_where_it_looked_and_makes_nothing(tmp_path: Path) -> None:
    done = at_once("backup", str(tmp_path / "copy"), CAMIND_DATA_DIR=str(tmp_path / "absent"))
    told = f"There is no database at {tmp_path / 'absent' / 'camind.sqlite3'}.\n"
    assert (done.exit_code, done.stderr) == (1, told)
    assert list(tmp_path.iterdir()) == []


def test_help_is_asked_for_in_short_too() -> None:
    assert at_once("cameras", "list", "-h").stdout == at_once("cameras", "list", "--help").stdout


def test_the_version_is_the_package_s(tmp_path: Path) -> None:
    assert camind(tmp_path, "version").stdout.strip() == version("camind")


def test_a_wrong_setting_refuses_to_start(tmp_path: Path) -> None:
    done = camind(tmp_path, "serve", CAMIND_DEADLINE_S="-1")
    assert done.returncode == 2
    assert done.stderr.startswith("CAMIND_DEADLINE_S=-1: ")
    assert "Traceback" not in done.stderr


def test_a_taken_port_is_said(tmp_path: Path, tiny_model_dir: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        done = camind(tmp_path, "serve", "--port", port, "--model", str(tiny_model_dir))
    assert done.returncode == 1
    assert f"127.0.0.1:{port}" in done.stderr
    assert "--port or CAMIND_PORT" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("host", ["203.0.113.1", "no.such.host.invalid"])
def test_an_address_that_is_not_this_machine_s_is_no_matter_of_the_port(host: str) -> None:
    with pytest.raises(OSError, match=f"Cannot listen on {host}:0 .* choose another --host"):
        server.bind(host, 0)


def test_a_kernel_without_ipv6_is_no_matter_of_the_port(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "AF_INET6", 99)  # a family that no kernel knows
    with pytest.raises(OSError, match=r"Cannot listen on ::1:0 .* choose another --host"):
        server.bind("::1", 0)


def test_a_broken_model_is_said(tmp_path: Path) -> None:
    done = camind(tmp_path, "serve", "--port", "0", "--model", str(tmp_path))
    assert done.returncode == 1
    assert "manifest.json" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("command", "folder"),
    [
        (("migrate",), "data"),
        (("cameras", "seed"), "data"),
        (("serve", "--port", "0"), "data"),
        (("serve", "--port", "0"), "calibrations"),
    ],
)
def test_a_folder_that_cannot_be_made_is_said(
    tmp_path: Path, tiny_model_dir: Path, command: tuple[str, ...], folder: str
) -> None:
    (tmp_path / folder).touch()
    url = f"sqlite:///{tmp_path}/data/a.sqlite3"
    done = camind(tmp_path, *command, CAMIND_DATABASE_URL=url, CAMIND_MODEL_DIR=str(tiny_model_dir))
    told = f"The folder {tmp_path}/{folder} cannot be made (File exists): set CAMIND_DATA_DIR or CAMIND_DATABASE_URL.\n"
    assert (done.returncode, done.stderr) == (1, told)


def test_a_database_of_a_later_version_is_said(own_folder: Path, tiny_model_dir: Path) -> None:
    at_once("migrate")
    with closing(sqlite3.connect(own_folder / "camind.sqlite3")) as database, database:
        database.execute("UPDATE alembic_version SET version_num = '2099_01_01_later'")
    told = "at schema 2099_01_01_later, which this version does not know"
    for command in (("migrate",), ("cameras", "list")):
        done = at_once(*command)
        assert (done.exit_code, told in done.stderr) == (1, True)
    served = camind(own_folder, "serve", "--port", "0", "--model", str(tiny_model_dir))
    assert (served.returncode, served.stderr.count("Traceback")) == (1, 0)
    assert told in served.stderr


@pytest.mark.parametrize("command", [("migrate",), ("cameras", "list")])
@pytest.mark.usefixtures("own_folder")
def test_why_a_server_is_not_reached_is_said_without_its_password(command: tuple[str, ...]) -> None:
    done = at_once(*command, CAMIND_DATABASE_URL="postgresql+psycopg://u:hunter2@127.0.0.1:1/x")
    assert done.exit_code == 1
    verdict, reason = done.stderr.splitlines()
    assert verdict.startswith("The database cannot be used")
    assert "Connection refused" in reason
    assert "hunter2" not in done.stderr


@pytest.mark.parametrize("url", ["postgresql+psycopg://u:p@h:abc/db", "sqlite://", "sqlite:/x"])
def test_a_url_of_no_database_is_said(own_folder: Path, url: str) -> None:
    done = at_once("backup", str(own_folder / "copy"), CAMIND_DATABASE_URL=url)
    assert done.exit_code == 2
    assert done.stderr.startswith("CAMIND_DATABASE_URL ")


@pytest.mark.parametrize("days", ["9999999", "nan", "-1"])
@pytest.mark.usefixtures("bench")
def test_a_key_that_outlives_the_calendar_is_not_made(days: str) -> None:
    refused = at_once("keys", "create", "k", "--days", days)
    assert (refused.exit_code, "--days" in refused.stderr) == (2, True)
    assert at_once("keys", "list").stdout == ""


@pytest.mark.parametrize("arguments", [("cameras", "list", "--owner"), ("keys", "revoke")])
@pytest.mark.usefixtures("bench")
def test_what_is_no_utf_8_is_said(arguments: tuple[str, ...]) -> None:
    refused = at_once(*arguments, os.fsdecode(b"\xff"))
    assert (refused.exit_code, "no UTF-8" in refused.stderr) == (2, True)


def test_other_packages_commands_stand_beside_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    entry_point = EntryPoint("extra", "tests.test_cli:EXTRA", cli.GROUP)
    monkeypatch.setattr(cli.app, "registered_commands", list(cli.app.registered_commands))
    cli._add_commands(entry_point)
    assert "extra" in typer.main.get_group(cli.app).commands


def test_commands_that_cannot_be_loaded_are_a_hint(capsys: pytest.CaptureFixture[str]) -> None:
    cli._add_commands(EntryPoint("absent", "no_such_package.cli:commands", cli.GROUP))
    assert "no_such_package" in capsys.readouterr().err


EXTRA = typer.Typer()


@EXTRA.command(name="extra")
def run_extra() -> None:
    """Do nothing."""


def test_a_folder_of_photographs_gives_a_camera(own_folder: Path) -> None:
    folder, out = own_folder / "photos", own_folder / "found.json"
    folder.mkdir()
    for name, _, rgb in sheet_photos(CAMERA, FEW_DEPTHS_M):
        cv2.imwrite(str(folder / f"{name}.png"), rgb[:, :, ::-1])
    pattern = ("--rows", "7", "--columns", "3", "--spacing-mm", "26", "--diameter-mm", "18")
    done = camind(own_folder, "calibrate", str(folder), *pattern, "--out", str(out), "--register", "bench")
    assert done.returncode == 0, done.stderr
    assert "stored as bench, revision 1" in done.stdout
    found = json.loads(out.read_text())["result"]
    assert found["k_cam_px"]["value"] == pytest.approx(CAMERA.k_cam_px, rel=0.04)
    assert out.with_suffix(".svg").read_bytes().startswith(b"<?xml")
    assert at_once("cameras", "list").stdout.startswith("bench\tr1\t")


def test_a_folder_without_a_calibration_says_why(own_folder: Path) -> None:
    photos = own_folder / "photos"
    photos.mkdir()
    none = at_once("calibrate", str(photos))
    assert (none.exit_code, "no photographs" in none.stderr) == (2, True)
    paper = at_once("calibrate", str(photos), "--method", "paper")
    assert (paper.exit_code, "--method paper needs --focus-distance-m" in paper.stderr) == (2, True)
    cv2.imwrite(str(photos / "grey.png"), np.full((300, 400, 3), 128, np.uint8))
    grey = at_once("calibrate", str(photos), "--out", str(own_folder / "grey.json"))
    assert grey.exit_code == 1
    assert "no result: the circles could be measured in none of the photographs" in grey.stdout


@pytest.mark.parametrize(
    ("name", "url", "code", "said"),
    [
        ("no name", "", 2, "'no name' is no name for a camera"),
        ("bench", "postgresql+psycopg://u@127.0.0.1:1/x", 1, "The database cannot be used"),
    ],
)
def test_a_camera_that_could_not_be_stored_is_said_before_calibrating(
    own_folder: Path, name: str, url: str, code: int, said: str
) -> None:
    cv2.imwrite(str(own_folder / "grey.png"), np.full((300, 400, 3), 128, np.uint8))
    asked = ("calibrate", str(own_folder), "--out", str(own_folder / "found.json"), "--register", name)
    refused = at_once(*asked, CAMIND_DATABASE_URL=url)
    assert (refused.exit_code, refused.stdout) == (code, "")
    assert said in refused.stderr
    assert not (own_folder / "found.json").exists()


BENCH = {
    "name": "bench",
    "image_width_px": 64,
    "image_height_px": 48,
    "focus_distance_m": 2,
    "k_cam_px": 4,
    "gamma_px": 0,
}


@pytest.fixture
def bench(own_folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder to work in, whose database knows the camera ``bench``."""
    monkeypatch.chdir(own_folder)
    added = at_once("cameras", "add", "-", said=json.dumps(BENCH))
    assert (added.exit_code, added.stdout) == (0, "bench\tr1\t4 px\t2 m\t64x48\n")
    return own_folder


@pytest.mark.parametrize(
    ("specs", "code", "said"),
    [
        ("x", 2, "This is not valid JSON: "),
        ("[]", 2, "JSON object"),
        (json.dumps({**BENCH, "focus_distance_m": -2}), 2, "focus_distance_m: "),
        (json.dumps({**BENCH, "name": "half", "description": "\ud800"}), 2, "description: "),
        (json.dumps({**BENCH, "k_cam_px": None}), 1, "exactly one of k_cam_px and lens"),
        (json.dumps(BENCH), 1, "exists already"),
    ],
)
@pytest.mark.usefixtures("bench")
def test_what_is_no_new_camera_is_said(specs: str, code: int, said: str) -> None:
    refused = at_once("cameras", "add", "-", said=specs)
    assert refused.exit_code == code
    assert said in refused.stderr
    assert at_once("cameras", "list").stdout.count("\n") == 1


@pytest.mark.usefixtures("bench")
def test_cameras_that_the_page_exports_are_stored() -> None:
    exported = {"cameras": [BENCH, {**BENCH, "name": "other"}]}
    assert "exists already" in at_once("cameras", "add", "-", said=json.dumps(exported)).stderr
    stored = at_once("cameras", "add", "--replace", "-", said=json.dumps(exported))
    assert [line.split("\t")[:2] for line in stored.stdout.splitlines()] == [["bench", "r1"], ["other", "r1"]]
    half = {"cameras": [{**BENCH, "name": "third"}, {"name": "half"}]}
    assert at_once("cameras", "add", "-", said=json.dumps(half)).exit_code == 2
    assert "third" not in at_once("cameras", "list").stdout


@pytest.mark.parametrize("known_by", [{}, {"k_cam_px": None, "lens": LENS_EXAMPLE["lens"]}], ids=["k_cam", "lens"])
@pytest.mark.usefixtures("bench")
def test_a_camera_is_shown_as_what_stores_it_and_replaced_and_deleted(known_by: dict[str, object]) -> None:
    inner = {"fx_px": 60.5, "fy_px": 61.0, "cx_px": 31.5, "cy_px": 23.5, "distortion": [0.1, 0.0, 0.0, 0.0]}
    told = {**BENCH, "name": "other", "description": "on the bench", "intrinsics": inner, **known_by}
    assert at_once("cameras", "add", "-", said=json.dumps(told)).exit_code == 0
    shown = at_once("cameras", "show", "other").stdout
    assert json.loads(shown) == {name: value for name, value in told.items() if value is not None}
    assert "--replace" in at_once("cameras", "add", "-", said=shown).stderr
    same = at_once("cameras", "add", "--replace", "-", said=shown)
    assert ("\tr1\t" in same.stdout, same.stderr) == (True, "unchanged:\n")
    moved = shown.replace("on the bench", "on the wall")
    assert "\tr2\t" in at_once("cameras", "add", "--replace", "-", said=moved).stdout
    assert "\tr3\t" in at_once("cameras", "add", "--replace", "-", said=shown).stdout
    assert at_once("cameras", "delete", "other").exit_code == 0
    for command in ("show", "delete"):
        gone = at_once("cameras", command, "other")
        assert gone.exit_code == 1
        assert "There is no camera 'other': camind cameras list" in gone.stderr


@pytest.mark.usefixtures("bench")
def test_cameras_of_another_owner_are_told_of_where_one_s_own_are_missed() -> None:
    for name in ("front", "rear"):
        told = json.dumps({**BENCH, "name": name})
        assert at_once("cameras", "add", "--owner", "robot", "-", said=told).exit_code == 0
    assert at_once("cameras", "list").stderr == ""
    assert at_once("cameras", "delete", "bench").exit_code == 0
    listed = at_once("cameras", "list")
    assert (listed.exit_code, listed.stdout) == (0, "")
    assert listed.stderr == "There is no camera of this owner, but 2 of robot (--owner).\n"
    missed = at_once("cameras", "show", "rear").stderr
    assert missed.startswith("There is no camera 'rear' of this owner, but 1 of robot (--owner): ")
    assert at_once("cameras", "show", "re\x00ar").stderr.startswith("There is no camera 're")


def test_calibrations_that_just_ended_are_not_pruned(bench: Path) -> None:
    engine = open_engine(Settings(data_dir=bench).effective_database_url)
    calibrations = Calibrations(engine)
    for _ in range(2):
        calibrations.cancel(calibrations.add(CalibrationDraft(uuid4().hex, "a" * 32, "bench", {}, ())).id)
    longest_ago = calibrations.page(2)[0][1]
    with writing(engine) as session:
        days_ago = update(CalibrationRow).where(col(CalibrationRow.id) == longest_ago.id)
        session.connection().execute(days_ago.values(updated_at=longest_ago.updated_at - timedelta(days=31)))
    assert at_once("calibrations", "prune", "--days", "30").stdout == "deleted calibrations: 1\n"
    assert at_once("calibrations", "prune", "--days", "0").exit_code == 2
    assert len(calibrations.page(2)[0]) == 1
    engine.dispose()


def test_a_photograph_in_which_nothing_is_seen_has_no_depth(bench: Path) -> None:
    cv2.imwrite(str(bench / "black.png"), np.zeros((48, 64, 3), np.uint8))
    told = at_once("depth", "black.png", "./black.png", "--camera", "bench")
    assert told.exit_code == 1
    assert "has depth of 0 of 1 photographs" in told.stdout


def test_a_full_disk_is_said_of_what_has_no_room_and_leaves_no_half_of_it(bench: Path, tiny_model_dir: Path) -> None:
    for name in ("a.png", "b.png"):
        cv2.imwrite(name, np.full((48, 64, 3), brightness_for(2.0), np.uint8))
    (bench / "depth").mkdir()
    (bench / "depth" / ".a.npy.part").symlink_to("/dev/full")
    asked = ("a.png", "b.png", "--camera", "bench", "--format", "npy", "--model", str(tiny_model_dir))
    told = at_once("depth", *asked, "--known", "20,20,1.1")
    assert told.exit_code == 1
    assert "No space left" in told.stdout
    assert [file.name for file in (bench / "depth").iterdir()] == ["b.npy"]
    focus_m = re.search(r"100% +([0-9.]+)", told.stdout)
    assert focus_m is not None
    assert 1 < float(focus_m[1]) < 1.9  # by the known depth, not the camera's


def test_too_little_memory_is_said_of_the_photograph(bench: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise MemoryError

    monkeypatch.setattr("service.commands.depth_folder.fulfil", fail)
    (bench / "a.png").touch()
    told = at_once("depth", "a.png", "--camera", "bench")
    assert (told.exit_code, "too little memory" in told.stdout) == (1, True)


def test_nothing_is_left_in_the_user_s_home(tmp_path: Path) -> None:
    home = tmp_path / "home"
    home.mkdir()
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((48, 64, 3), 128, np.uint8))
    camera = tmp_path / "camera.json"
    camera.write_text(json.dumps(BENCH))
    own = {"HOME": str(home), "XDG_CACHE_HOME": "", "XDG_CONFIG_HOME": "", "XDG_DATA_HOME": ""}
    assert camind(tmp_path, "cameras", "add", str(camera), **own).returncode == 0
    asked = ("depth", str(tmp_path / "grey.png"), "--camera", "bench", "--out", str(tmp_path / "depth"))
    assert camind(tmp_path, *asked, **own).returncode == 0
    assert list(home.rglob("*")) == []


def test_a_folder_of_photographs_becomes_depth(bench: Path, tiny_model_dir: Path) -> None:
    photos, out = bench / "photos", bench / "depth"
    photos.mkdir()
    # the oracle reads blur off brightness: x is 0.5 and 1, so 2 / 1.5 and 2 / 2 m nearer than the focus
    for name, blur_px in (("half [b]", 2.0), ("whole", 4.0)):
        cv2.imwrite(str(photos / f"{name}.png"), np.full((48, 64, 3), brightness_for(blur_px), np.uint8))
    (photos / "broken.jpg").write_bytes(b"\xff\xd8\xff")
    asked = ["depth", str(photos), "--camera", "bench", "--out", str(out), "--model", str(tiny_model_dir)]
    asked += ["--side", "near", "--format", "npy", "--format", "json", "--at", "40,4"]
    asked += ["--longest-px", "32"]

    done = camind(bench, *asked)
    assert done.returncode == 1, done.stderr
    assert "has depth of 2 of 3 photographs" in done.stdout
    assert re.search(r"^broken\.jpg +no depth: The jpeg file .+: .+\. *$", done.stdout, re.MULTILINE)
    assert sorted(file.name for file in out.iterdir()) == ["half [b].json", "half [b].npy", "whole.json", "whole.npy"]
    for name, depth_m in (("half [b]", 2 / 1.5), ("whole", 1.0)):
        assert np.load(out / f"{name}.npy") == pytest.approx(np.full((24, 32), depth_m), rel=0.02)
        assert json.loads((out / f"{name}.json").read_text())["points"][0]["depth_m"] == pytest.approx(
            depth_m, rel=0.02
        )

    (photos / "broken.jpg").unlink()
    (out / "half [b].npy").unlink()
    kept = (out / "whole.npy").stat().st_mtime_ns
    again = at_once(*asked, "--only-missing", "--focus-distance-m", "0.1")
    assert again.exit_code == 0, again.stderr
    assert re.search(r"0\.09\d\d\d +0\.09\d\d\d to", again.stdout)  # what is close has four digits
    assert "has depth of 1 of 1 photographs, and had that of 1" in again.stdout
    assert (out / "half [b].npy").exists()
    assert (out / "whole.npy").stat().st_mtime_ns == kept


def test_photographs_that_had_depth_when_a_signal_came_are_told_of(bench: Path, tiny_model_dir: Path) -> None:
    photos, out = bench / "photos", bench / "depth"
    photos.mkdir()
    for place in range(200):
        cv2.imwrite(str(photos / f"{place}.png"), np.full((480, 640, 3), 128, np.uint8))
    asked = ["depth", str(photos), "--camera", "bench", "--out", str(out), "--model", str(tiny_model_dir)]
    with subprocess.Popen([CAMIND, *asked], stdout=subprocess.PIPE, text=True) as running:
        while running.poll() is None and not list(out.glob("*.png")):
            time.sleep(0.01)
        running.terminate()
        told, _ = running.communicate(timeout=30)
    assert running.returncode == 128 + signal.SIGTERM
    made = {file.stem for file in out.iterdir()}
    assert 0 < len(made) < 200
    named = {line.split(".png")[0] for line in told.splitlines() if ".png" in line}
    assert named <= made
    assert len(made - named) <= 2  # what was at work when it came


def test_depth_has_its_name_once_it_is_on_the_disk(
    bench: Path, tiny_model_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    photo, out, on_disk = bench / "grey.png", bench / "depth", []
    cv2.imwrite(str(photo), np.full((48, 64, 3), 128, np.uint8))

    def synced(descriptor: int) -> None:
        named = [file for file in out.iterdir() if not file.name.startswith(".")]
        on_disk.append((len(named), os.fstat(descriptor).st_size))

    monkeypatch.setattr(os, "fsync", synced)
    asked = ("depth", str(photo), "--camera", "bench", "--out", str(out), "--model", str(tiny_model_dir))
    done = at_once(*asked, "--format", "npy", "--format", "json")
    assert done.exit_code == 0, done.stderr
    assert on_disk == [(n, (out / f"grey.{kind}").stat().st_size) for n, kind in enumerate(("npy", "json"))]


def test_a_table_tells_photographs_of_any_name_apart(bench: Path, tiny_model_dir: Path) -> None:
    photos = bench / "photos"
    photos.mkdir()
    names = (b"PXL_20240501_123456789.jpg", b"PXL_20240501_123457012.jpg", b"caf\xe9.jpg")
    for name in names:
        (photos / os.fsdecode(name)).write_bytes(b"\xff\xd8\xff")
    asked = ["depth", str(photos), "--camera", "bench", "--out", str(bench / "depth"), "--model", str(tiny_model_dir)]
    done = camind(bench, *asked, COLUMNS="60", TTY_COMPATIBLE="1", TERM="dumb")
    assert (done.returncode, "has depth of 0 of 3 photographs" in done.stdout) == (1, True), done.stderr
    shown = "".join(line[:26].strip() for line in done.stdout.splitlines())
    for name in names:
        assert name.decode("utf-8", "replace") in shown


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (("photos", "--camera", "other"), 1, "no camera 'other'"),
        (("photos", "--camera", "bench", "--format", "gif"), 2, "format: "),
        (("photos", "--camera", "bench", "--known", "1,2"), 2, "known.0: "),
        (("photos", "--camera", "bench", "--maps", "depth"), 2, "maps.0: "),
        (("photos", "--camera", "bench", "--longest-px", "8"), 2, "longest_px: "),
        (("photos", "--camera", "bench", "--out", "photos"), 2, "photos holds photographs"),
        (("photos", "--camera", "bench", "--out", "empty/../photos"), 2, "photos holds photographs"),
        (("photos", "--camera", "bench", "--format", "npy", "--format", "gif"), 2, "format: "),
        (("photos", "others/a.jpg", "--camera", "bench"), 2, "would become one file"),
        (("empty", "--camera", "bench"), 2, "no photographs in empty"),
    ],
)
@pytest.mark.usefixtures("bench")
def test_what_cannot_be_asked_of_photographs_is_said_before_anything_is_made(
    arguments: tuple[str, ...], code: int, said: str
) -> None:
    for name in ("photos/a.png", "others/a.jpg", "empty/notes.txt"):
        Path(name).parent.mkdir()
        Path(name).touch()
    refused = at_once("depth", *arguments)
    assert refused.exit_code == code
    assert said in refused.stderr
    assert not Path("depth").exists()


@pytest.mark.parametrize(
    ("blur", "said"),
    [("16-many", "not 16-many"), ("16-900-48-96", "become fewer")],
)
def test_channels_that_cannot_become_fewer_are_said(tmp_path: Path, blur: str, said: str) -> None:
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((300, 400, 3), 128, np.uint8))
    told = ["--textures", str(tmp_path), "--out", str(tmp_path / "narrow.pt"), "--blur", blur, "--depth", "16-16-16-48"]
    refused = camind(tmp_path, "narrow", *told)
    assert refused.returncode == 1
    assert said in refused.stderr
    assert "Traceback" not in refused.stderr
    assert not (tmp_path / "narrow.pt").exists()
