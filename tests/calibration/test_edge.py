"""Blur of a printed circle, where the blur is known."""

import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from model_export.render import DISC, GAUSSIAN, PointSpread, blur
from service.calibration.edge import EdgeError, find_spread, fit_again, fit_edge, slice_blur
from service.calibration.edge import PointSpread as FittedSpread
from service.opencv import cv2
from service.optics import thin_lens

SIZE = 128
FINE = 8


def circle(
    radius: float = 24.0,
    x: float = 63.3,
    y: float = 64.8,
    *,
    axes_ratio: float = 1.0,
    turn: float = 0.0,
    soft_px: float = 0.0,
) -> NDArray[np.float32]:
    """White paper [h,w] with a black ellipse, by a Gaussian lens, each pixel the mean over its square."""
    at = (np.arange(SIZE * FINE) + 0.5) / FINE - 0.5
    u, v = at[None, :] - x, at[:, None] - y
    along, across = u * math.cos(turn) + v * math.sin(turn), v * math.cos(turn) - u * math.sin(turn)
    fine = 0.9 - 0.85 * ((along / radius) ** 2 + (across / (radius * axes_ratio)) ** 2 < 1)
    if soft_px:
        fine = np.asarray(cv2.GaussianBlur(fine, (0, 0), soft_px * FINE), np.float64)
    return np.asarray(fine.reshape(SIZE, FINE, SIZE, FINE).mean((1, 3)), np.float32)


def photographed(
    sharp: NDArray[np.float32], sigma: float, spread: PointSpread, noise: float = 0.0
) -> NDArray[np.float32]:
    rng = np.random.default_rng(1)
    light = blur(torch.from_numpy(sharp), sigma, spread).numpy()
    return np.asarray(light + noise * rng.standard_normal(light.shape), np.float32)


@pytest.mark.parametrize("spread", [GAUSSIAN, DISC], ids=["gaussian", "disc"])
@pytest.mark.parametrize("sigma", [2.0, 4.0, 8.0, 10.0])
def test_blur_is_found_to_a_percent(sigma: float, spread: PointSpread) -> None:
    total = math.sqrt(sigma**2 + 1 / 12)
    found = fit_edge(photographed(circle(), sigma, spread), 64, 64, 23)
    assert found.blur_px == pytest.approx(total, rel=0.015)
    assert (found.x_px, found.y_px) == pytest.approx((63.3, 64.8), abs=0.02)
    assert found.radius_px == pytest.approx(24, rel=0.01)
    assert found.shape == ("disc" if spread is DISC else "gaussian")


@pytest.mark.parametrize("sigma", [0.7, 1.0, 1.5])
def test_small_blur_is_found_under_a_gaussian_and_a_little_high_under_a_disc(sigma: float) -> None:
    """Both shapes look alike there; eight in a hundred at most is what the wrong one costs."""
    total = math.sqrt(sigma**2 + 1 / 12)
    assert fit_edge(photographed(circle(), sigma, GAUSSIAN), 64, 64, 23).blur_px == pytest.approx(total, rel=0.015)
    disc = fit_edge(photographed(circle(), sigma, DISC), 64, 64, 23)
    assert disc.blur_px == pytest.approx(total, rel=0.08)


@pytest.mark.parametrize("sigma", [0.3, 0.5, 0.9])
def test_a_blur_as_small_as_a_pixel_is_read_beside_the_pixel_s_own_box(sigma: float) -> None:
    found = fit_edge(circle(soft_px=sigma), 64, 64, 23)
    assert found.blur_px == pytest.approx(math.sqrt(sigma**2 + 1 / 12), rel=0.009)


def test_noise_shows_in_the_error_that_is_stated() -> None:
    sharp = circle()
    errors, stated = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        light = photographed(sharp, 3.0, GAUSSIAN) + 0.02 * rng.standard_normal((SIZE, SIZE)).astype(np.float32)
        found = fit_edge(light.astype(np.float32), 64, 64, 24)
        errors.append(found.blur_px - math.sqrt(9 + 1 / 12))
        stated.append(found.blur_error_px)
    assert np.abs(np.mean(errors)) < 0.03
    assert 0.7 < np.std(errors) / np.mean(stated) < 1.15


@pytest.mark.parametrize(("radius", "share", "noise"), [(5.0, 1.0, 0.0), (24.0, 0.15, 0.0), (24.0, 1.0, 0.05)])
def test_a_small_a_faint_and_a_noisy_circle_are_read_too(radius: float, share: float, noise: float) -> None:
    printed = 0.9 - share * (0.9 - circle(radius))
    found = fit_edge(photographed(printed, 1.0, GAUSSIAN, noise), 64, 64, radius)
    assert found.blur_px == pytest.approx(math.sqrt(1 + 1 / 12), rel=0.04)


