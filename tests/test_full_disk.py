"""The real process on disks that refuse: it says so, loses nothing it acknowledged, and goes on when there is room.

Two faults. A limit on the size of the process's files, which any user can set and lift while it runs: every write
beyond it fails with EFBIG, which SQLite takes for a failing disk (an I/O error) and the photographs for a full one. And
a file system of a megabyte that really is full (ENOSPC), in a mount namespace of the process's own: where the kernel
lets nobody make one, that one is skipped, and tests/api/test_full_storage.py has SQLite's own refusal to grow.
"""

import json
import resource
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from model_export.started_server import CAMIND, Reply, Server, serving
from tests.fake_calibration import calibration_form
from tests.inference.photographs import corners, png

JSON = {"Content-Type": "application/json"}
DISK_BYTES = 2**20
# with room for what one calibration holds, but not for a copy of all of them
PRUNED_IN_LITTLE_ROOM = """
import os, sys
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from uuid import uuid4
from service.errors import InsufficientStorage
from service.storage import schema
from service.storage.calibrations import CalibrationDraft, Calibrations, StoredPicture
from service.storage.engine import open_engine

database, ballast = Path(sys.argv[1], "camind.sqlite3"), Path(sys.argv[1], "ballast")
engine = open_engine(f"sqlite:///{database}")
schema.upgrade(engine)
calibrations = Calibrations(engine)
for _ in range(10):
    pictures = (StoredPicture("x" * 40_000, "focused"),)
    calibrations.cancel(calibrations.add(CalibrationDraft(uuid4().hex, "a" * 32, "bench", {}, pictures)).id)
with suppress(OSError), ballast.open("ab", buffering=0) as file:
    while True:
        file.write(bytes(4096))
try:
    calibrations.forget(datetime.now(UTC))
except InsufficientStorage:
    os.truncate(ballast, ballast.stat().st_size - 50_000)
    print(calibrations.forget(datetime.now(UTC)))
"""
OWN_NAMESPACE = ("unshare", "--mount", "--map-root-user")


def camera(name: str) -> dict[str, Any]:
    size = {"image_width_px": 4, "image_height_px": 3, "focus_distance_m": 1.0}
    return {"name": name, **size, "k_cam_px": 2.0, "description": "x" * 1000}


def replacement() -> str:
    return json.dumps({key: value for key, value in camera("").items() if key != "name"})


def post_calibration(server: Server) -> Reply:
    request = calibration_form(png(corners()) + bytes(50_000))
    kind = request.headers["content-type"]
    return server.ask("POST", "/calibrate?camera=bench", request.content, {"Content-Type": kind})


def is_ready(server: Server) -> bool:
    return server.ask("GET", "/health/ready").status == 200


def test_a_disk_that_fails_writes_is_told_of_and_recovered_from(tmp_path: Path, tiny_model_dir: Path) -> None:
    with serving(tmp_path / "data", "--model", tiny_model_dir, settings={"CAMIND_LOG_LEVEL": "error"}) as server:
        pid = server.process.pid
        before = resource.prlimit(pid, resource.RLIMIT_FSIZE)
        assert server.add(camera("there")) == 201
        # less than a journal of one page needs, more than the log will
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (4096, before[1]))
        replies = [
            server.ask("POST", "/cameras", json.dumps(camera("new")), JSON),
            server.ask("PUT", "/cameras/there", replacement(), JSON),
            server.ask("DELETE", "/cameras/there"),
        ]
        assert [(reply.status, reply.json()["type"]) for reply in replies] == [
            (503, "urn:camind:problem:not-ready")
        ] * 3
        refused = post_calibration(server)
        assert (refused.status, refused.json()["type"]) == (507, "urn:camind:problem:insufficient-storage")
        assert not [path for path in (tmp_path / "data" / "calibrations").iterdir() if path.is_dir()]
        resource.prlimit(pid, resource.RLIMIT_FSIZE, before)
        assert is_ready(server)
        assert server.ask("GET", "/cameras/new").status == 404
        assert server.ask("PUT", "/cameras/there", replacement(), JSON).json()["revision"] == 2
        assert server.add(camera("new")) == 201
        assert post_calibration(server).status == 202
        assert server.process.pid == pid
        assert "Traceback" not in server.log


class SmallDisk:
    """A server whose data folder is a file system of its own, seen through the process."""

    def __init__(self, server: Server, data_dir: Path) -> None:
        self.server = server
        self.folder = Path(f"/proc/{server.process.pid}/root{data_dir}")
        self._ballast = self.folder / "ballast"

    def fill(self) -> None:
        with self._ballast.open("ab", buffering=0) as file:
            for size in (65_536, 4096):
                try:
                    while True:
                        file.write(b"\0" * size)
                except OSError:
                    pass

    def clear(self) -> None:
        self._ballast.unlink()


@pytest.fixture
def _own_namespace(tmp_path: Path) -> None:
    tried = subprocess.run([*OWN_NAMESPACE, "mount", "-t", "tmpfs", "none", tmp_path], check=False, capture_output=True)
    if tried.returncode != 0:
        pytest.skip("the kernel gives this user no mount namespace of its own")


@pytest.fixture
def small_disk(tmp_path: Path, tiny_model_dir: Path, _own_namespace: None) -> Iterator[SmallDisk]:
    data_dir = tmp_path / "data"
    data_dir.mkdir()
    program = tmp_path / "camind-on-a-small-disk"
    program.write_text(
        f"#!/bin/sh\nexec {' '.join(OWN_NAMESPACE)} sh -c "
        f"""'mount -t tmpfs -o size={DISK_BYTES} none "$CAMIND_DATA_DIR" && exec "$0" "$@"' {CAMIND} "$@"\n"""
    )
    program.chmod(0o755)
    with serving(data_dir, "--model", tiny_model_dir, camind=program) as server:
        yield SmallDisk(server, data_dir)


def test_a_full_disk_is_told_of_and_recovered_from(small_disk: SmallDisk) -> None:
    server = small_disk.server
    assert server.add(camera("there")) == 201
    small_disk.fill()
    replies = [
        server.ask("POST", "/cameras", json.dumps(camera("new")), JSON),
        server.ask("PUT", "/cameras/there", replacement(), JSON),
        server.ask("DELETE", "/cameras/there"),
        post_calibration(server),
    ]
    assert [(reply.status, reply.json()["type"]) for reply in replies] == [
        (507, "urn:camind:problem:insufficient-storage")
    ] * 4
    assert server.ask("GET", "/health/ready").status == 503
    assert server.ask("GET", "/cameras/there").json()["revision"] == 1
    assert not [path for path in (small_disk.folder / "calibrations").iterdir() if path.is_dir()]
    small_disk.clear()
    assert is_ready(server)
    assert server.ask("PUT", "/cameras/there", replacement(), JSON).json()["revision"] == 2
    assert server.ask("DELETE", "/cameras/there").status == 204
    path = post_calibration(server).headers["location"]
    # a picture without a sheet: worked on all the same
    server.poll(lambda: server.ask("GET", path).json()["state"] == "failed")
    assert "Traceback" not in server.log


@pytest.mark.usefixtures("_own_namespace")
def test_calibrations_are_pruned_in_little_room(tmp_path: Path) -> None:
    script = f'mount -t tmpfs -o size={DISK_BYTES} none "$2" && exec "$0" -c "$1" "$2"'
    arguments: list[str | Path] = [*OWN_NAMESPACE, "sh", "-c", script, sys.executable, PRUNED_IN_LITTLE_ROOM, tmp_path]
    assert subprocess.run(arguments, check=True, capture_output=True, text=True).stdout == "10\n"
