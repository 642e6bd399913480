"""The real process: no client can hold or confuse it."""

import http.client
import json
import resource
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import h11
import pytest

from model_export.started_server import Server, serving
from service.server import MOST_CRUMBS, Connection

RECEIVE_DEADLINE_S = 1.0


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory, tiny_model_dir: Path) -> Iterator[Server]:
    settings = {"CAMIND_RECEIVE_DEADLINE_S": str(RECEIVE_DEADLINE_S), "CAMIND_MAX_IMAGE_BYTES": "200000"}
    with serving(tmp_path_factory.mktemp("server") / "data", "--model", tiny_model_dir, settings=settings) as running:
        yield running


def read_to_end(connection: socket.socket) -> tuple[int, dict[str, str], bytes]:
    """The last answer before the server closes the connection."""
    raw = b""
    while chunk := connection.recv(65536):
        raw += chunk
    head, _, body = raw.rpartition(b"HTTP/1.1 ")[2].partition(b"\r\n\r\n")
    status, *lines = head.decode().split("\r\n")
    return int(status.split()[0]), dict(line.lower().split(": ", 1) for line in lines), body


def test_headers_that_never_end_are_cut_off(server: Server) -> None:
    with server.connect() as connection:
        started = time.monotonic()
        connection.sendall(b"GET /cameras HTTP/1.1\r\nHost: x\r\n")
        status, headers, body = read_to_end(connection)
    assert status == 408
    assert headers["content-type"] == "application/problem+json"
    assert headers["x-request-id"]
    assert json.loads(body)["type"] == "urn:camind:problem:receive-timeout"
    assert time.monotonic() - started < RECEIVE_DEADLINE_S + 3


def test_a_silent_connection_is_closed(server: Server) -> None:
    with server.connect() as connection:
        assert connection.recv(1) == b""


@pytest.mark.parametrize("path", ["/cameras", "/depth?camera=x", "/nothing"])
def test_a_body_that_never_ends_is_cut_off(server: Server, path: str) -> None:
    head = f"POST {path} HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\nContent-Length: 9999\r\n\r\n"
    with server.connect() as connection:
        started = time.monotonic()
        connection.sendall(head.encode() + b"{")
        status, headers, _ = read_to_end(connection)
    assert status in ((404, 408, 415) if path != "/cameras" else (408,))
    assert headers["content-type"] == "application/problem+json"
    assert headers["x-request-id"]
    assert time.monotonic() - started < 2 * RECEIVE_DEADLINE_S + 4


@pytest.mark.parametrize(
    "raw", [b"NONSENSE\r\n\r\n", b"GET / HTTP/1.1\r\n\r\n", b"GET / HTTP/1.1\r\nHost: x\r\nA\x00: b\r\n\r\n"]
)
def test_what_is_no_http_gets_a_problem(server: Server, raw: bytes) -> None:
    with server.connect() as connection:
        connection.sendall(raw)
        status, headers, body = read_to_end(connection)
    assert status == 400
    assert headers["content-type"] == "application/problem+json"
    assert json.loads(body)["status"] == 400


def events_of(server: Server, request_id: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in server.log.splitlines() if request_id in line]


def test_what_is_no_http_is_in_the_log_under_its_id(server: Server) -> None:
    with server.connect() as connection:
        connection.sendall(b"NONSENSE\r\n\r\n")
        _, headers, _ = read_to_end(connection)
    (event,) = server.poll(lambda: events_of(server, headers["x-request-id"]))
    assert (event["event"], event["status"], event["problem"]) == ("refused", 400, "malformed-request")


@pytest.mark.parametrize(("method", "pause_s"), [("POST", 0.1), ("POST", 0), ("HEAD", 0)])
def test_a_body_that_is_no_http_gets_a_problem(server: Server, method: str, pause_s: float) -> None:
    request_id = f"bad-chunk-{method.lower()}-{pause_s}"
    head = f"{method} /cameras HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\nX-Request-Id: {request_id}"
    pieces = [head.encode() + b"\r\nTransfer-Encoding: chunked\r\n\r\n", b"zz\r\n{}\r\n"]
    with server.connect() as connection:
        for piece in pieces if pause_s else [b"".join(pieces)]:
            connection.sendall(piece)
            time.sleep(pause_s)
        status, headers, body = read_to_end(connection)
    assert (status, headers["x-request-id"], bool(body)) == (400, request_id, method != "HEAD")
    events = server.poll(lambda: events_of(server, request_id))
    assert events[0]["event"] == "refused"
    assert "Traceback" not in server.log


@pytest.mark.parametrize(("size", "expected"), [(1, 400), (64, 400), (256, 413)])
def test_a_body_in_crumbs_is_refused(server: Server, size: int, expected: int) -> None:
    head = b"POST /photographs/preview HTTP/1.1\r\nHost: x\r\nConnection: close\r\nTransfer-Encoding: chunked\r\n\r\n"
    chunk = b"%x\r\n" % size + b"x" * size + b"\r\n"
    with server.connect() as connection:
        connection.sendall(head + 2_500 * chunk + b"0\r\n\r\n")
        status, _, body = read_to_end(connection)
    assert status == expected
    assert (b"chunks of less than 256 bytes" in body) == (status == 400)


