"""``POST /depth`` end to end: a photograph in, metres out in every form, a clear no to all else."""

import asyncio
import io
import json
import os
import threading
import time
from collections.abc import MutableMapping
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
import pytest
import tifffile
from fastapi import FastAPI
from httpx2 import Response
from numpy.typing import NDArray
from starlette.testclient import TestClient

from service.app import create_app
from service.config import Settings
from service.inference.cancellation import Cancellation
from service.inference.encode import MAPS, MEDIA_TYPES
from service.inference.worker import Worker
from service.opencv import cv2
from service.optics import thin_lens
from tests.inference.oracle_pair import blur_of
from tests.inference.photographs import corners, exif_of, hostile_png, jpeg, png, tiff, webp, with_exif

CAMERA = {
    "name": "bench",
    "image_width_px": 96,
    "image_height_px": 64,
    "focus_distance_m": 2.0,
    "k_cam_px": 6.0,
    "gamma_px": 0.5,
    "intrinsics": {"fx_px": 300.0, "fy_px": 300.0, "cx_px": 40.0, "cy_px": 30.0},
}
LEVEL = 90
PROBLEM = "application/problem+json"


def depth_near(level: int, k_cam_px: float = 6.0, gamma_px: float = 0.5, focus_m: float = 2.0) -> float:
    """What the model folder of these tests must answer on the near side for a grey level."""
    x = thin_lens.relative_defocus_from_blur(blur_of(level), gamma_px, k_cam_px)
    return thin_lens.depth_near(x, focus_m)


def grey(level: int = LEVEL, height: int = 64, width: int = 96) -> NDArray[np.uint8]:
    return np.full((height, width, 3), level, np.uint8)


@pytest.fixture
def bench(client: TestClient) -> TestClient:
    """The running app with a camera for these photographs."""
    assert client.post("/cameras", json=CAMERA).status_code == 201
    return client


def ask(client: TestClient, body: bytes | None = None, headers: dict[str, str] | None = None, **query: Any) -> Response:
    """Post a photograph (a grey PNG unless given) taken by the camera of these tests."""
    content = png(grey()) if body is None else body
    parameters = {"camera": "bench", "side": "near"} | query
    given = {name: value for name, value in parameters.items() if value is not None}
    return client.post("/depth", params=given, content=content, headers={"Content-Type": "image/png"} | (headers or {}))


def refused(response: Response, status: int, *words: str) -> dict[str, Any]:
    """The problem of a response that must have this status, and these words in its detail."""
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == PROBLEM
    problem: dict[str, Any] = response.json()
    assert problem["status"] == status
    for word in words:
        assert word in json.dumps(problem), problem
    return problem


def npy(response: Response) -> NDArray[np.float32]:
    assert response.status_code == 200, response.text
    return np.asarray(np.load(io.BytesIO(response.content), allow_pickle=False), np.float32)


