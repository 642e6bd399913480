"""``POST /calibrate`` and ``/calibrations`` end to end, with a stand-in for the calibration itself."""

import json
import re
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import MISSING, asdict, fields
from pathlib import Path
from threading import Semaphore
from typing import Any
from uuid import uuid4

import pytest
from fastapi import FastAPI
from httpx2 import Response
from pydantic import JsonValue
from sqlalchemy import update
from starlette.testclient import TestClient

from service.app import create_app
from service.config import Settings
from service.inference.exif import F_NUMBER
from service.storage.calibrations import Calibrations
from service.storage.engine import writing
from service.storage.tables import CalibrationRow
from tests.fake_calibration import RESULT, SETTINGS, FakeCalibration, without_calibrations
from tests.inference.photographs import corners, exif_of, jpeg, png, with_exif
from tests.simulated_sheets import CAMERA, FEW_DEPTHS_M, GRID, sheet_photos

PROBLEM = "application/problem+json"
PATIENCE_S = 15.0
PICTURE = png(corners())
FINAL = ("succeeded", "failed", "cancelled")

Part = tuple[str, tuple[str | None, bytes | str, str]]


@pytest.fixture
def settings(settings: Settings) -> Settings:
    limits = {"max_calibration_images": 4, "max_image_bytes": 50_000, "max_calibration_bytes": 200_000}
    return settings.model_copy(update={**limits, "calibration_queue_size": 3})


@pytest.fixture
def app(settings: Settings, fake: FakeCalibration) -> FastAPI:
    return create_app(settings, fake)


@pytest.fixture
def spool_dir(settings: Settings) -> Path:
    return settings.spool_dir


def settings_part(change: dict[str, JsonValue] | None = None) -> Part:
    return ("settings", (None, json.dumps({**SETTINGS, **(change or {})}), "application/json"))


def picture(role: str = "defocused", name: str = "near.png", content: bytes = PICTURE) -> Part:
    return (role, (name, content, "image/png"))


def send(client: TestClient, *parts: Part, camera: str = "bench", prefer: str | None = None, **more: Any) -> Response:
    headers = {"Prefer": prefer} if prefer else {}
    files = list(parts) or [settings_part(), picture()]
    return client.post("/calibrate", params={"camera": camera}, files=files, headers=headers, **more)


def refused(response: Response, status: int, pointer: str | None = None, *words: str) -> None:
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == PROBLEM
    body = response.json()
    if pointer is not None:
        assert pointer in [fault["pointer"] for fault in body["errors"]], body
    for word in words:
        assert word in response.text


def ended(client: TestClient, path: str) -> dict[str, Any]:
    give_up_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < give_up_s:
        body: dict[str, Any] = client.get(path).json()
        if body["state"] in FINAL:
            return body
        time.sleep(0.02)
    raise AssertionError("still not ended")


def folders(spool_dir: Path) -> list[str]:
    return [path.name for path in spool_dir.iterdir() if path.is_dir()]


def gone(spool_dir: Path) -> bool:
    give_up_s = time.monotonic() + PATIENCE_S
    while folders(spool_dir) and time.monotonic() < give_up_s:
        time.sleep(0.02)
    return not folders(spool_dir)


def test_photographs_become_a_camera_s_constants(client: TestClient, spool_dir: Path) -> None:
    answer = send(client, settings_part(), picture("focused", "sharp.png"), picture(), picture(name="far.png"))
    assert answer.status_code == 202
    queued = answer.json()
    assert answer.headers["location"] == f"/calibrations/{queued['id']}"
    assert (queued["state"], queued["camera"], queued["settings"]) == ("queued", "bench", SETTINGS)
    assert (queued["images"], queued["result"], queued["problem"]) == ([], None, None)
    body = ended(client, answer.headers["location"])
    assert (body["state"], body["progress"], body["problem"]) == ("succeeded", 1.0, None)
    assert body["result"] == json.loads(json.dumps(asdict(RESULT)))
    assert [(image["name"], image["role"], image["found"]) for image in body["images"]] == [
        ("sharp.png", "focused", True),
        ("near.png", "defocused", True),
        ("far.png", "defocused", True),
    ]
    assert body["camera_revision"] is None
    assert client.get("/cameras/bench").status_code == 404
    assert gone(spool_dir)


