"""The joint fit, on circles whose camera is known."""

import re
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

from service.calibration.fit import Circles, FitError, fit_as_paper, fit_constants, odd_pictures, per_circle_k_cam
from service.calibration.fit import _check_span as check_span
from service.calibration.report import Interval
from service.optics import thin_lens

K_CAM, GAMMA, FOCUS = 6.0, 0.7, 1.2
BOTH_SIDES = (0.6, 0.75, 0.9, 1.1, 1.4, 1.8, 2.4)


def circles(depths_m: tuple[float, ...], *, error: float = 0.02, seed: int = 0, per_picture: int = 20) -> Circles:
    """Pictures of a tilted board about each depth; errors of a picture are partly its own, as in life."""
    rng = np.random.default_rng(seed)
    picture = np.repeat(np.arange(len(depths_m)), per_picture)
    depth = np.repeat(depths_m, per_picture) * (1 + rng.uniform(-0.05, 0.05, picture.size))
    blur = thin_lens.blur_at_depth(depth, FOCUS, K_CAM, GAMMA)
    shared = rng.standard_normal(len(depths_m))[picture]
    noise = error * (0.7 * rng.standard_normal(picture.size) + 0.7 * shared)
    nowhere = np.zeros(picture.size, np.bool_)
    return Circles(depth, blur * (1 + noise), np.full(picture.size, 0.02), picture, nowhere)


def test_both_sides_of_focus_give_all_three() -> None:
    found = fit_constants(circles(BOTH_SIDES), resamples=40)
    assert found.k_cam_px.value == pytest.approx(K_CAM, rel=0.03)
    assert found.gamma_px.value == pytest.approx(GAMMA, abs=0.08)
    assert found.focus_distance_m.value == pytest.approx(FOCUS, rel=0.02)
    assert not found.warnings
    for interval in (found.k_cam_px, found.gamma_px, found.focus_distance_m):
        assert interval.low <= interval.value <= interval.high


def test_a_lens_focused_at_infinity_has_its_k_cam() -> None:
    k_cam, focus_m = 7e-5, 100_000.0
    some = circles(BOTH_SIDES, error=0.0)
    blur = np.asarray(thin_lens.blur_at_depth(some.depth_m, focus_m, k_cam, GAMMA))
    found = fit_constants(replace(some, blur_px=blur), focus_m, resamples=0)
    assert found.k_cam_px.value == pytest.approx(k_cam, rel=1e-3)


def test_exact_circles_are_fitted_exactly() -> None:
    found = fit_constants(circles(BOTH_SIDES, error=0.0), resamples=5)
    assert found.k_cam_px.value == pytest.approx(K_CAM, rel=1e-4)
    assert found.rms_px < 1e-3


def test_the_curve_is_that_of_the_camera_over_all_depths() -> None:
    some = circles(BOTH_SIDES, error=0.0)
    curve = fit_constants(some, resamples=5).curve
    depth_m = np.array([point.depth_m for point in curve])
    assert depth_m.min() < some.depth_m.min() < some.depth_m.max() < depth_m.max()
    assert np.ptp(np.diff(1 / depth_m)) < 1e-9, "in equal steps of 1/z"
    true = thin_lens.blur_at_depth(depth_m, FOCUS, K_CAM, GAMMA)
    np.testing.assert_allclose([point.blur_px for point in curve], true, rtol=1e-4)
    assert all(point.low_px < point.blur_px < point.high_px for point in curve)


def test_circles_none_of_which_is_nearly_sharp_tell_k_cam_too() -> None:
    some = circles((0.5, 0.6, 0.7, 1.9, 2.4), error=0.0)
    blur = np.asarray(thin_lens.blur_at_depth(some.depth_m, FOCUS, 75.0, GAMMA))
    assert blur.min() > 25
    found = fit_constants(replace(some, blur_px=blur), resamples=0)
    assert found.k_cam_px.value == pytest.approx(75.0, rel=1e-3)


def test_a_fit_can_be_stopped() -> None:
    def stop() -> None:
        raise InterruptedError

    with pytest.raises(InterruptedError):
        fit_constants(circles(BOTH_SIDES), tick=stop)


