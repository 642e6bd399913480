"""A database without room, or that takes no writes, is said so; what was answered with an error was not stored.

``PRAGMA max_page_count`` makes SQLite itself refuse to grow the file, and ``PRAGMA query_only`` to write to it: both
are its own errors, as of a full disk and a read-only file, and need no rights that a developer lacks (and to root, no
file is read-only). The faults of real file systems are in tests/test_full_disk.py.
"""

import json
import sqlite3
from collections.abc import Iterator
from typing import Any

import pytest
from fastapi import FastAPI
from sqlalchemy import event
from starlette.testclient import TestClient

from service.app import create_app
from service.config import Settings
from service.storage.engine import open_engine
from service.storage.keys import Keys
from tests.fake_calibration import SETTINGS, FakeCalibration
from tests.inference.photographs import corners, png

UNLIMITED_PAGES = 2**30
MOST_CAMERAS = 50
FULL, UNWRITABLE = "urn:camind:problem:insufficient-storage", "urn:camind:problem:not-ready"


class Fault:
    """What every connection is told before it is used."""

    def __init__(self) -> None:
        self.is_full = False
        self.is_read_only = False

    def __call__(self, connection: sqlite3.Connection, *_: object) -> None:
        # SQLite takes the file's size for a limit that is smaller
        connection.execute(f"PRAGMA max_page_count = {1 if self.is_full else UNLIMITED_PAGES}")
        connection.execute(f"PRAGMA query_only = {self.is_read_only}")


@pytest.fixture
def calibrate() -> FakeCalibration:
    return FakeCalibration()


@pytest.fixture
def app(settings: Settings, calibrate: FakeCalibration) -> FastAPI:
    return create_app(settings, calibrate)


@pytest.fixture
def fault(client: TestClient, app: FastAPI) -> Iterator[Fault]:
    assert client.get("/health/ready").status_code == 200
    made = Fault()
    event.listen(app.state.engine, "checkout", made)
    yield made
    made.is_full = made.is_read_only = False


def camera(name: str) -> dict[str, Any]:
    size = {"image_width_px": 4, "image_height_px": 3, "focus_distance_m": 1.0}
    return {"name": name, **size, "k_cam_px": 2.0, "description": "x" * 1000}


def post_calibration(client: TestClient, *, register: bool = False) -> Any:
    settings = json.dumps({**SETTINGS, "register": register})
    files = [("settings", (None, settings, "application/json"))]
    # the names fill a page
    pictures = [("defocused", (f"{number}{'y' * 90}.png", png(corners()), "image/png")) for number in range(60)]
    return client.post("/calibrate?camera=bench", files=[*files, *pictures])


def fill(client: TestClient) -> list[str]:
    """Register cameras until there is no room for one more; their names."""
    stored: list[str] = []
    for number in range(MOST_CAMERAS):
        answer = client.post("/cameras", json=camera(f"camera-{number:02d}"))
        if answer.status_code != 201:
            assert (answer.status_code, answer.json()["type"]) == (507, FULL)
            return stored
        stored.append(f"camera-{number:02d}")
    raise AssertionError("the database never was full")


def test_a_full_database_refuses_and_recovers(client: TestClient, fault: Fault, app: FastAPI) -> None:
    fault.is_full = True
    stored = fill(client)
    assert stored
    refused = client.put(f"/cameras/{stored[0]}", json={key: camera("")[key] for key in camera("") if key != "name"})
    assert (refused.status_code, refused.json()["type"]) == (507, FULL)
    refused = post_calibration(client)
    assert (refused.status_code, refused.json()["type"]) == (507, FULL)
    assert app.state.spool.ids() == []
    assert client.get("/calibrations").json()["items"] == []
    # what was not refused is there, and nothing else
    assert [item["name"] for item in client.get("/cameras").json()["items"]] == stored
    assert client.get(f"/cameras/{stored[0]}").json()["revision"] == 1
    fault.is_full = False
    assert client.post("/cameras", json=camera("with-room")).status_code == 201
    assert post_calibration(client).status_code == 202


def test_a_database_that_takes_no_writes_is_still_read(client: TestClient, fault: Fault, app: FastAPI) -> None:
    assert client.post("/cameras", json=camera("there")).status_code == 201
    keys = Keys(app.state.engine)
    _, key = keys.create("robot", "lab")
    fault.is_read_only = True
    replaced = {key: camera("")[key] for key in camera("") if key != "name"}
    for answer in (
        client.post("/cameras", json=camera("new")),
        client.put("/cameras/there", json=replaced),
        client.delete("/cameras/there"),
        post_calibration(client),
        client.get("/health/ready"),
    ):
        assert (answer.status_code, answer.json()["type"]) == (503, UNWRITABLE)
    assert client.get("/cameras/there").status_code == 200
    assert keys.find(key) is not None
    assert app.state.spool.ids() == []
    fault.is_read_only = False
    assert client.get("/health/ready").status_code == 200
    assert client.delete("/cameras/there").status_code == 204
    assert post_calibration(client).status_code == 202


@pytest.mark.parametrize("calibrate", [FakeCalibration(is_held=True)])
def test_a_running_calibration_waits_for_room(client: TestClient, fault: Fault, calibrate: FakeCalibration) -> None:
    path = post_calibration(client, register=True).headers["location"]
    assert calibrate.has_begun.wait(15)
    fault.is_full = True
    fill(client)
    calibrate.go.set()
    # the queue is looked at, and the end written, again and again
    assert client.get(path).json()["state"] == "running"
    with client.stream("GET", f"{path}/events") as events:
        fault.is_full = False
        last = [line for line in events.iter_lines() if line.startswith("data:")][-1]
    ended = json.loads(last.removeprefix("data:"))
    assert (ended["state"], ended["camera_revision"]) == ("succeeded", 1)
    assert client.get("/cameras/bench").json()["source"] == "calibration"


def test_a_full_postgresql_is_said_so(settings: Settings, postgres_url: str) -> None:
    """A trigger raises what the server raises when its disk is full: it is the server's error all the same."""
    from service.storage import schema

    engine = open_engine(postgres_url)
    schema.upgrade(engine)
    with engine.begin() as connection:
        connection.exec_driver_sql(
            "CREATE FUNCTION fill() RETURNS trigger LANGUAGE plpgsql AS "
            "$$ BEGIN RAISE EXCEPTION 'could not extend file' USING ERRCODE = 'disk_full'; END $$"
        )
        for table in ("cameras", "calibrations"):
            connection.exec_driver_sql(
                f"CREATE TRIGGER fill BEFORE INSERT ON {table} FOR EACH ROW EXECUTE FUNCTION fill()"
            )
    app = create_app(settings.model_copy(update={"database_url": postgres_url}), FakeCalibration())
    with TestClient(app) as client:
        for answer in (client.post("/cameras", json=camera("a")), post_calibration(client)):
            assert (answer.status_code, answer.json()["type"]) == (507, FULL)
        with engine.begin() as connection:
            for table in ("cameras", "calibrations"):
                connection.exec_driver_sql(f"DROP TRIGGER fill ON {table}")
        assert client.post("/cameras", json=camera("a")).status_code == 201
        assert post_calibration(client).status_code == 202
    engine.dispose()
