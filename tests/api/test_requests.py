"""What may arrive all at once, request ids, and the one log event of a request."""

import gzip
from typing import Any

import pytest
import structlog
from fastapi import FastAPI
from starlette.testclient import TestClient

from service.api.uploads import Arrivals
from service.errors import Busy
from tests.inference.photographs import corners, never_read, png


def test_what_arrives_all_together_is_bounded() -> None:
    arrivals = Arrivals(100)
    with arrivals.counted() as take:
        take(60)
        with arrivals.counted() as take_more:
            take_more(40)
            with pytest.raises(Busy, match="arrive at once"):
                take(1)
        take(40)
        with pytest.raises(Busy):
            take(1)
    with arrivals.counted() as take:
        take(100)


@pytest.mark.parametrize("form", [False, True])
def test_too_much_at_once_is_busy_and_is_forgotten(app: FastAPI, client: TestClient, form: bool) -> None:
    body = png(corners())
    sent: dict[str, Any] = {"files": {"image": ("a.png", body, "image/png")}} if form else {"content": body}
    app.state.arrivals = Arrivals(len(body) // 2)
    for _ in range(2):
        answer = client.post("/photographs/preview", **sent)
        assert answer.status_code == 503
        assert answer.json()["type"] == "urn:camind:problem:busy"
        assert answer.headers["retry-after"] == "1"
    app.state.arrivals = Arrivals(2 * len(body) + 1000)
    for _ in range(3):
        assert client.post("/photographs/preview", **sent).status_code == 200


@pytest.mark.parametrize("path", ["/depth", "/calibrate/look"])
def test_an_unknown_camera_is_told_before_a_photograph_is_received(client: TestClient, path: str) -> None:
    assert client.post(path, params={"camera": "nobody"}, content=never_read()).status_code == 404


@pytest.mark.parametrize("name", ["at", "nothing"])
def test_a_query_of_too_many_parameters_is_not_looked_through(client: TestClient, name: str) -> None:
    answer = client.post(f"/depth?camera=x&{'&'.join([name] * 1200)}", content=png(corners()))
    assert (answer.status_code, answer.json()["detail"].split(":")[0]) == (
        422,
        "A query may have at most 1200 parameters, not 1201",
    )
    assert "errors" not in answer.json()


def test_a_compressed_body_is_refused_by_that_name(client: TestClient) -> None:
    for path, body in (("/cameras", b"{}"), ("/photographs/preview", png(corners()))):
        refused = client.post(path, content=gzip.compress(body), headers={"Content-Encoding": "gzip"})
        assert (refused.status_code, refused.json()["type"]) == (415, "urn:camind:problem:unsupported-kind")
        assert "Content-Encoding: gzip" in refused.json()["detail"]
    plain = client.post("/photographs/preview", content=png(corners()), headers={"Content-Encoding": "Identity"})
    assert plain.status_code == 200


@pytest.mark.parametrize("path", ["/docs", "/cameras", "/no-such-thing", "/calibrate/target.svg", "/web/icon.svg", "/"])
def test_no_answer_is_framed_or_taken_for_another_kind(client: TestClient, path: str) -> None:
    headers = client.get(path).headers
    assert "frame-ancestors 'none'" in headers["content-security-policy"]
    assert headers["x-content-type-options"] == "nosniff"


@pytest.mark.parametrize("given", ["abc", "0f8b-4.2_1:x", "a" * 128])
def test_a_sane_request_id_is_kept(client: TestClient, given: str) -> None:
    assert client.get("/health/live", headers={"X-Request-Id": given}).headers["x-request-id"] == given


@pytest.mark.parametrize("given", ["", "a b", "a\tb", "x" * 129, "<script>"])
def test_any_other_request_id_is_replaced(client: TestClient, given: str) -> None:
    made = client.get("/nothing", headers={"X-Request-Id": given}).headers["x-request-id"]
    assert made != given
    assert len(made) == 32


def test_requests_have_ids_of_their_own(client: TestClient) -> None:
    made = {client.get("/health/live").headers["x-request-id"] for _ in range(3)}
    assert len(made) == 3


def test_a_request_is_one_event(client: TestClient, phone: dict[str, Any]) -> None:
    client.post("/cameras", json=phone)
    with structlog.testing.capture_logs(processors=[structlog.contextvars.merge_contextvars]) as events:
        client.get("/cameras/pixel7-wide", headers={"X-Request-Id": "abc"})
        client.head("/cameras/pixel7-wide/curve")
        client.get("/nothing")
        client.post("/depth?camera=pixel7-wide", content=b"x", headers={"Content-Type": "text/plain"})
    assert [(event["method"], event["path"], event["status"]) for event in events] == [
        ("GET", "/cameras/{name}", 200),
        ("HEAD", "/cameras/{name}/curve", 200),
        ("GET", None, 404),
        ("POST", "/depth", 415),
    ]
    assert [event.get("camera") for event in events] == ["pixel7-wide", "pixel7-wide", None, "pixel7-wide"]
    assert [event.get("problem") for event in events] == [None, None, "not-found", "unsupported-kind"]
    assert events[0]["request_id"] == "abc"
    assert events[0]["duration_ms"] > 0


@pytest.mark.parametrize("path", ["/cameras/", "/depth?camera="])
def test_what_a_camera_is_called_makes_no_event_long(client: TestClient, path: str) -> None:
    with structlog.testing.capture_logs() as events:
        client.get(path + "x" * 5_000)
    assert len(str(events)) < 500
