"""The physics: round trips, limits, gradients, and one answer from float, NumPy and torch."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from service.optics import thin_lens
from service.optics.camera import Camera

focus = st.floats(0.1, 20.0)
k_cams = st.floats(0.05, 300.0)
gammas = st.floats(0.0, 3.0)
near_ratio = st.floats(0.05, 0.98)
far_ratio = st.floats(1.02, 20.0)


@given(focus, k_cams, gammas, near_ratio)
def test_near_depth_survives_the_trip_through_blur(s1: float, k: float, gamma: float, ratio: float) -> None:
    blur = thin_lens.blur_at_depth(s1 * ratio, s1, k, gamma)
    x = thin_lens.relative_defocus_from_blur(blur, gamma, k)
    assert thin_lens.depth_near(x, s1) == pytest.approx(s1 * ratio, rel=1e-4)


@given(focus, k_cams, gammas, far_ratio)
def test_far_depth_survives_the_trip_through_blur(s1: float, k: float, gamma: float, ratio: float) -> None:
    blur = thin_lens.blur_at_depth(s1 * ratio, s1, k, gamma)
    x = thin_lens.relative_defocus_from_blur(blur, gamma, k)
    assert thin_lens.depth_far(x, s1) == pytest.approx(s1 * ratio, rel=1e-2)


@given(focus, k_cams, gammas)
def test_focus_shows_gamma_alone(s1: float, k: float, gamma: float) -> None:
    assert thin_lens.defocus_at_depth(s1, s1, k) == 0
    assert thin_lens.blur_at_depth(s1, s1, k, gamma) == pytest.approx(gamma)


@given(focus, st.floats(0.0001, 1e6))
def test_relative_defocus_reaches_one_only_near(s1: float, ratio: float) -> None:
    x = thin_lens.relative_defocus(s1 * ratio, s1)
    if x >= 1:
        assert ratio <= 0.5
    if ratio > 1:
        assert x < 1


def test_signed_defocus_is_negative_nearer_than_focus() -> None:
    assert thin_lens.signed_defocus(1.0, 2.0) < 0 == thin_lens.signed_defocus(2.0, 2.0)
    assert 0 < thin_lens.signed_defocus(400.0, 2.0) < 1


def test_blur_below_gamma_is_focus() -> None:
    assert thin_lens.defocus_from_blur(0.3, 0.5) == 0


@given(focus, k_cams, st.floats(0.1, 10))
def test_width_and_blur_scale_alike_and_depth_stays(s1: float, k: float, ratio: float) -> None:
    blur = thin_lens.blur_at_depth(0.7 * s1, s1, k, 0.5)
    x = thin_lens.relative_defocus_from_blur(blur * ratio, 0.5 * ratio, k * ratio)
    assert thin_lens.depth_near(x, s1) == pytest.approx(0.7 * s1, rel=1e-4)


@given(st.floats(0.5, 5), st.floats(0.5, 5))
def test_moving_the_focus_is_computing_k_cam_there(old: float, new: float) -> None:
    before = thin_lens.k_cam(0.05, 1.8, old, 4e-6)
    moved = thin_lens.k_cam_at_focus(before, 0.05, old, new)
    assert moved == pytest.approx(thin_lens.k_cam(0.05, 1.8, new, 4e-6), rel=1e-9)


@given(st.floats(0.2, 1e5), st.floats(0.2, 1e5), st.floats(0.2, 0.99))
def test_a_camera_that_blurs_alike_shows_each_depth_at_another(old: float, new: float, ratio: float) -> None:
    camera = Camera(640, 480, old, 3.0)
    moved_m = thin_lens.depth_at_focus(ratio * old, old, new)
    assert camera.blurring_alike(new).blur_px(moved_m) == pytest.approx(camera.blur_px(ratio * old), rel=1e-6)
    assert moved_m < new
    assert thin_lens.depth_at_focus(moved_m, new, old) == pytest.approx(ratio * old, rel=1e-6)


@pytest.mark.parametrize(
    "call", [lambda: thin_lens.k_cam(0.05, 2, 0.05, 4e-6), lambda: thin_lens.k_cam_at_focus(1, 2, 3, 2)]
)
def test_a_lens_cannot_focus_within_its_focal_length(call: Callable[[], float]) -> None:
    with pytest.raises(ValueError, match="focal length"):
        call()


@given(st.floats(0.004, 0.2), st.floats(2.01, 500))
def test_what_a_ring_counts_from_the_sensor_is_object_and_image_distance_together(focal: float, times: float) -> None:
    from_lens = times * focal
    behind = 1 / (1 / focal - 1 / from_lens)
    assert thin_lens.focus_from_lens(from_lens + behind, focal) == pytest.approx(from_lens, rel=1e-6)


def test_nothing_is_sharp_that_is_nearer_to_the_sensor_than_four_focal_lengths() -> None:
    with pytest.raises(ValueError, match="four focal lengths"):
        thin_lens.focus_from_lens(0.39, 0.1)


def test_depth_error_is_the_derivative_of_depth() -> None:
    s1, k, depth, step = 2.0, 3.81, 1.2, 1e-6
    x = thin_lens.relative_defocus(depth, s1)
    moved = thin_lens.depth_near(x + step / k, s1)
    assert thin_lens.depth_error(depth, s1, k, 1.0) == pytest.approx(abs(moved - depth) / step, rel=1e-4)


def test_farthest_depth_is_where_the_error_meets_the_limit() -> None:
    far = thin_lens.farthest_depth(2.0, 1.5, 0.25, 0.1)
    assert thin_lens.depth_error(far, 2.0, 1.5, 0.25) / far == pytest.approx(0.1)


def test_spread_is_finite_in_focus_and_shrinks_with_certainty() -> None:
    in_focus = thin_lens.relative_defocus_spread(0.5, 0.1, 0.5, 2.0)
    assert 0 < in_focus < 1
    assert thin_lens.relative_defocus_spread(4.0, 0.05, 0.5, 2.0) < thin_lens.relative_defocus_spread(
        4.0, 0.1, 0.5, 2.0
    )


FORMULAS: list[Callable[[Any], Any]] = [
    lambda z: thin_lens.relative_defocus(z, 2.0),
    lambda z: thin_lens.signed_defocus(z, 2.0),
    lambda z: thin_lens.blur_at_depth(z, 2.0, 3.81, 0.5),
    lambda z: thin_lens.relative_defocus_from_blur(z, 0.2, 3.81),
    lambda z: thin_lens.depth_near(z, 2.0),
    lambda z: thin_lens.depth_far(z, 2.0),
    lambda z: thin_lens.depth_error(z, 2.0, 3.81, 0.25),
    lambda z: thin_lens.depth_at_focus(z, 2.0, 1e3),
    lambda z: thin_lens.relative_defocus_spread(z, 0.1 + 0 * z, 0.2, 3.81),
]
POINTS = [0.3, 0.7, 1.3, 2.5, 4.0]


@pytest.mark.parametrize("formula", FORMULAS)
def test_float_numpy_and_torch_agree(formula: Callable[[Any], Any]) -> None:
    floats = [formula(z) for z in POINTS]
    np.testing.assert_allclose(formula(np.array(POINTS)), floats, rtol=1e-12)
    np.testing.assert_allclose(formula(torch.tensor(POINTS, dtype=torch.float64)).numpy(), floats, rtol=1e-12)


@pytest.mark.parametrize("formula", FORMULAS)
def test_gradients_are_those_of_finite_differences(formula: Callable[[Any], Any]) -> None:
    points = torch.tensor(POINTS, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(formula, (points,))


def test_gradient_at_focus_is_finite_with_a_floor() -> None:
    blur = torch.tensor([0.5], dtype=torch.float64, requires_grad=True)
    torch.autograd.backward(thin_lens.defocus_from_blur(blur, 0.5, floor_px=0.05).sum())
    assert blur.grad is not None
    assert torch.isfinite(blur.grad).all()


@pytest.mark.parametrize(("from_px", "to_px"), [(320, 200), (480, 320), (640, 512), (300, 100), (336, 320), (645, 323)])
def test_averaging_areas_adds_the_variance_it_says(from_px: int, to_px: int) -> None:
    """The second moment of what each pixel of the larger picture becomes, its own box with it."""
    ratio = to_px / from_px
    edges = np.arange(from_px + 1) * ratio
    cells = np.arange(to_px)
    shares = np.clip(np.minimum(edges[1:, None], cells + 1) - np.maximum(edges[:-1, None], cells), 0, None) / ratio
    middles = (edges[1:] + edges[:-1]) / 2
    moment = (shares * (cells + 0.5 - middles[:, None]) ** 2).sum(1).mean() + ratio**2 * thin_lens.PIXEL_BOX_VARIANCE
    added = moment - thin_lens.PIXEL_BOX_VARIANCE
    assert thin_lens.averaging_variance(from_px, to_px) == pytest.approx(added, abs=2e-3)


@pytest.mark.parametrize("gamma_px", [0.6, 1.2])
def test_gamma_before_averaging_is_that_of_which_it_comes(gamma_px: float) -> None:
    before = thin_lens.gamma_before_averaging(gamma_px, 300, 200)
    assert thin_lens.gamma_after_averaging(before, 300, 200) == pytest.approx(gamma_px, rel=1e-9)


@pytest.mark.parametrize("gamma_px", [0.0, 0.2])
def test_no_copy_and_no_picture_is_sharper_than_a_pixels_box(gamma_px: float) -> None:
    box_px = math.sqrt(thin_lens.PIXEL_BOX_VARIANCE)
    assert thin_lens.gamma_after_averaging(gamma_px, 640, 320) == pytest.approx(box_px)
    assert thin_lens.gamma_before_averaging(gamma_px, 640, 320) == pytest.approx(box_px)


@pytest.mark.parametrize("blur_px", [0.5, 1.0, 4.0])
def test_an_edge_is_as_steep_after_sharpening_as_one_of_the_blur_asked_for(blur_px: float) -> None:
    amount, spread_px = 0.4, 1.2
    before_px = thin_lens.blur_before_sharpening(blur_px, amount, spread_px)
    assert before_px > blur_px
    x = np.linspace(-40, 40, 160_001)

    def edge(sigma: float) -> NDArray[np.float64]:
        shares = np.exp(-((x / sigma) ** 2) / 2)
        return np.asarray(np.cumsum(shares) / shares.sum())

    sharpened = (1 + amount) * edge(before_px) - amount * edge(math.hypot(before_px, spread_px))
    assert np.gradient(sharpened, x).max() == pytest.approx(np.gradient(edge(blur_px), x).max(), rel=1e-3)
    assert thin_lens.blur_before_sharpening(blur_px, 0.0, spread_px) == pytest.approx(blur_px)


@given(gamma_px=st.floats(0, 3), ratio=st.floats(0.01, 1))
def test_gamma_of_a_smaller_picture_is_between_its_scaled_self_and_itself(gamma_px: float, ratio: float) -> None:
    small = thin_lens.gamma_after_shrinking(gamma_px, ratio)
    assert gamma_px * ratio - 1e-9 <= small <= gamma_px + 1e-9
    assert small >= min(gamma_px, thin_lens.SHRUNK_GAMMA_PX) - 1e-9
    assert thin_lens.gamma_after_shrinking(gamma_px, 1) == pytest.approx(gamma_px)


def test_softness_of_many_pixels_shrinks_with_the_picture() -> None:
    assert thin_lens.gamma_after_shrinking(6.0, 0.5) == pytest.approx(3.0, rel=0.02)


@pytest.mark.parametrize("blur_px", [3.0, 8.0])
def test_far_from_gamma_the_spread_of_defocus_is_the_error_of_blur(blur_px: float) -> None:
    k_cam_px, error = 4.0, 0.05
    spread = thin_lens.relative_defocus_spread(blur_px, error, 0.3, k_cam_px)
    assert spread == pytest.approx(error * blur_px / k_cam_px, rel=0.03)


@given(st.just(0.0) | st.floats(1e-3, 5.0), st.floats(0.2, 2.0), st.floats(1.01, 2.0), st.floats(0.3, 30.0))
def test_by_a_softer_gamma_defocus_is_less_and_never_nothing(x: float, gamma: float, times: float, k: float) -> None:
    less = thin_lens.relative_defocus_if_softer(x, gamma, times * gamma, k)
    blur_px = thin_lens.blur_from_defocus(x * k, gamma)
    assert thin_lens.relative_defocus_from_blur(blur_px, times * gamma, k) - 1e-7 <= less <= x
    assert less > 0 or x == 0
    # much out of focus it is what eq. 7 says
    if blur_px > 5 * times * gamma:
        assert less == pytest.approx(thin_lens.relative_defocus_from_blur(blur_px, times * gamma, k), rel=1e-2)
    # what a network puts beyond focus stays there
    assert thin_lens.relative_defocus_if_softer(-x, gamma, times * gamma, k) == -less
