"""Clients that dawdle, against the real process: they are cut at the deadline, and the others do not notice."""

import socket
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from threading import Event, Thread
from typing import Any

import pytest

from model_export.started_server import Reply, Server, serving
from tests.inference.photographs import corners, png

DEADLINE_S, SOAK_DEADLINE_S = 2.0, 60.0
SLACK_S = 4.0
DRIP_S = 0.1
IDLE = 300
CAMERA: dict[str, Any] = {
    "name": "bench",
    "image_width_px": 64,
    "image_height_px": 48,
    "focus_distance_m": 2.0,
    "k_cam_px": 6.0,
}
PHOTOGRAPH = png(corners())
PNG = {"Content-Type": "image/png"}
BEGINNINGS = (
    b"GET /cameras HTTP/1.1\r\nHost: x\r\nX-Slow: ",
    b"POST /depth?camera=bench HTTP/1.1\r\nHost: x\r\nContent-Type: image/png\r\nContent-Length: 900000\r\n\r\n",
    b"POST /calibrate?camera=bench HTTP/1.1\r\nHost: x\r\nContent-Type: multipart/form-data; boundary=x\r\n"
    b"Content-Length: 900000\r\n\r\n--x\r\nContent-Disposition: ",
    b"POST /cameras HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\nTransfer-Encoding: chunked\r\n\r\n",
)


@pytest.fixture(scope="module")
def deadline_s(is_soak: bool) -> float:
    return SOAK_DEADLINE_S if is_soak else DEADLINE_S


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory, tiny_model_dir: Path, deadline_s: float) -> Iterator[Server]:
    settings = {
        "CAMIND_RECEIVE_DEADLINE_S": str(deadline_s),
        "CAMIND_CALIBRATION_RECEIVE_DEADLINE_S": str(deadline_s),
    }
    data_dir = tmp_path_factory.mktemp("server") / "data"
    with serving(data_dir, "--model", tiny_model_dir, settings=settings) as running:
        assert running.add(CAMERA) == 201
        yield running


class Dripping:
    """Connections that send a byte now and then, and how long each was borne."""

    def __init__(self, server: Server, count: int) -> None:
        self._open = {server.connect(): BEGINNINGS[number % len(BEGINNINGS)] for number in range(count)}
        self.borne_s: list[float] = []
        self._enough = Event()
        self._thread = Thread(target=self._drip)

    def __enter__(self) -> "Dripping":
        self.started_s = time.monotonic()
        for connection, beginning in self._open.items():
            connection.sendall(beginning)
            connection.setblocking(False)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._enough.set()
        self._thread.join()
        for connection in self._open:
            connection.close()

    def wait(self, longest_s: float) -> None:
        """Until all were cut, or so long."""
        self._thread.join(longest_s)

    def _drip(self) -> None:
        while self._open and not self._enough.wait(DRIP_S):
            for connection in [each for each in self._open if not _takes_a_byte(each)]:
                self.borne_s.append(time.monotonic() - self.started_s)
                connection.close()
                del self._open[connection]


def _takes_a_byte(connection: socket.socket) -> bool:
    try:
        while True:
            if not connection.recv(65_536):
                return False
    except BlockingIOError:
        pass
    except OSError:
        return False
    try:
        connection.send(b"1\r\n")
    except OSError:
        return False
    return True


def sent_slowly(server: Server, takes_s: float) -> Reply:
    """The answer to a photograph that comes at twice the least rate, which is 32 kB/s."""
    chunk = bytes(round(2 * 32_000 * DRIP_S))

    def body() -> Iterator[bytes]:
        yield PHOTOGRAPH
        for _ in range(round(takes_s / DRIP_S)):  # what stands behind its end does no harm
            time.sleep(DRIP_S)
            yield chunk

    return server.ask("POST", "/depth?camera=bench", body(), PNG)


@pytest.mark.timeout(300)
def test_who_drips_is_cut_at_the_deadline_while_the_others_go_on(server: Server, deadline_s: float) -> None:
    with ThreadPoolExecutor(1) as beside, Dripping(server, 20) as slow:
        honest = beside.submit(sent_slowly, server, 1.5 * deadline_s)
        answered = 0
        while time.monotonic() - slow.started_s < deadline_s * 0.8:
            assert server.ask("POST", "/depth?camera=bench", PHOTOGRAPH, PNG).status == 200
            assert server.ask("GET", "/cameras/bench").status == 200
            answered += 1
        assert answered >= 3
        slow.wait(deadline_s + SLACK_S)
        assert len(slow.borne_s) == 20
        assert deadline_s * 0.9 < min(slow.borne_s) <= max(slow.borne_s) < deadline_s + SLACK_S
        assert honest.result().status == 200


@pytest.mark.timeout(300)
def test_hundreds_of_idle_connections_keep_nobody_out(server: Server, deadline_s: float) -> None:
    with ExitStack() as stack:
        idle = [stack.enter_context(server.connect()) for _ in range(IDLE)]
        started_s = time.monotonic()
        for _ in range(5):
            assert server.ask("GET", "/health/ready").status == 200
            assert server.ask("POST", "/depth?camera=bench", PHOTOGRAPH, PNG).status == 200
        for connection in idle:
            connection.settimeout(deadline_s + SLACK_S)
            assert connection.recv(1) == b""
        assert time.monotonic() - started_s < deadline_s + SLACK_S + 5


@pytest.mark.timeout(400)
def test_an_answer_that_nobody_takes_is_given_up(server: Server, deadline_s: float) -> None:
    large = {**CAMERA, "name": "large", "image_width_px": 1200, "image_height_px": 900}
    server.add(large)
    body = png(corners(900, 1200))
    head = f"POST /depth?camera=large&format=npz HTTP/1.1\r\nHost: x\r\nContent-Length: {len(body)}\r\n\r\n".encode()
    whole = server.ask("POST", "/depth?camera=large&format=npz", body)
    assert whole.status == 200
    with socket.socket() as connection:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4_096)
        connection.settimeout(30)
        connection.connect(("127.0.0.1", server.port))
        connection.sendall(head + body)
        received = len(connection.recv(1_000))
        time.sleep(2 * deadline_s + SLACK_S)
        try:
            while chunk := connection.recv(1_000_000):
                received += len(chunk)
        except ConnectionResetError:
            pass
    assert received < len(whole.body)
