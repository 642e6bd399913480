"""From brightness to metres through real graphs: correction, scales, sides, no answer."""

import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from service.inference.artifact import Interval, load_model_folder
from service.inference.cancellation import Cancellation, Cancelled
from service.inference.depth_map import LEAST_BLUR_ERROR_PX, NO_ANSWER, Reading, decide, layers_at
from service.inference.estimator import SURROUNDINGS_PX, Estimator
from service.inference.hypotheses import in_metres
from service.inference.known import KnownDepth
from service.inference.pair import MAPS, GraphPair, RawMaps, Side
from service.inference.part import Part
from service.inference.resampling import Lines, Ratio
from service.inference.session import Graph
from service.optics import thin_lens
from service.optics.camera import Camera, Intrinsics
from tests.inference.oracle_pair import (
    LOG_DEPTH_SCALE,
    RELATIVE_BLUR_ERROR,
    blur_of,
    brightness_for,
    build_oracle_pair,
)

CAMERA = Camera(96, 64, 2.0, 6.0, 0.5)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_oracle_pair(tmp_path_factory.mktemp("model"))


@pytest.fixture(scope="module")
def estimator(folder: Path) -> Estimator:
    return Estimator.from_folder(load_model_folder(folder))


def grey(level: int, height: int = 64, width: int = 96) -> NDArray[np.uint8]:
    return np.full((height, width, 3), level, np.uint8)


def stated(times: float) -> float:
    """Relative deviation in metres where the network's stated error counts so many times."""
    return float(in_metres(np.array(times * np.sqrt(2) * LOG_DEPTH_SCALE, np.float32)))


def expected_x(level: float, camera: Camera = CAMERA) -> float:
    return thin_lens.relative_defocus_from_blur(blur_of(level), camera.gamma_px, camera.k_cam_px)


@pytest.mark.parametrize("level", [10, 60, 80, 100, 130])
def test_a_level_of_blur_becomes_the_thin_lens_depth_on_either_side(estimator: Estimator, level: int) -> None:
    x = expected_x(level)
    near = estimator.estimate(grey(level), CAMERA, "near")
    far = estimator.estimate(grey(level), CAMERA, "far")
    np.testing.assert_allclose(near.depth_m, thin_lens.depth_near(x, 2.0), rtol=1e-4)
    np.testing.assert_allclose(far.depth_m, thin_lens.depth_far(x, 2.0), rtol=1e-4)
    np.testing.assert_allclose(near.depth_alt_m, far.depth_m, rtol=1e-6)
    np.testing.assert_allclose(near.blur_px, blur_of(level), rtol=1e-4)
    assert (near.p_near == 1).all()
    assert (far.p_near == 0).all()


@pytest.mark.parametrize("focus_m", [5.0, 5.001, 8.0, 30.0, 1e5])
def test_a_lens_focused_far_away_tells_what_is_near_as_surely_as_one_focused_at_five_metres(
    estimator: Estimator, focus_m: float
) -> None:
    camera = Camera(96, 64, 5.0, 2.0).blurring_alike(focus_m)
    blur_px = camera.blur_px(1.5)
    answer = estimator.estimate(grey(brightness_for(blur_px)), camera, "near")
    depth_m = thin_lens.depth_near(expected_x(brightness_for(blur_px), camera), focus_m)
    assert answer.warnings == ()
    assert answer.camera == camera
    np.testing.assert_allclose(answer.depth_m, depth_m, rtol=1e-4)
    by_five_m = thin_lens.depth_at_focus(depth_m, focus_m, 5.0)
    floor = thin_lens.depth_error(depth_m, focus_m, camera.k_cam_px, LEAST_BLUR_ERROR_PX)
    np.testing.assert_allclose(answer.sigma_m, max(stated(depth_m / by_five_m) * depth_m, floor), rtol=1e-3)


def test_beyond_a_far_focus_depth_ends_where_blur_is_that_of_infinity(estimator: Estimator) -> None:
    camera = Camera(96, 64, 20.0, 2.0, 0.3)
    seen, beyond = brightness_for(camera.blur_px(60.0)), brightness_for(1.2 * camera.blur_px(1e9))
    answer = estimator.estimate(grey(seen), camera, "far")
    np.testing.assert_allclose(answer.depth_m, thin_lens.depth_far(expected_x(seen, camera), 20.0), rtol=1e-3)
    nothing = estimator.estimate(grey(beyond), camera, "far")
    assert not nothing.valid.any()
    near = estimator.estimate(grey(beyond), camera, "near")
    assert near.valid.all()
    assert np.isnan(near.depth_alt_m).all()


def test_at_a_farther_focus_what_had_no_answer_has_none_and_none_is_beyond_the_farthest() -> None:
    read_m = np.array([[1.0, 1.0, 1.9, 1.99, 2.5]], np.float32)
    error = np.array([[0.1, NO_ANSWER, 0.01, 0.01, 0.01]], np.float32)
    far_m = np.full_like(read_m, 1.9)
    reading = Reading(read_m, far_m, np.ones_like(read_m), error, np.ones_like(read_m), CAMERA, 1.0, Ratio(1, 1))
    moved = reading.at_focus(100_000.0, 100.0)
    np.testing.assert_array_equal(moved.error <= 1, [[True, False, True, False, False]])
    np.testing.assert_allclose(moved.depth_m[0, [0, 2]], 1 / (1 / read_m[0, [0, 2]] - 0.5 + 1e-5), rtol=1e-4)
    np.testing.assert_allclose(moved.error[0, [0, 2]], [0.2, 0.2], rtol=1e-2)
    assert moved.depth_m.max() == 100.0
    np.testing.assert_allclose(moved.other_m, 38.0, rtol=1e-2)
    assert np.isnan(reading.at_focus(100_000.0, 30.0).other_m).all()


