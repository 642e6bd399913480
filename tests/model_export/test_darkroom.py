"""Pictures taken on the training device are those of the renderer and the developer, many at a time."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from model_export.config import SceneConfig, TrainConfig
from model_export.darkroom import (
    _areas,
    _Surfaces,
    _through_mosaic,
    compressed,
    photograph,
    render,
    retake,
)
from model_export.pool import collate_retaken
from model_export.render import Layer, render_layers
from model_export.scenes import _through_mosaic as through_mosaic
from model_export.scenes import draw_negative, draw_sample

CPU = torch.device("cpu")
SCENES = SceneConfig(size_px=64, margin_px=24)
CONFIG = TrainConfig(scenes=SCENES, retaken=True)
NEGATIVES = [draw_negative(seed, SCENES) for seed in range(8)]


def test_scenes_taken_together_look_as_each_does_alone() -> None:
    surfaces = _Surfaces.of(NEGATIVES, CPU)
    together, excess = render(surfaces, [negative.shot for negative in NEGATIVES])
    for picture, found, negative in zip(together, excess[:, 0], NEGATIVES, strict=True):
        maps = negative.surfaces.float()
        layers = [Layer(m[:3], m[3:4], -m[4] * negative.shot.k_cam_px) for m in maps]
        alone, front = render_layers(layers, negative.shot.spread)
        assert torch.allclose(picture, alone, atol=2e-3)
        assert (found == torch.take_along_dim(maps[:, 4], front[None], 0)[0]).float().mean() > 0.99


def pixels(seed: int, size: int = 64) -> torch.Tensor:
    return torch.from_numpy(draw_sample(seed, replace(SCENES, size_px=size)).image)[None].float()


@pytest.mark.parametrize("quality", [60, 85, 98])
def test_compression_is_that_of_a_jpeg(quality: int) -> None:
    picture = pixels(3)
    image = picture[0].permute(1, 2, 0).numpy().astype(np.uint8)
    packed = cv2.imencode(".jpg", image[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    true = np.asarray(cv2.imdecode(packed, cv2.IMREAD_COLOR), np.float32)[:, :, ::-1]
    found = compressed(picture, torch.tensor([float(quality)]))[0].permute(1, 2, 0).numpy()
    lost = np.abs(true - image).mean()
    assert np.abs(found - true).mean() < max(0.3 * lost, 0.6)


def test_a_mosaic_of_colours_is_interpolated_as_opencv_does() -> None:
    linear = pixels(1)[0] / 255
    found = _through_mosaic(linear[None])[0].permute(1, 2, 0).numpy()
    true = through_mosaic(linear.permute(1, 2, 0).numpy())
    assert np.abs(found - true)[2:-2, 2:-2].max() < 1e-3


def test_pictures_are_made_small_by_averaging_areas() -> None:
    row = np.random.default_rng(0).random((1, 80), np.float32)
    true = cv2.resize(row, (64, 1), interpolation=cv2.INTER_AREA)
    assert row @ _areas(80, 64).T == pytest.approx(np.asarray(true), abs=1e-5)


def test_a_scene_is_taken_by_another_camera_each_time_within_what_scenes_span() -> None:
    rng = np.random.default_rng(0)
    shots = [retake(rng, NEGATIVES[0], CONFIG) for _ in range(50)]
    assert len({shot.k_cam_px for shot in shots}) > 40
    for shot in shots:
        assert SCENES.k_cam_px[0] <= shot.k_cam_px <= SCENES.k_cam_px[1]
        assert SCENES.gamma_px[0] <= shot.gamma_px <= SCENES.gamma_px[1]
        assert shot.focus_distance_m == NEGATIVES[0].shot.focus_distance_m


def test_pictures_made_small_are_told_the_smaller_cameras_numbers() -> None:
    for seed in range(40):  # a few of them are
        images, excess, shots = photograph(np.random.default_rng(seed), NEGATIVES, CONFIG, CPU)
        assert images.shape == (8, 3, 64, 64)
        assert excess.shape == (8, 1, 64, 64)
        assert 0 <= images.min() <= images.max() <= 1
        ratios = {
            round(shot.focal_length_px / n.shot.focal_length_px, 6) for shot, n in zip(shots, NEGATIVES, strict=True)
        }
        assert len(ratios) == 1
        if ratios != {1.0}:
            assert ratios == {0.8}
            return
    pytest.fail("none was made small")


def test_in_a_picture_made_small_a_camera_blurs_less_and_is_no_sharper(monkeypatch: pytest.MonkeyPatch) -> None:
    told = []
    for share in (0.0, 1.0):
        monkeypatch.setattr("model_export.darkroom.RESCALED_SHARE", share)
        told.append(photograph(np.random.default_rng(0), NEGATIVES, CONFIG, CPU)[2])
    for whole, small in zip(*told, strict=True):
        assert small.k_cam_px == pytest.approx(0.8 * whole.k_cam_px)
        assert small.gamma_px > 0.999 * whole.gamma_px


def test_the_same_seed_takes_the_same_pictures_another_takes_others() -> None:
    one, same, other = (collate_retaken(NEGATIVES, np.random.default_rng(seed), CONFIG, CPU) for seed in (1, 1, 2))
    assert torch.equal(one.image, same.image)
    assert torch.equal(one.excess, same.excess)
    assert not torch.equal(one.image, other.image)
    assert torch.equal(one.shown, one.image)


def test_some_pictures_that_are_taken_anew_go_through_a_noise_filter() -> None:
    config = replace(CONFIG, filtered_share=0.5)
    batch = collate_retaken(NEGATIVES, np.random.default_rng(0), config, CPU)
    filtered = (batch.shown != batch.image).flatten(1).any(1)
    assert 1 <= int(filtered.sum()) <= 7
    assert float((batch.shown - batch.image).abs().mean()) < 0.05
