"""Cameras over HTTP: registered, read, replaced, deleted, listed, and refused where they make no sense."""

import json
import math
from dataclasses import replace
from datetime import datetime
from typing import Any

import pytest
from fastapi import FastAPI
from starlette.testclient import TestClient

from service.api.cursors import cursor_after
from service.optics import thin_lens
from service.principal import LOCAL
from service.storage.cameras import Cameras

PROBLEM = "application/problem+json"


def test_lens_specs_become_a_camera(client: TestClient, d200: dict[str, Any]) -> None:
    answer = client.post("/cameras", json=d200)
    assert answer.status_code == 201
    assert answer.headers["location"] == "/cameras/d200"
    assert answer.headers["etag"] == '"1"'
    camera = answer.json()
    expected = thin_lens.k_cam(35e-3, 2.8, 2.0, 6.05e-6, 645 / 3872, 4.0)
    assert camera["k_cam_px"] == pytest.approx(expected, rel=1e-12)
    assert camera["source"] == "lens"
    assert camera["k_r"] == 4.0
    assert camera["fx_px"] == pytest.approx(35e3 / 6.05 * 645 / 3872)
    assert camera["lens"] == {**d200["lens"], "k_r": 4.0}
    assert camera["revision"] == 1
    far = 0.1 * 2.0 * expected / 0.25
    assert camera["range_m"] == {"near": pytest.approx(0.035), "far": pytest.approx(far)}
    assert datetime.fromisoformat(camera["created_at"]).utcoffset() is not None
    assert client.get(answer.headers["location"]).json() == camera


def test_a_given_k_cam_is_kept(client: TestClient, phone: dict[str, Any]) -> None:
    camera = client.post("/cameras", json=phone).json()
    assert (camera["k_cam_px"], camera["gamma_px"], camera["source"]) == (1.31, 0.6, "given")
    assert (camera["fx_px"], camera["lens"], camera["intrinsics"]) == (None, None, None)


def test_gamma_and_k_r_have_defaults(client: TestClient, d200: dict[str, Any]) -> None:
    del d200["gamma_px"]
    camera = client.post("/cameras", json=d200).json()
    assert (camera["gamma_px"], camera["k_r"]) == (0.5, 4.0)


def test_k_r_divides_k_cam(client: TestClient, d200: dict[str, Any]) -> None:
    d200["lens"]["k_r"] = 2.0
    camera = client.post("/cameras", json=d200).json()
    assert camera["k_cam_px"] == pytest.approx(thin_lens.k_cam(35e-3, 2.8, 2.0, 6.05e-6, 645 / 3872, 2.0))
    assert camera["k_r"] == 2.0


@pytest.mark.parametrize(
    ("lens", "focus_distance_m"),
    [
        ([1.8, 0.53, 6.5, 2048], 0.0021),  # a microscope's objective of NA 0.95
        ([50, 0.7, 6, 4000], 1.0),  # the fastest there was
        ([100, 32, 3.7, 6000], 0.2),  # macro at 1:1
        ([0.55, 2.8, 1.1, 400], 0.01),  # an endoscope's
        ([7820, 22, 3.76, 6248], 100_000),  # a telescope with a Barlow lens
        ([6.9, 1.8, 0.012, 8160], 3.0),  # a phone's digital zoom of 50 times, as its draft says it
    ],
)
def test_lenses_that_there_are_become_cameras(
    client: TestClient, d200: dict[str, Any], lens: list[float], focus_distance_m: float
) -> None:
    specs = dict(zip(LENS_NUMBERS, lens, strict=False))
    answer = client.post("/cameras", json={**d200, "focus_distance_m": focus_distance_m, "lens": specs})
    assert answer.status_code == 201, answer.text


def test_a_lens_that_was_stored_when_bounds_were_wider_is_still_read(
    client: TestClient, app: FastAPI, d200: dict[str, Any]
) -> None:
    client.post("/cameras", json=d200)
    cameras = Cameras(app.state.engine, LOCAL)
    draft = cameras.get("d200").draft
    assert draft.lens
    cameras.replace(replace(draft, lens=replace(draft.lens, f_number=0.3)))
    assert client.get("/cameras/d200").json()["lens"]["f_number"] == 0.3


