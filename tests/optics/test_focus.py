"""Where a lens was focused, from blur at known depths."""

import math
import random
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.optics.camera import Camera
from service.optics.focus import FARTHEST_OFF, FocusFit, Sighting, fit_focus, likely_gamma

CAMERA = Camera(640, 480, 2.0, 3.81, 0.5, focal_length_m=0.05)
DEPTHS_M = (0.8, 1.2, 1.5, 2.5, 3.5)
EXACT = 0.01


def fitted(true_m: float, *depths_m: float, told: Camera = CAMERA, error: float = EXACT) -> FocusFit:
    """What follows from blur as the camera's lens shows it, focused where it is not told to be."""
    true = told.focused_at(true_m)
    return fit_focus(told, [Sighting(depth_m, true.blur_px(depth_m), error) for depth_m in depths_m])


@given(times=st.floats(0.85, 1.15), focal_length_m=st.sampled_from([None, 0.004, 0.1]), k_cam_px=st.floats(2, 40))
def test_things_near_and_far_tell_the_focus_distance(
    times: float, focal_length_m: float | None, k_cam_px: float
) -> None:
    told = replace(CAMERA, focal_length_m=focal_length_m, k_cam_px=k_cam_px)
    fit = fitted(2.0 * times, *DEPTHS_M, told=told)
    assert fit.focus_distance_m == pytest.approx(2.0 * times, rel=0.04)
    assert fit.low_m <= 2.0 * times <= fit.high_m
    assert max(fit.deviations) < 1


@pytest.mark.parametrize("gamma_px", [0.35, 0.5, 0.8, 1.1])
def test_what_is_in_focus_tells_gamma_and_what_is_not_the_focus_distance(gamma_px: float) -> None:
    true = replace(CAMERA.focused_at(1.9), gamma_px=gamma_px)
    fit = fit_focus(CAMERA, [Sighting(depth_m, true.blur_px(depth_m), EXACT) for depth_m in (1.0, 1.9, 4.0)])
    assert fit.gamma_ratio * CAMERA.gamma_px == pytest.approx(gamma_px, rel=0.13)
    assert fit.focus_distance_m == pytest.approx(1.9, rel=0.03)
    assert max(fit.deviations) < 2


@pytest.mark.parametrize("true_m", [0.2009, 0.1991, 0.2027])
def test_where_k_cam_is_large_the_focus_distance_is_found_as_finely_as_blur_tells_it(true_m: float) -> None:
    told = Camera(1440, 1080, 0.2, 216.0, 0.6, focal_length_m=0.05)
    fit = fitted(true_m, *(true_m * ratio for ratio in (0.98, 0.99, 0.995, 1.01)), told=told)
    assert fit.focus_distance_m == pytest.approx(true_m, rel=2e-4)
    assert fit.low_m < true_m < fit.high_m < 1.003 * fit.low_m
    assert fit.gamma_ratio == 1
    assert max(fit.deviations) < 0.5


@pytest.mark.parametrize(("true_m", "depth_m"), [(0.193, 0.2), (0.186, 0.2), (0.2137, 0.22), (0.199, 0.2)])
def test_where_k_cam_is_large_one_thing_is_blurred_by_the_focus_found_as_it_was(true_m: float, depth_m: float) -> None:
    fit = fitted(true_m, depth_m, told=Camera(1440, 1080, 0.2, 800.0, 0.6, focal_length_m=0.05))
    assert fit.focus_distance_m == pytest.approx(true_m, rel=6e-4)
    assert fit.deviations == pytest.approx((0.0,), abs=0.2)


def test_things_out_of_focus_tell_no_gamma() -> None:
    true = replace(CAMERA, gamma_px=0.8)
    fit = fit_focus(CAMERA, [Sighting(depth_m, true.blur_px(depth_m), EXACT) for depth_m in (0.5, 0.8)])
    assert fit.gamma_ratio == 1


def test_one_thing_tells_it_less_surely_than_three() -> None:
    one, three = fitted(1.8, 1.2), fitted(1.8, 1.0, 1.2, 3.0)
    assert abs(three.focus_distance_m - 1.8) < abs(one.focus_distance_m - 1.8) < 0.2
    assert three.high_m - three.low_m < one.high_m - one.low_m


