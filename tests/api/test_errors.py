"""Every error, whatever its source, is problem+json with a request id, and echoes nothing it should not."""

import json
from collections.abc import Iterator
from typing import Any

import pytest
import structlog
from fastapi import FastAPI
from sqlalchemy import Engine
from starlette.testclient import TestClient

from service.api.problems import invalid_request
from service.config import Settings

JSON = {"Content-Type": "application/json"}


def require_problem(answer: Any, status: int, kind: str) -> dict[str, Any]:
    assert answer.status_code == status
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.headers["x-request-id"]
    assert answer.headers["cache-control"] == "no-store"
    body: dict[str, Any] = answer.json()
    assert body["status"] == status
    assert body["type"] == f"urn:camind:problem:{kind}"
    assert body["title"]
    assert body["detail"]
    return body


@pytest.mark.parametrize("path", ["/nothing", "/cameras/", "/cameras/a/b/c", "/health", "/depth/x"])
def test_an_unknown_path_is_not_found(client: TestClient, path: str) -> None:
    require_problem(client.get(path), 404, "not-found")


@pytest.mark.parametrize(
    ("method", "path", "allow"),
    [
        ("PATCH", "/cameras", {"GET", "HEAD", "POST", "OPTIONS"}),
        ("DELETE", "/cameras", {"GET", "HEAD", "POST", "OPTIONS"}),
        ("POST", "/cameras/x", {"GET", "HEAD", "PUT", "DELETE", "OPTIONS"}),
        ("GET", "/depth", {"POST", "OPTIONS"}),
        ("HEAD", "/depth", {"POST", "OPTIONS"}),
        ("POST", "/health/live", {"GET", "HEAD", "OPTIONS"}),
        ("BREW", "/model", {"GET", "HEAD", "OPTIONS"}),
    ],
)
def test_another_method_says_which_are_allowed(client: TestClient, method: str, path: str, allow: set[str]) -> None:
    answer = client.request(method, path)
    assert set(answer.headers["allow"].split(", ")) == allow
    assert answer.status_code == 405
    if method != "HEAD":
        require_problem(answer, 405, "method-not-allowed")


def test_options_lists_the_methods(client: TestClient) -> None:
    answer = client.options("/cameras/x")
    assert (answer.status_code, answer.content) == (204, b"")
    assert answer.headers["allow"] == "GET, HEAD, PUT, DELETE, OPTIONS"
    require_problem(client.options("/nothing"), 404, "not-found")


@pytest.mark.parametrize("path", ["/", "/docs", "/openapi.json", "/cameras", "/model", "/metrics", "/health/live"])
def test_head_is_get_without_the_body(client: TestClient, path: str) -> None:
    head, get = client.head(path), client.get(path)
    assert (head.status_code, head.content) == (200, b"")
    assert head.headers["content-type"] == get.headers["content-type"]


@pytest.mark.parametrize(
    "content",
    [
        b"{",
        b"",
        b"nul",
        b'{"name": "\xff"}',
        b"[" * 9_000,
        b'{"a": ' + b"9" * 6_000 + b"}",
        b"\x00",
        b"null",
        b"[]",
        b"7",
    ],
)
def test_what_is_no_camera_is_refused(client: TestClient, content: bytes) -> None:
    body = require_problem(client.post("/cameras", content=content, headers=JSON), 422, "invalid-request")
    assert all(fault["pointer"].startswith("#") for fault in body.get("errors", []))


@pytest.mark.parametrize(
    ("content", "detail"),
    [
        (b"", "body: this is required"),
        (b"[]", "body: this must be a JSON object"),
        (b"{", "body: this is not valid JSON: Expecting property name enclosed in double quotes at character 1"),
    ],
)
def test_what_is_wrong_with_the_whole_body_is_told_of_the_body(client: TestClient, content: bytes, detail: str) -> None:
    body = require_problem(
        client.post("/cameras", content=content, headers=JSON if content else {}), 422, "invalid-request"
    )
    assert body["detail"] == detail


@pytest.mark.parametrize(
    "kind", ["text/plain", "image/jpeg", "multipart/form-data; boundary=x", "json", "text/json", "text/x+json", None]
)
def test_another_content_type_is_unsupported_and_so_is_none(
    client: TestClient, phone: dict[str, Any], kind: str | None
) -> None:
    answer = client.post("/cameras", content=json.dumps(phone), headers={"Content-Type": kind} if kind else {})
    require_problem(answer, 415, "unsupported-kind")