def test_intrinsics_and_description_come_back_as_sent(client: TestClient, phone: dict[str, Any]) -> None:
    phone["intrinsics"] = {"fx_px": 3000, "fy_px": 3001.5, "cx_px": 2040, "cy_px": 1536.5}
    phone["intrinsics"]["distortion"] = [0.1, -0.2, 0, 0, 0.01]
    phone["description"] = "Größe 1:1, 👍"
    client.post("/cameras", json=phone)
    camera = client.get("/cameras/pixel7-wide").json()
    assert camera["intrinsics"] == phone["intrinsics"]
    assert camera["description"] == phone["description"]
    assert camera["fx_px"] == 3000


def test_intrinsics_that_are_sent_count_more_than_the_lens(client: TestClient, d200: dict[str, Any]) -> None:
    sent = d200 | {"intrinsics": {"fx_px": 980.0, "fy_px": 981.0, "cx_px": 320.0, "cy_px": 214.0}}
    assert client.post("/cameras", json=sent).json()["fx_px"] == 980.0


def test_the_aperture_is_the_lens_s_or_that_of_k_cam_and_told_once(
    client: TestClient, phone: dict[str, Any], d200: dict[str, Any]
) -> None:
    assert client.post("/cameras", json=phone).json()["f_number"] is None
    assert client.put(f"/cameras/{phone['name']}", json=phone | {"f_number": 1.85}).json()["f_number"] == 1.85
    assert client.get(f"/cameras/{phone['name']}").json()["f_number"] == 1.85
    answer = client.post("/cameras", json=d200 | {"f_number": 2.8})
    assert answer.status_code == 422
    assert [fault["pointer"] for fault in answer.json()["errors"]] == ["#/f_number"]
    assert client.post("/cameras", json=d200).json()["f_number"] == d200["lens"]["f_number"]


def test_a_taken_name_is_a_conflict(client: TestClient, d200: dict[str, Any]) -> None:
    client.post("/cameras", json=d200)
    answer = client.post("/cameras", json=d200)
    assert answer.status_code == 409
    assert answer.headers["content-type"] == PROBLEM
    assert "PUT /cameras/d200" in answer.json()["detail"]


def test_put_makes_a_new_revision(client: TestClient, d200: dict[str, Any]) -> None:
    first = client.post("/cameras", json=d200).json()
    d200["focus_distance_m"] = 1.0
    answer = client.put("/cameras/d200", json=d200)
    assert answer.status_code == 200
    assert answer.headers["etag"] == '"2"'
    second = answer.json()
    assert (second["revision"], second["focus_distance_m"]) == (2, 1.0)
    assert second["k_cam_px"] > 2 * first["k_cam_px"]
    assert second["created_at"] == first["created_at"]
    assert second["updated_at"] > first["updated_at"]


def test_put_replaces_the_whole(client: TestClient, d200: dict[str, Any], phone: dict[str, Any]) -> None:
    client.post("/cameras", json={**d200, "gamma_px": 0.9, "description": "before"})
    del phone["name"], phone["gamma_px"]
    camera = client.put("/cameras/d200", json=phone).json()
    assert (camera["source"], camera["lens"], camera["description"]) == ("given", None, None)
    assert camera["gamma_px"] == 0.5


def test_put_needs_an_existing_camera_of_that_name(client: TestClient, d200: dict[str, Any]) -> None:
    assert client.put("/cameras/d200", json=d200).status_code == 404
    client.post("/cameras", json=d200)
    answer = client.put("/cameras/d200", json={**d200, "name": "other"})
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["pointer"] == "#/name"


@pytest.mark.parametrize("tag", ['"1"', "*", '"7", "1"'])
def test_if_match_lets_the_known_revision_pass(client: TestClient, d200: dict[str, Any], tag: str) -> None:
    client.post("/cameras", json=d200)
    assert client.put("/cameras/d200", json=d200, headers={"If-Match": tag}).status_code == 200


@pytest.mark.parametrize("tag", ['"2"', 'W/"1"', "1", '"x"', ""])
@pytest.mark.parametrize("method", ["PUT", "DELETE"])
def test_if_match_holds_back_what_knows_another_revision(
    client: TestClient, d200: dict[str, Any], tag: str, method: str
) -> None:
    client.post("/cameras", json=d200)
    body = d200 if method == "PUT" else None
    answer = client.request(method, "/cameras/d200", headers={"If-Match": tag}, json=body)
    assert answer.status_code == 412
    assert answer.json()["detail"].endswith('repeat with If-Match: "1".')
    assert client.get("/cameras/d200").json()["revision"] == 1