def test_what_is_in_focus_is_on_neither_side(estimator: Estimator) -> None:
    sharp, blurred = brightness_for(CAMERA.gamma_px), 130
    found = [estimator.estimate(grey(level), CAMERA).p_near for level in (sharp, blurred)]
    np.testing.assert_allclose(found[0], 0.5, atol=0.05)
    np.testing.assert_allclose(found[1], blurred / 255, atol=0.01)


def test_sigma_is_in_metres_what_root_two_times_the_laplace_scale_is_in_log_depth(estimator: Estimator) -> None:
    answer = estimator.estimate(grey(80), CAMERA, "near")
    np.testing.assert_allclose(answer.sigma_m, stated(1) * answer.depth_m, rtol=1e-4)


def test_blur_is_multiplied_by_the_models_gain(folder: Path) -> None:
    model = load_model_folder(folder)
    lower = replace(model, manifest=model.manifest.model_copy(update={"blur_gain": 0.9}))
    answer = Estimator.from_folder(lower).estimate(grey(80), CAMERA, "near")
    x = thin_lens.relative_defocus_from_blur(0.9 * blur_of(80), CAMERA.gamma_px, CAMERA.k_cam_px)
    np.testing.assert_allclose(answer.blur_px, 0.9 * blur_of(80), rtol=1e-4)
    np.testing.assert_allclose(answer.depth_m, thin_lens.depth_near(x, CAMERA.focus_distance_m), rtol=1e-4)


def test_sigma_is_multiplied_by_the_models_temperature(folder: Path) -> None:
    model = load_model_folder(folder)
    warm = replace(model, manifest=model.manifest.model_copy(update={"temperature": 1.5}))
    answer = Estimator.from_folder(warm).estimate(grey(80), CAMERA, "near")
    np.testing.assert_allclose(answer.sigma_m, stated(1.5) * answer.depth_m, rtol=1e-4)


def test_sigma_is_never_below_what_a_twentieth_of_a_pixel_does_to_depth(estimator: Estimator) -> None:
    weak = Camera(96, 64, 2.0, 0.5, 0.5)
    answer = estimator.estimate(grey(10), weak, "near")
    floor = thin_lens.depth_error(answer.depth_m, 2.0, weak.k_cam_px, LEAST_BLUR_ERROR_PX)
    assert (floor > np.sqrt(2) * LOG_DEPTH_SCALE * answer.depth_m).all()
    np.testing.assert_allclose(answer.sigma_m, in_metres(floor / answer.depth_m) * answer.depth_m, rtol=1e-4)
    assert (answer.sigma_m >= floor).all()


@pytest.mark.parametrize("level", [80, 120])
def test_beyond_focus_sigma_is_what_the_error_of_blur_makes_of_depth(estimator: Estimator, level: int) -> None:
    near, far = (estimator.estimate(grey(level), CAMERA, side) for side in ("near", "far"))
    np.testing.assert_allclose(near.sigma_m, stated(1) * near.depth_m, rtol=1e-4)
    error = np.sqrt(2) * RELATIVE_BLUR_ERROR
    x_low, x, x_high = (expected_x(level * times) for times in (1 / (1 + error), 1, 1 + error))
    relative = np.full(1, (x_high - x_low) / 2 / (1 - x), np.float32)
    assert relative > 2 * np.sqrt(2) * LOG_DEPTH_SCALE
    np.testing.assert_allclose(far.sigma_m, in_metres(relative) * far.depth_m, rtol=1e-3)


def test_by_a_k_cam_below_those_that_the_model_knows_errors_grow_until_nothing_is_answered(
    estimator: Estimator,
) -> None:
    weak, nil = Camera(96, 64, 2.0, 0.1, 0.5), Camera(96, 64, 2.0, 0.01, 0.5)
    answer = estimator.estimate(grey(13), weak, "near")
    assert (answer.sigma_m / answer.depth_m > 0.95 * 5 * np.sqrt(2) * LOG_DEPTH_SCALE).all()
    assert not estimator.estimate(grey(13), nil, "near").valid.any()


def half_sharp(sharp_px: float, blurred: int = 130) -> NDArray[np.uint8]:
    """Half a photograph in focus, half as blurred as a level of grey says."""
    picture = grey(blurred)
    picture[:, :48] = brightness_for(sharp_px)
    return picture


def test_no_photograph_is_sharper_than_its_gamma(estimator: Estimator) -> None:
    # registered at a sixth of the size, where the copy was as soft by the pixel
    soft = replace(CAMERA, gamma_px=6 * CAMERA.gamma_px)
    answer = estimator.estimate(half_sharp(1.0), soft, "near")
    sharp_px = blur_of(brightness_for(1.0))
    x = thin_lens.relative_defocus_from_blur(blur_of(130), sharp_px, CAMERA.k_cam_px)
    assert answer.camera.gamma_px == pytest.approx(sharp_px, rel=1e-3)
    np.testing.assert_allclose(answer.depth_m[:, :40], CAMERA.focus_distance_m, rtol=3e-3)
    np.testing.assert_allclose(answer.depth_m[:, 56:], thin_lens.depth_near(x, CAMERA.focus_distance_m), rtol=3e-3)
    assert answer.warnings == ("gamma_px taken as 1.02, where 3 was told: the photograph is sharper than that",)
    bordered = half_sharp(1.0)
    bordered[:, -8:] = 0
    assert estimator.estimate(bordered, soft, "near").warnings == (
        "a black border, 8% of the photograph, shows nothing: no answer there",
        *answer.warnings,
    )


