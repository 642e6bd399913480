"""``POST /calibrate/look`` on simulated photographs of the sheet."""

import math
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest
from httpx2 import Response
from numpy.typing import NDArray
from starlette.testclient import TestClient

from service.inference.images import TURNS
from service.optics.camera import Camera, Intrinsics
from tests.inference.photographs import corners, exif_of, jpeg, png, with_exif
from tests.simulated_sheets import CAMERA, GRID, sheet_photos

Z_M = 0.4
AXIS: dict[str, Any] = {"fx_px": 900, "fy_px": 900, "cx_px": 400, "cy_px": 300, "distortion": [-0.05, 0.02, 0, 0, 0]}
KNOWN = {
    "name": "bench",
    "image_width_px": 800,
    "image_height_px": 600,
    "focus_distance_m": 0.5,
    "k_cam_px": 4.0,
    "intrinsics": AXIS,
}


@pytest.fixture(scope="module")
def sheet() -> NDArray[np.uint8]:
    return sheet_photos(CAMERA, [Z_M])[0][2]


def look(client: TestClient, data: bytes, **query: Any) -> Response:
    return client.post(
        "/calibrate/look", params=asdict(GRID) | query, content=data, headers={"Content-Type": "image/png"}
    )


def test_the_circles_and_what_is_told_of_them(client: TestClient, sheet: NDArray[np.uint8]) -> None:
    client.post("/cameras", json=KNOWN)
    seen = look(client, png(sheet), camera="bench").json()
    assert (seen["found"], len(seen["circles"]), seen["width_px"], seen["height_px"]) == (True, 21, 800, 600)
    assert seen["measured"] == 11
    assert seen["distance_m"] == pytest.approx(Z_M, rel=0.02)
    assert seen["focal_length_from"] == "camera"
    assert 0 <= seen["tilt_deg"] <= 26
    assert seen["exposure"] == "good"
    assert seen["blur_px"] == pytest.approx(math.hypot(4.0 * (0.5 / Z_M - 1), 0.7), rel=0.15)
    # each is where the paper turns black
    for circle in seen["circles"]:
        u, v, radius = round(circle["u_px"]), round(circle["v_px"]), circle["radius_px"]
        assert sheet[v, u].max() < 100 < sheet[v, round(u + 1.5 * radius)].min()
    assert client.get("/calibrations").json()["items"] == []


def test_without_a_focal_length_there_is_no_distance(client: TestClient, sheet: NDArray[np.uint8]) -> None:
    seen = look(client, png(sheet)).json()
    assert (seen["found"], seen["distance_m"], seen["tilt_deg"], seen["focal_length_from"]) == (True, None, None, None)


def test_the_exif_s_focal_length_will_do(client: TestClient, sheet: NDArray[np.uint8]) -> None:
    # 9 mm on pixels of 10 um, 1000 to the centimetre: 900 px
    taken = with_exif(jpeg(sheet), exif_of({}, {0x920A: (9, 1), 0xA20E: (1000, 1), 0xA210: 3}))
    seen = look(client, taken).json()
    assert seen["focal_length_from"] == "exif"
    assert seen["distance_m"] == pytest.approx(Z_M, rel=0.03)


def test_of_a_picture_made_small_the_exif_s_pixels_are_those_of_the_large_one(
    client: TestClient, sheet: NDArray[np.uint8]
) -> None:
    # 9 mm on pixels of 5 um, 2000 to the centimetre: 1800 px of 1600
    large: dict[int, Any] = {0x920A: (9, 1), 0xA20E: (2000, 1), 0xA210: 3, 0xA002: 1600, 0xA003: 1200}
    seen = look(client, with_exif(jpeg(sheet), exif_of({}, large))).json()
    assert seen["distance_m"] == pytest.approx(Z_M, rel=0.03)