def test_a_deleted_name_is_free_and_goes_on_counting(client: TestClient, d200: dict[str, Any]) -> None:
    client.post("/cameras", json=d200)
    answer = client.delete("/cameras/d200")
    assert (answer.status_code, answer.content) == (204, b"")
    assert client.get("/cameras/d200").status_code == 404
    assert client.delete("/cameras/d200").status_code == 404
    assert client.get("/cameras").json()["items"] == []
    again = client.post("/cameras", json=d200)
    assert (again.status_code, again.json()["revision"]) == (201, 2)


def test_listing_goes_through_every_camera_once(client: TestClient, phone: dict[str, Any]) -> None:
    names = sorted(f"camera-{number}" for number in range(7))
    for name in reversed(names):
        client.post("/cameras", json={**phone, "name": name})
    seen: list[str] = []
    query: dict[str, str] = {"limit": "3"}
    for _ in range(3):
        page = client.get("/cameras", params=query).json()
        seen += [camera["name"] for camera in page["items"]]
        query["cursor"] = page["next_cursor"]
    assert seen == names
    assert page["next_cursor"] is None


@pytest.mark.parametrize(
    "query",
    [
        *("cursor=nonsense", "cursor=ZDIwMA", "cursor=", "cursor=%00", "cursor=a", "cursor=YWZ0ZXI6YQo"),
        *("limit=0", "limit=x", "limit=201"),
    ],
)
def test_a_bad_page_is_refused(client: TestClient, query: str) -> None:
    answer = client.get(f"/cameras?{query}")
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["pointer"] == query.partition("=")[0]


def test_the_curve_is_the_thin_lens(client: TestClient, phone: dict[str, Any]) -> None:
    client.post("/cameras", json=phone)
    curve = client.get("/cameras/pixel7-wide/curve?near_m=1&far_m=4&points=4").json()
    assert (curve["camera"], curve["revision"], curve["focus_distance_m"]) == ("pixel7-wide", 1, 2.0)
    assert [point["depth_m"] for point in curve["points"]] == [1, 2, 3, 4]
    assert [point["defocus_px"] for point in curve["points"]] == pytest.approx([1.31, 0, 1.31 / 3, 1.31 / 2])
    assert curve["points"][0]["blur_px"] == pytest.approx(math.hypot(1.31, 0.6))
    assert curve["points"][1]["blur_px"] == pytest.approx(0.6)
    assert curve["points"][3]["depth_error_m"] == pytest.approx(16 / (2 * 1.31) * 0.25)


def test_the_curve_spans_the_focus_by_default(client: TestClient, phone: dict[str, Any]) -> None:
    client.post("/cameras", json=phone)
    points = client.get("/cameras/pixel7-wide/curve").json()["points"]
    assert points[0]["depth_m"] < 2 < points[-1]["depth_m"]
    beyond = client.get("/cameras/pixel7-wide/curve?near_m=50").json()["points"]
    assert (beyond[0]["depth_m"], len(beyond)) == (50, 101)
    infinite = phone | {"focus_distance_m": 1e5, "k_cam_px": 5e-5}
    points = client.post("/cameras/preview", json=infinite).json()["points"]
    assert (points[0]["depth_m"], points[-1]["depth_m"]) == pytest.approx((0.4, 10))  # its range ends at 2 m


@pytest.mark.parametrize(
    "query",
    ["near_m=2&far_m=1", "near_m=1&far_m=1", "near_m=0", "far_m=-1", "near_m=nan", "far_m=inf", "points=1"],
)
def test_a_bad_curve_is_refused(client: TestClient, phone: dict[str, Any], query: str) -> None:
    client.post("/cameras", json=phone)
    answer = client.get(f"/cameras/pixel7-wide/curve?{query}")
    assert answer.status_code == 422
    assert answer.json()["errors"]


def test_both_or_neither_of_k_cam_and_lens_is_refused(client: TestClient, d200: dict[str, Any]) -> None:
    both = client.post("/cameras", json={**d200, "k_cam_px": 3.0})
    del d200["lens"]
    neither = client.post("/cameras", json=d200)
    for answer in (both, neither):
        assert answer.status_code == 422
        assert {fault["pointer"] for fault in answer.json()["errors"]} == {"#/k_cam_px", "#/lens"}