@pytest.mark.parametrize("kind", ["application/json; charset=utf-8", "application/vnd.camera+json", "APPLICATION/JSON"])
def test_json_may_say_more_of_itself(client: TestClient, phone: dict[str, Any], kind: str) -> None:
    answer = client.post("/cameras", content=json.dumps(phone), headers={"Content-Type": kind})
    assert answer.status_code == 201


def test_too_many_bytes_are_refused_by_their_stated_length(client: TestClient, settings: Settings) -> None:
    content = b" " * (settings.max_json_bytes + 1)
    body = require_problem(client.post("/cameras", content=content, headers=JSON), 413, "too-large")
    require_problem(client.post("/cameras", content=content[1:], headers=JSON), 422, "invalid-request")
    assert str(settings.max_json_bytes) in body["detail"]


def test_too_many_bytes_are_refused_while_they_come(client: TestClient) -> None:
    def endless() -> Iterator[bytes]:
        for _ in range(100):
            yield b" " * 1_000

    answer = client.post("/cameras", content=endless(), headers=JSON)
    assert "content-length" not in answer.request.headers
    require_problem(answer, 413, "too-large")


def test_an_image_may_be_larger_than_json(client: TestClient, settings: Settings) -> None:
    headers = {"Content-Type": "image/jpeg"}
    small = client.post("/depth?camera=x", content=b"\xff" * (settings.max_json_bytes + 1), headers=headers)
    assert small.status_code != 413
    large = client.post("/depth?camera=x", content=b"\xff" * (settings.max_image_bytes + 1), headers=headers)
    require_problem(large, 413, "too-large")


def test_nothing_sent_is_echoed(client: TestClient, phone: dict[str, Any]) -> None:
    typed = "correct-horse-battery"
    answer = client.post("/cameras", json={**phone, "k_cam_px": typed, "name": f"{typed} "})
    assert typed not in answer.text


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"name": "no name"}, "a name has up to 64 letters, digits, dots, dashes and underscores"),
        ({"name": 7}, "this must be a string"),
        ({"k_cam_px": "7"}, "this must be a number"),
        ({"image_width_px": 7.5}, "this must be a whole number"),
        ({"description": "\x00"}, "no control characters"),
        ({"description": "x" * 1001}, "at most 1000 characters"),
        ({"lens": []}, "this must be a JSON object"),
        ({"colour": "black"}, "no such field"),
    ],
)
def test_a_fault_is_told_in_words_and_not_by_a_pattern(
    client: TestClient, phone: dict[str, Any], changes: dict[str, Any], words: str
) -> None:
    (fault,) = require_problem(client.post("/cameras", json={**phone, **changes}), 422, "invalid-request")["errors"]
    assert fault["pointer"] == f"#/{next(iter(changes))}"
    assert words in fault["detail"]
    assert "error" not in fault["detail"]


def test_headers_and_parameters_are_told_of_in_words_too(client: TestClient, phone: dict[str, Any]) -> None:
    spaced = client.post("/cameras", json=phone, headers={"Idempotency-Key": "a b"})
    assert "no spaces" in require_problem(spaced, 422, "invalid-request")["detail"]
    long = client.post("/cameras", json=phone, headers={"Idempotency-Key": "a" * 256})
    assert "at most 255 characters" in require_problem(long, 422, "invalid-request")["detail"]
    named = client.post("/calibrate", params={"camera": "-"})
    assert "a name has up to 64 letters" in require_problem(named, 422, "invalid-request")["detail"]
    assert "whole number" in require_problem(client.get("/cameras?limit=x"), 422, "invalid-request")["detail"]