def test_of_one_thing_close_to_focus_either_side_of_it_is_possible() -> None:
    fit = fitted(1.9, 2.0)
    assert fit.low_m < 1.9 < 2.1 < fit.high_m
    macro = fitted(0.1975, 0.2, told=Camera(1440, 1080, 0.2, 800.0, 0.6, focal_length_m=0.05))
    assert macro.low_m < 0.1975 < 0.2025 < macro.high_m


def test_what_is_told_stands_where_a_thing_close_to_it_is_read_too_blurred() -> None:
    fit = fit_focus(CAMERA, [Sighting(2.0, 0.62, EXACT)])
    assert fit.focus_distance_m == pytest.approx(2.0, rel=0.01)
    assert fit.low_m < 1.95 < 2.05 < fit.high_m


@pytest.mark.parametrize(("is_near", "depth_m", "told_m"), [(True, 1.5, 1.45), (False, 3.0, 3.3)])
def test_of_one_thing_close_to_focus_that_side_is_taken_on_which_all_was_said_to_be(
    is_near: bool, depth_m: float, told_m: float
) -> None:
    seen = [Sighting(depth_m, CAMERA.blur_px(depth_m), EXACT)]
    told = CAMERA.focused_at(told_m)
    fit, without = fit_focus(told, seen, is_near), fit_focus(told, seen)
    assert fit.low_m < 2.0 < fit.high_m
    assert fit.low_m > 0.85 * depth_m if is_near else fit.high_m < 1.15 * depth_m
    assert (fit.focus_distance_m > depth_m) == is_near != (without.focus_distance_m > depth_m)


def test_of_a_large_k_cam_what_is_clearly_blurred_is_on_its_side_however_near_focus_it_is() -> None:
    told = Camera(640, 480, 0.095, 80.0, 0.5)
    seen = [Sighting(0.0985, told.focused_at(0.1).blur_px(0.0985), EXACT)]
    near, without = fit_focus(told, seen, is_near=True), fit_focus(told, seen)
    assert near.focus_distance_m == pytest.approx(0.1, rel=0.002)
    assert without.focus_distance_m < 0.0985


def test_a_doubtful_reading_moves_it_less() -> None:
    sure, doubtful = (fitted(1.6, 1.2, error=error).focus_distance_m for error in (0.1, 0.8))
    assert 1.6 < sure < doubtful < 2.0


def test_the_intervals_hold_and_tell_something() -> None:
    """Of focus told to a tenth, as by a ring, and two things read to 15 %."""
    rng = random.Random(0)
    held, widths = 0, []
    for _ in range(60):
        true = CAMERA.focused_at(2.0 * math.exp(rng.gauss(0, 0.1)))
        depths_m = rng.sample(DEPTHS_M, 2)
        fit = fit_focus(CAMERA, [Sighting(z, true.blur_px(z) * math.exp(rng.gauss(0, 0.15)), 0.15) for z in depths_m])
        held += fit.low_m <= true.focus_distance_m <= fit.high_m
        widths.append(fit.high_m / fit.low_m)
    assert held >= 55
    assert sum(widths) / 60 < 1.35


def test_where_a_reading_tells_nothing_the_interval_is_that_of_what_was_told() -> None:
    """A tenth, 95 times in a hundred: 1.96 of it by a normal law, a little more by one of longer tails."""
    fit = fit_focus(CAMERA, [Sighting(1.0, 1.0, 1e6)])
    assert fit.focus_distance_m == pytest.approx(2.0, rel=0.02)
    for end_m in (fit.low_m, fit.high_m):
        assert 0.196 < abs(math.log(end_m / 2.0)) < 0.25


@pytest.mark.parametrize(("true_m", "end_m"), [(7.0, 5.0), (0.65, 0.8)])
def test_what_was_told_is_off_by_two_and_a_half_times_at_most(true_m: float, end_m: float) -> None:
    fit = fitted(true_m, *DEPTHS_M)
    assert (fit.high_m if true_m > end_m else fit.low_m) == pytest.approx(end_m, rel=0.01)


@pytest.mark.parametrize("mistaken_m", [1.6, 0.4])
def test_one_thing_mistaken_does_not_decide_and_is_told_apart(mistaken_m: float) -> None:
    true = CAMERA.focused_at(1.8)
    seen = [Sighting(depth_m, true.blur_px(depth_m), EXACT) for depth_m in DEPTHS_M]
    fit = fit_focus(CAMERA, [replace(seen[0], depth_m=mistaken_m), *seen[1:]])
    assert fit.focus_distance_m == pytest.approx(1.8, rel=0.05)
    assert fit.deviations[0] > 3 > max(fit.deviations[1:])