@pytest.mark.parametrize("focal_length_mm", [2000, 2000.0, 5000])
def test_a_lens_longer_than_its_focus_distance_is_refused(
    client: TestClient, d200: dict[str, Any], focal_length_mm: float
) -> None:
    d200["lens"]["focal_length_mm"] = focal_length_mm
    answer = client.post("/cameras", json=d200)
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["pointer"] == "#/lens/focal_length_mm"
    assert "cannot focus at 2 m" in answer.json()["detail"]


@pytest.mark.parametrize("place", ["lens", "body"])
@pytest.mark.parametrize("name", ["focal_length_35mm", "FocalLengthIn35MM", "EquivalentFocalLength"])
def test_an_equivalent_focal_length_is_explained(
    client: TestClient, d200: dict[str, Any], place: str, name: str
) -> None:
    del d200["lens"]["focal_length_mm"]
    (d200["lens"] if place == "lens" else d200)[name] = 52
    answer = client.post("/cameras", json=d200)
    assert answer.status_code == 422
    fault = answer.json()["errors"][0]
    assert fault["pointer"] == (f"#/lens/{name}" if place == "lens" else f"#/{name}")
    assert "35-mm-equivalent" in fault["detail"]
    assert "35-mm-equivalent" in answer.json()["detail"]
    assert "focal_length_mm" in fault["detail"]


def test_lens_specs_beside_the_camera_are_told_their_place(client: TestClient, d200: dict[str, Any]) -> None:
    lens = d200.pop("lens")
    answer = client.post("/cameras", json=d200 | lens)
    assert answer.status_code == 422
    faults = {fault["pointer"]: fault["detail"] for fault in answer.json()["errors"]}
    del lens["f_number"]  # is one beside k_cam_px
    assert {f"#/{name}" for name in lens} <= faults.keys()
    assert all(f'{{"lens": {{"{name}": ...}}}}' in faults[f"#/{name}"] for name in lens)


NUMBERS = ["image_width_px", "image_height_px", "focus_distance_m", "k_cam_px", "f_number"]
LENS_NUMBERS = ["focal_length_mm", "f_number", "pixel_pitch_um", "sensor_width_px", "k_r"]
LENS = {"focal_length_mm": 35, "f_number": 2.8, "pixel_pitch_um": 6.05, "sensor_width_px": 3872}
BAD = [
    "0",
    "-1",
    "NaN",
    "Infinity",
    "-Infinity",
    "1e400",
    '"2"',
    "true",
    "[]",
    "1" + "0" * 30,
    "1" + "0" * 5000,
]


@pytest.mark.parametrize("name", NUMBERS)
def test_no_number_of_a_camera_may_be_nonsense(client: TestClient, phone: dict[str, Any], name: str) -> None:
    for bad in BAD:
        require_pointed_at(client, _json_with(phone, name, bad), f"#/{name}", bad)


@pytest.mark.parametrize("name", LENS_NUMBERS)
def test_no_number_of_a_lens_may_be_nonsense(client: TestClient, d200: dict[str, Any], name: str) -> None:
    for bad in BAD:
        lens = _json_with(d200["lens"], name, bad)
        require_pointed_at(client, _json_with(d200, "lens", lens), f"#/lens/{name}", bad)


def require_pointed_at(client: TestClient, body: str, pointer: str, bad: str) -> None:
    answer = client.post("/cameras", content=body, headers={"Content-Type": "application/json"})
    assert (answer.status_code, answer.headers["content-type"]) == (422, PROBLEM), bad[:40]
    if len(bad) < 1000:  # of more digits Python makes no number, and the JSON as a whole is refused
        assert answer.json()["errors"][0]["pointer"] == pointer, bad


@pytest.mark.parametrize("gamma_px", ["-0.1", "NaN", "Infinity"])
def test_gamma_may_be_zero_and_not_less(client: TestClient, phone: dict[str, Any], gamma_px: str) -> None:
    body = _json_with(phone, "gamma_px", gamma_px)
    answer = client.post("/cameras", content=body, headers={"Content-Type": "application/json"})
    assert answer.status_code == 422
    assert client.post("/cameras", json={**phone, "gamma_px": 0}).status_code == 201