@pytest.mark.parametrize(
    ("method", "path", "query", "name", "words"),
    [
        ("GET", "/cameras", "limits=2", "limits", "no such parameter"),
        ("GET", "/cameras", "limit=1&limit=2", "limit", "once"),
        ("GET", "/cameras/x", "points=2", "points", "no such"),
        ("GET", "/cameras/x/curve", "near=1", "near", "no such"),
        ("GET", "/cameras/x/curve", "name=x", "name", "no such"),
        ("GET", "/cameras/x/curve", "near_m=1&near_m=2", "near_m", "once"),
        ("GET", "/calibrations", "page=2", "page", "no such"),
        ("GET", "/calibrate/target.svg", "row=3", "row", "no such"),
        ("GET", "/calibrate/target.pdf", "rows=3&rows=4", "rows", "once"),
        ("POST", "/calibrate/look", "roi=1", "roi", "no such"),
        ("POST", "/photographs/preview", "longest_px=99&longest_px=98", "longest_px", "once"),
        ("POST", "/depth", "camera=a&camera=b", "camera", "once"),
        ("POST", "/depth", "camera=a&focus_distance_m=1&focus_distance_m=2", "focus_distance_m", "once"),
        ("POST", "/depth", "camera=a&query=1", "query", "no such"),
        ("DELETE", "/cameras/x", "if-match=1", "if-match", "no such"),
    ],
)
def test_a_parameter_that_is_unknown_or_sent_twice_is_named(
    client: TestClient, method: str, path: str, query: str, name: str, words: str
) -> None:
    body = require_problem(client.request(method, f"{path}?{query}"), 422, "invalid-request")
    (fault,) = body["errors"]
    assert fault["pointer"] == name
    assert words in fault["detail"]


def test_a_page_s_address_may_have_any_query(client: TestClient) -> None:
    for path in ("/", "/health/live", "/model", "/web/app.js"):
        assert client.get(f"{path}?from=mail&from=mail").status_code == 200


def test_a_field_s_name_is_told_in_short_and_commands_no_terminal(client: TestClient, phone: dict[str, Any]) -> None:
    answer = client.post("/cameras", json={**phone, f"\x1b[2J{'x' * 9_000}": 1})
    (fault,) = require_problem(answer, 422, "invalid-request")["errors"]
    assert fault["pointer"].startswith("#/?[2Jxxx")
    assert len(fault["pointer"]) < 250


def test_a_lone_surrogate_breaks_nothing(client: TestClient) -> None:
    answer = client.post("/cameras", content=b'{"\\ud800": 1, "name": "\\udfff"}', headers=JSON)
    require_problem(answer, 422, "invalid-request")


def test_many_faults_are_cut_short(client: TestClient) -> None:
    answer = client.post("/cameras", json={f"field{number}": 1 for number in range(500)})
    assert 1 < len(require_problem(answer, 422, "invalid-request")["errors"]) <= 50
    faults = [{"type": "missing", "loc": ("body", str(number)), "msg": ""} for number in range(500)]
    assert len(invalid_request(faults).errors) == 50  # no more of them are put into words


def test_a_failure_inside_tells_the_log_and_not_the_client(app: FastAPI) -> None:
    def fail() -> None:
        raise RuntimeError("the password is 1234")

    app.add_api_route("/fail", fail)
    with TestClient(app, raise_server_exceptions=False) as client, structlog.testing.capture_logs() as events:
        answer = client.get("/fail", headers={"X-Request-Id": "abc"})
    body = require_problem(answer, 500, "internal-error")
    assert "1234" not in answer.text
    assert "Traceback" not in str(body)
    assert answer.headers["x-request-id"] == "abc"
    failures = [event for event in events if event["event"] == "request_failed"]
    assert len(failures) == 1
    assert failures[0]["exc_info"]


def test_a_database_that_is_gone_is_unavailable(client: TestClient, app: FastAPI, phone: dict[str, Any]) -> None:
    engine: Engine = app.state.engine
    with engine.begin() as connection:
        connection.exec_driver_sql("DROP TABLE camera_revisions")
    require_problem(client.get("/cameras"), 503, "not-ready")
    require_problem(client.post("/cameras", json=phone), 503, "not-ready")


def test_a_busy_database_says_when_to_come_back(
    client: TestClient, app: FastAPI, phone: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    engine: Engine = app.state.engine
    monkeypatch.setattr("service.storage.engine.BUSY_TIMEOUT_MS", 50)
    engine.dispose()
    with engine.connect() as connection:
        connection.exec_driver_sql("COMMIT")
        connection.exec_driver_sql("BEGIN EXCLUSIVE")
        with structlog.testing.capture_logs([structlog.contextvars.merge_contextvars]) as events:
            answer = client.post("/cameras", json=phone)
        connection.exec_driver_sql("ROLLBACK")
    require_problem(answer, 503, "busy")
    assert int(answer.headers["retry-after"]) >= 1
    (told,) = [event for event in events if event["event"] == "unavailable"]
    assert "database is locked" in told["cause"]
    assert told["request_id"] == answer.headers["x-request-id"]
