"""Calibrations in the real process: what was acknowledged survives SIGKILL, and nobody waits for ever."""

import http.client
import json
import signal
import socket
import sqlite3
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, closing
from pathlib import Path

import pytest
from httpx2 import Request

from model_export.started_server import Reply, Server
from model_export.started_server import serving as start
from tests.fake_calibration import calibration_form
from tests.held_server import GO, ended_calibration, folders, write_command
from tests.inference.photographs import corners, png

RECEIVE_DEADLINE_S = 1.0
CALIBRATION_RECEIVE_DEADLINE_S = 4.0


def serving(data_dir: Path, model_dir: Path) -> AbstractContextManager[Server]:
    settings = {
        "CAMIND_RECEIVE_DEADLINE_S": str(RECEIVE_DEADLINE_S),
        "CAMIND_CALIBRATION_RECEIVE_DEADLINE_S": str(CALIBRATION_RECEIVE_DEADLINE_S),
    }
    return start(data_dir, "--model", model_dir, camind=write_command(data_dir.parent), settings=settings)


def form() -> Request:
    return calibration_form(png(corners()), png(corners()), register=True)


def post(server: Server, **headers: str) -> Reply:
    request = form()
    kind = request.headers["content-type"]
    return server.ask("POST", "/calibrate?camera=bench", request.content, {"Content-Type": kind, **headers})


def running(server: Server) -> str:
    """The path of a calibration that runs, and is held."""
    reply = post(server)
    assert reply.status == 202
    path = reply.headers["location"]
    server.poll(lambda: server.ask("GET", path).json()["images"])
    return path


@pytest.fixture
def data_dir(tmp_path: Path) -> Path:
    return tmp_path / "data"


@pytest.fixture
def server(data_dir: Path, tiny_model_dir: Path) -> Iterator[Server]:
    with serving(data_dir, tiny_model_dir) as started:
        yield started


def test_what_was_acknowledged_survives_a_kill(data_dir: Path, tiny_model_dir: Path) -> None:
    with serving(data_dir, tiny_model_dir) as first:
        paths = [running(first), post(first).headers["location"]]
        assert first.ask("GET", paths[0]).json()["state"] == "running"
        assert first.stop(signal.SIGKILL) == -signal.SIGKILL
    (data_dir / GO).touch()
    with serving(data_dir, tiny_model_dir) as second:
        for revision, path in enumerate(paths, 1):
            body = ended_calibration(second, path)
            assert (body["state"], body["camera_revision"]) == ("succeeded", revision)
        assert second.ask("GET", "/cameras/bench").json()["revision"] == 2
        second.poll(lambda: folders(data_dir) == [])


def test_a_stop_waits_for_no_calibration_and_no_listener(data_dir: Path, server: Server) -> None:
    path = running(server)
    listener = http.client.HTTPConnection("127.0.0.1", server.port, timeout=30)
    listener.request("GET", f"{path}/events")
    events = listener.getresponse()
    # the first event comes though nothing changes
    assert json.loads(events.readline().partition(b": ")[2])["state"] == "running"
    waiting = http.client.HTTPConnection("127.0.0.1", server.port, timeout=30)
    request = form()
    headers = {"Content-Type": request.headers["content-type"], "Prefer": "wait=60"}
    waiting.request("POST", "/calibrate?camera=bench", request.content, headers)
    server.poll(lambda: len(server.ask("GET", "/calibrations").json()["items"]) == 2)
    started_s = time.monotonic()
    assert server.stop(signal.SIGTERM) == 0
    assert time.monotonic() - started_s < 10
    with closing(sqlite3.connect(data_dir / "camind.sqlite3")) as database:
        assert database.execute("SELECT state, attempts FROM calibrations").fetchall() == [("queued", 0)] * 2
    assert waiting.getresponse().status == 202
    assert len(folders(data_dir)) == 2
    for connection in (listener, waiting):
        connection.close()


def test_head_of_events_does_not_wait_for_the_end(server: Server) -> None:
    path = running(server)
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)
    connection.request("HEAD", f"{path}/events")
    answer = connection.getresponse()
    assert (answer.status, answer.read()) == (200, b"")
    connection.request("GET", "/health/live")
    assert connection.getresponse().status == 200
    connection.close()
    with server.connect() as last:
        last.sendall(f"HEAD {path}/events HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n".encode())
        while last.recv(4096):
            pass


def test_photographs_may_take_longer_than_other_bodies(server: Server) -> None:
    request = form()
    with _half_sent(server, request) as connection:
        time.sleep(2 * RECEIVE_DEADLINE_S + 1)
        connection.sendall(request.content[100:])
        assert b" 202 " in connection.recv(100)


def test_photographs_that_never_end_are_cut_off(data_dir: Path, server: Server) -> None:
    with _half_sent(server, form()) as connection:
        assert b" 408 " in connection.recv(100)
    assert folders(data_dir) == []


def test_who_goes_away_while_sending_leaves_nothing(data_dir: Path, server: Server) -> None:
    with _half_sent(server, form()):
        server.poll(lambda: folders(data_dir) != [])
    server.poll(lambda: folders(data_dir) == [])
    assert server.ask("GET", "/calibrations").json()["items"] == []


def test_who_goes_away_while_waiting_loses_nothing(server: Server) -> None:
    def states() -> list[str]:
        return [item["state"] for item in server.ask("GET", "/calibrations").json()["items"]]

    request = form()
    with _half_sent(server, request, "Prefer: wait=60\r\n") as connection:
        connection.sendall(request.content[100:])
        server.poll(lambda: states() == ["running"])
    time.sleep(0.5)
    assert states() == ["running"]


def _half_sent(server: Server, request: Request, headers: str = "") -> socket.socket:
    head = (
        "POST /calibrate?camera=bench HTTP/1.1\r\nHost: x\r\n"
        f"Content-Type: {request.headers['content-type']}\r\nContent-Length: {len(request.content)}\r\n{headers}\r\n"
    )
    connection = server.connect()
    connection.sendall(head.encode() + request.content[:100])
    return connection
