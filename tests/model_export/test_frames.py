"""A sharp picture with depth is photographed by the camera that training drew."""

from dataclasses import replace

import numpy as np
import pytest

from model_export.config import SceneConfig
from model_export.frames import Frame, draw_crop, draw_frame
from model_export.render import sliced
from model_export.scenes import Material, draw_sample, true_blur_px

CONFIG = SceneConfig(size_px=64, margin_px=16)


def frame(near_m: float = 1.0, far_m: float = 3.0, size: tuple[int, int] = (120, 160)) -> Frame:
    """Noise, its left half nearer than its right one."""
    image = np.random.default_rng(0).integers(0, 255, (*size, 3), np.uint8)
    depth_m = np.full(size, far_m, np.float16)
    depth_m[:, : size[1] // 2] = near_m
    return Frame(image, depth_m, 130.0)


@pytest.mark.parametrize("size", [96, 200])
def test_a_view_shows_what_it_says_the_depth_of(size: int) -> None:
    shown = np.where(frame().depth_m > 2, 200, 20).astype(np.uint8)
    dark_left = replace(frame(), image=shown[..., None].repeat(3, 2))
    for seed in range(20):
        crop = draw_crop(np.random.default_rng(seed), dark_left, size)
        light, depth_m = crop.light, crop.depth_m
        assert light.shape == (size, size, 3)
        assert 0.65 * 130 <= crop.focal_length_px <= 130
        dark = light[..., 1] < light[..., 1].max() / 4 if np.ptp(depth_m) > 0 else depth_m < 2
        assert (dark == (depth_m < 2)).mean() > 0.97  # all but the edge


def test_a_frame_is_not_made_smaller_than_a_window_of_it() -> None:
    """At 0.65 of its size this one is 78 pixels high."""
    grown = [draw_crop(np.random.default_rng(seed), frame(), 114).focal_length_px / 130 for seed in range(20)]
    assert min(grown) >= 0.95
    assert max(grown) > 0.98


def test_frames_that_look_far_are_drawn_more_often() -> None:
    """One that looks sixteen times as far 32 times as often."""
    near, far = frame(0.25, 0.25), frame(4.0, 4.0)
    rng = np.random.default_rng(0)
    share = np.mean([draw_frame(rng, [near, far]) is far for _ in range(2000)])
    assert share == pytest.approx(32 / 33, abs=0.012)


def test_frames_are_half_of_the_scenes_and_keep_their_metres() -> None:
    material = Material(frames=[frame()])
    samples = [draw_sample(seed, CONFIG, material) for seed in range(40)]
    framed = [s for s in samples if 0.65 * 130 <= s.shot.focal_length_px <= 130]
    assert 10 <= len(framed) <= 30
    for sample in framed:
        depth_m = sample.shot.focus_distance_m / (1 + sample.excess.astype(np.float32))
        near = np.isclose(depth_m, 1.0, rtol=0.02) | np.isclose(depth_m, 3.0, rtol=0.02)
        assert near.mean() > 0.95
        assert CONFIG.focus_distance_m[0] <= sample.shot.focus_distance_m <= CONFIG.focus_distance_m[1]
        assert np.quantile(true_blur_px(sample), 0.9) <= np.hypot(CONFIG.defocus_px[1], CONFIG.gamma_px[1]) * 1.01


def test_without_frames_scenes_are_what_they_were() -> None:
    one, other = draw_sample(3, CONFIG), draw_sample(3, CONFIG, Material())
    np.testing.assert_array_equal(one.image, other.image)


def test_a_sharp_picture_in_layers_is_the_picture() -> None:
    """Put over each other unblurred, the layers show what they were cut from, nearest first."""
    light = np.random.default_rng(1).random((32, 40, 3), np.float32)
    defocus_px = np.linspace(-8, 8, 40, dtype=np.float32)[None].repeat(32, 0)
    layers, index = sliced(light, defocus_px)
    assert len(layers) > 3
    assert (np.diff(index, axis=1) >= 0).all()
    seen = np.zeros_like(light)
    for layer in reversed(layers):
        alpha = layer.alpha[0].numpy()[..., None]
        seen = seen * (1 - alpha) + layer.color.numpy().transpose(1, 2, 0)
        assert layer.defocus_px.shape == (32, 40)
    np.testing.assert_allclose(seen, light)
    assert layers[-1].alpha.min() == 1