def test_a_lens_tells_the_focal_length_and_without_any_the_exif_may(
    client: TestClient, sheet: NDArray[np.uint8]
) -> None:
    taken = with_exif(jpeg(sheet), exif_of({}, {0x920A: (9, 1), 0xA20E: (1000, 1), 0xA210: 3}))
    lens = {"focal_length_mm": 9, "f_number": 2, "pixel_pitch_um": 10, "sensor_width_px": 800}
    bare = {name: value for name, value in KNOWN.items() if name not in ("k_cam_px", "intrinsics")}
    for change, source in (({"lens": lens}, "camera"), ({"k_cam_px": 4.0}, "exif")):
        client.post("/cameras", json=bare | change | {"name": source})
        seen = look(client, taken, camera=source).json()
        assert seen["focal_length_from"] == source
        assert seen["distance_m"] == pytest.approx(Z_M, rel=0.03)
    blank = with_exif(jpeg(corners(200, 150)), exif_of({}, {0x920A: (9, 1), 0xA20E: (1000, 1), 0xA210: 3}))
    seen = look(client, blank).json()
    assert (seen["found"], seen["focal_length_from"]) == (False, None)


@pytest.mark.parametrize(("gain", "exposure"), [(1.4, "over"), (0.5, "good"), (0.25, "under")])
def test_exposure_is_told(client: TestClient, sheet: NDArray[np.uint8], gain: float, exposure: str) -> None:
    changed = np.clip(sheet * gain, 0, 255).astype(np.uint8)
    assert look(client, png(changed)).json()["exposure"] == exposure


def test_white_that_is_clipped_in_a_part_of_the_sheet_is_over(client: TestClient, sheet: NDArray[np.uint8]) -> None:
    changed = sheet.copy()
    changed[:, 450:] = np.clip(1.4 * sheet[:, 450:], 0, 255)
    seen = look(client, png(changed)).json()
    assert seen["exposure"] == "over"
    assert seen["paper_level"] < 0.98


def test_a_photograph_without_the_sheet_says_so(client: TestClient) -> None:
    seen = look(client, png(corners(200, 150))).json()
    assert (seen["found"], seen["circles"], seen["blur_px"], seen["exposure"]) == (False, [], None, None)
    assert "no grid" in seen["warnings"][0]


def test_circles_are_of_the_stored_frame_and_the_turn_is_told(client: TestClient, sheet: NDArray[np.uint8]) -> None:
    plain, turned = (look(client, jpeg(sheet, orientation=n)).json() for n in (1, 6))
    assert (turned["orientation"], turned["width_px"], turned["height_px"]) == (6, 800, 600)
    assert turned["circles"] == plain["circles"] != []


def test_a_camera_registered_upright_stands_where_one_of_the_file_s_size_does(
    client: TestClient, sheet: NDArray[np.uint8]
) -> None:
    client.post("/cameras", json=KNOWN)
    stored = Intrinsics(**AXIS)
    upright = Camera(800, 600, 0.5, 4.0, intrinsics=stored).turned(*TURNS[6])
    assert upright.intrinsics is not None
    told = {"image_width_px": 600, "image_height_px": 800, "intrinsics": asdict(upright.intrinsics)}
    client.post("/cameras", json=KNOWN | told | {"name": "upright"})
    as_filed, as_shown = (look(client, jpeg(sheet, orientation=6), camera=name).json() for name in ("bench", "upright"))
    assert as_filed["focal_length_from"] == "camera"
    assert (as_shown["distance_m"], as_shown["tilt_deg"]) == pytest.approx(
        (as_filed["distance_m"], as_filed["tilt_deg"]), rel=1e-6
    )


def test_an_exif_that_makes_pixels_of_no_size_has_no_focal_length(client: TestClient, sheet: NDArray[np.uint8]) -> None:
    taken = with_exif(jpeg(sheet), exif_of({}, {0x920A: (50, 1), 0xA405: 50, 0xA002: 4_000_000_000}))
    seen = look(client, taken).json()
    assert (seen["found"], seen["focal_length_from"]) == (True, None)


def test_what_cannot_be_looked_at_is_refused(client: TestClient) -> None:
    assert look(client, b"no picture").status_code == 415
    assert look(client, png(corners())[:60]).status_code == 422
    assert look(client, png(corners()), camera="nobody").status_code == 404
    touching = look(client, png(corners()), diameter_mm=60)
    assert [fault["pointer"] for fault in touching.json()["errors"]] == ["spacing_mm"]
    assert look(client, bytes(3_000_000)).status_code == 413