@pytest.mark.parametrize("gamma_px", [0.0, 0.5, 1.3])
def test_a_gamma_that_may_be_true_is_taken(estimator: Estimator, gamma_px: float) -> None:
    answer = estimator.estimate(half_sharp(1.0), replace(CAMERA, gamma_px=gamma_px), "near")
    assert answer.camera.gamma_px == gamma_px
    assert answer.warnings == ()


def test_what_is_sharpest_is_in_focus_if_it_is_about_as_sharp_as_gamma(estimator: Estimator) -> None:
    softer_px, blurred = 1.2 * CAMERA.gamma_px, 130
    answer = estimator.estimate(half_sharp(softer_px), CAMERA, "near")
    assert answer.camera == CAMERA
    assert answer.warnings == ()
    # by the gamma that was told 1.9 m, by what is shown 2
    x = thin_lens.relative_defocus_from_blur(softer_px, CAMERA.gamma_px, CAMERA.k_cam_px)
    assert 2 - answer.depth_m[0, 10] < 0.75 * (2 - thin_lens.depth_near(x, 2.0))
    np.testing.assert_allclose(answer.depth_m[:, 56:], thin_lens.depth_near(expected_x(blurred), 2.0), rtol=2e-3)


def test_where_all_is_much_softer_than_gamma_it_is_out_of_focus(estimator: Estimator) -> None:
    level = brightness_for(4 * CAMERA.gamma_px)
    answer = estimator.estimate(grey(level), CAMERA, "near")
    np.testing.assert_allclose(answer.depth_m, thin_lens.depth_near(expected_x(level), 2.0), rtol=1e-4)


@pytest.mark.parametrize("level", [2, 253])
def test_of_a_lens_cap_or_an_overexposed_photograph_nothing_is_answered(estimator: Estimator, level: int) -> None:
    noise = np.random.default_rng(0).integers(-2, 3, (64, 96, 3))
    answer = estimator.estimate((level + noise).astype(np.uint8), CAMERA)
    assert not answer.valid.any()
    assert np.isnan(answer.depth_m).all()
    assert answer.warnings[0] == "the photograph is black or white all over: nothing is seen in it"


def test_of_a_dark_photograph_with_something_in_it_that_is_answered(estimator: Estimator) -> None:
    dark = grey(2)
    dark[:, 48:] = 7
    assert estimator.estimate(dark, CAMERA).valid.all()


@pytest.mark.parametrize("part", [None, Part(0, 8, 96, 40), Part(20, 8, 60, 40)])
@pytest.mark.parametrize("k_cam_px", [6.0, 48.0])  # read as it is, and on a smaller copy
def test_a_black_border_is_not_answered_and_changes_no_answer(
    estimator: Estimator, part: Part | None, k_cam_px: float
) -> None:
    camera, picture = replace(CAMERA, k_cam_px=k_cam_px), grey(60)
    picture[:, 72:] = 130
    plain = estimator.estimate(picture, camera, "near", part=part)
    picture[:, :24] = 0
    answer = estimator.estimate(picture, camera, "near", part=part)
    hidden = max(0, 24 - (part.left if part else 0))
    assert not answer.valid[:, : hidden - 2].any()
    np.testing.assert_allclose(answer.depth_m[:, hidden + 4 :], plain.depth_m[:, hidden + 4 :], rtol=1e-5)
    assert answer.warnings == (
        "a black border, 25% of the photograph, shows nothing: no answer there",
        *plain.warnings,
    )


def test_what_is_hidden_is_not_answered_and_changes_no_answer(estimator: Estimator) -> None:
    picture, hidden = grey(60), np.zeros((64, 96), np.bool_)
    plain = estimator.estimate(picture, CAMERA, "near")
    hidden[20:44, 36:60] = True  # in the middle, where no border is
    picture[hidden] = np.random.default_rng(0).integers(0, 255, (24 * 24, 3))
    picture[:, :24] = 0
    answer = estimator.estimate(picture, CAMERA, "near", hidden=hidden)
    assert not answer.valid[20:44, 36:60].any()
    assert not answer.valid[:, :22].any()
    np.testing.assert_allclose(answer.depth_m[answer.valid], plain.depth_m[answer.valid], rtol=1e-3)
    assert answer.valid[:, 64:].all()
    assert answer.warnings == (
        "what is transparent, 9% of the photograph, shows nothing: no answer there",
        "a black border, 25% of the photograph, shows nothing: no answer there",
        *plain.warnings,
    )


@pytest.mark.parametrize("side", ["auto", "near"])
def test_relative_defocus_of_one_and_more_is_near(estimator: Estimator, side: Side) -> None:
    level = 200
    x = expected_x(level)
    assert x > 1
    answer = estimator.estimate(grey(level), CAMERA, side)
    np.testing.assert_allclose(answer.depth_m, thin_lens.depth_near(x, 2.0), rtol=1e-4)
    assert np.isnan(answer.depth_alt_m).all()
    assert (answer.p_near == 1).all()


def test_of_what_is_far_blur_that_only_near_things_have_has_no_answer(estimator: Estimator) -> None:
    halves = grey(100)
    halves[:, 48:] = 200
    answer = estimator.estimate(halves, CAMERA, "far")
    assert (answer.depth_m[:, :46] > CAMERA.focus_distance_m).all()
    assert answer.valid[:, :46].all()
    assert not answer.valid[:, 50:].any()
    assert np.isnan(answer.depth_m[:, 50:]).all()
    assert (answer.p_near == 0).all()