def test_the_default_is_a_16_bit_png_in_millimetres_with_all_headers(bench: TestClient) -> None:
    response = ask(bench)
    assert response.status_code == 200, response.text
    assert response.headers["content-type"] == "image/png"
    pixels = cv2.imdecode(np.frombuffer(response.content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert pixels is not None
    assert pixels.dtype == np.uint16
    assert pixels.shape == (64, 96)
    np.testing.assert_allclose(pixels * 0.001, depth_near(LEVEL), atol=0.001)
    assert response.headers["Camind-Camera"] == "bench"
    assert response.headers["Camind-Camera-Revision"] == "1"
    assert response.headers["Camind-Model"] == "oracle-20260101"
    assert float(response.headers["Camind-Depth-Scale-M"]) == 0.001
    assert response.headers["Camind-Warnings"] == ""
    stages = dict(stage.split(";dur=") for stage in response.headers["Server-Timing"].split(", "))
    assert list(stages) == ["decode", "wait", "blur", "correct", "depth", "encode"]
    assert all(float(spent) >= 0 for spent in stages.values())


def test_every_format_tells_the_same_metres(bench: TestClient) -> None:
    want = depth_near(LEVEL)
    np.testing.assert_allclose(npy(ask(bench, format="npy")), want, rtol=1e-3)
    with np.load(io.BytesIO(ask(bench, format="npz").content)) as stored:
        np.testing.assert_allclose(stored["depth_m"], want, rtol=1e-3)
        np.testing.assert_array_equal(stored["K"], [[300, 0, 40], [0, 300, 30], [0, 0, 1]])
    floats = tifffile.imread(io.BytesIO(ask(bench, format="tiff").content))
    np.testing.assert_allclose(floats, want, rtol=1e-3)
    assert b"element vertex 6144" in ask(bench, format="ply").content
    assert ask(bench, format="preview").content.startswith(b"\xff\xd8\xff")
    assert ask(bench, format="json").json()["depth_m"]["median"] == pytest.approx(want, rel=1e-3)
    for name, media_type in MEDIA_TYPES.items():
        response = ask(bench, format=name)
        assert response.headers["content-type"] == media_type
        assert float(response.headers["Camind-Depth-Scale-M"]) == (0.001 if name == "png" else 1)


def test_an_npz_has_the_maps_asked_for(bench: TestClient) -> None:
    response = ask(bench, format="npz", maps=["depth_m", "sigma_m"])
    with np.load(io.BytesIO(response.content)) as stored:
        assert set(stored) == {"depth_m", "sigma_m", "K"}
    assert len(response.content) < 0.5 * len(ask(bench, format="npz").content)


def test_a_file_says_what_it_was_made_by(bench: TestClient) -> None:
    response = ask(bench, format="npz", roi="0,0,50,40", known="3,4,1.5", focus_distance_m=1.5)
    with ZipFile(io.BytesIO(response.content)) as archive:
        origin = json.loads(archive.comment)
    headers = response.headers
    assert origin["focus_distance_m"] == pytest.approx(float(headers["Camind-Focus-Distance-M"]), rel=1e-5)
    assert "; ".join(origin.pop("warnings")) == headers["Camind-Warnings"] != ""
    del origin["focus_distance_m"]
    made_by = {"camera": "bench", "revision": 1, "model": "oracle-20260101", "side": "near"}
    made_by |= {"image_width_px": 96, "image_height_px": 64}
    assert origin == made_by | {"roi": "0,0,50,40", "known": ["3,4,1.5"], "depth_scale_m": 1.0}


def test_json_has_exactly_the_numbers_of_the_design(bench: TestClient) -> None:
    answer = ask(bench, format="json", at=["12,7", "95.4,0"]).json()
    assert set(answer) == {
        *("camera", "revision", "model", "width_px", "height_px", "depth_m"),
        *("valid_fraction", "points", "warnings"),
    }
    assert set(answer["depth_m"]) == {"min", "p5", "median", "p95", "max"}
    assert (answer["width_px"], answer["height_px"], answer["valid_fraction"]) == (96, 64, 1.0)
    point, other = answer["points"]
    assert set(point) == {"u", "v", "depth_m", "depth_alt_m", "sigma_m", "p_near"}
    assert (point["u"], point["v"], other["u"]) == (12, 7, 95.4)
    assert point["depth_m"] == pytest.approx(depth_near(LEVEL), rel=1e-3)
    assert point["depth_alt_m"] > 2 > point["depth_m"]
    assert point["p_near"] == 1
    assert point["sigma_m"] > 0


@pytest.mark.parametrize(
    ("at", "u", "v"),
    [("32.1234567890,21", 32.123456789, 21), ("1e1,2", 10, 2), ("1, 2", 1, 2), (".5,1.", 0.5, 1), ("+3,4e-1", 3, 0.4)],
)
def test_a_number_may_be_written_in_any_way(bench: TestClient, at: str, u: float, v: float) -> None:
    (point,) = ask(bench, format="json", at=at).json()["points"]
    assert (point["u"], point["v"]) == (u, v)
    assert ask(bench, known=f"{at}, 1.1000000000").status_code == 200


def test_of_what_is_transparent_there_is_no_answer(bench: TestClient) -> None:
    alpha = np.full((64, 96), 255, np.uint8)
    alpha[:, :48] = 0
    response = ask(bench, png(np.dstack([grey(), alpha])), format="npy")
    assert "what is transparent, 50% of the photograph, shows nothing" in response.headers["camind-warnings"]
    answered = np.isfinite(npy(response))
    assert answered[:, 50:].all()
    assert not answered[:, :46].any()


def test_json_says_null_and_never_nan(bench: TestClient) -> None:
    response = ask(bench, png(grey(230)), format="json", at="3,3", side="auto")
    assert b"NaN" not in response.content
    assert response.json()["points"][0]["depth_alt_m"] is None


@pytest.mark.parametrize(
    ("accept", "kind"),
    [
        ("*/*", "image/png"),
        ("image/*", "image/png"),
        ("application/json", "application/json"),
        ("image/png;q=0.5, application/x-npy", "application/x-npy"),
        ("image/jpeg;q=0.9, image/png;q=0.8", "image/jpeg"),
        ("image/png;q=0, */*;q=0.1", "application/x-npy"),
        ("text/html, application/xhtml+xml, */*;q=0.8", "image/png"),
        ("APPLICATION/JSON; q=1.0", "application/json"),
        ("application/json; charset=utf-8, image/png;q=0.9", "application/json"),
    ],
)
def test_accept_chooses_the_form(bench: TestClient, accept: str, kind: str) -> None:
    response = ask(bench, headers={"Accept": accept})
    assert response.headers["content-type"] == kind
    assert "Accept" in response.headers["vary"]


def test_accept_may_come_in_several_lines(bench: TestClient) -> None:
    lines = [("Content-Type", "image/png"), ("Accept", "image/webp"), ("Accept", "image/tiff")]
    response = bench.post("/depth", params={"camera": "bench"}, content=png(grey()), headers=lines)
    assert (response.status_code, response.headers["content-type"]) == (200, "image/tiff")


def test_format_wins_over_accept(bench: TestClient) -> None:
    response = ask(bench, headers={"Accept": "image/png"}, format="json")
    assert response.headers["content-type"] == "application/json"


@pytest.mark.parametrize(
    "accept", ["text/csv", "image/gif, video/*", "image/png;q=0", "image/png;q=2", "image/png;q=nan", "image/png;q=x"]
)
def test_an_accept_that_nothing_fits_is_406(bench: TestClient, accept: str) -> None:
    refused(ask(bench, headers={"Accept": accept}), 406, "image/png", "application/json")


def test_side_forces_the_answer_and_the_probability(bench: TestClient) -> None:
    near = ask(bench, format="json", at="9,9", side="near").json()["points"][0]
    far = ask(bench, format="json", at="9,9", side="far").json()["points"][0]
    assert (near["p_near"], far["p_near"]) == (1, 0)
    assert near["depth_m"] == pytest.approx(far["depth_alt_m"])
    assert near["depth_m"] < 2 < far["depth_m"]


def test_a_form_field_is_as_good_as_the_body(bench: TestClient) -> None:
    for name, data, kind in (("a.jpg", jpeg(grey()), "image/jpeg"), ("a", png(grey()), "")):
        files = {"image": (name, data, kind)} if kind else {"image": (name, data)}
        response = bench.post("/depth?camera=bench&side=near&format=npy", files=files)
        np.testing.assert_allclose(npy(response), depth_near(LEVEL), rtol=0.01)
    form = bench.build_request("POST", "/", files=files)
    kind = form.headers["content-type"].replace("multipart/form-data", "Multipart/Form-Data")
    assert bench.post("/depth?camera=bench", content=form.read(), headers={"Content-Type": kind}).status_code == 200


@pytest.mark.parametrize("make", [jpeg, png, webp, tiff])
def test_every_kind_of_photograph_is_taken(bench: TestClient, make: Any) -> None:
    kind = f"image/{make.__name__}"
    response = ask(bench, make(grey()), {"Content-Type": kind}, format="npy")
    np.testing.assert_allclose(npy(response), depth_near(LEVEL), rtol=0.01)


@pytest.mark.parametrize(
    ("kind", "make"), [("image/jpg", jpeg), ("image/pjpeg", jpeg), ("image/x-png", png), ("IMAGE/JPG; q=1", jpeg)]
)
def test_a_kind_may_go_by_another_name(bench: TestClient, kind: str, make: Any) -> None:
    files = {"image": ("a", make(grey()), kind)}
    for response in (ask(bench, make(grey()), {"Content-Type": kind}), bench.post("/depth?camera=bench", files=files)):
        assert response.status_code == 200, response.text
        assert "declared" not in response.headers["Camind-Warnings"]


def test_without_a_focal_length_there_is_no_point_cloud_and_no_camera_matrix(client: TestClient) -> None:
    client.post("/cameras", json={name: value for name, value in CAMERA.items() if name != "intrinsics"})
    problem = refused(ask(client, format="ply"), 422, "focal length")
    assert problem["errors"][0]["pointer"] == "format"
    response = ask(client, format="npz")
    assert "K is NaN" in response.headers["Camind-Warnings"]
    with np.load(io.BytesIO(response.content)) as stored:
        assert np.isnan(stored["K"][0, 0])


def test_an_upright_phone_photograph_is_answered_upright(bench: TestClient) -> None:
    stored = grey(30)
    stored[:, :48] = 120
    response = ask(bench, png(stored, 6), format="npz")
    with np.load(io.BytesIO(response.content)) as found:
        assert found["depth_m"].shape == (96, 64)
        # each half is heard a little in the other
        np.testing.assert_allclose(found["depth_m"][:40], depth_near(120), rtol=2e-3)
        np.testing.assert_allclose(found["depth_m"][56:], depth_near(30), rtol=2e-3)
        np.testing.assert_array_equal(found["K"], [[300, 0, 33], [0, 300, 40], [0, 0, 1]])


def test_a_resized_frame_rescales_the_camera_and_warns(bench: TestClient) -> None:
    response = ask(bench, png(grey(60, 32, 48)), format="npy")
    np.testing.assert_allclose(npy(response), depth_near(60, 3.0, thin_lens.gamma_after_shrinking(0.5, 0.5)), rtol=1e-3)
    warning = response.headers["Camind-Warnings"]
    assert "48x32" in warning
    assert "96x64" in warning


def test_another_frame_is_refused_with_both_sizes(bench: TestClient) -> None:
    refused(ask(bench, png(grey(60, 64, 64))), 422, "64x64", "96x64", "image-size-mismatch")


def test_another_focus_distance_moves_k_cam_and_warns_without_a_focal_length(bench: TestClient) -> None:
    response = ask(bench, format="npy", focus_distance_m=1.6)
    np.testing.assert_allclose(npy(response), depth_near(LEVEL, 7.5, 0.5, 1.6), rtol=1e-3)
    assert "focal length" in response.headers["Camind-Warnings"]
    assert ask(bench, focus_distance_m=2.0).headers["Camind-Warnings"] == ""  # where it is anyway


def test_a_lens_moves_focus_exactly_but_not_nearer_than_its_focal_length(
    client: TestClient, d200: dict[str, Any]
) -> None:
    client.post("/cameras", json=d200)
    picture = png(grey(60, 432, 645))
    assert ask(client, picture, camera="d200", focus_distance_m=1.5).headers["Camind-Warnings"] == ""
    with np.load(io.BytesIO(ask(client, picture, camera="d200", format="npz").content)) as stored:
        assert stored["K"][0, 0] == pytest.approx(35e3 / 6.05 * 645 / 3872)
    problem = refused(ask(client, picture, camera="d200", focus_distance_m=0.03), 422, "focal length")
    assert problem["errors"][0]["pointer"] == "focus_distance_m"


def test_what_focus_that_near_does_to_a_focal_length_from_specs_is_said_of_points_alone(
    client: TestClient, d200: dict[str, Any]
) -> None:
    near = {**d200, "focus_distance_m": 0.25}
    fx_px = 35e3 / 6.05 * 645 / 3872
    given = near | {"name": "given", "intrinsics": {"fx_px": fx_px, "fy_px": fx_px, "cx_px": 322.0, "cy_px": 215.5}}
    for camera in (near, given):
        assert client.post("/cameras", json=camera).status_code == 201
    for name, kind, is_warned in (("d200", "npz", True), ("d200", "png", False), ("given", "npz", False)):
        warned = ask(client, png(grey(60, 432, 645)), camera=name, format=kind).headers["Camind-Warnings"]
        assert ("fx_px is that of the lens focused far away" in warned) == is_warned, (name, kind)
    elsewhere = ask(client, png(grey(60, 432, 645)), camera="given", format="npz", focus_distance_m=1)
    assert "fx_px is that of the lens focused at 0.25 m" in elsewhere.headers["Camind-Warnings"]


def test_a_photograph_by_another_lens_is_warned_of(client: TestClient, d200: dict[str, Any]) -> None:
    client.post("/cameras", json=d200)
    client.post("/cameras", json={**CAMERA, "image_width_px": 645, "image_height_px": 432})
    other = with_exif(jpeg(grey(60, 432, 645)), exif_of({}, {0x920A: (50, 1), 0x829D: (12, 10)}))
    warned = ask(client, other, {"Content-Type": "image/jpeg"}, camera="d200").headers["Camind-Warnings"]
    assert warned == "its EXIF says 50 mm f/1.2, the camera is 35 mm f/2.8"
    assert "EXIF" not in ask(client, other).headers["Camind-Warnings"]
    cropped = with_exif(jpeg(grey(60, 432, 645)), exif_of({}, {0x920A: (35, 1), 0xA405: 105}))
    warned = ask(client, cropped, {"Content-Type": "image/jpeg"}, camera="d200").headers["Camind-Warnings"]
    assert warned.startswith("its EXIF says it shows what 105 mm show on 35-mm film, the camera what 53.7 do")


def test_intrinsics_that_cannot_be_the_camera_s_are_warned_of(client: TestClient, d200: dict[str, Any]) -> None:
    client.post("/cameras", json=d200 | {"intrinsics": CAMERA["intrinsics"]})
    warned = ask(client, png(grey(60, 432, 645)), camera="d200").headers["Camind-Warnings"].split("; ")
    assert warned[0].startswith("intrinsics put the axis at (40, 30) of 645x432 pixels")
    assert warned[1].startswith("fx_px is 964 by lens and 300 by intrinsics")


def test_a_focus_that_the_photograph_notes_is_no_matter_where_about_that_is_told_or_it_follows(
    bench: TestClient,
) -> None:
    noted = with_exif(jpeg(grey()), exif_of({}, {0x9206: (1, 1)}))
    about, other, known = {"focus_distance_m": 1.9}, {"focus_distance_m": 2.1}, {"known": "20,20,1.1"}
    for told, is_warned in (({}, True), (about, False), (other, True), (other | known, False)):
        warned = ask(bench, noted, {"Content-Type": "image/jpeg"}, **told).headers["Camind-Warnings"]
        assert ("its EXIF says" in warned) == is_warned, told


def test_known_depths_tell_where_this_shot_was_focused(bench: TestClient) -> None:
    response = ask(bench, format="npy", known=["20,20,1.1", "70,50,1.1"])
    told_m = depth_near(LEVEL)
    assert response.headers["Camind-Focus-Distance-M"] != ask(bench).headers["Camind-Focus-Distance-M"] == "2"
    assert abs(npy(response)[0, 0] - 1.1) < abs(told_m - 1.1) / 3
    assert "where 2 m was told" in response.headers["Camind-Warnings"]
    focus_m = float(response.headers["Camind-Focus-Distance-M"])
    np.testing.assert_allclose(npy(ask(bench, format="npy", focus_distance_m=focus_m)), npy(response), rtol=0.02)
    assert npy(response)[20, 20] == pytest.approx(1.1, rel=0.005)


def test_what_divides_warnings_in_a_header_is_in_none(bench: TestClient) -> None:
    declared = {"Content-Type": "image/jpeg; charset=utf-8"}
    told = ask(bench, png(grey()), declared, focus_distance_m=1.6).headers["Camind-Warnings"].split("; ")
    assert told[1] == "declared image/jpeg, charset=utf-8, read as png"
    assert len(told) == 2


def test_so_many_warnings_that_no_proxy_takes_them_in_a_header_are_in_json(bench: TestClient) -> None:
    known = [f"{pixel % 96},{pixel // 2},{0.4 + pixel % 7}" for pixel in range(100)]
    response = ask(bench, format="json", known=known)
    every = response.json()["warnings"]
    *told, more = response.headers["Camind-Warnings"].split("; ")
    assert len(response.headers["Camind-Warnings"]) < 2_100
    assert told == every[: len(told)]
    assert more == f"and {len(every) - len(told)} more, which format=json has"


def test_known_depths_are_of_the_whole_whatever_part_is_asked_for(bench: TestClient) -> None:
    whole, part = (ask(bench, format="npy", known="90,60,1.1", roi=roi) for roi in (None, "0,0,32,32"))
    np.testing.assert_allclose(npy(part), npy(whole)[:32, :32], rtol=1e-4)
    problem = refused(ask(bench, known="96,3,1.1"), 422, "(0, 0) to (96, 64)")
    assert problem["errors"][0]["pointer"] == "known"


@pytest.mark.parametrize(
    ("query", "word"),
    [
        ({"camera": None}, "camera"),
        ({"side": "left"}, "side"),
        ({"format": "gif"}, "npy"),
        ({"format": ""}, "format"),
        ({"focus_distance_m": 0}, "focus_distance_m"),
        ({"focus_distance_m": -1}, "focus_distance_m"),
        ({"focus_distance_m": "nan"}, "focus_distance_m"),
        ({"focus_distance_m": "inf"}, "focus_distance_m"),
        ({"at": "12"}, "u,v"),
        ({"at": "a,b"}, "u,v"),
        ({"at": "nan,1"}, "u,v"),
        ({"at": "96,3", "format": "json"}, "(0, 0) to (96, 64)"),
        ({"at": "3,-1", "format": "json"}, "(0, 0) to (96, 64)"),
        ({"maps": "depth"}, "depth_m"),
        ({"known": "3,4"}, "u,v,depth_m"),
        ({"known": "3,4,0"}, "u,v,depth_m"),
        ({"known": "3,4,-1"}, "u,v,depth_m"),
        ({"known": "3,4,inf"}, "u,v,depth_m"),
        ({"known": "3,4,123456"}, "u,v,depth_m"),
        ({"known": ["3,4,1.5"] * 101}, "100"),
        ({"known": "3,4,nan"}, "u,v,depth_m"),
        ({"at": "1e7,1"}, "u,v"),
        ({"at": "1," + "0" * 200}, "u,v"),
        ({"roi": "1,2,3"}, "four whole numbers of pixels, u0,v0,u1,v1"),
        ({"focus_distance_m": "two"}, "this must be a number"),
        ({"roi": "-1,2,3,4"}, "roi"),
        ({"longest_px": 15}, "longest_px"),
        ({"longest_px": 100_001}, "longest_px"),
        ({"longest_px": "16.5"}, "longest_px"),
        ({"colour": "red"}, "colour"),
    ],
)
def test_a_wrong_parameter_is_422_and_named(bench: TestClient, query: dict[str, Any], word: str) -> None:
    refused(ask(bench, **query), 422, word)


def test_an_unknown_camera_is_404(bench: TestClient) -> None:
    refused(ask(bench, camera="nobody"), 404, "nobody")


@pytest.mark.parametrize(
    ("body", "kind", "status", "word"),
    [
        (b"", "image/jpeg", 422, "empty"),
        (jpeg(corners())[:-100], "image/jpeg", 422, "cut off"),
        (png(corners())[:-20], "image/png", 422, "cut off"),
        (b"this is a letter, not a picture", "image/jpeg", 415, "JPEG"),
        (png(corners()), "text/plain", 415, "text/plain"),
        (png(corners()), "application/json", 415, "application/json"),
        (png(corners()), "application/x-www-form-urlencoded", 415, "add -H 'Content-Type: image/jpeg'"),
        (b"GIF89a" + bytes(60), "image/gif", 415, "image/gif"),
        (bytes(2_000_001), "image/png", 413, "2000000"),
    ],
)
def test_bytes_that_are_no_photograph_are_refused(
    bench: TestClient, body: bytes, kind: str, status: int, word: str
) -> None:
    refused(ask(bench, body, {"Content-Type": kind}), status, word)


def test_a_huge_picture_in_a_small_file_is_413(bench: TestClient) -> None:
    started = time.perf_counter()
    refused(ask(bench, hostile_png()), 413, "20000x20000")
    assert time.perf_counter() - started < 5


@pytest.mark.parametrize(
    "form",
    [
        {"files": {"picture": ("a.png", b"x", "image/png")}},
        {"files": [("image", ("a.png", b"x")), ("image", ("b.png", b"x"))]},
        {"files": {"image": ("a.png", b"x")}, "data": {"camera": "bench"}},
        {"content": b"--x\r\n", "headers": {"Content-Type": "multipart/form-data; boundary=x"}},
        {"content": b"what", "headers": {"Content-Type": "multipart/form-data"}},
    ],
)
def test_a_form_without_exactly_the_field_is_422(bench: TestClient, form: dict[str, Any]) -> None:
    refused(bench.post("/depth?camera=bench", **form), 422, "image")


@pytest.mark.parametrize("size", [10, 1_500_000])
def test_a_form_s_file_without_a_name_is_asked_for_one(bench: TestClient, size: int) -> None:
    answer = bench.post("/depth?camera=bench", files={"image": (None, b"x" * size)})
    refused(answer, 422, "with a file name")


def test_a_form_of_the_wrong_kind_or_without_bytes_is_refused(bench: TestClient) -> None:
    refused(bench.post("/depth?camera=bench", files={"image": ("a.txt", b"x", "text/plain")}), 415)
    refused(bench.post("/depth?camera=bench", files={"image": ("a.png", b"", "image/png")}), 422, "empty")


def test_a_part_is_the_same_part_of_the_whole_in_every_form(bench: TestClient) -> None:
    body = png(np.random.default_rng(0).integers(40, 130, (64, 96, 3), np.uint8))
    whole, part = npy(ask(bench, body, format="npy")), npy(ask(bench, body, format="npy", roi="10,20,41,50"))
    np.testing.assert_allclose(part, whole[20:50, 10:41], rtol=1e-5)
    with np.load(io.BytesIO(ask(bench, body, format="npz", roi="10,20,41,50").content)) as stored:
        np.testing.assert_array_equal(stored["K"], [[300, 0, 30], [0, 300, 10], [0, 0, 1]])
        assert stored["valid"].shape == (30, 31)
    assert b"element vertex 930\n" in ask(bench, body, format="ply", roi="10,20,41,50").content
    told = ask(bench, body, format="json", roi="10,20,41,50", at="12,21").json()
    assert (told["width_px"], told["height_px"]) == (31, 30)
    (point,) = told["points"]
    assert (point["u"], point["v"]) == (12, 21)
    assert point["depth_m"] == pytest.approx(float(whole[21, 12]), rel=1e-5)


@pytest.mark.parametrize(("roi", "top", "left", "size"), [(None, 0, 0, (64, 96)), ("10,20,41,50", 20, 10, (30, 31))])
def test_a_smaller_answer_has_pixels_of_the_whole_one_in_every_form(
    bench: TestClient, roi: str | None, top: int, left: int, size: tuple[int, int]
) -> None:
    body = png(np.random.default_rng(0).integers(40, 130, (64, 96, 3), np.uint8))
    asked: dict[str, Any] = {"roi": roi, "side": "auto"}
    small = asked | {"longest_px": 24}
    shape = tuple(round(length * 24 / max(size)) for length in size)
    rows, columns = (((np.arange(few) + 0.5) * many / few).astype(int) for many, few in zip(size, shape, strict=True))
    with (
        np.load(io.BytesIO(ask(bench, body, format="npz", **asked).content)) as whole,
        np.load(io.BytesIO(ask(bench, body, format="npz", **small).content)) as stored,
    ):
        assert set(stored) == set(whole) == {*MAPS, "K"}
        for name in MAPS:
            np.testing.assert_array_equal(stored[name], whole[name][rows][:, columns], err_msg=name)
        depth_m = stored["depth_m"]
        (down, across) = (few / many for few, many in zip(shape, size, strict=True))
        wanted = [300 * across, (40.5 - left) * across - 0.5], [300 * down, (30.5 - top) * down - 0.5]
        np.testing.assert_allclose((stored["K"][0, [0, 2]], stored["K"][1, [1, 2]]), wanted)
    np.testing.assert_array_equal(npy(ask(bench, body, format="npy", **small)), depth_m)
    np.testing.assert_array_equal(
        tifffile.imread(io.BytesIO(ask(bench, body, format="tiff", **small).content)), depth_m
    )
    for kind in ("png", "preview"):
        found = cv2.imdecode(np.frombuffer(ask(bench, body, format=kind, **small).content, np.uint8), -1)
        assert found is not None
        assert found.shape[:2] == shape
    points = f"element vertex {shape[0] * shape[1]}\n".encode()
    assert points in ask(bench, body, format="ply", **small).content
    # what is read is the photograph's
    told = [ask(bench, body, format="json", at="12,21", **query).json() for query in (asked, small)]
    assert told[0] == told[1]
    assert (told[0]["height_px"], told[0]["width_px"]) == size


def test_no_answer_is_enlarged(bench: TestClient) -> None:
    assert ask(bench, format="npz", longest_px=96).content == ask(bench, format="npz").content
    assert npy(ask(bench, longest_px=4096, format="npy")).shape == (64, 96)


@pytest.mark.parametrize("roi", ["10,20,10,50", "50,20,40,30", "0,0,97,64", "0,0,96,65"])
def test_what_is_no_part_of_the_photograph_is_refused_by_name(bench: TestClient, roi: str) -> None:
    problem = refused(ask(bench, roi=roi), 422, "96x64")
    assert problem["errors"][0]["pointer"].endswith("roi")


def test_a_point_outside_the_part_is_refused(bench: TestClient) -> None:
    for kind in ("json", "npy"):
        refused(ask(bench, format=kind, roi="10,20,41,50", at="9,21"), 422, "(9, 21)", "(10, 20) to (41, 50)")


def test_a_deadline_that_passes_is_503_with_retry_after(app: FastAPI, bench: TestClient) -> None:
    replace_worker(app, deadline_s=1e-6)
    response = ask(bench)
    refused(response, 503, "No answer within")
    assert int(response.headers["retry-after"]) >= 1


def test_a_full_queue_is_503_with_retry_after(app: FastAPI, bench: TestClient) -> None:
    worker, release = replace_worker(app, deadline_s=10), threading.Event()
    assert bench.portal is not None
    held = bench.portal.start_task_soon(worker.run, None, lambda _: release.wait(10))
    while not worker.in_flight:
        pass
    response = ask(bench)
    refused(response, 503, "with room for no more")
    assert int(response.headers["retry-after"]) >= 1
    release.set()
    assert held.result(10).value
    assert ask(bench).status_code == 200


def test_who_waits_for_a_slot_longer_than_a_body_may_take_is_answered(settings: Settings) -> None:
    app = create_app(settings.model_copy(update={"receive_deadline_s": 2.0}))
    is_held, release = threading.Event(), threading.Event()
    with TestClient(app) as client:
        client.post("/cameras", json=CAMERA)
        assert client.portal is not None

        def hold(_: object) -> bool:
            is_held.set()
            return release.wait(10)

        held = client.portal.start_task_soon(app.state.worker.run, None, hold)
        assert is_held.wait(10)
        threading.Timer(2.3, release.set).start()
        assert ask(client).status_code == 200
        assert held.result(10).value


def replace_worker(app: FastAPI, deadline_s: float) -> Worker:
    """A worker of one slot and no queue, from now on the running app's."""
    app.state.worker.close()
    app.state.worker = worker = Worker(slots=1, queue_size=0, deadline_s=deadline_s)
    return worker


def test_a_form_touches_no_disk(client: TestClient, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "nowhere"))
    body = png(np.random.default_rng(0).integers(0, 255, (640, 960, 3), np.uint8))
    assert 1.5e6 < len(body) < 2e6
    client.post("/cameras", json=CAMERA)
    answer = client.post("/depth?camera=bench", files={"image": ("photo.png", body, "image/png")})
    assert answer.status_code == 200


def test_a_client_that_goes_away_gives_up_its_place(app: FastAPI) -> None:
    release = threading.Event()
    received: list[MutableMapping[str, Any]] = [
        {"type": "http.request", "body": png(grey())},
        {"type": "http.disconnect"},
    ]
    sent: list[MutableMapping[str, Any]] = []

    def hold(_: Cancellation) -> None:
        release.wait(10)

    async def receive() -> MutableMapping[str, Any]:
        return received.pop(0)

    async def send(message: MutableMapping[str, Any]) -> None:
        sent.append(message)

    async def scenario(worker: Worker) -> None:
        holding = asyncio.create_task(worker.run(None, hold))
        await asyncio.sleep(0.02)
        scope: dict[str, Any] = {"type": "http", "method": "POST", "path": "/depth", "headers": []}
        scope |= {"raw_path": b"/depth", "root_path": "", "query_string": b"camera=bench"}
        scope |= {"http_version": "1.1", "scheme": "http"}
        await asyncio.wait_for(app(scope, receive, send), timeout=5)
        assert worker.in_flight == 1
        release.set()
        await holding

    with TestClient(app) as client:
        client.post("/cameras", json=CAMERA)
        asyncio.run(scenario(app.state.worker))
    assert sent == []


def test_ten_requests_leave_no_memory_behind(client: TestClient) -> None:
    client.post("/cameras", json=CAMERA | {"image_width_px": 640, "image_height_px": 480})
    body = jpeg(np.random.default_rng(0).integers(0, 200, (480, 640, 3), np.uint8))

    def resident_mb() -> float:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20

    ask(client, body, {"Content-Type": "image/jpeg"})
    before_mb = resident_mb()
    for _ in range(10):
        assert ask(client, body, {"Content-Type": "image/jpeg"}).status_code == 200
    assert resident_mb() - before_mb < 60


def test_the_document_lists_every_form_and_every_kind(client: TestClient) -> None:
    operation = client.get("/openapi.json").json()["paths"]["/depth"]["post"]
    assert set(operation["responses"]["200"]["content"]) == {*MEDIA_TYPES.values(), "application/json"}
    assert {"image/jpeg", "image/png", "multipart/form-data"} <= set(operation["requestBody"]["content"])
    assert {"404", "406", "413", "415", "422", "503"} <= set(operation["responses"])
    assert {parameter["name"] for parameter in operation["parameters"]} == {
        *("camera", "side", "format", "at", "maps", "roi", "longest_px", "focus_distance_m", "known")
    }