def test_settings_may_be_a_file_and_have_defaults(client: TestClient, fake: FakeCalibration) -> None:
    pattern = {"kind": "symmetric_circles", "rows": 7, "columns": 5, "spacing_mm": 30, "diameter_mm": 18}
    part = ("settings", ("settings.json", json.dumps({"pattern": pattern}), "application/json"))
    body = send(client, part, picture(), prefer="wait=10").json()
    assert body["settings"] == {"pattern": pattern, "focus_distance_m": None, "method": "edge", "register": False}
    assert (fake.tasks[0].grid.rows, fake.tasks[0].grid.diameter_mm) == (7, 18)


def test_what_was_asked_reaches_the_calibration(client: TestClient, fake: FakeCalibration) -> None:
    asked = settings_part({"focus_distance_m": 2, "method": "paper"})
    send(client, asked, picture("focused", "sharp.png"), picture(), prefer="wait=10")
    assert (fake.tasks[0].focus_distance_m, fake.tasks[0].method) == (2.0, "paper")
    assert [(each.name, each.role) for each in fake.pictures[0]] == [
        ("sharp.png", "focused"),
        ("near.png", "defocused"),
    ]


def test_register_makes_a_camera_and_then_a_revision(client: TestClient) -> None:
    for revision in (1, 2):
        answer = send(client, settings_part({"register": True}), picture(), prefer="wait=10")
        assert (answer.status_code, answer.json()["camera_revision"]) == (200, revision)
    camera = client.get("/cameras/bench").json()
    assert (camera["source"], camera["revision"]) == ("calibration", 2)
    assert (camera["k_cam_px"], camera["gamma_px"], camera["focus_distance_m"]) == (6.5, 0.75, 1.5)
    assert (camera["image_width_px"], camera["image_height_px"]) == (64, 48)
    assert camera["intrinsics"] == json.loads(json.dumps(asdict(RESULT.intrinsics)))
    # it can be used at once
    depth = client.post("/depth?camera=bench", content=PICTURE, headers={"Content-Type": "image/png"})
    assert depth.status_code == 200
    assert depth.headers["camind-camera-revision"] == "2"


def test_depth_is_answered_while_a_calibration_runs(client: TestClient, fake: FakeCalibration) -> None:
    send(client, settings_part({"register": True}), picture(), prefer="wait=10")
    fake.go.clear()
    fake.has_begun.clear()
    send(client)
    assert fake.has_begun.wait(PATIENCE_S)
    depth = client.post("/depth?camera=bench", content=PICTURE, headers={"Content-Type": "image/png"})
    assert depth.status_code == 200


@pytest.mark.parametrize("prefer", ["wait=10", "respond-async, WAIT=10", 'wait="10"; x=y', "wait = 10"])
def test_who_waits_gets_the_end(client: TestClient, prefer: str) -> None:
    answer = send(client, prefer=prefer)
    assert (answer.status_code, answer.json()["state"]) == (200, "succeeded")
    assert answer.headers["preference-applied"] == "wait=10"
    assert answer.headers["location"] == f"/calibrations/{answer.json()['id']}"


def test_who_waits_too_short_gets_what_there_is(client: TestClient, fake: FakeCalibration) -> None:
    fake.go.clear()
    started_s = time.monotonic()
    answer = send(client, prefer="wait=1")
    assert time.monotonic() - started_s >= 1
    assert (answer.status_code, answer.json()["state"]) == (202, "running")
    assert answer.headers["preference-applied"] == "wait=1"


@pytest.mark.parametrize("prefer", ["respond-async", "wait", "wait=-1", "wait=soon", "await=5"])
def test_a_preference_that_is_none_is_ignored(client: TestClient, prefer: str) -> None:
    answer = send(client, prefer=prefer)
    assert answer.status_code == 202
    assert "preference-applied" not in answer.headers


def test_a_wait_has_its_end(client: TestClient) -> None:
    assert send(client, prefer="wait=999999").headers["preference-applied"] == "wait=60"