def test_the_intervals_hold() -> None:
    held = 0
    for seed in range(20):
        found = fit_constants(circles(BOTH_SIDES, seed=seed, per_picture=6), FOCUS, resamples=40)
        held += found.k_cam_px.low <= K_CAM <= found.k_cam_px.high
    assert held >= 17


def test_no_interval_is_narrower_than_what_all_pictures_share() -> None:
    """0.3 % of blur, 0.5 % for every doubling of it, 0.005 px of gamma, 0.05 % of the focus distance."""
    many = circles(tuple(np.geomspace(0.6, 2.4, 24).tolist()), error=0.0, per_picture=4)
    found = fit_constants(many, resamples=100)
    assert 0.02 < found.k_cam_px.relative_width < 0.026
    assert 0.002 < found.focus_distance_m.relative_width < 0.003
    pairs = replace(many, is_focused=many.picture % 2 == 0)
    blur = np.asarray(thin_lens.blur_from_defocus(K_CAM * pairs.excess(FOCUS), 0.2))
    gamma = fit_constants(replace(pairs, blur_px=blur), resamples=100).gamma_px
    assert 2 * 0.008 < gamma.high - gamma.low < 2 * 0.011


def test_what_few_pictures_cannot_show_is_in_their_intervals() -> None:
    """That each has an error of its own of 0.5 %, exact as they may be."""
    found = fit_constants(circles(BOTH_SIDES, error=0.0, per_picture=4), resamples=100)
    assert 0.003 < found.focus_distance_m.relative_width < 0.004
    of_two = fit_constants(circles((0.6, 1.8), error=0.0), resamples=100)
    assert of_two.k_cam_px.relative_width > 0.06, "and in how blur changes over its depths"


def test_a_few_wrong_circles_are_shown_and_move_little() -> None:
    some = circles(BOTH_SIDES)
    blur = some.blur_px.copy()
    blur[::25] *= 2.5
    found = fit_constants(replace(some, blur_px=blur), resamples=20)
    assert found.k_cam_px.value == pytest.approx(K_CAM, rel=0.05)
    assert found.is_outlier[::25].mean() > 0.8
    assert np.delete(found.is_outlier, np.s_[::25]).mean() < 0.05


def test_a_picture_that_is_odd_is_told_from_pictures_with_some_wrong_circles() -> None:
    some = circles(BOTH_SIDES)
    blur = some.blur_px.copy()
    blur[some.picture == 3] = np.hypot(blur[some.picture == 3], 2.0)
    blur[::25] *= 2.5
    wrong = replace(some, blur_px=blur)
    assert odd_pictures(wrong, fit_constants(wrong, resamples=0)) == [3]
    assert odd_pictures(some, fit_constants(some, resamples=0)) == []


@pytest.mark.parametrize(("times", "odd"), [(1.08, []), (1.15, [1])])
def test_a_picture_is_odd_that_is_blurred_by_more_than_a_tenth_otherwise(times: float, odd: list[int]) -> None:
    some = circles(BOTH_SIDES, error=0.002)
    wrong = replace(some, blur_px=np.where(some.picture == 1, times * some.blur_px, some.blur_px))
    found = fit_constants(wrong, resamples=0)
    assert found.is_outlier[some.picture == 1].all()
    assert odd_pictures(wrong, found) == odd


def test_one_side_is_said_and_stated_wide() -> None:
    near = (0.5, 0.55, 0.6, 0.65, 0.7)
    free = fit_constants(circles(near), resamples=40)
    given = fit_constants(circles(near), FOCUS, resamples=40)
    assert any("both sides" in warning for warning in free.warnings)
    assert free.k_cam_px.relative_width > 2 * given.k_cam_px.relative_width
    assert free.k_cam_px.low < K_CAM < free.k_cam_px.high
    assert given.k_cam_px.value == pytest.approx(K_CAM, rel=0.05)
    assert given.focus_distance_m.low == given.focus_distance_m.high == pytest.approx(FOCUS)


