"""``POST /cameras/from-photo``: a draft that can be completed and sent back, and nothing kept of the photograph."""

import pytest
from starlette.testclient import TestClient

from service.optics.camera import Lens
from tests.inference.photographs import ExifTags, corners, exif_of, jpeg, webp, with_exif

MAIN: ExifTags = {271: "NIKON CORPORATION", 272: "NIKON D200"}
SHOT: ExifTags = {0x829D: (28, 10), 0x920A: (35, 1), 0xA002: 3872, 0xA405: 52}
PLACE: ExifTags = {1: "N", 0x1D: "2026:11:21"}
PHOTOGRAPH = with_exif(jpeg(corners(432, 645)), exif_of(MAIN, SHOT, PLACE))
PATH = "/cameras/from-photo"


def test_a_draft_completed_is_a_camera(client: TestClient) -> None:
    answer = client.post(PATH, content=PHOTOGRAPH, headers={"Content-Type": "image/jpeg"})
    assert answer.status_code == 200
    draft = answer.json()
    assert draft["focus_distance_m"] is None
    assert draft["lens"]["focal_length_mm"] == 35.0
    assert "2026" not in answer.text
    assert client.get("/cameras").json()["items"] == []
    warnings = draft.pop("warnings")
    assert any("focus_distance_m" in warning for warning in warnings)
    made = client.post("/cameras", json=draft | {"focus_distance_m": 2.0})
    assert made.status_code == 201, made.text
    known = Lens(focal_length_mm=35, f_number=2.8, pixel_pitch_um=6.05, sensor_width_px=3872)
    assert made.json()["k_cam_px"] == pytest.approx(known.k_cam_px(2.0, 645), rel=0.01)


def test_a_form_is_as_good(client: TestClient) -> None:
    answer = client.post(PATH, files={"image": ("a.jpg", PHOTOGRAPH, "image/jpeg")})
    assert answer.json()["name"] == "nikon-d200-35mm-f2.8"
    assert client.post(PATH, files={"image": ("a.txt", PHOTOGRAPH, "text/plain")}).status_code == 415


def test_a_webp_tells_as_much(client: TestClient) -> None:
    content = webp(corners(432, 645), exif=exif_of(MAIN, SHOT, PLACE))
    answer = client.post(PATH, content=content, headers={"Content-Type": "image/webp"})
    assert answer.json() == client.post(PATH, content=PHOTOGRAPH, headers={"Content-Type": "image/jpeg"}).json()


def test_what_the_file_notes_of_its_making_is_told(client: TestClient) -> None:
    xmp = b'http://ns.adobe.com/xap/1.0/\0crs:HasCrop="True" crs:AlreadyApplied="True" SpecialType-PORTRAIT'
    content = PHOTOGRAPH[:2] + b"\xff\xe1" + (len(xmp) + 2).to_bytes(2, "big") + xmp + PHOTOGRAPH[2:]
    usual, noted = (client.post(PATH, content=each).json() for each in (PHOTOGRAPH, content))
    (portrait, crop) = noted["warnings"][len(usual["warnings"]) :]
    assert "a portrait mode" in portrait
    assert "cropped" in crop


def test_what_is_no_photograph_is_refused(client: TestClient) -> None:
    for content, kind, status in (
        (b"", "image/jpeg", 422),
        (b"x", "image/jpeg", 415),
        (b"{}", "application/json", 415),
        (PHOTOGRAPH[:2000], "image/jpeg", 422),
        (b"x" * 2_100_000, "image/jpeg", 413),
    ):
        answer = client.post(PATH, content=content, headers={"Content-Type": kind})
        assert (answer.status_code, answer.headers["content-type"]) == (status, "application/problem+json")
