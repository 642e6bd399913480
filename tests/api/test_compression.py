"""Who takes gzip gets text and JSON in it, and both forms are the same thing."""

import gzip
from typing import Any

import pytest
from starlette.testclient import TestClient

from service.compression import LEAST_BYTES, takes_gzip
from tests.inference.photographs import corners, png

TEXTS = ("/web/depth.js", "/web/style.css", "/static-offline-docs/swagger-ui.css", "/openapi.json", "/metrics")


def raw(client: TestClient, path: str, accepted: str, method: str = "GET", **headers: str) -> tuple[Any, bytes]:
    """The answer, and its bytes as they came."""
    with client.stream(method, path, headers={"Accept-Encoding": accepted, **headers}) as answer:
        return answer, b"".join(answer.iter_raw())


@pytest.fixture
def curve(client: TestClient, phone: dict[str, Any]) -> str:
    client.post("/cameras", json=phone | {"description": "x" * LEAST_BYTES})
    return "/cameras/pixel7-wide/curve"


def test_text_and_json_come_compressed(client: TestClient, curve: str) -> None:
    for path in (*TEXTS, curve):
        plain, whole = raw(client, path, "identity")
        packed, fewer = raw(client, path, "br, gzip")
        assert "content-encoding" not in plain.headers
        assert packed.headers["content-encoding"] == "gzip"
        assert "content-length" not in packed.headers  # which is not known before
        assert plain.headers["vary"] == packed.headers["vary"] == "Accept-Encoding"
        assert plain.headers.get("etag") == packed.headers.get("etag")
        assert len(fewer) < len(whole) / 2
        if path != "/metrics":  # which counts these requests
            assert gzip.decompress(fewer) == whole
        head, nothing = raw(client, path, "gzip", method="HEAD")
        assert (head.headers["content-encoding"], nothing) == ("gzip", b"")


def test_a_file_at_hand_is_told_to_be_still_good(client: TestClient) -> None:
    for path in ("/web/depth.js", "/web/focus.js", "/static-offline-docs/swagger-ui.css"):
        tag = raw(client, path, "gzip")[0].headers["etag"]
        assert tag.startswith('W/"')
        answer, body = raw(client, path, "gzip", **{"If-None-Match": tag})
        assert (answer.status_code, answer.headers["etag"], answer.headers["vary"]) == (304, tag, "Accept-Encoding")
        assert body == b""


def test_a_part_of_a_file_comes_as_it_is(client: TestClient) -> None:
    answer, body = raw(client, "/web/depth.js", "gzip", Range="bytes=0-1999")
    assert (answer.status_code, len(body)) == (206, 2_000)
    assert "content-encoding" not in answer.headers


def test_a_camera_comes_as_it_is_for_if_match_takes_its_tag(
    client: TestClient, curve: str, phone: dict[str, Any]
) -> None:
    path = curve.removesuffix("/curve")
    answer, body = raw(client, path, "gzip")
    assert len(body) > LEAST_BYTES
    assert "content-encoding" not in answer.headers
    assert "no-transform" in answer.headers["cache-control"]
    answer = client.put(path, json=phone | {"gamma_px": 0.7}, headers={"If-Match": answer.headers["etag"]})
    assert (answer.status_code, answer.headers["etag"]) == (200, '"2"')
    assert "no-transform" in answer.headers["cache-control"]


def test_accept_encoding_may_come_in_several_lines(client: TestClient) -> None:
    lines = [("Accept-Encoding", "br"), ("Accept-Encoding", "gzip")]
    assert client.get("/openapi.json", headers=lines).headers["content-encoding"] == "gzip"


def test_pictures_and_small_answers_come_as_they_are(client: TestClient) -> None:
    picture = client.post("/photographs/preview", content=png(corners()), headers={"Accept-Encoding": "gzip"})
    for answer in (picture, client.get("/web/icon.svg"), client.get("/health/live")):
        assert answer.status_code == 200
        assert "content-encoding" not in answer.headers


@pytest.mark.parametrize(
    ("accepted", "expected"),
    [
        ("gzip", True),
        ("deflate, GZIP;q=0.5, br", True),
        ("", False),
        ("br", False),
        ("gzip;q=0", False),
        ("gzip ; q=0.000, br", False),
        ("*;q=0", False),
    ],
)
def test_gzip_is_taken_where_the_client_says_so(accepted: str, expected: bool) -> None:
    assert takes_gzip(accepted) is expected