def test_a_failed_one_says_why(settings: Settings) -> None:
    with TestClient(create_app(settings, FakeCalibration(lambda: None))) as client:
        body = send(client, prefer="wait=10").json()
    assert (body["state"], body["result"]) == ("failed", None)
    assert body["problem"] == "The grid was found in none of the pictures."


def events_of(answer: Response) -> list[tuple[int, dict[str, Any]]]:
    events = []
    for block in answer.text.strip().split("\n\n"):
        lines = dict(line.split(": ", 1) for line in block.splitlines())
        events.append((int(lines["id"]), json.loads(lines["data"])))
    return events


def test_events_tell_every_change_and_end_with_the_last(client: TestClient, fake: FakeCalibration) -> None:
    fake.go.clear()
    path = send(client).headers["location"]
    fake.release_after(1.5)
    answer = client.get(f"{path}/events")
    assert answer.headers["content-type"].startswith("text/event-stream")
    events = events_of(answer)
    numbers = [number for number, _ in events]
    assert numbers == sorted(set(numbers))
    assert events[0][1]["state"] in ("queued", "running")
    assert events[-1][1] == client.get(path).json()
    assert events[-1][1]["state"] == "succeeded"
    assert events[-1][1]["settings"] == SETTINGS
    assert any(event["state"] == "running" and event["images"] for _, event in events)


def test_the_events_of_one_that_has_ended_are_its_end(client: TestClient) -> None:
    path = f"/calibrations/{send(client, prefer='wait=10').json()['id']}"
    events = events_of(client.get(f"{path}/events"))
    assert [event for _, event in events] == [client.get(path).json()]


def test_waiting_outlasts_a_database_that_fails(client: TestClient, app: FastAPI, fake: FakeCalibration) -> None:
    fake.go.clear()
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(send, client, prefer="wait=3")
        assert fake.has_begun.wait(PATIENCE_S)
        with without_calibrations(app.state.engine):
            answer = waiting.result()
    assert answer.status_code == 202
    fake.go.set()
    assert ended(client, answer.headers["location"])["state"] == "succeeded"


