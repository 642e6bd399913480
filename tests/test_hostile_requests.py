"""Requests that mean harm, against the real process: each is refused as a problem, and the service goes on."""

import json
import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from model_export.started_server import Reply, Server, serving
from service.opencv import cv2
from tests.fake_calibration import SETTINGS
from tests.inference.photographs import corners, hostile_png, jpeg, png

CAMERA: dict[str, Any] = {
    "name": "bench",
    "image_width_px": 64,
    "image_height_px": 48,
    "focus_distance_m": 2.0,
    "k_cam_px": 6.0,
    "intrinsics": {"fx_px": 100.0, "fy_px": 100.0, "cx_px": 32.0, "cy_px": 24.0},
}
JSON = {"Content-Type": "application/json"}
PNG = {"Content-Type": "image/png"}
FORM = {"Content-Type": "multipart/form-data; boundary=x"}
IMAGE_LIMITS = {"CAMIND_MAX_IMAGE_BYTES": "1000000", "CAMIND_MAX_CALIBRATION_IMAGES": "4"}


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory, tiny_model_dir: Path) -> Iterator[Server]:
    data_dir = tmp_path_factory.mktemp("server") / "data"
    settings = {"CAMIND_WORKERS": "1", "CAMIND_LOG_LEVEL": "debug", **IMAGE_LIMITS}
    with serving(data_dir, "--model", tiny_model_dir, settings=settings) as running:
        assert running.add(CAMERA) == 201
        yield running
        assert running.ask("GET", "/health/ready").status == 200
        assert "Traceback" not in running.log


def refused(reply: Reply, *statuses: int) -> None:
    assert reply.status in statuses, reply.body[:500]
    assert reply.headers["content-type"] == "application/problem+json"
    assert reply.json()["status"] == reply.status


def part(head: str, content: bytes = b"x") -> bytes:
    return b"--x\r\n" + head.encode("latin-1") + b"\r\n\r\n" + content + b"\r\n"


def named(name: str, filename: str | None = None, more: str = "") -> str:
    return f'Content-Disposition: form-data; name="{name}"' + (f'; filename="{filename}"' if filename else "") + more


NESTED = {
    "arrays": b"[" * 30_000,
    "closed arrays": b"[" * 30_000 + b"]" * 30_000,
    "objects": b'{"lens":' * 7_000 + b"1" + b"}" * 7_000,
    "an array in a field": b'{"name": "a", "intrinsics": {"distortion": ' + b"[" * 20_000 + b"]" * 20_000 + b"}}",
    "an unknown field": b'{"x": ' + b"[" * 900 + b"]" * 900 + b"}",
    "a long number": b'{"k_cam_px": ' + b"9" * 60_000 + b"}",
    "a huge exponent": b'{"k_cam_px": 1e999999999}',
}


@pytest.mark.parametrize("body", NESTED.values(), ids=NESTED)
def test_json_of_any_depth_is_refused(server: Server, body: bytes) -> None:
    refused(server.ask("POST", "/cameras", body, JSON), 422)
    refused(server.ask("PUT", "/cameras/bench", body, JSON), 422)
    form = part(named("settings"), body) + part(named("defocused", "a.png"), png(corners())) + b"--x--\r\n"
    refused(server.ask("POST", "/calibrate?camera=bench", form, FORM), 422)


PICTURE = png(corners())
FORMS = {
    "a long header": part(named("image", "a", f"\r\nX-Long: {'x' * 5_000}")),
    "a long name of a header": part(named("image", "a", f"\r\n{'x' * 5_000}: 1")),
    "many headers": part(named("image", "a", "\r\nX-More: 1" * 20)),
    "a header without end": b"--x\r\nContent-Disposition: " + b"x" * 500_000,
    "many fields": part(named("image")) * 2_000,
    "many files": part(named("image", "a")) * 2_000,
    "many empty files": part(named("image", "a"), b"") * 2_000,
    "a field of a megabyte": part(named("image"), b"x" * 990_000),
}


@pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
def test_forms_are_limited(server: Server, form: bytes) -> None:
    refused(server.ask("POST", "/depth?camera=bench", form + b"--x--\r\n", FORM), 422)
    as_calibration = form.replace(b'name="image"', b'name="defocused"') + b"--x--\r\n"
    refused(server.ask("POST", "/calibrate?camera=bench", as_calibration, FORM), 413, 422)


def test_parts_that_nobody_filled_are_limited(server: Server) -> None:
    settings = part(named("settings"), json.dumps(SETTINGS).encode())
    unfilled = part('Content-Disposition: form-data; name="focused"; filename=""', b"")
    photograph = part(named("defocused", "a.png"), PICTURE)
    few, many = (settings + unfilled * number + photograph + b"--x--\r\n" for number in (5, 5_000))
    assert server.ask("POST", "/calibrate?camera=bench", few, FORM).status == 202
    refused(server.ask("POST", "/calibrate?camera=bench", many, FORM), 413)


