"""A request that is sent again with its Idempotency-Key is done once."""

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from fastapi import FastAPI
from httpx2 import Response
from sqlalchemy import Engine, select, update
from sqlmodel import col
from starlette.testclient import TestClient

from service.api.camera_schemas import CameraCreate
from service.app import create_app
from service.config import Settings
from service.errors import Conflict, KeyReused
from service.optics.camera import Camera
from service.storage.calibrations import CalibrationDraft, Calibrations, StoredPicture
from service.storage.cameras import CameraDraft, Cameras
from service.storage.idempotency import KEPT, Once, once_of
from service.storage.tables import IdempotencyRow
from tests.fake_calibration import SETTINGS, FakeCalibration
from tests.inference.photographs import corners, png

CAMERA = {"name": "bench", "image_width_px": 4, "image_height_px": 3, "focus_distance_m": 1.0, "k_cam_px": 2.0}
DRAFT = CameraDraft("bench", Camera(640, 480, 1.5, 3.81), "given")
ONCE = Once("first-try", "0" * 64)
CALIBRATION = CalibrationDraft("0" * 32, "1" * 32, "bench", {}, (StoredPicture("near.png", "defocused"),))


@pytest.fixture
def app(settings: Settings) -> FastAPI:
    return create_app(settings, FakeCalibration())


def register(client: TestClient, key: str, **change: Any) -> Response:
    return client.post("/cameras", json=CAMERA | change, headers={"Idempotency-Key": key})


def calibrate(client: TestClient, key: str, content: bytes, camera: str = "bench") -> Response:
    files: list[tuple[str, tuple[str | None, bytes | str, str]]] = [
        ("settings", (None, json.dumps(SETTINGS), "application/json")),
        ("defocused", ("near.png", content, "image/png")),
    ]
    return client.post(f"/calibrate?camera={camera}", files=files, headers={"Idempotency-Key": key})


def forget(engine: Engine) -> None:
    """Let a day go by."""
    with engine.begin() as connection:
        connection.execute(update(IdempotencyRow).values(created_at=datetime.now(UTC) - KEPT - timedelta(seconds=1)))


def test_a_repeated_registration_answers_as_the_first(client: TestClient) -> None:
    first, again = register(client, "a"), register(client, "a")
    assert (first.status_code, again.status_code) == (201, 201)
    assert again.json() == first.json()
    assert (again.headers["etag"], again.headers["location"]) == ('"1"', "/cameras/bench")
    assert client.get("/cameras/bench").json()["revision"] == 1
    assert register(client, "b").status_code == 409


def test_it_answers_so_whatever_became_of_the_camera(client: TestClient) -> None:
    first = register(client, "a").json()
    body = {field: value for field, value in CAMERA.items() if field != "name"} | {"k_cam_px": 5.0}
    assert client.put("/cameras/bench", json=body).status_code == 200
    assert register(client, "a").json() == first
    assert client.delete("/cameras/bench").status_code == 204
    assert register(client, "a").json() == first
    assert client.get("/cameras/bench").status_code == 404


def test_a_field_that_a_later_version_adds_makes_no_other_request(app: FastAPI, client: TestClient) -> None:
    assert register(client, "a").status_code == 201
    sent = {field: CAMERA[field] for field in CameraCreate.model_fields if field in CAMERA}
    once = once_of("a", [b"POST /cameras", json.dumps(sent, separators=(",", ":")).encode()])
    with app.state.engine.connect() as connection:
        assert connection.scalar(select(col(IdempotencyRow.fingerprint))) == (once and once.fingerprint)


def test_another_request_with_the_same_key_is_refused(client: TestClient) -> None:
    assert register(client, "a").status_code == 201
    for answer in (register(client, "a", name="other"), calibrate(client, "a", png(corners()))):
        assert answer.status_code == 422
        assert answer.json()["type"] == "urn:camind:problem:idempotency-key-reused"
    assert client.get("/cameras/other").status_code == 404
    assert client.get("/calibrations").json()["items"] == []


@pytest.mark.parametrize("key", ["", "x" * 256, "with space", "é"])
def test_a_key_is_plain_text(client: TestClient, key: str) -> None:
    answer = client.post("/cameras", json=CAMERA, headers={b"Idempotency-Key": key.encode("latin-1")})
    assert answer.status_code == 422
    assert client.get("/cameras/bench").status_code == 404


