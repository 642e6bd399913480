"""Whatever JSON is sent, the answer is a camera or a problem, and what is stored can be read."""

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from starlette.testclient import TestClient

from service.app import create_app
from service.config import Settings

numbers = st.one_of(st.floats(), st.integers(), st.floats(1e-3, 1e3), st.just(0))
values = st.one_of(numbers, st.text(max_size=5), st.none(), st.booleans(), st.just([]), st.just({}))
lenses = st.fixed_dictionaries(
    {"focal_length_mm": numbers, "f_number": numbers, "pixel_pitch_um": numbers, "sensor_width_px": numbers},
    optional={"k_r": numbers, "focal_length_35mm": numbers},
)
cameras = st.fixed_dictionaries(
    {
        "name": st.one_of(st.just("fuzzed"), st.text(max_size=5)),
        "image_width_px": st.one_of(st.integers(1, 9_000), numbers),
        "image_height_px": st.one_of(st.integers(1, 9_000), values),
        "focus_distance_m": numbers,
    },
    optional={"k_cam_px": numbers, "lens": st.one_of(lenses, values), "gamma_px": numbers, "description": values},
)


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory, tiny_model_dir: Path) -> Iterator[TestClient]:
    data_dir = tmp_path_factory.mktemp("data")
    app = create_app(Settings(data_dir=data_dir, model_dir=tiny_model_dir, workers=1, intra_op_threads=1))
    with TestClient(app) as client:
        yield client


@settings(max_examples=150)
@given(body=cameras)
def test_any_camera_is_stored_or_refused(running: TestClient, body: dict[str, Any]) -> None:
    content = json.dumps(body)
    answer = running.post("/cameras", content=content, headers={"Content-Type": "application/json"})
    assert answer.status_code in (201, 422)
    if answer.status_code == 422:
        assert answer.headers["content-type"] == "application/problem+json"
        return
    location = answer.headers["location"]
    assert running.get(location).json() == answer.json()
    curve = running.get(f"{location}/curve?points=5").json()
    assert all(math.isfinite(value) for point in curve["points"] for value in point.values())
    assert running.delete(location).status_code == 204


@settings(max_examples=100)
@given(near=st.floats(), far=st.floats(), points=st.integers())
def test_any_curve_is_drawn_or_refused(running: TestClient, near: float, far: float, points: int) -> None:
    body = {"name": "curved", "image_width_px": 4, "image_height_px": 3, "focus_distance_m": 1, "k_cam_px": 2}
    running.post("/cameras", json=body)
    answer = running.get(f"/cameras/curved/curve?near_m={near}&far_m={far}&points={points}")
    assert answer.status_code in (200, 422)
    for point in answer.json().get("points", []):
        assert all(math.isfinite(value) for value in point.values())