def test_events_outlast_a_database_that_fails(
    client: TestClient, app: FastAPI, fake: FakeCalibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, version = Semaphore(0), Calibrations.version

    def told(calibrations: Calibrations, calibration_id: str) -> int:
        try:
            return version(calibrations, calibration_id)
        finally:
            asked.release()

    monkeypatch.setattr(Calibrations, "version", told)
    fake.go.clear()
    path = send(client).headers["location"]
    assert fake.has_begun.wait(PATIENCE_S)
    with ThreadPoolExecutor(1) as pool:
        following = pool.submit(client.get, f"{path}/events")
        assert asked.acquire(timeout=PATIENCE_S)
        with without_calibrations(app.state.engine):
            assert all(asked.acquire(timeout=PATIENCE_S) for _ in range(2))
        fake.go.set()
        events = events_of(following.result())
    assert events[-1][1]["state"] == "succeeded"


def test_a_waiting_one_can_be_cancelled(client: TestClient, fake: FakeCalibration, spool_dir: Path) -> None:
    fake.go.clear()
    running, waiting = (send(client).headers["location"] for _ in range(2))
    assert fake.has_begun.wait(PATIENCE_S)
    answer = client.delete(waiting)
    assert (answer.status_code, answer.content) == (204, b"")
    assert "content-type" not in answer.headers
    assert client.get(waiting).json()["state"] == "cancelled"
    assert folders(spool_dir) == [running.rpartition("/")[2]]
    fake.go.set()
    assert ended(client, running)["state"] == "succeeded"
    assert len(fake.tasks) == 1


def test_a_running_one_can_be_cancelled(client: TestClient, fake: FakeCalibration, spool_dir: Path) -> None:
    fake.go.clear()
    path = send(client, settings_part({"register": True}), picture()).headers["location"]
    assert fake.has_begun.wait(PATIENCE_S)
    assert client.delete(path).status_code == 204
    body = client.get(path).json()
    assert (body["state"], body["result"], body["problem"]) == ("cancelled", None, None)
    assert gone(spool_dir)
    fake.go.set()
    assert client.delete(path).status_code == 204
    assert client.get(path).json() == body
    assert client.get("/cameras/bench").status_code == 404


def test_one_that_has_ended_stays_as_it_is(client: TestClient) -> None:
    path = f"/calibrations/{send(client, prefer='wait=10').json()['id']}"
    assert client.delete(path).status_code == 204
    assert client.get(path).json()["state"] == "succeeded"


def test_lists_are_paged_from_the_newest(client: TestClient) -> None:
    ids = [send(client, camera=f"camera-{number}", prefer="wait=10").json()["id"] for number in range(3)]
    first = client.get("/calibrations?limit=2").json()
    assert [item["id"] for item in first["items"]] == [ids[2], ids[1]]
    assert {"state", "progress", "camera", "created_at"} <= set(first["items"][0])
    last = client.get("/calibrations", params={"limit": 2, "cursor": first["next_cursor"]}).json()
    assert ([item["id"] for item in last["items"]], last["next_cursor"]) == ([ids[0]], None)


@pytest.mark.parametrize("query", ["limit=0", "limit=201", "limit=x", "cursor=zzz", "cursor=YWZ0ZXI6ZDIwMA"])
def test_a_bad_list_is_refused(client: TestClient, query: str) -> None:
    refused(client.get(f"/calibrations?{query}"), 422, query.partition("=")[0])


@pytest.mark.parametrize("name", ["nobody", "f" * 32, "%00", "..%2f", "x" * 300])
def test_an_unknown_calibration_is_not_found(client: TestClient, name: str) -> None:
    for method, path in (("GET", ""), ("DELETE", ""), ("GET", "/events"), ("GET", "/plot.svg")):
        refused(client.request(method, f"/calibrations/{name}{path}"), 404)


def test_there_is_no_plot_without_a_result(client: TestClient, fake: FakeCalibration) -> None:
    fake.go.clear()
    path = send(client).headers["location"]
    refused(client.get(f"{path}/plot.svg"), 409, None, "has no result")


def change_pattern(**change: JsonValue) -> dict[str, JsonValue]:
    pattern = SETTINGS["pattern"]
    assert isinstance(pattern, dict)
    return {"pattern": {**pattern, **change}}


@pytest.mark.parametrize(
    ("change", "pointer"),
    [
        ({"colour": "black"}, "#/settings/colour"),
        ({"is_to_register": True}, "#/settings/is_to_register"),
        ({"register": "yes"}, "#/settings/register"),
        ({"method": "guess"}, "#/settings/method"),
        ({"method": "paper"}, "#/settings/focus_distance_m"),
        ({"focus_distance_m": 0}, "#/settings/focus_distance_m"),
        ({"focus_distance_m": 100_001}, "#/settings/focus_distance_m"),
        ({"focus_distance_m": "2"}, "#/settings/focus_distance_m"),
        ({"focus_distance_m": float("nan")}, "#/settings/focus_distance_m"),
        ({"pattern": None}, "#/settings/pattern"),
        (change_pattern(kind="chessboard"), "#/settings/pattern/kind"),
        (change_pattern(rows=1), "#/settings/pattern/rows"),
        (change_pattern(columns=41), "#/settings/pattern/columns"),
        (change_pattern(spacing_mm=0), "#/settings/pattern/spacing_mm"),
        (change_pattern(diameter_mm=-1), "#/settings/pattern/diameter_mm"),
        (change_pattern(diameter_mm=28), "#/settings/pattern/diameter_mm"),
        (change_pattern(squares=3), "#/settings/pattern/squares"),
    ],
)
def test_a_wrong_setting_is_pointed_at(
    client: TestClient, spool_dir: Path, change: dict[str, JsonValue], pointer: str
) -> None:
    refused(send(client, settings_part(change), picture()), 422, pointer)
    assert folders(spool_dir) == []
    assert client.get("/calibrations").json()["items"] == []


@pytest.mark.parametrize("text", ["", "{", "null", "[]", "7", '"x"', "\x00", "{} {}", "[" * 9_000])
def test_settings_that_are_none_are_pointed_at(client: TestClient, text: str) -> None:
    refused(send(client, ("settings", (None, text, "application/json")), picture()), 422, "#/settings")


def test_a_missing_pattern_is_pointed_at(client: TestClient) -> None:
    refused(send(client, ("settings", (None, "{}", "application/json")), picture()), 422, "#/settings/pattern")


@pytest.mark.parametrize(
    ("parts", "pointer"),
    [
        ([picture()], "#/settings"),
        ([settings_part()], "#/defocused"),
        ([settings_part(), picture("focused")], "#/defocused"),
        ([settings_part(), picture(name="", content=b"")], "#/defocused"),
        ([settings_part(), picture(content=b"")], "#/defocused"),
        ([settings_part(), picture("focused"), picture(content=b"no picture at all")], "#/defocused"),
        ([settings_part(), settings_part(), picture()], "#/settings"),
        ([settings_part(), picture("image")], "#/image"),
        ([settings_part(), picture(), ("note", (None, "hello", "text/plain"))], "#/note"),
    ],
)
def test_a_wrong_form_is_pointed_at(client: TestClient, spool_dir: Path, parts: list[Part], pointer: str) -> None:
    refused(send(client, *parts), 422, pointer)
    assert folders(spool_dir) == []


def test_a_file_that_is_none_is_told_of_beside_the_others(client: TestClient) -> None:
    parts = [picture(), picture(name="empty.png", content=b""), picture(name="cut.png", content=PICTURE[:80])]
    body = send(client, settings_part(), *parts, prefer="wait=10").json()
    assert body["state"] == "succeeded"
    assert [image["found"] for image in body["images"]] == [True, False, False]
    assert all(image["warnings"] for image in body["images"])


def test_names_are_told_apart_and_are_no_paths(client: TestClient, spool_dir: Path) -> None:
    names = ["../../a.png", "a.png", "a\x01b.png", "C:\\temp\\a.png"]
    body = send(client, settings_part(), *[picture(name=name) for name in names], prefer="wait=10").json()
    told = [image["name"] for image in body["images"]]
    assert told[:2] == ["a.png", "a.png (2)"]
    assert len(set(told)) == 4
    assert all("/" not in name and "\\" not in name and name.isprintable() for name in told)
    assert not list(spool_dir.parent.parent.glob("*.png"))


@pytest.mark.parametrize("camera", ["", "a/b", "a b", "../x", "x" * 65])
def test_a_camera_needs_a_name(client: TestClient, camera: str) -> None:
    refused(send(client, camera=camera), 422, "camera")


def test_the_camera_s_name_is_needed(client: TestClient) -> None:
    refused(client.post("/calibrate", files=[settings_part(), picture()]), 422, "camera")


@pytest.mark.parametrize(
    "kind", ["application/json", "image/png", "application/x-www-form-urlencoded", "multipart/mixed"]
)
def test_what_is_no_form_is_unsupported(client: TestClient, kind: str) -> None:
    answer = client.post("/calibrate?camera=bench", content=b"{}", headers={"Content-Type": kind})
    refused(answer, 415, None, "multipart/form-data")


@pytest.mark.parametrize("kept", [0.2, 0.6, 0.99])
def test_a_form_that_is_cut_off_is_refused(client: TestClient, spool_dir: Path, kept: float) -> None:
    whole = client.build_request("POST", "/calibrate?camera=bench", files=[settings_part(), picture(), picture()])
    body = whole.read()
    headers = {"Content-Type": whole.headers["content-type"]}
    refused(client.post("/calibrate?camera=bench", content=body[: int(len(body) * kept)], headers=headers), 422)
    assert folders(spool_dir) == []


def test_headers_of_a_form_s_parts_come_in_any_order(client: TestClient) -> None:
    whole = client.build_request("POST", "/calibrate?camera=bench", files=[settings_part(), picture()])
    turned = re.sub(rb"(Content-Disposition: [^\r]+\r\n)(Content-Type: [^\r]+\r\n)", rb"\2\1", whole.read())
    assert turned != whole.content
    headers = {"Content-Type": whole.headers["content-type"]}
    assert client.post("/calibrate?camera=bench", content=turned, headers=headers).status_code == 202


@pytest.mark.parametrize(
    "kind", ["multipart/form-data", "multipart/form-data; boundary=", f"multipart/form-data; boundary={'x' * 300}"]
)
def test_a_form_without_a_boundary_is_refused(client: TestClient, kind: str) -> None:
    refused(client.post("/calibrate?camera=bench", content=b"--x", headers={"Content-Type": kind}), 422)


def test_what_is_damaged_is_no_form(client: TestClient) -> None:
    headers = {"Content-Type": "multipart/form-data; boundary=x"}
    refused(client.post("/calibrate?camera=bench", content=b"nonsense" * 100, headers=headers), 422)


def test_too_many_photographs_are_refused(client: TestClient, spool_dir: Path) -> None:
    refused(send(client, settings_part(), *[picture()] * 5), 413, None, "at most 4 photographs")
    assert folders(spool_dir) == []


def test_too_large_a_photograph_is_refused(client: TestClient, spool_dir: Path) -> None:
    refused(send(client, settings_part(), picture(content=PICTURE + bytes(50_000))), 413, "#/defocused", "50000")
    assert folders(spool_dir) == []


def test_too_many_bytes_are_refused(client: TestClient) -> None:
    parts = [picture(name=f"{number}.png", content=PICTURE + bytes(49_000)) for number in range(4)]
    assert send(client, settings_part(), *parts[:3]).status_code == 202
    refused(send(client, settings_part(), *parts, picture("focused", content=bytes(9_000))), 413, None, "200000")


def test_too_long_settings_are_refused(client: TestClient) -> None:
    refused(send(client, ("settings", (None, " " * 20_001, "application/json")), picture()), 413, None, "settings")


def test_a_full_queue_says_when_to_come_back(client: TestClient, fake: FakeCalibration, spool_dir: Path) -> None:
    fake.go.clear()
    first = send(client).headers["location"]
    assert fake.has_begun.wait(PATIENCE_S)
    waiting = [send(client).headers["location"] for _ in range(3)]
    answer = send(client)
    refused(answer, 503)
    assert int(answer.headers["retry-after"]) >= 1
    assert len(folders(spool_dir)) == 4
    fake.go.set()
    for path in (first, *waiting):
        assert ended(client, path)["state"] == "succeeded"
    assert send(client).status_code == 202


def test_a_folder_of_nobody_is_removed_at_start(settings: Settings, app: FastAPI) -> None:
    orphan = settings.spool_dir / uuid4().hex
    orphan.mkdir(parents=True)
    (orphan / "0000").write_bytes(b"half a pict")
    with TestClient(app):
        assert gone(settings.spool_dir)


def test_a_restart_goes_on_with_what_waits(settings: Settings) -> None:
    held = FakeCalibration(is_held=True)
    with TestClient(create_app(settings, held)) as client:
        paths = [send(client).headers["location"] for _ in range(2)]
        assert held.has_begun.wait(PATIENCE_S)
    with TestClient(create_app(settings, FakeCalibration())) as client:
        assert [ended(client, path)["state"] for path in paths] == ["succeeded", "succeeded"]
        assert gone(settings.spool_dir)


def test_twelve_megapixels_are_within_the_limits() -> None:
    settings = Settings()
    assert settings.max_image_pixels >= 4080 * 3072
    assert settings.max_calibration_bytes >= 40 * 12_000_000
    assert len(jpeg(corners())) < settings.max_image_bytes


def test_photographs_of_a_sheet_become_a_camera_that_depth_can_use(settings: Settings) -> None:
    """The calibration itself, from JPEG bytes to the registered camera and its plot."""
    whole = Settings(data_dir=settings.data_dir, model_dir=settings.model_dir)
    given: dict[str, JsonValue] = {
        "pattern": {"kind": GRID.kind, "rows": 7, "columns": 3, "spacing_mm": 26.0, "diameter_mm": 18.0},
        "register": True,
    }
    wide_open, stopped_down = (exif_of({}, {F_NUMBER: (number, 10)}) for number in (20, 56))
    photos = [(name, jpeg(rgb)) for name, _, rgb in sheet_photos(CAMERA, FEW_DEPTHS_M)]
    parts = [picture(name=f"{name}.jpg", content=with_exif(data, wide_open)) for name, data in photos]
    with TestClient(create_app(whole)) as client:
        response = send(client, settings_part(given), *parts, prefer="wait=60")
        assert response.status_code == 200, response.text
        found = response.json()
        assert found["state"] == "succeeded", found["problem"]
        assert [image["found"] for image in found["images"]] == [True] * len(FEW_DEPTHS_M)
        assert found["result"]["point_spread"] == "disc"
        camera = client.get("/cameras/bench").json()
        assert camera["k_cam_px"] == pytest.approx(CAMERA.k_cam_px, rel=0.04)
        assert camera["focus_distance_m"] == pytest.approx(CAMERA.focus_distance_m, rel=0.02)
        assert found["result"]["f_number"] == camera["f_number"] == 2.0
        for exif, is_told in ((wide_open, False), (stopped_down, True)):
            answer = client.post("/depth?camera=bench&format=json", content=with_exif(photos[0][1], exif))
            said = "its EXIF says f/5.6, the camera is f/2"
            assert (answer.status_code, said in answer.json()["warnings"]) == (200, is_told), answer.text
        plot = client.get(f"/calibrations/{found['id']}/plot.svg")
        assert (plot.status_code, plot.headers["content-type"]) == (200, "image/svg+xml")


def test_what_was_not_registered_is_accepted_later(client: TestClient) -> None:
    path = send(client, prefer="wait=20").headers["location"]
    assert client.get("/cameras").json()["items"] == []
    accepted = client.post(f"{path}/accept", json={})
    assert accepted.status_code == 200
    assert (accepted.json()["camera"], accepted.json()["camera_revision"]) == ("bench", 1)
    camera = client.get("/cameras/bench").json()
    assert (camera["source"], camera["k_cam_px"], camera["focus_distance_m"]) == ("calibration", 6.5, 1.5)
    assert camera["intrinsics"] == {**asdict(RESULT.intrinsics), "distortion": [0.125, -0.25, 0.0, 0.0, 0.5]}
    # an answer that was lost is asked for again
    assert client.post(f"{path}/accept", json={"camera": "bench"}).json() == accepted.json()
    assert client.get("/cameras/bench").json()["revision"] == 1


def test_what_an_older_version_found_is_read_drawn_and_accepted(app: FastAPI, client: TestClient) -> None:
    path = send(client, prefer="wait=20").headers["location"]
    found = client.get(path).json()["result"]
    since = {field.name for field in fields(RESULT) if field.default is not MISSING}
    assert {"corner_ratio", "f_number"} <= since
    older = {name: value for name, value in found.items() if name not in since - {"warnings"}}
    with writing(app.state.engine) as session:
        session.connection().execute(update(CalibrationRow).values(result=older))
    assert client.get(path).json()["result"] == {**found, "corner_ratio": None, "f_number": None}
    assert client.get(f"{path}/plot.svg").status_code == 200
    assert client.post(f"{path}/accept", json={}).json()["camera_revision"] == 1


def test_a_calibration_is_accepted_into_another_camera(client: TestClient, phone: dict[str, Any]) -> None:
    client.post("/cameras", json=phone | {"description": "kept"})
    path = send(client, prefer="wait=20").headers["location"]
    accepted = client.post(f"{path}/accept", json={"camera": "pixel7-wide"}).json()
    assert (accepted["camera"], accepted["camera_revision"]) == ("pixel7-wide", 2)
    assert client.get("/cameras/pixel7-wide").json()["description"] == "kept"
    refused(client.post(f"{path}/accept", json={"camera": "bench"}), 409, None, "pixel7-wide")


def test_what_has_no_result_is_not_accepted(client: TestClient, fake: FakeCalibration) -> None:
    fake.go.clear()
    path = send(client).headers["location"]
    refused(client.post(f"{path}/accept", json={}), 409, None, "no result")
    refused(client.post(f"{path}/accept", json={"camera": "no name"}), 422, "#/camera")
    refused(client.post(f"/calibrations/{'0' * 32}/accept", json={}), 404)


def test_what_is_being_received_waits_too(client: TestClient, app: FastAPI) -> None:
    with ExitStack() as arriving:
        for _ in range(3):
            arriving.enter_context(app.state.spool.receiving(uuid4().hex))
        refused(send(client), 503)
    assert send(client).status_code == 202