@pytest.mark.parametrize(
    ("change", "pointer"),
    [
        ({"colour": "black"}, "#/colour"),
        ({"name": ""}, "#/name"),
        ({"name": "a/b"}, "#/name"),
        ({"name": "../x"}, "#/name"),
        ({"name": "a b"}, "#/name"),
        ({"name": "d200\n"}, "#/name"),
        ({"name": "x" * 65}, "#/name"),
        ({"name": 7}, "#/name"),
        ({"name": None}, "#/name"),
        ({"description": "a\x00b"}, "#/description"),
        ({"description": "x" * 1001}, "#/description"),
        ({"lens": []}, "#/lens"),
        ({"lens": {**LENS, "f_number": 0.49}}, "#/lens/f_number"),
        ({"lens": {**LENS, "focal_length_mm": 0.05}}, "#/lens/focal_length_mm"),
        ({"focus_distance_m": 100_001}, "#/focus_distance_m"),
        ({"intrinsics": {"fx_px": 1, "fy_px": 1, "cx_px": 0, "cy_px": 0, "skew": 0}}, "#/intrinsics/skew"),
        ({"intrinsics": {"fx_px": 1, "fy_px": 0, "cx_px": 0, "cy_px": 0}}, "#/intrinsics/fy_px"),
        (
            {"intrinsics": {"fx_px": 1, "fy_px": 1, "cx_px": 0, "cy_px": 0, "distortion": [1, 2]}},
            "#/intrinsics/distortion",
        ),
        ({"~weird/name": 1}, "#/~0weird~1name"),
    ],
)
def test_a_wrong_field_is_pointed_at(
    client: TestClient, phone: dict[str, Any], change: dict[str, Any], pointer: str
) -> None:
    answer = client.post("/cameras", json={**phone, **change})
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["pointer"] == pointer


def test_half_a_character_is_no_description(client: TestClient, phone: dict[str, Any]) -> None:
    body = json.dumps({**phone, "description": "a\ud800b"})
    answer = client.post("/cameras", content=body, headers={"Content-Type": "application/json"})
    assert (answer.status_code, answer.json()["errors"][0]["pointer"]) == (422, "#/description")


@pytest.mark.parametrize("missing", ["name", "image_width_px", "image_height_px", "focus_distance_m"])
def test_a_missing_field_is_pointed_at(client: TestClient, phone: dict[str, Any], missing: str) -> None:
    del phone[missing]
    answer = client.post("/cameras", json=phone)
    assert answer.status_code == 422
    assert answer.json()["errors"] == [{"pointer": f"#/{missing}", "detail": "this is required"}]


@pytest.mark.parametrize("name", ["nobody", "%00", "a%20b", "..%2f", "x" * 300, "%ff"])
def test_an_unknown_camera_is_not_found(client: TestClient, phone: dict[str, Any], name: str) -> None:
    del phone["name"]
    for method, path in (("GET", ""), ("DELETE", ""), ("GET", "/curve"), ("PUT", "")):
        body = phone if method == "PUT" else None
        answer = client.request(method, f"/cameras/{name}{path}", json=body)
        assert answer.status_code == 404, (method, path)
        assert answer.headers["content-type"] == PROBLEM


def _json_with(fields: dict[str, Any], name: str, raw: str) -> str:
    """JSON text with one value written as it stands."""
    parts = {**{key: json.dumps(value) for key, value in fields.items()}, name: raw}
    return "{" + ", ".join(f"{json.dumps(key)}: {value}" for key, value in parts.items()) + "}"


@pytest.mark.parametrize("kind", ["d200", "phone"])
def test_a_preview_says_what_the_stored_camera_will(
    client: TestClient, kind: str, request: pytest.FixtureRequest
) -> None:
    body = request.getfixturevalue(kind)
    seen = client.post("/cameras/preview", json=body)
    assert seen.status_code == 200
    assert client.get("/cameras").json()["items"] == []
    camera = client.post("/cameras", json=body).json()
    curve = client.get(f"/cameras/{body['name']}/curve").json()
    preview = seen.json()
    assert preview.pop("points") == curve["points"]
    assert preview == {field: camera[field] for field in preview}