def test_what_fits_nothing_leaves_it_near_what_was_told() -> None:
    fit = fit_focus(CAMERA, [Sighting(1.0, 300.0, EXACT)])
    assert 2.0 / FARTHEST_OFF <= fit.focus_distance_m <= 2.0 * FARTHEST_OFF
    assert fit.deviations[0] > 3


def test_a_lens_is_never_focused_nearer_than_its_focal_length() -> None:
    macro = Camera(640, 480, 0.12, 40.0, 0.5, focal_length_m=0.1)
    assert fit_focus(macro, [Sighting(0.11, 0.5, EXACT)]).low_m > 0.1


def test_without_gamma_a_thing_in_focus_has_no_blur_and_is_no_fault() -> None:
    fit = fit_focus(replace(CAMERA, gamma_px=0.0), [Sighting(2.0, 0.0, EXACT)])
    assert fit.focus_distance_m == pytest.approx(2.0, rel=1e-3)


def test_nothing_known_tells_nothing() -> None:
    with pytest.raises(ValueError, match="one known depth"):
        fit_focus(CAMERA, [])


@pytest.mark.parametrize("true_m", [10.0, 5.0, 3.0, 1.6])
def test_a_lens_said_to_be_at_infinity_is_found_at_its_hyperfocal_distance(true_m: float) -> None:
    told = Camera(640, 480, 100_000.0, 7.6e-5, 0.5)
    fit = fitted(true_m, 0.5, 0.8, 1.2, told=told)
    assert 1 / fit.focus_distance_m == pytest.approx(1 / true_m, abs=0.04)
    assert fit.low_m <= true_m <= fit.high_m


def test_of_a_lens_said_to_be_at_infinity_one_thing_tells_where_it_is_and_one_read_badly_hardly() -> None:
    told = Camera(640, 480, 100_000.0, 7.6e-5, 0.5)
    assert fitted(3.0, 0.8, told=told).focus_distance_m == pytest.approx(3.0, rel=0.2)
    assert fitted(3.0, 0.8, told=told, error=0.8).focus_distance_m > 10


def test_a_lens_said_to_be_at_infinity_is_taken_half_way_by_a_reading_as_doubtful_as_that() -> None:
    """0.3 dioptres are as much as 0.3 of such a blur."""
    fit = fitted(2.5, 0.8, told=Camera(640, 480, 100_000.0, 7.6e-5, 0.5), error=0.3)
    assert 1 / fit.focus_distance_m == pytest.approx(0.4 / 2, abs=0.03)


def test_a_lens_said_to_be_at_infinity_is_at_one_metre_and_a_half_or_beyond() -> None:
    fit = fitted(1.2, 0.5, 0.8, 1.2, told=Camera(640, 480, 100_000.0, 7.6e-5, 0.5))
    assert fit.low_m == pytest.approx(1.5, rel=0.01)


def test_a_lens_at_infinity_is_left_there() -> None:
    fit = fitted(100_000.0, 0.5, 0.8, 1.2, told=Camera(640, 480, 100_000.0, 7.6e-5, 0.5))
    assert fit.focus_distance_m == fit.high_m == 100_000.0
    assert fit.low_m < 50


@given(st.floats(0.2, 2.0), st.floats(0.01, 100.0))
def test_a_photograph_s_gamma_lies_between_what_is_told_and_what_is_sharpest(told_px: float, times: float) -> None:
    gamma_px = likely_gamma(told_px, times * told_px)
    assert told_px <= gamma_px * (1 + 1e-12)
    assert gamma_px <= max(told_px, times * told_px) * (1 + 1e-12)


def test_what_is_hardly_softer_than_gamma_is_gamma_and_what_is_much_softer_is_not() -> None:
    assert likely_gamma(0.5, 0.55) == pytest.approx(0.5 * 1.1**0.8, rel=0.01)
    assert likely_gamma(0.5, 2.0) == pytest.approx(0.5, rel=1e-3)
    assert likely_gamma(0.5, 0.4) == 0.5
    assert likely_gamma(0.0, 0.4) == 0.0
    assert likely_gamma(1e-6, 60.0) == 1e-6
