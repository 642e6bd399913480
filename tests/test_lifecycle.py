"""How the process begins and ends: not on a damaged database, and not before what was asked is answered."""

import http.client
import json
import os
import shutil
import signal
import socket
import sqlite3
import subprocess
import time
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import urlopen

import pytest

from model_export.started_server import CAMIND, Reply, Server, serving
from tests.storage.test_backup import damage, fill

DRAIN_S = 2.0
CAMERA = {"name": "kept", "image_width_px": 4, "image_height_px": 3, "focus_distance_m": 1.0, "k_cam_px": 2.0}
JSON = {"Content-Type": "application/json"}


@pytest.fixture
def server(tmp_path: Path, tiny_model_dir: Path) -> Iterator[Server]:
    with serving(tmp_path / "data", "--model", tiny_model_dir, settings={"CAMIND_DRAIN_S": "0"}) as running:
        yield running


def is_listening(server: Server) -> bool:
    try:
        server.connect().close()
    except ConnectionError:  # refused, or reset where the service stops listening at that very moment
        return False
    return True


def _unready(server: Server) -> Reply | None:
    reply = server.ask("GET", "/health/ready")
    return None if reply.status == 200 else reply


def test_it_says_that_it_stops_while_it_still_answers(tmp_path: Path, tiny_model_dir: Path) -> None:
    with serving(tmp_path / "data", "--model", tiny_model_dir, settings={"CAMIND_DRAIN_S": str(DRAIN_S)}) as server:
        server.process.send_signal(signal.SIGTERM)
        started_s = time.monotonic()
        reply = server.poll(lambda: _unready(server))
        assert time.monotonic() - started_s < DRAIN_S
        assert (reply.status, reply.json()["detail"]) == (503, "The service is stopping.")
        live = server.ask("GET", "/health/live")
        # who keeps connections comes on a new one next time, to whoever serves then
        assert (live.status, live.headers["connection"]) == (200, "close")
        assert server.add(CAMERA) == 201
        assert server.process.wait(timeout=30) == 0
        assert time.monotonic() - started_s >= DRAIN_S


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_request_in_flight_is_answered_before_the_end(server: Server, number: signal.Signals) -> None:
    body = json.dumps(CAMERA).encode()
    head = f"POST /cameras HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\nContent-Length: {len(body)}\r\n\r\n"
    with server.connect() as connection:
        connection.sendall(head.encode() + body[:10])
        server.poll(lambda: "camind_requests_in_progress 2" in server.ask("GET", "/metrics").body.decode())
        server.process.send_signal(number)
        server.poll(lambda: not is_listening(server))
        connection.sendall(body[10:])
        assert connection.recv(100).startswith(b"HTTP/1.1 201 ")
    assert server.process.wait(timeout=30) == 0
    assert "Traceback" not in server.log


def test_a_connection_is_kept_between_requests_and_holds_up_no_end(server: Server) -> None:
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)
    connection.connect()
    kept = connection.sock
    for pause_s in (5.5, 0):
        connection.request("GET", "/health/live")
        assert connection.getresponse().read()
        time.sleep(pause_s)
    assert connection.sock is kept
    started_s = time.monotonic()
    assert server.stop(signal.SIGTERM) == 0
    assert time.monotonic() - started_s < 4
    connection.close()


def test_a_second_signal_ends_it_at_once(server: Server) -> None:
    with server.connect() as connection:
        connection.sendall(b"POST /cameras HTTP/1.1\r\nHost: x\r\nContent-Length: 10\r\n\r\n{")
        server.poll(lambda: "camind_requests_in_progress 2" in server.ask("GET", "/metrics").body.decode())
        server.process.send_signal(signal.SIGTERM)
        server.poll(lambda: not is_listening(server))
        started_s = time.monotonic()
        assert server.stop(signal.SIGTERM) == 128 + signal.SIGTERM
        assert time.monotonic() - started_s < 5


def refused_start(data_dir: Path, model_dir: Path, *options: str) -> str:
    """What ``camind serve`` says where it does not start."""
    environment = {**os.environ, "CAMIND_DATA_DIR": str(data_dir)}
    command: list[str | Path] = [CAMIND, "serve", "--port", "0", "--model", model_dir, *options]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 1
    return done.stderr


def test_the_address_that_it_says_can_be_opened_in_ipv6_too(tmp_path: Path, tiny_model_dir: Path) -> None:
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:  # this machine has none, which is said
        assert "Cannot listen on ::1:0 " in refused_start(tmp_path, tiny_model_dir, "--host", "::1")
        return
    environment = {**os.environ, "CAMIND_DATA_DIR": str(tmp_path)}
    command: list[str | Path] = [CAMIND, "serve", "--host", "::1", "--port", "0", "--model", tiny_model_dir]
    with subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        try:
            told = urlsplit(process.stderr.readline().split()[-1])
            assert (told.scheme, told.hostname) == ("http", "::1")
            with socket.create_connection((told.hostname, told.port), timeout=10):
                pass
        finally:
            process.kill()