def test_a_preview_needs_no_name_and_points_to_what_is_wrong(client: TestClient, d200: dict[str, Any]) -> None:
    del d200["name"]
    assert client.post("/cameras/preview", json=d200).status_code == 200
    d200["lens"]["f_number"] = 0
    answer = client.post("/cameras/preview", json=d200)
    assert answer.status_code == 422
    assert [fault["pointer"] for fault in answer.json()["errors"]] == ["#/lens/f_number"]


def test_a_camera_may_be_called_preview(client: TestClient, phone: dict[str, Any]) -> None:
    assert client.post("/cameras", json=phone | {"name": "preview"}).status_code == 201
    assert client.get("/cameras/preview").json()["name"] == "preview"
    assert client.delete("/cameras/preview").status_code == 204


def test_revisions_are_listed_newest_first_a_page_at_a_time(client: TestClient, phone: dict[str, Any]) -> None:
    stored = [client.post("/cameras", json=phone).json()]
    stored += [client.put("/cameras/pixel7-wide", json=phone | {"k_cam_px": k}).json() for k in (1.5, 2.0)]
    client.delete("/cameras/pixel7-wide")
    of_the_deleted = client.get("/cameras/pixel7-wide/revisions").json()["items"]
    assert [one["revision"] for one in of_the_deleted] == [3, 2, 1]
    stored.append(client.post("/cameras", json=phone | {"k_cam_px": 2.5}).json())
    first = client.get("/cameras/pixel7-wide/revisions", params={"limit": 3}).json()
    rest = client.get("/cameras/pixel7-wide/revisions", params={"cursor": first["next_cursor"]}).json()
    found = first["items"] + rest["items"]
    assert [one["revision"] for one in found] == [4, 3, 2, 1]
    assert [one["k_cam_px"] for one in found] == [2.5, 2.0, 1.5, 1.31]
    assert rest["next_cursor"] is None
    # the time of each is its own
    assert [one["updated_at"] for one in found] == [one["updated_at"] for one in reversed(stored)]


def test_revisions_of_nothing_and_cursors_of_nobody_are_refused(client: TestClient, phone: dict[str, Any]) -> None:
    assert client.get("/cameras/pixel7-wide/revisions").status_code == 404
    client.post("/cameras", json=phone)
    assert client.get("/cameras/pixel7-wide/revisions", params={"cursor": cursor_after("pixel7")}).status_code == 422


@pytest.mark.parametrize(
    ("tag", "status"),
    [('"1"', 304), ('W/"1"', 304), ('"7", "1"', 304), ("*", 304), ('"2"', 200), ("1", 200), ("", 200), ('"11"', 200)],
)
def test_a_revision_that_is_at_hand_is_not_sent_again(
    client: TestClient, phone: dict[str, Any], tag: str, status: int
) -> None:
    path = client.post("/cameras", json=phone).headers["location"]
    answer = client.get(path, headers={"If-None-Match": tag})
    assert (answer.status_code, answer.headers["etag"]) == (status, '"1"')
    if status == 304:
        assert answer.content == b""
        assert "content-type" not in answer.headers
    client.put(path, json=phone)
    assert client.get(path, headers={"If-None-Match": '"1"'}).json()["revision"] == 2
    assert client.get("/cameras/nobody", headers={"If-None-Match": "*"}).status_code == 404


def test_no_cache_keeps_a_camera(client: TestClient, phone: dict[str, Any]) -> None:
    path = client.post("/cameras", json=phone).headers["location"]
    for tag, status in (('"2"', 200), ('"1"', 304)):
        answer = client.get(path, headers={"If-None-Match": tag})
        assert answer.status_code == status
        assert (answer.headers["cache-control"], answer.headers["vary"]) == (
            "no-store, no-transform",
            "Authorization",
        )


def test_no_content_has_no_type(client: TestClient, phone: dict[str, Any]) -> None:
    client.post("/cameras", json=phone)
    answer = client.delete(f"/cameras/{phone['name']}")
    assert (answer.status_code, answer.content) == (204, b"")
    assert "content-type" not in answer.headers


def test_a_curve_may_end_before_where_it_begins_by_itself(client: TestClient, phone: dict[str, Any]) -> None:
    client.post("/cameras", json=phone)
    within = client.get("/cameras/pixel7-wide/curve?far_m=0.1").json()["points"]
    assert (within[0]["depth_m"], within[-1]["depth_m"]) == pytest.approx((0.02, 0.1))
