"""What ``GET /metrics`` says of requests, queues, slots, calibrations, refusals and the process when it is asked."""

import threading
import time
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI
from prometheus_client.parser import text_string_to_metric_families
from starlette.testclient import TestClient

from model_export.started_server import serving
from service import errors
from service.app import create_app
from service.config import Settings
from service.inference.cancellation import Cancellation
from service.storage import schema
from service.storage.calibrations import CalibrationDraft, Calibrations
from tests.fake_calibration import SETTINGS, FakeCalibration, calibration_form
from tests.inference.photographs import corners, png

Labels = tuple[tuple[str, str], ...]


def figures(text: str) -> dict[tuple[str, Labels], float]:
    """Every sample of an exposition, by name and labels."""
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def figure(client: TestClient, name: str, **labels: str) -> float:
    return figures(client.get("/metrics").text)[name, tuple(sorted(labels.items()))]


@pytest.fixture
def released() -> Iterator[threading.Event]:
    event = threading.Event()
    yield event
    event.set()


def test_metrics_count_by_path_template(client: TestClient, phone: dict[str, Any]) -> None:
    client.post("/cameras", json=phone)
    for name in ("pixel7-wide", "a", "b"):
        client.get(f"/cameras/{name}")
    client.get("/wp-admin")
    client.request("BREW", "/coffee")
    answer = client.get("/metrics")
    assert answer.headers["content-type"].startswith("text/plain; version=")
    lines = answer.text.splitlines()
    assert 'camind_requests_total{method="GET",path="/cameras/{name}",status="200"} 1.0' in lines
    assert 'camind_requests_total{method="GET",path="/cameras/{name}",status="404"} 2.0' in lines
    assert 'camind_requests_total{method="GET",path="unmatched",status="404"} 1.0' in lines
    assert 'camind_requests_total{method="other",path="unmatched",status="404"} 1.0' in lines
    assert "wp-admin" not in answer.text
    assert "process_resident_memory_bytes" in answer.text


def test_slots_and_queue_are_as_they_are_now(client: TestClient, app: FastAPI, released: threading.Event) -> None:
    worker = app.state.worker
    has_begun = threading.Event()

    def hold(_: Cancellation) -> None:
        has_begun.set()
        released.wait(10)

    async def run() -> None:
        await worker.run(None, hold)

    assert figure(client, "camind_depth_slots") == worker.slots == 1
    assert figure(client, "camind_depth_queue_size") == worker.queue_size == 16
    assert figure(client, "camind_depth_slots_in_use") == figure(client, "camind_depth_queue_depth") == 0
    portal = client.portal
    assert portal is not None
    running = [portal.start_task_soon(run) for _ in range(3)]
    assert has_begun.wait(5)
    while worker.in_flight < len(running):
        pass
    assert figure(client, "camind_depth_slots_in_use") == 1
    assert figure(client, "camind_depth_queue_depth") == 2
    assert figure(client, "camind_depth_in_flight") == 3
    released.set()
    for task in running:
        task.result(5)
    assert figure(client, "camind_depth_queue_wait_seconds_count") == 3
    assert figure(client, "camind_depth_queue_depth") == 0


def test_a_wait_is_told_of_refused_photographs_too(client: TestClient, phone: dict[str, Any]) -> None:
    client.post("/cameras", json=phone)
    answer = client.post(
        "/depth?camera=pixel7-wide", content=png(corners(40, 90)), headers={"Content-Type": "image/png"}
    )
    assert answer.status_code == 422
    assert figure(client, "camind_depth_queue_wait_seconds_count") == 1


def test_the_time_of_each_stage_is_told_in_seconds(client: TestClient, phone: dict[str, Any]) -> None:
    client.post("/cameras", json=phone)
    started_s = time.perf_counter()
    answer = client.post("/depth?camera=pixel7-wide", content=png(corners()), headers={"Content-Type": "image/png"})
    took_s = time.perf_counter() - started_s
    assert answer.status_code == 200
    stages = ("decode", "wait", "blur", "correct", "depth", "encode")
    assert 0 < sum(figure(client, "camind_depth_stage_seconds_sum", stage=stage) for stage in stages) < took_s