@pytest.mark.parametrize("focus_m", [8.0, 25.0, 125.0])
def test_a_focus_far_beyond_all_sheets_is_in_the_intervals_or_nothing_is_told(focus_m: float) -> None:
    """Where the search for it ended at three times the farthest sheet, k_cam came out up to twenty times too large."""
    some, k_cam = circles(BOTH_SIDES, error=0.01), 4.0 / focus_m
    off = some.blur_px / thin_lens.blur_at_depth(some.depth_m, FOCUS, K_CAM, GAMMA)
    far = replace(some, blur_px=off * thin_lens.blur_at_depth(some.depth_m, focus_m, k_cam, GAMMA))
    if focus_m < 10:
        found = fit_constants(far, resamples=40)
        assert found.k_cam_px.low < k_cam < found.k_cam_px.high
        assert found.gamma_px.low < GAMMA < found.gamma_px.high
        assert found.focus_distance_m.low < focus_m < found.focus_distance_m.high
        return
    with pytest.raises(FitError, match="focus it nearer, or give focus_distance_m"):
        fit_constants(far, resamples=40)


@pytest.mark.parametrize(
    ("given", "off"), [(0.985, 0), (1.0, 0), (1.015, 0), (0.97, 1), (1.05, 1), (0.95, 1), (1.12, 2), (0.8, 2)]
)
def test_a_focus_distance_that_the_pictures_contradict_is_said_and_one_far_off_is_an_error(
    given: float, off: int
) -> None:
    some = circles(BOTH_SIDES, error=0.005 if off else 0.02)
    said = rf"the photographs say 1\.(19|20)\d m \(1\.1\d\d to 1\.2\d\d\), not the {given * FOCUS:g} m given"
    if off == 2:
        with pytest.raises(FitError, match=said):
            fit_constants(some, given * FOCUS, resamples=20)
        return
    warnings = fit_constants(some, given * FOCUS, resamples=20).warnings
    assert [bool(re.match(said, warning)) for warning in warnings[:1]] == [True] * off
    assert not any("separate" in warning for warning in warnings)


def test_a_focus_distance_that_one_side_does_not_tell_is_not_doubted() -> None:
    near = fit_constants(circles((0.5, 0.55, 0.6, 0.65, 0.7)), 1.3 * FOCUS, resamples=10)
    assert not any("photographs say" in warning for warning in near.warnings)
    assert near.warnings[0].startswith("all circles are on one side")


def test_pictures_in_focus_are_on_no_side_of_it() -> None:
    some = circles((0.5, 0.55, 0.6, 0.65, 0.7, 2.0), error=0.005)
    is_focused = some.picture == 5
    some = replace(some, blur_px=np.where(is_focused, GAMMA, some.blur_px), is_focused=is_focused)
    assert any("all circles are nearer than" in warning for warning in fit_constants(some, resamples=10).warnings)
    given = fit_constants(some, 1.3 * FOCUS, resamples=10)
    assert any("on one side" in warning or "photographs say" in warning for warning in given.warnings)


def test_a_focus_distance_that_one_side_tells_well_is_held_against_the_given_one() -> None:
    near = circles((0.5, 0.6, 0.7, 0.8, 0.9, 1.0), error=0.002)
    wrong = fit_constants(near, 1.1 * FOCUS, resamples=20)
    assert wrong.k_cam_px.high < K_CAM
    assert re.match(r"the photographs say 1\.(19|20)\d m", wrong.warnings[0])
    assert not fit_constants(near, FOCUS, resamples=20).warnings


def test_little_defocus_is_said_and_none_is_an_error() -> None:
    some = circles((1.18, 1.2, 1.22))
    assert any("little is blurred" in warning for warning in fit_constants(some, FOCUS, resamples=10).warnings)
    sharp = replace(some, depth_m=np.linspace(1.19, 1.21, some.depth_m.size), blur_px=np.full(some.depth_m.size, GAMMA))
    with pytest.raises(FitError, match="no circle is blurred"):
        fit_constants(sharp, FOCUS, resamples=10)