@pytest.mark.parametrize(
    ("x", "relative_error", "may_be_beyond"), [(1.2, 0.05, False), (1.2, 0.1, True), (3.0, 0.2, False)]
)
def test_blur_no_surer_than_that_may_lie_beyond_focus_all_the_same(
    folder: Path, x: float, relative_error: float, may_be_beyond: bool
) -> None:
    blur_px = thin_lens.blur_from_defocus(x * CAMERA.k_cam_px, CAMERA.gamma_px)
    values = dict.fromkeys(MAPS, 1.0) | {"blur_px": blur_px, "blur_log_error": float(np.log(relative_error))}
    maps = {name: np.full((32, 48), value, np.float32) for name, value in values.items()}
    reading = Reading.of(maps, CAMERA, (64, 96), load_model_folder(folder).manifest, "auto", 20.0)
    assert np.isfinite(reading.other_m).all() == may_be_beyond


@pytest.mark.parametrize(
    ("near_m", "far_m", "p_near", "is_near"),
    [
        (1.5, 3.0, 0.34, False),
        (1.5, 3.0, 0.36, True),
        (1.5, 2.0, 0.42, False),
        (1.5, 2.0, 0.44, True),
        (0.2, 9.0, 0.34, False),
        (1.99, 2.01, 0.49, False),
        (1.99, 2.01, 0.51, True),
    ],
)
def test_the_side_is_the_one_that_is_off_by_less_on_average(
    folder: Path, near_m: float, far_m: float, p_near: float, is_near: bool
) -> None:
    values = dict.fromkeys(MAPS, 0.0) | {"blur_px": 2.0, "blur_log_error": -3.0, "p_near": p_near, "log_scale": -12.0}
    values |= {"log_ratio_near": np.log(near_m / 2), "log_ratio_far": np.log(far_m / 2)}
    maps = {name: np.full((32, 48), value, np.float32) for name, value in values.items()}
    reading = Reading.of(maps, CAMERA, (64, 96), load_model_folder(folder).manifest, "auto", 20.0)
    answer, other = (near_m, far_m) if is_near else (far_m, near_m)
    np.testing.assert_allclose(decide(reading, (64, 96))[0], answer, rtol=1e-4)
    layers = layers_at(reading, 96, Lines.between(0, 64, 0, 96))
    np.testing.assert_allclose(layers.depth_alt_m, other, rtol=1e-4)
    np.testing.assert_allclose(layers.p_near, p_near, rtol=1e-4)


def test_doubt_between_depths_far_apart_is_said_and_still_an_answer(folder: Path) -> None:
    values = dict.fromkeys(MAPS, 0.0) | {"blur_px": 2.0, "blur_log_error": -3.0, "p_near": 0.4, "log_scale": -3.0}
    values |= {"log_ratio_near": np.log(0.2), "log_ratio_far": np.log(7.0)}
    maps = {name: np.full((32, 48), value, np.float32) for name, value in values.items()}
    reading = Reading.of(maps, CAMERA, (64, 96), load_model_folder(folder).manifest, "auto", 20.0)
    assert decide(reading, (64, 96))[1].all()
    layers = layers_at(reading, 96, Lines.between(0, 64, 0, 96))
    np.testing.assert_allclose(layers.sigma_m, layers.depth_m, rtol=0.01)
    assert (layers.sigma_m <= layers.depth_m).all()


def test_auto_follows_the_features_handed_from_graph_to_graph(estimator: Estimator) -> None:
    rgb = grey(0)
    rgb[:, :48, 0] = 255
    rgb[:, 48:, 1] = 255
    answer = estimator.estimate(rgb, CAMERA)
    assert (answer.depth_m[:, :40] < 2).all()
    assert (answer.depth_m[:, 56:] > 2).all()


@pytest.mark.parametrize("size", [(1, 1), (7, 5), (17, 33), (100, 250)])
def test_any_size_is_answered_at_its_own_size(estimator: Estimator, size: tuple[int, int]) -> None:
    height, width = size
    answer = estimator.estimate(grey(60, height, width), Camera(width, height, 2.0, 6.0), "near")
    assert answer.depth_m.shape == size
    assert answer.valid.all()
    np.testing.assert_allclose(answer.depth_m, answer.depth_m[0, 0], rtol=1e-5)


def test_maps_are_aligned_with_the_photograph_to_a_fraction_of_a_pixel(estimator: Estimator) -> None:
    ramp = np.linspace(20, 140, 96).round().astype(np.uint8)
    rgb = np.repeat(np.repeat(ramp[np.newaxis, :, np.newaxis], 64, axis=0), 3, axis=2)
    answer = estimator.estimate(rgb, CAMERA, "near")
    np.testing.assert_allclose(answer.blur_px[32, 2:-2], ramp[2:-2] / 255 * 10, atol=0.04)


