"""The model in the repository, through the real service: the README's requests, and metres that make sense."""

import io
import json
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from model_export import textures
from model_export.cases import fixed_cases, is_textured
from model_export.config import SceneConfig
from model_export.evaluate import Examiner
from model_export.evaluation_sets import FIXED
from model_export.render import refocus
from model_export.started_server import Server, serving
from model_export.summary import summarise
from model_export.textures import draw_texture
from service.config import INT8, SHIPPED_MODEL
from service.inference.artifact import load_model_folder
from service.inference.estimator import Estimator
from service.inference.pair import GraphPair, Side
from service.opencv import cv2
from service.optics.camera import Camera
from tests.d200 import D200

PICTURE = Path(__file__).parents[1] / "docs" / "pictures" / "coffee.jpg"
MAX_BYTES = 12_000_000
MAX_PEAK_BYTES = 600_000_000
LARGE_PICTURES_BYTES = 150_000_000
REFERENCE = Camera(640, 480, 2.0, 3.81, 0.5)
PLANES_M = (0.7, 1.0, 1.5)
ABOUT = 0.3


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with serving(tmp_path_factory.mktemp("shipped") / "data") as running:
        assert running.add(D200) == 201
        yield running


def ask(server: Server, picture: bytes, query: str = "") -> bytes:
    answer = server.ask("POST", f"/depth?camera=d200{query}", picture, {"Content-Type": "image/jpeg"})
    assert answer.status == 200, answer.body
    return answer.body


def test_the_folder_is_whole_small_and_says_where_it_comes_from() -> None:
    folder = load_model_folder(SHIPPED_MODEL)
    assert sum(file.stat().st_size for file in SHIPPED_MODEL.iterdir()) < MAX_BYTES
    assert "LICENCE" in folder.card().upper()
    assert folder.manifest.scores
    assert folder.manifest.ranges.k_cam_px.low == SceneConfig().k_cam_px[0]


