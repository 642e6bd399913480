"""Health, the model that answers, and what a restart keeps."""

import json
import shutil
from pathlib import Path

import pytest
from fastapi import FastAPI
from sqlalchemy import event
from starlette.testclient import TestClient

import migrations
from service.app import create_app
from service.config import DATABASE_FILE, Settings
from service.storage import schema


def test_a_started_service_is_live_and_ready(client: TestClient) -> None:
    assert client.get("/health/live").json() == {"status": "live"}
    answer = client.get("/health/ready")
    assert answer.status_code == 200
    assert answer.json() == {
        "status": "ready",
        "model": "oracle-20260101",
        "database": "writable",
        "schema": "head",
    }


def test_an_old_schema_is_not_ready(client: TestClient, app: FastAPI) -> None:
    schema.downgrade(app.state.engine)
    answer = client.get("/health/ready")
    assert answer.status_code == 503
    assert answer.headers["content-type"] == "application/problem+json"
    assert "camind migrate" in answer.json()["detail"]
    assert client.get("/health/live").status_code == 200


def test_a_later_version_that_is_installed_meanwhile_changes_nothing(
    app: FastAPI, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    installed = Path(shutil.copytree(Path(migrations.__file__).parent, tmp_path / "later"))
    later = f"revision, down_revision = 'later', {schema.head_revision()!r}\n"
    schema.head_revision.cache_clear()
    with TestClient(app) as client:
        (installed / "versions" / "later.py").write_text(later)
        monkeypatch.setattr(migrations, "__file__", str(installed / "__init__.py"))
        assert client.get("/health/ready").status_code == 200


@pytest.mark.parametrize("is_there", [True, False])
def test_a_database_that_was_replaced_is_not_ready(client: TestClient, settings: Settings, *, is_there: bool) -> None:
    database = settings.data_dir / DATABASE_FILE
    assert client.get("/health/ready").status_code == 200
    if is_there:
        Path(shutil.copy(database, settings.data_dir / "copy")).replace(database)
    else:
        database.rename(settings.data_dir / "elsewhere")
    answer = client.get("/health/ready")
    assert (answer.status_code, answer.json()["type"]) == (503, "urn:camind:problem:not-ready")
    assert "replaced" in answer.json()["detail"]


def test_a_database_that_takes_no_writes_is_not_ready(client: TestClient, app: FastAPI) -> None:
    # on every connection: the runner has one of its own
    event.listen(app.state.engine, "checkout", lambda connection, *_: connection.execute("PRAGMA query_only = ON"))
    answer = client.get("/health/ready")
    assert answer.status_code == 503
    assert answer.json()["type"] == "urn:camind:problem:not-ready"


def test_a_model_that_is_not_warm_is_not_ready(client: TestClient, app: FastAPI) -> None:
    app.state.is_warm = False
    assert client.get("/health/ready").status_code == 503


def test_the_model_shows_its_manifest_and_card(client: TestClient, tiny_model_dir: Path) -> None:
    answer = client.get("/model").json()
    assert answer["manifest"] == json.loads((tiny_model_dir / "manifest.json").read_text())
    assert answer["card"] == (tiny_model_dir / "MODEL_CARD.md").read_text()


def test_a_stopped_service_starts_again_with_its_cameras(app: FastAPI, settings: Settings) -> None:
    body = {"image_width_px": 4, "image_height_px": 3, "focus_distance_m": 1, "k_cam_px": 2}
    with TestClient(app) as client:
        assert client.post("/cameras", json={"name": "kept", **body}).status_code == 201
    with TestClient(app) as client:
        assert client.get("/cameras/kept").json()["k_cam_px"] == 2
    assert (settings.data_dir / "camind.sqlite3").is_file()


def test_a_shared_database_is_migrated_by_hand(settings: Settings, postgres_url: str) -> None:
    app = create_app(settings.model_copy(update={"database_url": postgres_url}))
    body = {"image_width_px": 4, "image_height_px": 3, "focus_distance_m": 1, "k_cam_px": 2}
    with TestClient(app) as client:
        assert client.get("/health/ready").status_code == 503
        assert client.post("/cameras", json={"name": "kept", **body}).status_code == 503
        schema.upgrade(app.state.engine)
        assert client.get("/health/ready").status_code == 200
        assert client.post("/cameras", json={"name": "kept", **body}).status_code == 201
        assert client.get("/cameras/kept").json()["k_cam_px"] == 2
        assert client.get("/cameras/a%00b").status_code == 404