def test_two_lenses_mixed_are_said() -> None:
    one, other = circles((0.6, 0.9, 1.8, 2.4)), circles((0.62, 0.88, 1.9, 2.5))
    blur = np.hypot(GAMMA, np.sqrt(other.blur_px**2 - GAMMA**2) * 1.6)
    mixed = Circles(
        *(
            np.concatenate(pair)
            for pair in (
                (one.depth_m, other.depth_m),
                (one.blur_px, blur),
                (one.blur_error_px, other.blur_error_px),
                (one.picture, other.picture + 4),
                (one.is_focused, other.is_focused),
            )
        )
    )
    assert any("no one curve fits" in warning for warning in fit_constants(mixed, resamples=10).warnings)


def test_too_few_circles_are_an_error_and_fewer_than_three_pictures_a_warning() -> None:
    with pytest.raises(FitError, match="3 defocused circles"):
        fit_constants(circles((0.6,), per_picture=3))
    for depths_m, is_told in (((0.6,), True), ((0.6, 1.8), True), ((0.6, 0.9, 1.8), False)):
        found = fit_constants(circles(depths_m, error=0.005), FOCUS, resamples=20)
        assert any("fewer than three" in warning for warning in found.warnings) == is_told


def test_pictures_in_focus_show_gamma_alone() -> None:
    some = circles((*BOTH_SIDES, 0.5))
    is_focused = some.picture == len(BOTH_SIDES)
    some = replace(some, blur_px=np.where(is_focused, GAMMA, some.blur_px), is_focused=is_focused)
    found = fit_constants(some, resamples=0)
    assert found.k_cam_px.value == pytest.approx(K_CAM, rel=0.03)
    assert found.gamma_px.value == pytest.approx(GAMMA, rel=0.03)


def test_what_depths_are_off_by_together_is_in_the_intervals() -> None:
    some = circles(BOTH_SIDES, error=0.002)
    sure, unsure = (fit_constants(some, depth_error=error, resamples=40).focus_distance_m for error in (0.0, 0.03))
    assert unsure.relative_width > 4 * 0.03 > 2 * sure.relative_width


def test_of_one_picture_circles_are_drawn() -> None:
    exact, noisy = (fit_constants(circles((0.6,), error=error), FOCUS, resamples=20).k_cam_px for error in (0.0, 0.1))
    assert noisy.relative_width > 3 * exact.relative_width


@pytest.mark.parametrize(("depths_m", "side"), [((0.5, 0.6, 0.7), "nearer than"), ((1.7, 2.0, 2.4), "beyond")])
def test_the_one_side_is_named(depths_m: tuple[float, ...], side: str) -> None:
    warnings = fit_constants(circles(depths_m, error=0.002), resamples=0).warnings
    assert any(f"all circles are {side} the focus" in warning for warning in warnings)


def test_a_picture_a_little_off_with_a_few_wrong_circles_is_not_odd() -> None:
    some = circles(BOTH_SIDES)
    blur = np.where(some.picture == 3, 1.15 * some.blur_px, some.blur_px)
    blur[np.flatnonzero(some.picture == 3)[:4]] *= 2.5
    wrong = replace(some, blur_px=blur)
    found = fit_constants(wrong, resamples=0)
    assert odd_pictures(wrong, found) == []


def test_a_circle_tells_k_cam_alone_unless_it_is_in_focus_or_nearly() -> None:
    some = circles((*BOTH_SIDES, FOCUS), error=0.0)
    alone = per_circle_k_cam(some, GAMMA, FOCUS)
    is_out = thin_lens.relative_defocus(some.depth_m, FOCUS) > 0.05
    np.testing.assert_allclose(alone[is_out], K_CAM, rtol=1e-6)
    assert np.isnan(alone[~is_out]).all()
    assert 0 < is_out.sum() < is_out.size


def test_by_a_large_k_cam_circles_tell_it_that_are_clearly_blurred_however_near_focus() -> None:
    depth_m = np.linspace(0.095, 0.105, 21)
    blur = np.asarray(thin_lens.blur_at_depth(depth_m, 0.1, 300.0, GAMMA))
    nowhere = np.zeros(depth_m.size, np.bool_)
    alone = per_circle_k_cam(Circles(depth_m, blur, np.full(21, 0.02), np.arange(21), nowhere), GAMMA, 0.1)
    is_clear = np.abs(depth_m - 0.1) > 0.0008
    np.testing.assert_allclose(alone[is_clear], 300.0, rtol=1e-6)
    assert np.isnan(alone[~is_clear]).all()


