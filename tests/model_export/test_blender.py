"""Our renderer against ray-traced thin-lens pictures, which ``camind blender`` made; Blender itself is not run here."""

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from model_export.cases import photographed_cases
from model_export.datasets.blender import (
    EDGE_TOLERANCE,
    GAMMA_PX,
    Scene,
    compare_edge,
    develop,
    edge_sigma,
    edges,
    render,
    rooms,
    sharp_edge,
)
from model_export.datasets.blender_environment import environment, shares
from service.cores import available_cores
from service.optics import thin_lens
from service.optics.light import decode_srgb

RENDERS = Path(__file__).parent / "renders"
KEPT = [scene for scene in edges() if (RENDERS / f"{scene.name}.png").exists()]


@pytest.mark.parametrize("scene", KEPT, ids=lambda scene: str(scene.name))
def test_our_blur_is_that_of_a_ray_traced_lens(scene: Scene) -> None:
    raw = cv2.imread(str(RENDERS / f"{scene.name}.png"), cv2.IMREAD_UNCHANGED)
    assert raw is not None
    result = compare_edge(scene, np.asarray(raw, np.float32) / np.float32(65535))
    assert result.cycles_px == pytest.approx(result.expected_px, rel=0.01)
    assert result.ours_px == pytest.approx(result.cycles_px, rel=EDGE_TOLERANCE)


def test_edges_of_all_sizes_on_both_sides_are_kept() -> None:
    assert {scene.name.split("_")[1] for scene in KEPT} == {"near", "far"}
    assert {float(scene.name.split("_")[2]) for scene in KEPT} >= {0.5, 1, 10}


def test_a_wrong_blur_is_found() -> None:
    scene = next(s for s in KEPT if s.name == "edge_near_2")
    raw = cv2.imread(str(RENDERS / "edge_near_2.png"), cv2.IMREAD_UNCHANGED)
    light = np.asarray(raw, np.float32) / np.float32(65535)
    softer = np.asarray(cv2.GaussianBlur(light, (0, 0), 1.0), np.float32)
    assert edge_sigma(softer, 2.0) == pytest.approx(5**0.5, rel=0.02)
    assert compare_edge(scene, softer).cycles_px > 1.1 * compare_edge(scene, light).cycles_px


def test_rooms_become_a_set_with_their_cameras(tmp_path: Path) -> None:
    scenes = rooms(2, size_px=64)
    assert scenes == rooms(2, size_px=64)
    (tmp_path / "raw").mkdir()
    for scene in scenes:
        depth_m = np.full((64, 64), scene.focus_distance_m / 1.5, np.float32)
        depth_m[:, :8] = 100
        light = np.repeat(sharp_edge(64)[..., None], 3, axis=2)
        np.savez(tmp_path / "raw" / f"{scene.name}.npz", light=light, depth_m=depth_m)
    develop(tmp_path / "raw", scenes, tmp_path)
    found = list(photographed_cases(tmp_path, 2))
    assert [case.name for case in found] == [scene.name for scene in scenes]
    for case, scene in zip(found, scenes, strict=True):
        light = decode_srgb(np.asarray(case.image[..., 1] / 255, np.float32))
        beyond_box_px = math.sqrt(GAMMA_PX**2 - thin_lens.PIXEL_BOX_VARIANCE)
        assert edge_sigma(light, GAMMA_PX) == pytest.approx(beyond_box_px, rel=0.05)
        assert case.camera.gamma_px == GAMMA_PX
        assert case.camera.intrinsics is not None
        assert case.camera.intrinsics.fx_px == pytest.approx(scene.fx_px)
        assert np.isnan(case.truth_m[:, :8]).all()
        assert case.blur_px is not None
        sigma = thin_lens.defocus_from_blur(float(case.blur_px[30, 30]), GAMMA_PX)
        assert sigma == pytest.approx(0.5 * scene.k_cam_px, rel=5e-3)  # millimetres
    assert set(json.loads((tmp_path / "cameras.json").read_text())) == {scene.name for scene in scenes}


def test_every_core_has_its_share_of_the_scenes() -> None:
    parts = shares(rooms(5))
    assert len(parts) == min(5, available_cores())
    assert sorted((scene for part in parts for scene in part), key=lambda scene: scene.name) == rooms(5)
    assert max(map(len, parts)) - min(map(len, parts)) <= 1
    assert shares([]) == [[]]


def test_a_worker_that_fails_is_said(tmp_path: Path) -> None:
    broken = tmp_path / "python"
    broken.write_text("#!/bin/sh\necho no blender here\nexit 3\n")
    broken.chmod(0o755)
    with pytest.raises(ChildProcessError, match="no blender here"):
        render(broken, rooms(1), tmp_path / "out")


def test_an_environment_that_cannot_be_made_is_said_and_leaves_what_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = tmp_path / "python3.11"
    broken.write_text("#!/bin/sh\necho no room >&2\nexit 1\n")
    broken.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ChildProcessError, match="no room"):
        environment(tmp_path)
    assert broken.exists()


def test_a_missing_python_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(FileNotFoundError, match=r"python3\.11"):
        environment(tmp_path / "none")
