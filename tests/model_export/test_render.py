"""The refocuser: nothing made, nothing lost, nothing given away at an edge."""

import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from model_export.render import (
    DISC,
    GAUSSIAN,
    Layer,
    Levels,
    PointSpread,
    Spreads,
    blur,
    blur_varying,
    refocus,
    render_layers,
    sampled_taps,
)
from service.optics import thin_lens
from service.optics.camera import Camera
from service.optics.light import decode_srgb, encode_srgb

CAMERA = Camera(96, 96, 2.0, 3.81, 0.5)
Map = NDArray[np.float32]


def step_depth(near: float, far: float, size: int = 96) -> Map:
    depth = np.full((size, size), far, np.float32)
    depth[:, : size // 2] = near
    return depth


def rough_depth(size: int = 96) -> Map:
    u, v = np.meshgrid(np.linspace(0, 1, size), np.linspace(0, 1, size))
    return (0.5 + 2 * u + 0.5 * np.sin(9 * v)).clip(0.4, 4).astype(np.float32)


@pytest.mark.parametrize("depth", [step_depth(0.5, 3.0), step_depth(3.0, 0.5), rough_depth()])
@pytest.mark.parametrize("shade", [0.0, 0.37, 1.0])
def test_a_constant_image_stays_constant(depth: Map, shade: float) -> None:
    image = np.full((96, 96, 3), shade, np.float32)
    assert np.abs(refocus(image, depth, CAMERA) - shade).max() < 2e-3


@pytest.mark.parametrize("disc_share", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("sigma", [0.7, 2.0, 6.0])
def test_a_point_keeps_its_energy_and_gets_the_standard_deviation_asked_for(disc_share: float, sigma: float) -> None:
    point = torch.zeros(1, 129, 129)
    point[0, 64, 64] = 1
    spread = blur(point, sigma, PointSpread(disc_share))[0].double()
    offsets = torch.arange(-64, 65).double()
    assert float(spread.sum()) == pytest.approx(1, abs=1e-5)
    assert float((spread.sum(0) * offsets**2).sum()) == pytest.approx(sigma**2, rel=0.02)


def test_a_squeezed_disc_keeps_its_mean_variance_and_is_longer_one_way() -> None:
    point = torch.zeros(1, 129, 129)
    point[0, 64, 64] = 1
    seen = blur(point, 6.0, PointSpread(1.0, squeeze=0.7, angle=math.pi / 2))[0].double()
    offsets = torch.arange(-64, 65).double()
    across, along = (float((seen.sum(axis) * offsets**2).sum()) for axis in (0, 1))
    assert (along + across) / 2 == pytest.approx(36, rel=0.02)
    assert across / along == pytest.approx(0.49, rel=0.05)


def test_colours_focused_elsewhere_are_blurred_otherwise_nearer_and_farther() -> None:
    size = 96
    white = torch.zeros(3, size, size)
    white[:, size // 2, size // 2] = 1
    spreads = PointSpread(0.0, chromatic_px=(1.0, -1.0))
    peaks = []
    for signed_px in (-3.0, 3.0):
        layer = Layer(white, torch.ones(1, size, size), torch.full((size, size), signed_px))
        picture, front = render_layers([layer], spreads)
        assert picture.sum((1, 2)).tolist() == pytest.approx([1, 1, 1], rel=1e-4)
        assert (front == 0).all()
        peaks.append((1 / (2 * math.pi * picture.amax((1, 2)))).sqrt().tolist())
    assert peaks[0] == pytest.approx([2, 3, 4], rel=0.05)
    assert peaks[1] == pytest.approx([4, 3, 2], rel=0.05)


def test_energy_is_kept_on_a_slanted_surface() -> None:
    rng = np.random.default_rng(0)
    image = rng.random((96, 96, 3)).astype(np.float32)
    before = decode_srgb(image).mean()
    after = decode_srgb(refocus(image, rough_depth(), CAMERA)).mean()
    assert after == pytest.approx(before, rel=0.03)


@pytest.mark.parametrize(("near", "far"), [(0.5, 2.0), (2.0, 6.0), (0.6, 6.0)])
def test_no_halo_at_a_depth_edge(near: float, far: float) -> None:
    """Across an edge from dark to bright the picture only rises: no rim darker or brighter than both sides."""
    image = np.full((96, 96, 3), 0.8, np.float32)
    image[:, :48] = 0.2
    across = refocus(image, step_depth(near, far), CAMERA)[48, :, 0]
    assert np.diff(across).min() > -2e-3
    assert across[0] == pytest.approx(0.2, abs=2e-3)
    assert across[-1] == pytest.approx(0.8, abs=2e-3)


def test_a_sharp_occluder_keeps_a_sharp_edge_before_a_blurred_ground() -> None:
    image = np.full((96, 96, 3), 0.8, np.float32)
    image[:, :48] = 0.2
    camera = Camera(96, 96, 2.0, 8.0, 0.0)
    in_front = refocus(image, step_depth(2.0, 8.0), camera)[48, :, 0]
    behind = refocus(image, step_depth(8.0, 2.0), camera)[48, :, 0]
    # the edge belongs to whichever surface is nearer: in both pictures the nearer one is in focus or not
    assert in_front[50] == pytest.approx(0.8, abs=0.02)
    assert behind[45] == pytest.approx(0.2, abs=0.02)


def test_a_blurred_occluder_spills_over_a_sharp_ground() -> None:
    image = np.full((96, 96, 3), 0.8, np.float32)
    image[:, :48] = 0.2
    across = refocus(image, step_depth(0.5, 2.0), Camera(96, 96, 2.0, 2.0, 0.0))[48, :, 0]
    assert across[46] > 0.25
    assert across[50] < 0.75


def test_sampled_gaussians_have_the_variance_asked_for() -> None:
    variances = np.array([0.01, 0.05, 0.2, 0.79])
    taps = sampled_taps(variances)
    assert taps.sum(1) == pytest.approx(1)
    assert taps @ np.arange(taps.shape[1]) ** 2 == pytest.approx(variances, rel=1e-3, abs=1e-5)


def test_in_focus_nothing_changes() -> None:
    rng = np.random.default_rng(1)
    image = rng.random((64, 64, 3)).astype(np.float32)
    picture = refocus(image, np.full((64, 64), 2.0, np.float32), Camera(64, 64, 2.0, 5.0, 0.0))
    np.testing.assert_allclose(picture, image, atol=2e-3)


@pytest.mark.parametrize("gamma_px", [0.6, 1.2])
def test_in_focus_an_edge_shows_gamma_of_which_the_pixels_box_is_a_part(gamma_px: float) -> None:
    image = np.zeros((64, 64, 3), np.float32)
    image[:, 32:] = 1
    picture = refocus(image, np.full((64, 64), 2.0, np.float32), Camera(64, 64, 2.0, 5.0, gamma_px))
    rise = np.diff(decode_srgb(picture)[32, :, 0])
    beyond_box = float((rise * (np.arange(63) - 31) ** 2).sum() / rise.sum())
    assert beyond_box + thin_lens.PIXEL_BOX_VARIANCE == pytest.approx(gamma_px**2, rel=0.02)


def test_two_levels_of_blur_pass_for_the_one_between() -> None:
    point = torch.zeros(1, 128, 128)
    point[0, 64, 64] = 1
    ends = np.array([2.0]), np.array([4.0])
    middle = float(Levels.between(*ends).sigma_px[:2].mean())
    sigma = torch.full((1, 128, 128), middle)
    mixed, exact = blur_varying(point[None], sigma, Spreads.of([GAUSSIAN]), ends)[0, 0], blur(point, middle)[0]
    offsets = torch.arange(-64, 64)
    assert float((mixed.sum(0) * offsets**2).sum()) == pytest.approx(middle**2, rel=5e-3)
    assert float((mixed - exact).abs().max()) < 0.08 * float(exact.max())


def test_a_scene_of_one_shade_stays_that_shade_through_all_its_layers() -> None:
    size, shade = 64, 0.25
    alpha = torch.zeros(1, size, size)
    alpha[:, 20:40, 20:40] = 1
    far = torch.full((size, size), 2.0)
    near = torch.full((size, size), 5.0)
    layers = [Layer(shade * alpha.repeat(3, 1, 1), alpha, near)]
    layers.append(Layer(torch.full((3, size, size), shade), torch.ones(1, size, size), far))
    picture, _ = render_layers(layers, DISC)
    np.testing.assert_allclose(picture.numpy(), shade, atol=1e-4)


def test_a_pixel_belongs_to_the_layer_most_of_its_light_is_from() -> None:
    """A bar two sigma wide hides what is behind it; the same bar blurred eight times as much hides nothing."""
    size = 96
    alpha = torch.zeros(1, size, size)
    alpha[:, :, 44:52] = 1
    behind = Layer(torch.zeros(3, size, size), torch.ones(1, size, size), torch.full((size, size), 0.5))
    for blur_px, shown in ((1.0, True), (16.0, False)):
        bar = Layer(alpha.repeat(3, 1, 1), alpha, torch.full((size, size), blur_px))
        _, front = render_layers([bar, behind], GAUSSIAN)
        assert (front[:, 46:50] == (0 if shown else 1)).all()
        assert (front[:, :36] == 1).all()


def test_srgb_survives_the_round_trip() -> None:
    values = np.linspace(0, 1, 257, dtype=np.float32)
    np.testing.assert_allclose(encode_srgb(decode_srgb(values)), values, atol=1e-4)
    assert math.isclose(float(decode_srgb(np.array([0.5], np.float32))[0]), 0.21404, rel_tol=1e-3)