def test_close_by_a_focus_distance_is_contradicted_to_more_than_millimetres() -> None:
    some = circles(BOTH_SIDES, error=0.0)
    some = replace(some, depth_m=0.05 * some.depth_m)
    with pytest.raises(FitError, match=r"say 0\.0(6000|5999) m \(0\.0[56]\d\d\d to 0\.06\d\d\d\), not the 0.066 m"):
        fit_constants(some, 0.066, resamples=0)


@pytest.mark.parametrize("times", [0.6, 1.6])
def test_the_papers_k_cam_is_what_most_circles_tell(times: float) -> None:
    some = circles((*BOTH_SIDES, 0.5))
    is_focused = some.picture == len(BOTH_SIDES)
    blur = np.where(is_focused, GAMMA, some.blur_px)
    blur[::12] *= times
    some = replace(some, blur_px=blur, is_focused=is_focused)
    found = fit_as_paper(some, FOCUS, depth_error=0.0, resamples=0)
    assert found.k_cam_px.value == pytest.approx(K_CAM, rel=0.015)
    assert found.gamma_px.value == pytest.approx(GAMMA)
    with pytest.raises(FitError, match="focused and of defocused"):
        fit_as_paper(circles(BOTH_SIDES), FOCUS, depth_error=0.0, resamples=0)
    with pytest.raises(FitError, match="no circle is blurred"):
        fit_as_paper(replace(some, blur_px=np.where(is_focused, GAMMA, 0.9 * GAMMA)), FOCUS, depth_error=0, resamples=2)


@pytest.mark.parametrize("given", [None, FOCUS])
def test_pictures_that_were_each_focused_elsewhere_are_to_be_taken_with_the_focus_locked(given: float | None) -> None:
    locked = circles(BOTH_SIDES)
    elsewhere = np.array([1.1, 0.9, 1.1, 0.9, 1.1, 0.9, 1.1])[locked.picture]
    moved = replace(locked, depth_m=locked.depth_m * elsewhere)
    said = [" ".join(fit_constants(each, given, resamples=40).warnings) for each in (locked, moved)]
    assert ["lock the focus" in words for words in said] == [False, True]
    assert not any("on one side" in words for words in said)


@pytest.mark.parametrize(("times", "is_told"), [(9.5, True), (10.5, False)])
def test_a_k_cam_whose_interval_spans_ten_times_is_none(times: float, *, is_told: bool) -> None:
    with nullcontext() if is_told else pytest.raises(FitError, match=f"anything from 2 to {2 * times:.2g} by these"):
        check_span(Interval(5.0, 2.0, 2.0 * times))


def test_a_k_cam_that_may_be_anything_is_none() -> None:
    """As a phone's photographs show it: pictures differ, and not by defocus."""
    some = circles((0.5, 0.6, 0.7, 0.8))
    by_picture = replace(some, blur_px=np.array([0.43, 0.67, 0.46, 0.49])[some.picture])
    with pytest.raises(FitError, match=r"k_cam_px may be anything from \S+ to \S+ by .* both nearer and farther"):
        fit_constants(by_picture, resamples=20)


@pytest.mark.parametrize("depths_m", [(0.6, 1.8), (0.5, 0.6, 0.7)])
def test_the_intervals_of_few_pictures_hold_and_tell_something(depths_m: tuple[float, ...]) -> None:
    """Errors as simulated lenses make them: of single pictures, and of all blur, more where it is larger."""
    for seed in range(3):
        some = circles(depths_m, error=0.005, seed=seed)
        trend = 0.005 * np.random.default_rng(seed).standard_normal() * np.log2(some.blur_px / 2)
        found = fit_constants(replace(some, blur_px=some.blur_px * np.exp(trend)), resamples=40)
        for interval, true in ((found.k_cam_px, K_CAM), (found.focus_distance_m, FOCUS)):
            assert interval.low <= true <= interval.high
            assert interval.relative_width < (0.1 if len(depths_m) == 2 else 0.8)
