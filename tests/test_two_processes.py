"""Two processes on one database and one spool take nothing from each other."""

import signal
import socket
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from httpx2 import Request

from model_export.started_server import Server, serving
from tests.fake_calibration import calibration_form
from tests.held_server import GO, ended_calibration, folders, write_command
from tests.inference.photographs import corners, png

NAMES = 12


def camera(name: str) -> dict[str, Any]:
    return {"name": name, "image_width_px": 4, "image_height_px": 3, "focus_distance_m": 1.0, "k_cam_px": 2.0}


@pytest.fixture
def data_dir(tmp_path: Path) -> Path:
    folder = tmp_path / "shared"
    folder.mkdir()
    (folder / GO).touch()
    return folder


@pytest.fixture
def servers(tmp_path: Path, data_dir: Path, tiny_model_dir: Path) -> Iterator[tuple[Server, Server]]:
    """The one that works the spool off, and the one that came later."""
    settings = {"CAMIND_DATA_DIR": str(data_dir), "CAMIND_DRAIN_S": "0"}
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
    program = write_command(tmp_path)

    def start(name: str) -> Any:
        return serving(tmp_path / name / "own", "--model", tiny_model_dir, camind=program, settings=settings)

    with start("first") as first:
        # its thread has taken the spool when this has ended
        ended_calibration(first, _post(first))
        with start("second") as second:
            yield first, second


def test_a_name_is_given_once(servers: tuple[Server, Server]) -> None:
    with ThreadPoolExecutor(4) as pool:
        for number in range(NAMES):
            futures = [pool.submit(server.add, camera(f"camera-{number}")) for server in servers * 2]
            assert Counter(future.result() for future in futures) == {201: 1, 409: 3}
    for server in servers:
        items = server.ask("GET", "/cameras").json()["items"]
        assert sorted(item["name"] for item in items) == sorted(f"camera-{number}" for number in range(NAMES))
        assert {item["revision"] for item in items} == {1}


def test_what_one_receives_the_other_does_not_sweep_away(servers: tuple[Server, Server], data_dir: Path) -> None:
    first, second = servers
    request = calibration_form(png(corners()))
    with _half_sent(second, request) as connection:
        second.poll(lambda: len(folders(data_dir)) == 1)
        received = folders(data_dir)
        # the first sweeps before it works, and removes its own folder once it has ended
        ended_calibration(first, _post(first))
        first.poll(lambda: folders(data_dir) == received)
        connection.sendall(request.content[-10:])
        answer = connection.recv(65536)
    assert b" 202 " in answer
    path = answer.split(b"ocation: ")[1].split(b"\r\n")[0].decode()
    assert ended_calibration(first, path)["state"] == "succeeded"
    first.poll(lambda: folders(data_dir) == [])


def test_what_a_killed_one_was_receiving_is_swept_away(servers: tuple[Server, Server], data_dir: Path) -> None:
    first, second = servers
    with closing(_half_sent(second, calibration_form(png(corners())))):
        second.poll(lambda: len(folders(data_dir)) == 1)
        second.stop(signal.SIGKILL)
    ended_calibration(first, _post(first))
    first.poll(lambda: folders(data_dir) == [])


def test_the_other_goes_on_where_the_first_was_killed(servers: tuple[Server, Server], data_dir: Path) -> None:
    first, second = servers
    path = _post(first)
    first.stop(signal.SIGKILL)
    started_s = time.monotonic()
    assert ended_calibration(second, path)["state"] == "succeeded"
    assert time.monotonic() - started_s < 30
    second.poll(lambda: folders(data_dir) == [])


def _post(server: Server) -> str:
    request = calibration_form(png(corners()))
    headers = {"Content-Type": request.headers["content-type"]}
    return server.ask("POST", "/calibrate?camera=bench", request.content, headers).headers["location"]


def _half_sent(server: Server, request: Request) -> socket.socket:
    """All of a form but for its last bytes, sent."""
    head = (
        "POST /calibrate?camera=bench HTTP/1.1\r\nHost: x\r\n"
        f"Content-Type: {request.headers['content-type']}\r\nContent-Length: {len(request.content)}\r\n\r\n"
    )
    connection = server.connect()
    connection.sendall(head.encode() + request.content[:-10])
    return connection