@pytest.mark.parametrize("charset", ["undefined", "idna", "zip", "utf-7", "x\x00", "nobody-knows"])
def test_no_charset_of_a_form_breaks_it(server: Server, charset: str) -> None:
    body = part(named("im\xe4ge", "\xff")) + b"--x--\r\n"
    if "\x00" not in charset:
        headers = {"Content-Type": f"multipart/form-data; boundary=x; charset={charset}"}
        refused(server.ask("POST", "/depth?camera=bench", body, headers), 415, 422)
    headers = {"Content-Type": f'multipart/form-data; boundary=x; charset="{charset}"'.replace("\x00", "\\0")}
    refused(server.ask("POST", "/depth?camera=bench", body, headers), 415, 422)


@pytest.mark.parametrize("head", [b"GET /" + b"a" * 300_000, b"GET / HTTP/1.1\r\nA: " + b"b" * 300_000])
def test_headers_without_end_are_refused_by_size(server: Server, head: bytes) -> None:
    with server.connect() as connection:
        connection.sendall(head)
        raw = b""
        while chunk := connection.recv(65_536):
            raw += chunk
    status_line, _, rest = raw.partition(b"\r\n")
    assert status_line.split()[1] == b"431"
    assert b"application/problem+json" in rest
    assert json.loads(rest.partition(b"\r\n\r\n")[2])["type"] == "urn:camind:problem:headers-too-large"


def test_a_long_thin_picture_is_refused_from_its_header(server: Server) -> None:
    refused(server.ask("POST", "/depth?camera=bench", png(corners(2, 21)), PNG), 413)


def test_a_huge_picture_in_a_small_file_costs_no_memory(server: Server) -> None:
    body = hostile_png(25_600, bits=8)
    assert len(body) < 1_000_000
    refused(server.ask("POST", "/depth?camera=bench", png(corners(2, 21)) + bytes(len(body)), PNG), 413)
    before = server.peak_memory_bytes
    for _ in range(3):
        refused(server.ask("POST", "/depth?camera=bench", body, PNG), 413)
    assert server.peak_memory_bytes - before < 10_000_000


GPS_WORDS = (b"CAMIND-MEADOW", b"1999:12:31")
GPS_DEGREES = struct.pack("<6I", 47, 1, 33, 1, 271_828, 31_415)


def with_position(data: bytes) -> bytes:
    """The JPEG with a GPS directory in its EXIF: where it was taken, in numbers and in words, and on which day."""
    area, day = (word + b"\0" for word in GPS_WORDS)
    first = struct.pack("<HHHII", 1, 0x8825, 4, 1, 26) + bytes(4)
    values = 26 + 2 + 12 * 5 + 4
    directory = struct.pack("<HHHI", 5, 1, 2, 2) + b"N\0\0\0"
    for tag, kind, count, place in (
        (2, 5, 3, values),
        (4, 5, 3, values),
        (28, 2, len(area), values + 24),
        (29, 2, len(day), values + 24 + len(area)),
    ):
        directory += struct.pack("<HHII", tag, kind, count, place)
    exif = b"Exif\0\0II*\0" + struct.pack("<I", 8) + first + directory + bytes(4) + GPS_DEGREES + area + day
    return data[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + data[2:]


def test_where_a_photograph_was_taken_stays_unsaid(server: Server) -> None:
    picture = with_position(jpeg(corners()))
    assert all(secret in picture for secret in (*GPS_WORDS, GPS_DEGREES))
    assert cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR) is not None
    headers = {"Content-Type": "image/jpeg"}
    replies = [
        server.ask("POST", f"/depth?camera=bench&format={name}", picture, headers)
        for name in ("png", "npy", "npz", "tiff", "ply", "preview", "json")
    ]
    assert {reply.status for reply in replies} == {200}
    replies.append(server.ask("POST", "/depth?camera=bench", picture[:-50], headers))
    replies.append(server.ask("POST", "/depth?camera=bench", with_position(jpeg(corners(48, 48))), headers))
    replies.append(server.ask("POST", "/depth?camera=nobody", picture, headers))
    assert [reply.status for reply in replies[-3:]] == [422, 422, 404]
    form = part(named("settings"), json.dumps(SETTINGS).encode()) + part(named("defocused", "a.jpg"), picture)
    queued = server.ask("POST", "/calibrate?camera=bench", form + b"--x--\r\n", {**FORM, "Prefer": "wait=30"})
    assert queued.json()["state"] == "failed"
    replies += [queued, server.ask("GET", "/metrics")]
    said = server.log.encode() + b"".join(json.dumps(reply.headers).encode() + reply.body for reply in replies)
    assert not any(secret in said for secret in (*GPS_WORDS, GPS_DEGREES, GPS_DEGREES[-8:], b"GPS"))
    assert not re.search(rb"(?<![\d.])8\.652", said)  # the end of another number is no longitude