def test_a_request_that_failed_may_be_mended_under_its_key(client: TestClient) -> None:
    assert register(client, "a", k_cam_px=-1).status_code == 422
    assert register(client, "a").status_code == 201


def test_a_repeated_calibration_is_the_first(client: TestClient, settings: Settings) -> None:
    first, again = calibrate(client, "a", png(corners())), calibrate(client, "a", png(corners()))
    assert (first.status_code, again.status_code) == (202, 202)
    assert again.headers["location"] == first.headers["location"]
    assert again.json()["id"] == first.json()["id"]
    assert len(client.get("/calibrations").json()["items"]) == 1
    kept = {path.name for path in settings.spool_dir.iterdir() if path.is_dir()}
    assert kept <= {first.json()["id"]}
    for other in (calibrate(client, "a", png(corners(20, 10))), calibrate(client, "a", png(corners()), "other")):
        assert other.status_code == 422


def test_a_repeated_calibration_finds_no_queue_full(settings: Settings) -> None:
    held = FakeCalibration(is_held=True)
    app = create_app(settings.model_copy(update={"calibration_queue_size": 1}), held)
    with TestClient(app) as client:
        assert calibrate(client, "a", png(corners())).status_code == 202
        assert held.has_begun.wait(15)
        first = calibrate(client, "b", png(corners()))
        assert first.status_code == 202
        assert calibrate(client, "c", png(corners())).status_code == 503
        again = calibrate(client, "b", png(corners()))
        assert (again.status_code, again.headers["location"]) == (202, first.headers["location"])
        assert calibrate(client, "b", png(corners()), "other").status_code == 422
        forget(app.state.engine)
        assert calibrate(client, "b", png(corners())).status_code == 503


def test_a_restart_forgets_nothing(settings: Settings) -> None:
    with TestClient(create_app(settings)) as client:
        first = register(client, "a").json()
    with TestClient(create_app(settings)) as client:
        assert register(client, "a").json() == first


def test_repeated_at_once_it_is_still_done_once(engine: Engine) -> None:
    cameras, calibrations = Cameras(engine), Calibrations(engine)
    drafts = [replace(CALIBRATION, id=f"{number:032x}") for number in range(6)]
    with ThreadPoolExecutor(6) as pool:
        added = list(pool.map(lambda _: cameras.add(DRAFT, ONCE), range(6)))
        queued = list(pool.map(lambda draft: calibrations.add(draft, replace(ONCE, key="other")), drafts))
    assert {record.revision for record in added} == {1}
    assert len({record.id for record in queued}) == 1
    assert len(calibrations.page(10)[0]) == 1


def test_owners_have_their_own_keys(engine: Engine) -> None:
    assert Cameras(engine, "lab").add(DRAFT, ONCE).revision == 1
    assert Cameras(engine, "shop").add(DRAFT, replace(ONCE, fingerprint="1" * 64)).revision == 1
    assert [Calibrations(engine, owner).has_done(ONCE.key) for owner in ("lab", "third", None)] == [True, False, False]


def test_a_new_key_makes_no_other_forgotten(engine: Engine) -> None:
    cameras = Cameras(engine)
    added = cameras.add(DRAFT, ONCE)
    cameras.add(replace(DRAFT, name="other"), Once("second-try", "1" * 64))
    Cameras(engine, "lab").add(DRAFT, replace(ONCE, fingerprint="1" * 64))
    assert cameras.add(DRAFT, ONCE) == added


def test_a_key_is_forgotten_after_a_day(engine: Engine) -> None:
    cameras = Cameras(engine)
    cameras.add(DRAFT, ONCE)
    forget(engine)
    with pytest.raises(Conflict):
        cameras.add(DRAFT, ONCE)
    cameras.add(replace(DRAFT, name="other"), replace(ONCE, fingerprint="1" * 64))
    with pytest.raises(KeyReused):
        cameras.add(DRAFT, ONCE)
    with engine.connect() as connection:
        assert connection.exec_driver_sql("SELECT count(*) FROM idempotency_keys").scalar() == 1


def test_a_camera_that_is_not_stored_leaves_no_key(engine: Engine) -> None:
    cameras = Cameras(engine)
    cameras.add(DRAFT)
    with pytest.raises(Conflict):
        cameras.add(DRAFT, ONCE)
    cameras.delete("bench")
    assert cameras.add(DRAFT, ONCE).revision == 2