def test_calibrations_are_counted_by_state(client: TestClient, app: FastAPI) -> None:
    spool, calibrations = app.state.spool.id, Calibrations(app.state.engine)
    app.state.runner.close()
    for number in range(3):
        calibrations.add(CalibrationDraft(f"{number:032x}", spool, "bench", SETTINGS, ()))
    calibrations.add(CalibrationDraft(f"{9:032x}", "another process", "bench", SETTINGS, ()))
    calibrations.take(spool)
    assert figure(client, "camind_calibrations", state="queued") == 2
    assert figure(client, "camind_calibrations", state="running") == 1
    assert figure(client, "camind_calibration_queue_size") == 8


def test_the_version_that_runs_is_told(client: TestClient) -> None:
    assert figure(client, "camind_build_info", version=version("camind")) == 1


@pytest.mark.parametrize(("outcome", "defects"), [(lambda: 1 / 0, 1), (lambda: None, 0)])
def test_a_defect_that_ends_a_calibration_is_counted_and_poor_photographs_are_not(
    settings: Settings, outcome: Callable[[], Any], defects: int
) -> None:
    with TestClient(create_app(settings, FakeCalibration(outcome))) as client:
        form = calibration_form(png(corners()))
        kind = {"Content-Type": form.headers["content-type"], "Prefer": "wait=20"}
        answer = client.post("/calibrate?camera=bench", content=form.content, headers=kind)
        assert answer.json()["state"] == "failed"
        assert figure(client, "camind_problems_total", code="internal-error") == defects


def test_a_database_that_cannot_be_asked_hides_no_other_figure(client: TestClient, app: FastAPI) -> None:
    app.state.runner.close()
    schema.downgrade(app.state.engine)
    found = figures(client.get("/metrics").text)
    assert ("camind_depth_slots", ()) in found
    assert not [name for name, _ in found if name == "camind_calibrations"]


def test_refusals_are_counted_by_code_alone(client: TestClient, phone: dict[str, Any]) -> None:
    for name in ("a", "b"):
        client.get(f"/cameras/{name}")
    client.head("/cameras/c")
    client.post("/cameras", json={**phone, "name": "?"})
    client.post("/cameras", content=b"{}" + b" " * 30_000, headers={"Content-Type": "application/json"})
    client.get("/health/live")
    found = {
        labels: value
        for (name, labels), value in figures(client.get("/metrics").text).items()
        if name == "camind_problems_total" and value
    }
    assert found == {
        (("code", errors.NotFound.code),): 3,
        (("code", errors.BadRequest.code),): 1,
        (("code", errors.TooLarge.code),): 1,
    }


@pytest.mark.parametrize("code", ["internal-error", "busy", "invalid-image"])
def test_every_problem_is_counted_from_0_so_that_the_first_is_an_increase(client: TestClient, code: str) -> None:
    assert figure(client, "camind_problems_total", code=code) == 0


def test_what_is_no_http_is_counted_and_the_process_is_measured(tmp_path: Path, tiny_model_dir: Path) -> None:
    with serving(tmp_path / "data", "--model", tiny_model_dir) as server:
        with server.connect() as connection:
            connection.sendall(b"no HTTP at all\r\n\r\n")
            assert connection.recv(100).startswith(b"HTTP/1.1 400")
        found = figures(server.ask("GET", "/metrics").body.decode())
    assert found["camind_problems_total", (("code", "malformed-request"),)] == 1
    assert found["camind_problems_total", (("code", "headers-too-large"),)] == 0
    assert 30e6 < found["process_resident_memory_bytes", ()] < 2e9
    assert 0 < found["process_open_fds", ()] < found["process_max_fds", ()]
    assert found["camind_model_info", (("name", "oracle-20260101"),)] == 1