def test_small_bodies_one_after_another_are_no_crumbs() -> None:
    connection = Connection(h11.SERVER)
    head = b"POST /cameras HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n"
    for _ in range(MOST_CRUMBS + 1):
        connection.receive_data(head + b"2\r\n{}\r\n0\r\n\r\n")
        events = [connection.next_event() for _ in range(3)]
        assert [type(event) for event in events] == [h11.Request, h11.Data, h11.EndOfMessage]
        connection.send(h11.Response(status_code=204, headers=[]))
        connection.send(h11.EndOfMessage())
        connection.start_next_cycle()


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("GET http://127.0.0.1/health/live", 200),
        ("GET HTTP://localhost:8000/cameras?limit=1", 200),
        ("GET http://[::1]:8000", 200),
        ("GET https://127.0.0.1?no=thing", 200),
        ("GET http://stranger.example/cameras", 421),
        ("GET http://stranger.example@127.0.0.1/cameras", 421),
        ("OPTIONS *", 204),
        ("GET *", 404),
    ],
)
def test_a_target_may_name_the_host_which_counts(server: Server, line: str, expected: int) -> None:
    host = "stranger.example" if expected == 200 else "localhost"
    with server.connect() as connection:
        connection.sendall(f"{line} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n".encode())
        assert read_to_end(connection)[0] == expected


def test_a_body_that_is_too_large_is_answered_though_it_was_sent_whole(server: Server) -> None:
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)
    connection.request("POST", "/depth?camera=x", b"\xff" * 20_000_000, {"Content-Type": "image/jpeg"})
    answer = connection.getresponse()
    assert (answer.status, json.loads(answer.read())["status"]) == (413, 413)
    # the rest was thrown away, and the connection goes on
    connection.request("GET", "/health/live")
    assert connection.getresponse().status == 200
    connection.close()


@pytest.mark.parametrize("version", ["1.0", "1.1"])
def test_an_answer_comes_through_before_its_connection_is_closed(server: Server, version: str) -> None:
    head = f"POST /photographs/preview HTTP/{version}\r\nHost: x\r\nConnection: close\r\nContent-Type: text/plain\r\n"
    with server.connect() as connection:
        connection.sendall(f"{head}Content-Length: 150000\r\n\r\n".encode())
        for _ in range(15):
            time.sleep(0.02)
            connection.sendall(b" " * 10_000)
        assert read_to_end(connection)[0] == 415


BOTH_LENGTHS = b"Content-Length: 2\r\nTransfer-Encoding: chunked\r\n\r\n2\r\n{}\r\n0\r\n\r\n"


@pytest.mark.parametrize("rest", [b"Expect: 100-continue\r\nContent-Length: 9\r\n\r\n", BOTH_LENGTHS])
def test_a_connection_ends_where_a_body_could_be_taken_for_a_request(server: Server, rest: bytes) -> None:
    with server.connect() as connection:
        connection.sendall(b"POST /photographs/preview HTTP/1.1\r\nHost: x\r\nContent-Type: text/plain\r\n" + rest)
        status, headers, _ = read_to_end(connection)
    assert (status, headers["connection"]) == (415, "close")


def test_a_client_that_waits_to_send_its_body_is_told_to(server: Server) -> None:
    head = b"POST /cameras HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\nExpect: 100-continue\r\n"
    with server.connect() as connection:
        connection.sendall(head + b"Content-Length: 2\r\n\r\n")
        assert connection.recv(100).startswith(b"HTTP/1.1 100 ")
        connection.sendall(b"{}GET /health/live HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n")
        assert read_to_end(connection)[0] == 200


def test_a_body_that_grows_too_large_is_refused_while_it_comes(server: Server) -> None:
    chunks = (b" " * 10_000 for _ in range(100))
    headers = {"Content-Type": "application/json"}
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)
    connection.request("POST", "/cameras", chunks, headers)
    assert connection.getresponse().status == 413
    connection.close()


def test_more_connections_than_files_are_closed_and_others_answered(server: Server) -> None:
    def answers() -> bool:
        try:
            return server.ask("GET", "/health/live").status == 200
        except ConnectionError:
            return False  # it has yet to see that the others have left

    limits = resource.prlimit(server.process.pid, resource.RLIMIT_NOFILE)
    resource.prlimit(server.process.pid, resource.RLIMIT_NOFILE, (500, limits[1]))
    try:
        with ExitStack() as held:
            first = held.enter_context(server.connect())
            for _ in range(600):
                held.enter_context(server.connect())
            first.sendall(b"GET /cameras HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n")
            assert read_to_end(first)[0] == 200
        server.poll(answers)
    finally:
        resource.prlimit(server.process.pid, resource.RLIMIT_NOFILE, limits)
    assert "out of system resource" not in server.log


def test_answers_do_not_wait_for_acknowledgements(server: Server) -> None:
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)
    durations_s = []
    for _ in range(20):
        started = time.monotonic()
        connection.request("GET", "/health/live")
        connection.getresponse().read()
        durations_s.append(time.monotonic() - started)
    connection.close()
    assert min(durations_s) < 0.03


def test_the_log_has_one_json_event_a_request(server: Server) -> None:
    server.ask("GET", "/cameras/nobody", headers={"X-Request-Id": "find-me"})

    def find() -> list[dict[str, Any]]:
        return [json.loads(line) for line in server.log.splitlines() if "find-me" in line]

    # the event is written when the answer has left
    events = server.poll(find)
    assert len(events) == 1
    assert events[0]["path"] == "/cameras/{name}"
    assert (events[0]["status"], events[0]["camera"], events[0]["level"]) == (404, "nobody", "info")


def test_who_leaves_while_sending_is_no_fault_of_ours(server: Server) -> None:
    with server.connect() as client:
        head = "POST /photographs/preview HTTP/1.1\r\nHost: x\r\nX-Request-Id: leaver\r\nContent-Type: image/jpeg\r\n"
        client.sendall(f"{head}Content-Length: 1000\r\n\r\nhalf".encode())
        time.sleep(0.2)
    events = server.poll(lambda: [json.loads(line) for line in server.log.splitlines() if "leaver" in line])
    assert [(event["event"], event["status"], event["level"]) for event in events] == [("request", 499, "info")]