def test_a_log_without_room_hinders_neither_start_nor_end(tmp_path: Path, tiny_model_dir: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = str(free.getsockname()[1])
    environment = {**os.environ, "CAMIND_DATA_DIR": str(tmp_path), "CAMIND_DRAIN_S": "0"}
    command: list[str | Path] = [CAMIND, "serve", "--port", port, "--model", tiny_model_dir]
    with Path("/dev/full").open("w") as full, subprocess.Popen(command, env=environment, stderr=full) as process:
        try:
            is_ready = False
            while not is_ready and process.poll() is None:
                time.sleep(0.05)
                with suppress(OSError), urlopen(f"http://127.0.0.1:{port}/health/ready") as reply:
                    is_ready = reply.status == 200
            process.terminate()
            assert (is_ready, process.wait(timeout=30)) == (True, 0)
        finally:
            process.kill()


@pytest.mark.parametrize("page", [0, 2])
def test_a_damaged_database_is_not_served(tmp_path: Path, tiny_model_dir: Path, page: int) -> None:
    database = tmp_path / "camind.sqlite3"
    fill(database, "kept")
    damage(database, page)
    told = refused_start(tmp_path, tiny_model_dir)
    assert len(told.splitlines()) == 1
    assert str(database) in told
    assert "camind restore" in told


def test_an_app_that_does_not_start_ends_with_1(tmp_path: Path, tiny_model_dir: Path) -> None:
    model_dir = Path(shutil.copytree(tiny_model_dir, tmp_path / "model"))
    manifest = json.loads((model_dir / "manifest.json").read_text())
    manifest["graphs"]["blur"]["outputs"].append({"name": "more", "shape": ["n"]})
    (model_dir / "manifest.json").write_text(json.dumps(manifest))
    told = refused_start(tmp_path, model_dir)
    assert "lacks the outputs ['more']" in told
    assert told.endswith("camind did not start: the log above says why.\n")


def test_a_stop_is_heard_before_it_serves(tmp_path: Path) -> None:
    manifest = tmp_path / "model" / "manifest.json"
    manifest.parent.mkdir()
    os.mkfifo(manifest)
    environment = {**os.environ, "CAMIND_DATA_DIR": str(tmp_path / "data")}
    command: list[str | Path] = [CAMIND, "serve", "--port", "0", "--model", manifest.parent]
    with subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True) as process:
        try:
            with manifest.open("w"):  # which waits until it is about to be read
                process.terminate()
                told = process.communicate(timeout=30)[1]
        finally:
            process.kill()
    # by a handler of its own: without one a container's first process goes on
    assert (process.returncode, told) == (0, "")


def test_a_running_service_is_backed_up_and_not_restored(server: Server, tmp_path: Path) -> None:
    def camind(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
        environment = {**os.environ, "CAMIND_DATA_DIR": str(tmp_path / "data")}
        return subprocess.run([CAMIND, *arguments], env=environment, capture_output=True, text=True, check=False)

    copy = tmp_path / "copy.sqlite3"
    assert server.add(CAMERA) == 201
    done = camind("backup", copy)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith(f"{copy} holds ")
    assert "camera_revisions 1, cameras 1, " in done.stdout
    assert camind("backup", copy).returncode == 1
    assert server.add({**CAMERA, "name": "later"}) == 201
    refused = camind("restore", copy)
    assert (refused.returncode, refused.stdout) == (1, "")
    assert "stop the service first" in refused.stderr
    assert server.ask("GET", "/cameras/later").status == 200
    assert server.stop(signal.SIGTERM) == 0
    restored = camind("restore", copy)
    assert (restored.returncode, restored.stderr) == (0, "")
    kept = Path(restored.stdout.splitlines()[1].removeprefix("What was there before is "))
    with closing(sqlite3.connect(kept)) as connection:
        assert connection.execute("SELECT count(*) FROM cameras").fetchone() == (2,)
    assert [line.split("\t")[0] for line in camind("cameras", "list").stdout.splitlines()] == ["kept"]


def test_postgresql_has_its_own_commands(tmp_path: Path) -> None:
    environment = {**os.environ, "CAMIND_DATABASE_URL": "postgresql+psycopg://nobody@/none"}
    done = subprocess.run(
        [CAMIND, "backup", tmp_path / "x"], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert "pg_dump and pg_restore" in done.stderr


def test_a_new_database_is_seeded_once(tmp_path: Path, tiny_model_dir: Path) -> None:
    def names(server: Server) -> list[str]:
        return [item["name"] for item in json.loads(server.ask("GET", "/cameras?limit=100").body)["items"]]

    arguments = ("--seed", "--model", tiny_model_dir)
    # what a first start leaves that found the disk full
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "camind.sqlite3").touch()
    with serving(tmp_path / "data", *arguments) as server:
        seeded = names(server)
        assert "nikon-d7500-50mm-f1.8" in seeded
        assert server.ask("DELETE", f"/cameras/{seeded[0]}").status == 204
        server.stop(signal.SIGTERM)
    with serving(tmp_path / "data", *arguments) as server:
        assert names(server) == seeded[1:]