def test_a_robots_client_is_answered_as_its_page_says(server: Server, tmp_path: Path) -> None:
    frame = cv2.imread(str(PICTURE))
    assert frame is not None
    size = (frame.shape[1], frame.shape[0])
    video = cv2.VideoWriter(str(tmp_path / "frames.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10, size)
    video.write(frame)
    video.release()
    page = (PICTURE.parents[1] / "robots.md").read_text()
    client = tmp_path / "frames.py"
    client.write_text(page.split("```python\n")[1].split("```")[0].replace("DEADLINE_S = 1.0", "DEADLINE_S = 60.0"))
    command: list[str | Path] = [sys.executable, client, server.url.rstrip("/"), "d200", tmp_path / "frames.avi"]
    answered = subprocess.run(command, capture_output=True, text=True, check=True)
    said = r"\d+\.\d{6}: \d+\.\d\d s old, \d+% of \(432, 64[45]\) sure, fx 96\d\.\d px\n"
    assert re.fullmatch(said, answered.stdout)
    assert not answered.stderr


def test_the_readmes_picture_becomes_a_16_bit_map_of_its_size(server: Server) -> None:
    raw = np.frombuffer(ask(server, PICTURE.read_bytes()), np.uint8)
    depth_mm = cv2.imdecode(raw, cv2.IMREAD_UNCHANGED)
    assert depth_mm is not None
    assert depth_mm.shape == (432, 645)
    assert depth_mm.dtype == np.uint16
    assert (depth_mm > 0).any()


def test_the_readmes_point_has_metres_and_their_error(server: Server) -> None:
    answer = json.loads(ask(server, PICTURE.read_bytes(), "&format=json&at=320,216"))
    point = answer["points"][0]
    assert (point["u"], point["v"]) == (320, 216)
    if point["depth_m"] is not None:
        assert 0 < point["sigma_m"] <= point["depth_m"]
    assert answer["depth_m"]["min"] > 0


def test_ten_frames_stay_below_600_megabytes(server: Server) -> None:
    assert server.add({**D200, "name": "robot", "image_width_px": 640, "image_height_px": 480}) == 201
    frame = cv2.imencode(".jpg", to_pixels(texture(1)))[1].tobytes()
    for _ in range(10):
        answer = server.ask("POST", "/depth?camera=robot", frame, {"Content-Type": "image/jpeg"})
        assert answer.status == 200
    assert server.peak_memory_bytes < MAX_PEAK_BYTES


def test_what_a_large_picture_took_is_given_back(server: Server) -> None:
    before = server.memory_bytes
    large = cv2.resize(to_pixels(texture(1))[:428], (2580, 1728))
    ask(server, cv2.imencode(".jpg", large)[1].tobytes())
    taken = server.memory_bytes
    assert taken > before + LARGE_PICTURES_BYTES
    deadline = time.monotonic() + 60
    while server.memory_bytes > taken - LARGE_PICTURES_BYTES:
        assert time.monotonic() < deadline, "it was never given back"
        time.sleep(0.2)


def texture(seed: int) -> NDArray[np.float32]:
    square = draw_texture(np.random.default_rng(seed), [], 640)
    return np.ascontiguousarray(square[:480])


def to_pixels(picture: NDArray[np.float32]) -> NDArray[np.uint8]:
    return (picture * 255 + 0.5).astype(np.uint8)


@pytest.fixture(scope="module")
def estimator() -> Estimator:
    return Estimator.from_folder(load_model_folder(SHIPPED_MODEL), intra_op_threads=1)


def test_either_precision_scores_what_its_card_says() -> None:
    cases = tuple(fixed_cases())
    for folder in (SHIPPED_MODEL, SHIPPED_MODEL / INT8):
        examiner = Examiner(folder)
        found = summarise(FIXED, "gt", [examiner.answer(case)[0] for case in cases])
        recorded = load_model_folder(folder).manifest.scores
        assert found.mean.abs_rel == pytest.approx(recorded["fixed.abs_rel"], rel=0.02)
        assert found.pooled.rmse == pytest.approx(recorded["fixed.rmse_m"], rel=0.02)


def test_int8_is_served_when_set_and_answers_nearly_the_same(server: Server, tmp_path: Path) -> None:
    with serving(tmp_path / "data", settings={"CAMIND_PRECISION": "int8"}) as small:
        assert small.ask("GET", "/model").json()["manifest"]["name"].endswith("-int8")
        assert small.add(D200) == 201
        maps = [np.load(io.BytesIO(ask(one, PICTURE.read_bytes(), "&format=npy"))) for one in (server, small)]
    change = np.abs(np.log(maps[1] / maps[0]))
    assert 0 < np.nanmedian(change) < 0.03


@pytest.mark.parametrize("side", ["near", "auto"])
def test_tiles_show_no_seams(side: Side) -> None:
    """A photograph read in tiles answers as when it is read at once, and is told its side alike."""
    small = cv2.imdecode(np.frombuffer(PICTURE.read_bytes(), np.uint8), cv2.IMREAD_COLOR_RGB)
    picture = np.asarray(cv2.resize(np.asarray(small), (1280, 800)), np.uint8)
    camera, pair = Camera(1280, 800, 2.0, 5.0, 0.6), GraphPair(load_model_folder(SHIPPED_MODEL), 1)
    whole, tiled = (Estimator(pair, budget).estimate(picture, camera, side).depth_m for budget in (1_100_000, 700_000))
    change = np.abs(np.log(np.divide(tiled, whole)))
    assert 0 < np.nanquantile(change, 0.98) < 0.01


def test_a_scene_is_read_as_the_same_one_larger_where_focus_is_nearer_than_the_model_knows(
    estimator: Estimator,
) -> None:
    """What focus distances say of sides goes on to mislead below those that were trained on."""
    picture = np.asarray(cv2.imdecode(np.frombuffer(PICTURE.read_bytes(), np.uint8), cv2.IMREAD_COLOR_RGB), np.uint8)
    part = picture[100:292, 200:456]
    nearest_m = estimator.manifest.ranges.focus_distance_m.low
    close, known = (estimator.estimate(part, Camera(256, 192, s, 8.0)).depth_m / s for s in (0.03, nearest_m))
    np.testing.assert_allclose(close, known, rtol=1e-5)


@pytest.mark.parametrize("seed", [0, 3, 4, 6])
def test_textured_planes_stand_in_their_order_and_about_where_they_stand(
    estimator: Estimator, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Leaves, noise and text that no training drew, by a camera it never met; ``camind evaluate`` measures."""
    monkeypatch.setattr(textures, "KIND_SHARES", {"leaves": 0.4, "noise": 0.2, "drawing": 0.4})
    assert is_textured(texture(seed))
    medians = []
    for depth_m in PLANES_M:
        plane = np.full((480, 640), depth_m, np.float32)
        picture = to_pixels(refocus(texture(seed), plane, REFERENCE))
        medians.append(float(np.nanmedian(estimator.estimate(picture, REFERENCE, "near").depth_m)))
    assert medians == sorted(medians)
    assert np.abs(np.divide(medians, PLANES_M) - 1).max() < ABOUT
