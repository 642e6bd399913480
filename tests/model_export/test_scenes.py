"""Procedural scenes: the same seed is the same scene, and every scene is what its shot says."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from model_export import scenes
from model_export.config import SceneConfig
from model_export.scenes import Sharpening, develop, draw_sample, draw_shot, true_blur_px

CONFIG = SceneConfig(size_px=64, margin_px=24)
SEEDS = range(30)


def test_a_seed_is_a_scene() -> None:
    first, again, other = draw_sample(5, CONFIG), draw_sample(5, CONFIG), draw_sample(6, CONFIG)
    assert first.shot == again.shot
    np.testing.assert_array_equal(first.image, again.image)
    np.testing.assert_array_equal(first.excess, again.excess)
    assert not np.array_equal(first.image, other.image)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_scene_keeps_to_its_ranges(seed: int) -> None:
    sample = draw_sample(seed, CONFIG)
    shot, excess = sample.shot, sample.excess.astype(np.float32)
    assert sample.image.shape == (3, 64, 64)
    assert CONFIG.k_cam_px[0] <= shot.k_cam_px <= CONFIG.k_cam_px[1]
    assert CONFIG.gamma_px[0] <= shot.gamma_px <= CONFIG.gamma_px[1]
    ratio = 1 / (1 + excess)
    assert ratio.min() > CONFIG.depth_ratio[0] * 0.99
    assert ratio.max() < CONFIG.depth_ratio[1] * 1.01
    assert true_blur_px(sample).max() <= np.hypot(CONFIG.defocus_px[1], shot.gamma_px) * 1.01
    if shot.side < 0:
        assert excess.min() >= 0
    if shot.side > 0:
        assert excess.max() <= 0


def test_all_sides_and_lens_shapes_turn_up() -> None:
    shots = [draw_sample(seed, SceneConfig(size_px=32, margin_px=8)).shot for seed in range(60)]
    assert {shot.side for shot in shots} == {-1, 0, 1}
    assert {0.0, 1.0} < {shot.spread.disc_share for shot in shots}


def test_some_scenes_are_nothing_but_a_level_wall(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scenes, "LEVEL_SHARE", 1.0)
    monkeypatch.setattr(scenes, "RESCALED_SHARE", 0.0)
    for seed in range(4):
        assert np.ptp(draw_sample(seed, replace(CONFIG, wall_share=1.0)).excess) == 0


@pytest.mark.parametrize("seed", range(6))
def test_noise_is_left_out_or_alike_in_all_colours_where_it_is_asked_for(seed: int) -> None:
    grey = np.full((32, 32, 3), 0.2, np.float32)

    def deviations(config: SceneConfig) -> NDArray[np.float64]:
        pixels = develop(np.random.default_rng(seed), grey, config, Sharpening(), through_mosaic=False)
        return np.asarray(pixels - pixels.mean((0, 1)), np.float64)

    plain = replace(CONFIG, jpeg_quality=(100, 100))
    assert deviations(replace(plain, clean_share=1.0)) == pytest.approx(0, abs=0.01)
    alike, apart = (np.ptp(deviations(replace(plain, grey_share=share)), 2).mean() for share in (1.0, 0.0))
    assert alike < max(1.0, 0.5 * apart)  # white balance and rounding remain


def test_most_lenses_blur_red_and_blue_more_before_the_focus_than_beyond() -> None:
    rng = np.random.default_rng(0)
    shifts = [shift for _ in range(400) for shift in draw_shot(rng, CONFIG).spread.chromatic_px if shift]
    nearer_blurrier = np.array(shifts) < 0  # moves signed defocus, which is negative before the focus
    assert 0.75 < nearer_blurrier.mean() < 0.98


@pytest.mark.parametrize(
    ("focus_m", "nearer", "beyond"), [(0.3, (0.02, 0.15), (0.3, 0.5)), (5.0, (0.3, 0.5), (0.02, 0.15))]
)
def test_beyond_a_close_focus_lies_what_is_seen_and_before_a_distant_one(
    focus_m: float, nearer: tuple[float, float], beyond: tuple[float, float]
) -> None:
    rng = np.random.default_rng(0)
    config = SceneConfig(focus_distance_m=(focus_m, focus_m))
    sides = np.array([draw_shot(rng, config).side for _ in range(400)])
    for side, (low, high) in ((-1, nearer), (1, beyond), (0, (0.45, 0.65))):
        assert low < (sides == side).mean() < high


@pytest.mark.parametrize(("focus_m", "beyond"), [(0.3, (0.65, 0.95)), (2.0, (0.3, 0.7)), (5.0, (0.05, 0.35))])
def test_where_both_sides_are_seen_the_focus_says_how_much_of_each(focus_m: float, beyond: tuple[float, float]) -> None:
    config = SceneConfig(size_px=32, margin_px=8, focus_distance_m=(focus_m, focus_m))
    samples = [sample for sample in (draw_sample(seed, config) for seed in range(80)) if sample.shot.side == 0]
    low, high = beyond
    assert low < np.mean([(sample.excess < 0).mean() for sample in samples]) < high
