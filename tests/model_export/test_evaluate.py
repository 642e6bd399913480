"""Evaluation, with a pair whose answers are known."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from model_export.cli import commands
from model_export.evaluate import Case, answer, d200_cases, summarise
from service.inference.artifact import load_model_folder
from service.inference.estimator import Estimator
from service.optics import thin_lens
from service.optics.camera import Camera
from tests.inference.oracle_pair import blur_of

CAMERA = Camera(96, 64, 2.0, 6.0, 0.5)
LEVEL = 90


@pytest.fixture(scope="module")
def oracle(tiny_model_dir: Path) -> Estimator:
    return Estimator.from_folder(load_model_folder(tiny_model_dir))


def case(factor: float) -> Case:
    """A grey picture whose depth the oracle knows, and a truth that is that depth times a factor."""
    x = thin_lens.relative_defocus_from_blur(blur_of(LEVEL), CAMERA.gamma_px, CAMERA.k_cam_px)
    truth = np.full((64, 96), thin_lens.depth_near(x, CAMERA.focus_distance_m) * factor, np.float32)
    truth[:, :10] = np.nan
    return Case("grey", np.full((64, 96, 3), LEVEL, np.uint8), truth, CAMERA, "near")


def test_a_right_answer_scores_nothing_and_a_wrong_one_its_error(oracle: Estimator) -> None:
    assert answer(oracle, case(1.0)).scores.abs_rel == pytest.approx(0, abs=1e-3)
    assert answer(oracle, case(2.0)).scores.abs_rel == pytest.approx(0.5, abs=1e-3)


def test_a_summary_is_pooled_and_averaged(oracle: Estimator) -> None:
    summary = summarise("two", [answer(oracle, case(1.0)), answer(oracle, case(2.0))])
    assert summary.pictures == 2
    assert summary.answered == 1
    assert summary.mean.abs_rel == summary.pooled.abs_rel == pytest.approx(0.25, abs=1e-3)
    with pytest.raises(ValueError, match="no picture"):
        summarise("none", [])


def write_photo(folder: Path, name: str, depth_mm: int) -> None:
    for part in ("color", "depth"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    depth = np.full((480, 640), depth_mm, np.uint16)
    depth[:, 320:] *= 2
    cv2.imwrite(str(folder / "color" / f"{name}.png"), rng.integers(0, 255, (480, 640, 3), np.uint8))
    cv2.imwrite(str(folder / "depth" / f"{name}.png"), depth)


def test_real_lenses_are_scored_away_from_steps(tmp_path: Path) -> None:
    write_photo(tmp_path, "one", 1000)
    (found,) = d200_cases(tmp_path, 1)
    scored = np.isfinite(found.truth_m)
    assert not scored[:, 296:344].any()
    assert scored[:, :290].all()
    assert found.camera.k_cam_px == pytest.approx(1.5326 * 640 / 645, rel=1e-3)


def test_the_command_prints_and_writes_what_it_found(tmp_path: Path, tiny_model_dir: Path) -> None:
    write_photo(tmp_path / "data" / "rgbd", "one", 900)
    out = tmp_path / "report"
    arguments = ["--data", tmp_path / "data", "--model", tiny_model_dir, "--quick", "--out", out]
    result = CliRunner().invoke(commands, ["evaluate", *map(str, arguments)])
    assert result.exit_code == 0, result.output
    assert "best constant" in " ".join(result.output.split()) or "constant" in result.output
    report = json.loads((out / "report.json").read_text())
    assert report["sets"]["rgbd"]["pictures"] == 1
    assert (out / "rgbd.png").exists()