@pytest.mark.parametrize(
    ("width_px", "k_cam_px", "scales"),
    [
        (600, 48.0, (1, 0.5, 0.25)),
        (640, 20.0, (1, 0.6)),
        (1280, 96.0, (0.5, 0.25, 0.125)),
        (1280, 2000.0, (0.5, 0.25, 0.125, 0.075)),
    ],
)
def test_what_a_large_k_cam_hardly_blurs_is_read_on_larger_copies(
    estimator: Estimator, width_px: int, k_cam_px: float, scales: tuple[float, ...]
) -> None:
    camera = Camera(width_px, width_px // 4, 2.0, k_cam_px, 0.2)
    answer = estimator.estimate(grey(40, width_px // 4, width_px), camera, "near")
    assert answer.scales == pytest.approx(scales, rel=0.02)
    size = round(width_px * answer.scales[0]), round(width_px // 4 * answer.scales[0])
    x = thin_lens.relative_defocus_from_blur(blur_of(40), camera.averaged(*size).gamma_px, k_cam_px * answer.scales[0])
    np.testing.assert_allclose(answer.depth_m, thin_lens.depth_near(x, 2.0), rtol=1e-3)
    assert not any("k_cam_px" in words for words in answer.warnings)


def test_no_copy_is_larger_than_the_model_knows_its_k_cam(folder: Path) -> None:
    model = load_model_folder(folder)
    ranges = model.manifest.ranges.model_copy(update={"k_cam_px": Interval(0.5, 7.5)})
    narrow = replace(model, manifest=model.manifest.model_copy(update={"ranges": ranges}))
    answer = Estimator.from_folder(narrow).estimate(grey(100, 160, 640), Camera(640, 160, 2.0, 15.0), "near")
    assert answer.scales[-1] == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("width_px", "k_cam_px", "scale"),
    [(640, 7.5, 1.0), (1600, 7.5, 5 / 7.5), (1600, 20.0, 0.4), (1600, 1.3, 1.0), (2560, 48.0, 0.25)],
)
def test_of_a_large_picture_a_copy_is_read_that_shows_much_at_a_time_and_enough_blur(
    estimator: Estimator, width_px: int, k_cam_px: float, scale: float
) -> None:
    picture = grey(40, width_px // 4, width_px)
    camera = Camera(width_px, width_px // 4, 2.0, k_cam_px)
    assert estimator.estimate(picture, camera, "near").scales == pytest.approx((scale,), rel=0.01)
    part = estimator.estimate(picture, camera, "near", part=Part(0, 0, 40, 40))
    assert part.scales == pytest.approx((scale,), rel=0.05)


def test_a_small_copy_keeps_the_place_of_things(estimator: Estimator) -> None:
    rgb = grey(20, 403, 605)
    rgb[:, 300:] = 120
    answer = estimator.estimate(rgb, Camera(605, 403, 2.0, 40.0, 0.5), "near")
    middle = (answer.blur_px[200, 0] + answer.blur_px[200, -1]) / 2
    assert abs(int(np.argmax(answer.blur_px[200] > middle)) - 300) <= 1


@pytest.fixture(scope="module")
def halving(tmp_path_factory: pytest.TempPathFactory) -> Estimator:
    """It knows blur to 20 px, so that of 3.4 px and more is read on a copy of half the size, and there alike."""
    folder = build_oracle_pair(tmp_path_factory.mktemp("model"), blur_range=Interval(0.3, 20.0))
    return Estimator.from_folder(load_model_folder(folder))


def test_what_a_smaller_copy_shows_as_strong_blur_is_not_read_on_a_larger_one(halving: Estimator) -> None:
    picture = grey(20, 160, 640)
    picture[:, 320:] = brightness_for(3.3)  # that many pixels of either copy
    answer = halving.estimate(picture, Camera(640, 160, 2.0, 24.0, 0.5), "near")
    assert answer.scales == pytest.approx((1.0, 0.5))
    np.testing.assert_allclose(answer.blur_px[:, :280], blur_of(20), rtol=0.01)
    np.testing.assert_allclose(answer.blur_px[:, 360:], 2 * 3.3, rtol=0.05)


def test_strong_blur_by_a_large_k_cam_is_read_on_smaller_copies_and_reported(halving: Estimator) -> None:
    camera = Camera(1200, 800, 2.0, 96.0, 0.5)
    answer = halving.estimate(grey(brightness_for(8.0), 800, 1200), camera, "near")
    assert answer.scales == pytest.approx((0.125, 0.0625, 0.03125), rel=0.02)
    working_blur, copy = blur_of(brightness_for(8.0)), camera.averaged(150, 100).averaged(75, 50).averaged(38, 25)
    x = thin_lens.relative_defocus_from_blur(working_blur, copy.gamma_px, copy.k_cam_px)
    np.testing.assert_allclose(answer.depth_m, thin_lens.depth_near(x, 2.0), rtol=0.01)
    np.testing.assert_allclose(answer.blur_px, working_blur * 32, rtol=0.02)
    assert "read at 0.125 of full size (150x100)" in answer.warnings
    assert answer.camera == camera


@pytest.mark.parametrize("size", [(64, 96), (63, 101), (50, 203)])
def test_strong_blur_is_read_on_smaller_copies(halving: Estimator, size: tuple[int, int]) -> None:
    height, width = size
    rgb = grey(brightness_for(1.8), height, width)
    rgb[:, width // 2 :] = brightness_for(8.0)
    camera = replace(CAMERA, image_width_px=width, image_height_px=height)
    answer = halving.estimate(rgb, camera, "near")
    assert answer.scales == pytest.approx((1, 0.5, 0.25), rel=0.02)
    copied = camera
    for _ in range(2):
        copied = copied.averaged(round(copied.image_width_px * 0.5), round(copied.image_height_px * 0.5))
    for columns, told, seen_by in (
        (slice(0, width // 2 - 14), 1.8, camera),
        (slice(width // 2 + 14, width), 8.0, copied),
    ):
        blur_px = blur_of(brightness_for(told))
        np.testing.assert_allclose(answer.blur_px[:, columns], blur_px * width / seen_by.image_width_px, rtol=1e-4)
        x = thin_lens.relative_defocus_from_blur(blur_px, seen_by.gamma_px, seen_by.k_cam_px)
        # the other half surrounds it, and is heard a little
        np.testing.assert_allclose(answer.depth_m[:, columns], thin_lens.depth_near(x, 2.0), rtol=2e-3)


def test_between_two_copies_no_step_shows(halving: Estimator) -> None:
    ramp = np.linspace(brightness_for(1.0), brightness_for(6.0), 640).round().astype(np.uint8)
    rgb = np.repeat(np.repeat(ramp[np.newaxis, :, np.newaxis], 64, axis=0), 3, axis=2)
    answer = halving.estimate(rgb, replace(CAMERA, image_width_px=640), "near")
    assert answer.scales == (1, 0.5, 0.25)
    steps = np.diff(np.log(answer.blur_px[32, 8:-8]))
    assert steps.min() >= 0
    assert steps.max() < 0.05  # the oracle reads each copy twice as blurred: a step would be ln 2


@pytest.mark.parametrize(
    ("blur_px", "k_cam_px", "scales"),
    [(3.3, 6.0, (1,)), (8.0, 0.9, (1,)), (8.0, 1.9, (1, 0.5)), (8.0, 2.1, (1, 0.5, 0.25))],
)
def test_no_more_copies_are_read_where_no_blur_is_strong_or_the_model_knows_no_such_k_cam(
    halving: Estimator, blur_px: float, k_cam_px: float, scales: tuple[float, ...]
) -> None:
    picture = grey(brightness_for(blur_px))
    assert halving.estimate(picture, replace(CAMERA, k_cam_px=k_cam_px), "near").scales == scales


def test_a_few_cells_of_strong_blur_are_not_worth_a_second_copy(halving: Estimator) -> None:
    picture = grey(brightness_for(1.0))
    picture[20:22, 40:42] = brightness_for(8.0)
    assert halving.estimate(picture, CAMERA, "near").scales == (1,)
    picture[20:24, 40:44] = brightness_for(8.0)
    assert halving.estimate(picture, CAMERA, "near").scales == (1, 0.5, 0.25)


def test_what_lies_outside_the_trained_ranges_is_said(estimator: Estimator) -> None:
    camera = Camera(96, 64, 0.3, 0.2, 3.0, intrinsics=Intrinsics(20, 20, 48, 32))
    told = " / ".join(estimator.estimate(grey(60), camera).warnings)
    for name in ("k_cam_px", "gamma_px", "focus_distance_m"):
        assert name in told
    assert "fx_px" not in told  # any field of view reads as well


def test_the_gamma_that_a_large_photograph_s_copy_has_is_no_warning(tmp_path: Path) -> None:
    folder = load_model_folder(build_oracle_pair(tmp_path / "model", blur_range=Interval(0.3, 40.0)))
    ranges = folder.manifest.ranges.model_copy(update={"gamma_px": Interval(0.3, 1.5)})
    manifest = folder.manifest.model_copy(update={"ranges": ranges})
    estimator = Estimator.from_folder(replace(folder, manifest=manifest))
    large = Camera(1152, 768, 2.0, 300.0, 0.5)
    answer = estimator.estimate(grey(brightness_for(8.0), 768, 1152), large, "near")
    assert max(answer.scales) < 0.17  # of which gamma is hardly more than a pixel's box, 0.29
    assert not [warning for warning in answer.warnings if "gamma_px" in warning]
    (told,) = estimator.estimate(grey(60), replace(CAMERA, gamma_px=0.2), "near").warnings
    assert "gamma_px at that size is 0.2" in told


def test_an_answer_that_is_too_unsure_is_none(tmp_path: Path) -> None:
    unsure = Estimator.from_folder(load_model_folder(build_oracle_pair(tmp_path / "m", depth_scale=0.8)))
    answer = unsure.estimate(grey(60), CAMERA, "near")
    assert not answer.valid.any()
    for hidden in (answer.depth_m, answer.depth_alt_m, answer.sigma_m):
        assert np.isnan(hidden).all()
    assert "only 0% of the pixels have an answer" in answer.warnings


def test_more_blur_than_the_model_was_trained_on_has_no_answer(tmp_path: Path) -> None:
    folder = build_oracle_pair(tmp_path / "model", blur_range=Interval(0.3, 5.0))
    halves = np.hstack([grey(brightness_for(4.0), 64, 48), grey(brightness_for(6.0), 64, 48)])
    valid = Estimator.from_folder(load_model_folder(folder)).estimate(halves, CAMERA, "near").valid
    assert valid[:, :46].all()
    assert not valid[:, 50:].any()


@pytest.mark.parametrize(("blur_px", "k_cam_px", "side"), [(6.0, 1.0, "near"), (5.7, 6.0, "far")])
def test_depths_beyond_the_models_range_have_no_answer(
    estimator: Estimator, blur_px: float, k_cam_px: float, side: Side
) -> None:
    beyond = estimator.estimate(grey(brightness_for(blur_px)), replace(CAMERA, k_cam_px=k_cam_px), side)
    within = estimator.estimate(grey(brightness_for(0.8 * blur_px)), replace(CAMERA, k_cam_px=k_cam_px), side)
    assert not beyond.valid.any()
    assert within.valid.all()


def test_two_threads_get_the_answer_of_one(estimator: Estimator) -> None:
    levels = [10, 50, 90, 130]
    found: dict[int, float] = {}

    def ask(level: int) -> None:
        found[level] = float(estimator.estimate(grey(level), CAMERA, "near").depth_m[0, 0])

    threads = [threading.Thread(target=ask, args=(level,)) for level in levels]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for level in levels:
        assert found[level] == pytest.approx(thin_lens.depth_near(expected_x(level), 2.0), rel=1e-4)


def tiles_seen(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, ...]]:
    """The shapes of what the blur graph is shown from here on."""
    seen: list[tuple[int, ...]] = []
    see = GraphPair.see

    def noting(pair: GraphPair, tile: NDArray[np.uint8], cancellation: Cancellation) -> RawMaps:
        seen.append(tile.shape)
        return see(pair, tile, cancellation)

    monkeypatch.setattr(GraphPair, "see", noting)
    return seen


def test_a_part_is_read_with_its_surroundings_and_no_more(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    estimator = Estimator.from_folder(load_model_folder(folder))
    rgb = np.random.default_rng(0).integers(40, 130, (900, 1200, 3), np.uint8)
    camera = Camera(1200, 900, 2.0, 4.0, 0.5)
    whole, part = estimator.estimate(rgb, camera, "near"), Part(500, 400, 560, 430)
    seen = tiles_seen(monkeypatch)
    answer = estimator.estimate(rgb, camera, "near", part=part)
    np.testing.assert_allclose(answer.depth_m, part.of(whole.depth_m), rtol=1e-5)
    assert (answer.width_px, answer.height_px) == (60, 30)
    assert (answer.camera.image_width_px, answer.camera.image_height_px) == (60, 30)
    ((height, width, _),) = seen
    assert 60 + 2 * SURROUNDINGS_PX <= width < 60 + 2 * SURROUNDINGS_PX + 16
    assert 30 + 2 * SURROUNDINGS_PX <= height < 30 + 2 * SURROUNDINGS_PX + 16


@pytest.mark.parametrize(
    ("size", "k_cam_px", "part"),
    [
        ((1440, 1920), 6.0, Part(700, 501, 900, 640)),
        ((1441, 1923), 6.0, Part(1801, 1300, 1923, 1441)),
        ((2304, 3072), 12.0, Part(2000, 1100, 2200, 1300)),  # read at 0.42 of full size
    ],
)
def test_a_part_of_strong_blur_is_read_on_smaller_copies_of_more_that_surrounds_it(
    halving: Estimator, monkeypatch: pytest.MonkeyPatch, size: tuple[int, int], k_cam_px: float, part: Part
) -> None:
    down, across = (np.linspace(brightness_for(1.5), brightness_for(4.5), pixels) for pixels in size)
    rgb = np.repeat((down[:, np.newaxis] + across).round().astype(np.uint8)[..., np.newaxis], 3, axis=2)
    camera = Camera(size[1], size[0], 2.0, k_cam_px)
    whole = halving.estimate(rgb, camera, "near")
    seen = tiles_seen(monkeypatch)
    answer = halving.estimate(rgb, camera, "near", part=part)
    assert answer.scales == pytest.approx(whole.scales, rel=0.01)
    assert len(seen) == 3
    for tile, scale in zip(seen, answer.scales, strict=True):
        area = part.widened(round(SURROUNDINGS_PX / scale), 1, size[1], size[0])
        assert -1 / scale <= tile[0] / scale - area.height_px < 18 / scale
        assert -1 / scale <= tile[1] / scale - area.width_px < 18 / scale
    # a step of brightness is 2 % of this blur
    np.testing.assert_allclose(answer.blur_px, part.of(whole.blur_px), rtol=0.02 if answer.scales[0] < 1 else 1e-3)


def test_a_part_is_warned_of_for_itself(tmp_path: Path) -> None:
    folder = build_oracle_pair(tmp_path / "model", blur_range=Interval(0.3, 5.0))
    thirds = np.hstack([grey(brightness_for(4.0), 64, 48), grey(brightness_for(6.0), 64, 96)])
    camera = replace(CAMERA, image_width_px=144)
    estimator = Estimator.from_folder(load_model_folder(folder))
    blurred, sparse = "67% of the pixels show more blur than the model was trained on", "only 33% of the pixels"
    told = " / ".join(estimator.estimate(thirds, camera, "near").warnings)
    assert blurred in told
    assert sparse in told
    assert not estimator.estimate(thirds, camera, "near", part=Part(4, 8, 36, 40)).warnings
    told = " / ".join(estimator.estimate(thirds, camera, "near", part=Part(80, 8, 120, 40)).warnings)
    assert "100% of the pixels show more blur" in told
    assert "only 0% of the pixels" in told


def test_what_a_large_photograph_has_taken_is_freed_a_little_later(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    freed = threading.Semaphore(0)
    monkeypatch.setattr(GraphPair, "free_memory", lambda _: freed.release())
    monkeypatch.setattr("service.inference.estimator.KEPT_S", 0.01)
    estimator = Estimator.from_folder(load_model_folder(folder))
    estimator.estimate(grey(40, 60, 90), Camera(90, 60, 2.0, 6.0))
    assert not freed.acquire(timeout=0.1)
    estimator.estimate(grey(40, 700, 900), Camera(900, 700, 2.0, 6.0))
    assert freed.acquire(timeout=10)


def test_a_camera_of_another_size_is_refused(estimator: Estimator) -> None:
    with pytest.raises(ValueError, match="64x96"):
        estimator.estimate(grey(60, 96, 64), CAMERA)


def test_cancelled_work_stops(estimator: Estimator) -> None:
    cancellation = Cancellation()
    cancellation.cancel()
    with pytest.raises(Cancelled):
        estimator.estimate(grey(60), CAMERA, "auto", cancellation)


def test_a_run_inside_the_graph_stops_when_asked(folder: Path) -> None:
    pair = GraphPair(load_model_folder(folder), intra_op_threads=1)
    cancellation = Cancellation()
    ended: list[BaseException] = []

    def keep_reading() -> None:
        try:
            while True:
                Estimator(pair).estimate(grey(60, 640, 960), Camera(960, 640, 2.0, 6.0), "auto", cancellation)
        except Cancelled as exc:
            ended.append(exc)

    thread = threading.Thread(target=keep_reading)
    thread.start()
    cancellation.cancel()
    thread.join(timeout=20)
    assert not thread.is_alive()
    assert len(ended) == 1


def test_the_stages_are_timed(estimator: Estimator) -> None:
    timings = estimator.estimate(grey(60), CAMERA).timings_ms
    assert set(timings) == {"blur", "correct", "depth", "encode"}
    assert all(spent > 0 for spent in timings.values())


@pytest.mark.parametrize(("side", "hint"), [("auto", 0.0), ("near", -1.0), ("far", 1.0)])
def test_the_depth_graph_is_told_the_side_and_the_camera(
    estimator: Estimator, monkeypatch: pytest.MonkeyPatch, side: Side, hint: float
) -> None:
    run = Graph.run
    fed: list[Any] = []

    def noting(graph: Graph, feeds: Any, *options: Any, **named: Any) -> Any:
        fed.append(feeds)
        return run(graph, feeds, *options, **named)

    monkeypatch.setattr(Graph, "run", noting)
    estimator.estimate(grey(60), replace(CAMERA, intrinsics=Intrinsics(300, 300, 47.5, 31.5)), side)
    told = [[float(feeds[name][0]) for name in ("side", "focal_length_px", "focus_distance_m")] for feeds in fed[1:]]
    assert told == [[hint, 300.0, 2.0]]


def test_errors_grow_where_k_cam_is_smaller_than_the_model_knows(estimator: Estimator) -> None:
    weak = Camera(96, 64, 2.0, 0.1, 0.0)
    answer = estimator.estimate(grey(8), weak, "near")
    np.testing.assert_allclose(answer.sigma_m / answer.depth_m, stated(5), rtol=0.01)


def test_what_optics_cannot_tell_has_no_answer(estimator: Estimator) -> None:
    assert not estimator.estimate(grey(12), Camera(96, 64, 2.0, 0.03, 0.5), "near").valid.any()


def test_gamma_of_a_copy_is_told_for_the_photograph(estimator: Estimator) -> None:
    picture = half_sharp(1.0).repeat(20, 0).repeat(20, 1)
    answer = estimator.estimate(picture, Camera(1920, 1280, 2.0, 15.0, gamma_px=9.0), "near")
    assert answer.scales[0] == pytest.approx(1 / 3)
    sharp_px = thin_lens.gamma_before_averaging(blur_of(brightness_for(1.0)), 1920, 640)
    assert answer.camera.gamma_px == pytest.approx(sharp_px, rel=1e-3)


def test_blur_of_a_copy_is_held_against_what_the_model_knows_of_it(tmp_path: Path) -> None:
    limited = Estimator.from_folder(load_model_folder(build_oracle_pair(tmp_path / "m", blur_range=Interval(0.3, 5.0))))
    answer = limited.estimate(grey(brightness_for(4.0), 400, 600), Camera(600, 400, 2.0, 48.0, 0.5), "near")
    assert answer.scales[0] == 0.25
    assert not any("more blur" in warning for warning in answer.warnings)


def test_gamma_is_what_is_seen_where_depths_are_known_too(estimator: Estimator) -> None:
    soft = replace(CAMERA, gamma_px=6 * CAMERA.gamma_px)
    answer = estimator.estimate(half_sharp(1.0), soft, "near", known=[KnownDepth(10, 10, 2.0)])
    assert answer.warnings[0].startswith("gamma_px taken as 1.02, where 3 was told")


@pytest.mark.parametrize("sharp", [np.s_[256:], np.s_[:, 576:]], ids=["below", "beyond what the part is read with"])
def test_gamma_is_that_of_all_the_photograph_where_a_part_is_read(
    estimator: Estimator, sharp: slice | tuple[slice, slice]
) -> None:
    picture = grey(130, 512, 1152)
    picture[sharp] = brightness_for(1.0)
    soft = Camera(1152, 512, 2.0, 4.0, gamma_px=3.0)
    answer = estimator.estimate(picture, soft, "near", part=Part(0, 0, 30, 30))
    assert answer.camera.gamma_px == pytest.approx(blur_of(brightness_for(1.0)), rel=1e-3)


@pytest.mark.parametrize("side", ["near", "far"])
def test_answers_in_doubt_stay_on_the_side_that_is_asked_for(tmp_path: Path, side: Side) -> None:
    doubtful = Estimator.from_folder(load_model_folder(build_oracle_pair(tmp_path / "m", depth_scale=0.3)))
    v, u = np.mgrid[-32:32, -48:48]
    # where what is about a thing is in focus, the plane through both leads over to the other side
    picture = np.repeat((6 + 100 * np.exp(-(u**2 + v**2) / 150))[..., None], 3, 2).astype(np.uint8)
    depth_m = doubtful.estimate(picture, CAMERA, side).depth_m
    assert np.nanmax(depth_m) <= 2.0 if side == "near" else np.nanmin(depth_m) >= 2.0


def test_a_part_has_the_cells_that_it_touches() -> None:
    cells = np.arange(6 * 8).reshape(6, 8)
    np.testing.assert_array_equal(Part(10, 10, 31, 21).cells_of(cells, (60, 80)), cells[1:3, 1:4])
    np.testing.assert_array_equal(Part(0, 0, 80, 60).cells_of(cells, (60, 80)), cells)


def test_a_part_may_be_one_pixel(estimator: Estimator) -> None:
    assert estimator.estimate(grey(60), CAMERA, "near", part=Part(10, 10, 11, 11)).valid.all()