@pytest.mark.parametrize("axes_ratio", [0.88, 0.6])
def test_a_tilted_circle_under_uneven_light_is_read_alike(axes_ratio: float) -> None:
    light = photographed(circle(axes_ratio=axes_ratio, turn=0.5), 3.0, GAUSSIAN)
    shade = (
        np.linspace(0.7, 1.2, SIZE, dtype=np.float32)[None, :] * np.linspace(1.1, 0.9, SIZE, dtype=np.float32)[:, None]
    )
    found = fit_edge((light * shade).astype(np.float32), 64, 64, 23)
    assert found.blur_px == pytest.approx(math.sqrt(9 + 1 / 12), rel=0.02)
    assert found.semi_axes_px == pytest.approx((24, 24 * axes_ratio), rel=0.02)


def test_a_circle_is_found_beside_where_it_was_looked_for_and_larger() -> None:
    found = fit_edge(photographed(circle(), 3.0, GAUSSIAN), 70, 61, 18)
    assert found.blur_px == pytest.approx(math.sqrt(9 + 1 / 12), rel=0.015)


@pytest.mark.parametrize("sigma", [0.5, 4.0])
@pytest.mark.parametrize(("right", "bottom"), [(94, SIZE), (SIZE, 92), (94, 94)])
def test_paper_that_ends_beside_the_circle_is_said(right: int, bottom: int, sigma: float) -> None:
    printed = circle()
    printed[:, right:] = printed[bottom:] = 0.2
    with pytest.raises(EdgeError, match="leave a white margin"):
        fit_edge(photographed(printed, sigma, GAUSSIAN), 64, 64, 24)


@pytest.mark.parametrize(
    ("light", "place", "why"),
    [
        *((circle(), (*at, 24), "border") for at in ((10, 64), (118, 64), (64, 10), (64, 118))),
        (circle(), (64, 64, 3), "too small"),
        (np.full((SIZE, SIZE), 0.8, np.float32), (64, 64, 24), "faint"),
        (np.zeros((SIZE, SIZE), np.float32), (64, 64, 24), "no light"),
        (np.random.default_rng(0).random((SIZE, SIZE)).astype(np.float32), (64, 64, 24), "does not look"),
        (circle(radius=11), (64, 64, 24), "another size"),
        (circle(), (64, 64, 14), "another size"),
        (circle(), (78, 64, 24), "not the circle that was looked for"),
    ],
)
def test_what_cannot_be_measured_is_said(
    light: NDArray[np.float32], place: tuple[float, float, float], why: str
) -> None:
    with pytest.raises(EdgeError, match=why):
        fit_edge(light, *place)


def test_the_papers_slice_reads_a_third_more() -> None:
    total = math.sqrt(4.0**2 + 1 / 12)
    assert slice_blur(photographed(circle(), 4.0, GAUSSIAN), 63.3, 64.8, 24) == pytest.approx(1.329 * total, rel=0.03)


@pytest.mark.parametrize("place", [(45, 64), (83, 64), (64, -1), (64, SIZE)])
def test_the_papers_slice_is_within_the_picture_and_shows_something(place: tuple[float, float]) -> None:
    with pytest.raises(EdgeError, match="border"):
        slice_blur(circle(), *place, 24)
    with pytest.raises(EdgeError, match="no circle"):
        slice_blur(np.ones((SIZE, SIZE), np.float32), 64, 64, 24)


@pytest.mark.parametrize("lens", [GAUSSIAN, DISC], ids=["gaussian", "disc"])
def test_a_lens_whose_most_blurred_circles_tell_its_point_spread_is_read_right_throughout(lens: PointSpread) -> None:
    gamma, soft = math.sqrt(0.6**2 + 1 / 12), photographed(circle(), 0.6, GAUSSIAN)
    edges = [fit_edge(photographed(soft, sigma, lens), 64, 64, 23) for sigma in (0.5, 3.0, 5.0)]
    spread = find_spread([*edges, *24 * edges[:1]], gamma, lambda: None)
    assert spread.shape == ("disc" if lens is DISC else "gaussian")
    for edge, sigma, off in zip(edges, (0.5, 3.0, 5.0), (0.02, 0.002, 0.002), strict=True):
        assert fit_again(edge, spread).blur_px == pytest.approx(math.hypot(sigma, gamma), rel=off)
    assert find_spread(edges[:1], gamma, lambda: None).shape == "gaussian", "which is as good where none is blurred"


def test_a_narrow_ellipse_is_too_tilted() -> None:
    with pytest.raises(EdgeError, match="too tilted"):
        fit_edge(photographed(circle(30, axes_ratio=0.36), 1.5, GAUSSIAN), 64, 64, 20)


@pytest.mark.parametrize("radius_px", [7.0, 24.0])
def test_a_soft_rim_is_that_of_a_circle(radius_px: float) -> None:
    """A Gaussian draws a round edge in, which a straight one's rim would have as a circle 0.1 px smaller."""
    softness = math.hypot(1.2, math.sqrt(thin_lens.PIXEL_BOX_VARIANCE))
    light = photographed(circle(radius_px), 1.0, DISC)
    edge = fit_edge(photographed(light, 1.2, GAUSSIAN), 63, 65, radius_px)
    found = fit_again(edge, FittedSpread("disc", softness))
    assert found.radius_px == pytest.approx(radius_px, abs=0.01)
    assert found.blur_px == pytest.approx(math.hypot(1.0, softness), rel=0.01)
