"""Known depths through real graphs: the focus distance follows from them, and sides do."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from service.inference.artifact import load_model_folder
from service.inference.cancellation import Cancellation
from service.inference.copies import Read
from service.inference.depth_map import DepthMap
from service.inference.estimator import Estimator
from service.inference.known import LIKE_BLUR, REACH, Clues, KnownDepth
from service.inference.pair import GraphPair, RawMaps, Side, Sights
from service.inference.part import Part
from service.optics.camera import Camera
from service.optics.focus import Sighting, fit_focus
from tests.inference.oracle_pair import brightness_for, build_oracle_pair

TOLD = Camera(384, 256, 2.0, 6.0, 0.5)
TRUE = TOLD.focused_at(1.8)
LEFT_M, RIGHT_M = 1.0, 3.0
KNOWN = (KnownDepth(60, 120, LEFT_M), KnownDepth(330, 40, RIGHT_M))
EVENLY = 128
SIDES: tuple[Side, Side] = ("near", "far")


@pytest.fixture(scope="module")
def estimator(tmp_path_factory: pytest.TempPathFactory) -> Estimator:
    return Estimator.from_folder(load_model_folder(build_oracle_pair(tmp_path_factory.mktemp("model"))))


@pytest.fixture(scope="module")
def doubtful_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model that states errors of 10 %."""
    return build_oracle_pair(tmp_path_factory.mktemp("doubtful"), depth_scale=0.07)


def photograph(red: int | None = None) -> NDArray[np.uint8]:
    """A near thing beside a far one, as the true camera shows them; ``red`` is what the oracle takes for the side."""
    picture = np.empty((256, 384, 3), np.uint8)
    picture[:, :192] = brightness_for(TRUE.blur_px(LEFT_M))
    picture[:, 192:] = brightness_for(TRUE.blur_px(RIGHT_M))
    if red is not None:
        # the oracle reads blur off the mean of the colours
        picture[..., 1:] = np.clip((3 * picture[..., :1].astype(int) - red) / 2, 0, 255).round()
        picture[..., 0] = red
    return picture


def test_the_answer_is_by_the_camera_focused_where_known_depths_say(estimator: Estimator) -> None:
    told = estimator.estimate(photograph(), TOLD, "near")
    corrected = estimator.estimate(photograph(), TOLD, known=KNOWN)
    assert corrected.camera.focus_distance_m == pytest.approx(1.8, rel=0.03)
    assert corrected.camera.k_cam_px == pytest.approx(TRUE.k_cam_px, rel=0.03)
    assert told.depth_m[120, 60] > 1.05 * LEFT_M
    assert corrected.depth_m[120, 60] == pytest.approx(LEFT_M, rel=0.03)
    assert told.warnings == ()
    assert len(corrected.warnings) == 1
    assert "where 2 m was told" in corrected.warnings[0]


def of_halves(
    estimator: Estimator, told: Camera, true_m: float, depths_m: tuple[float, float]
) -> tuple[DepthMap, tuple[KnownDepth, ...]]:
    """What is answered of two halves at known depths, by a camera focused elsewhere than it is told; and these."""
    blur_px = [told.focused_at(true_m).blur_px(depth_m) for depth_m in depths_m]
    picture = np.empty((256, 384, 3), np.uint8)
    picture[:, :192], picture[:, 192:] = map(brightness_for, blur_px)
    known = tuple(replace(point, depth_m=depth_m) for point, depth_m in zip(KNOWN, depths_m, strict=True))
    return estimator.estimate(picture, told, known=known), known


def test_the_focus_follows_from_known_depths_where_it_is_far_away_too(estimator: Estimator) -> None:
    answer, known = of_halves(estimator, Camera(384, 256, 20.0, 1.5, 0.5), 16.0, (4.0, 10.0))
    assert answer.camera.focus_distance_m == pytest.approx(16.0, rel=0.1)
    for point in known:
        assert answer.depth_m[int(point.v), int(point.u)] == pytest.approx(point.depth_m, rel=0.03)


def test_a_lens_told_to_be_at_infinity_is_answered_as_it_is_focused_and_told_of_in_words(estimator: Estimator) -> None:
    answer, _ = of_halves(estimator, Camera(384, 256, 100_000.0, 7.6e-5, 0.5), 3.0, (0.8, 1.5))
    assert answer.camera.focus_distance_m == pytest.approx(3.0, rel=0.15)
    assert "where infinity was told" in answer.warnings[0]


def test_a_gamma_that_was_told_wrongly_follows_too(estimator: Estimator) -> None:
    blurry = replace(TRUE, gamma_px=1.0)
    picture = photograph()
    picture[100:200, 250:384] = brightness_for(blurry.blur_px(TRUE.focus_distance_m))
    known = (*KNOWN, KnownDepth(320, 150, TRUE.focus_distance_m))
    answer = estimator.estimate(picture, TOLD, known=known)
    assert answer.camera.gamma_px == pytest.approx(1.0, rel=0.15)
    assert answer.camera.focus_distance_m == pytest.approx(1.8, rel=0.05)
    assert any("where 0.5 was told" in warning for warning in answer.warnings)


def test_the_interval_told_takes_the_error_of_blur_for_a_laplace_law_s_scale() -> None:
    blur_px, scale = TRUE.blur_px(LEFT_M), 0.2
    values = {"blur_px": blur_px, "blur_log_error": np.log(scale), "p_near": 0.9}
    maps = {name: np.full((128, 192), value, np.float32) for name, value in values.items()}
    clues = Clues.of(Read(maps, TOLD, Part(0, 0, 384, 256), 2, (1.0,), 22.0), TOLD, "near", KNOWN[:1])
    fit = fit_focus(TOLD, [Sighting(LEFT_M, blur_px, 2**0.5 * scale)], is_near=True)
    assert clues.camera.focus_distance_m == pytest.approx(fit.focus_distance_m, rel=1e-3)
    assert f"({fit.low_m:.4g} to {fit.high_m:.4g})" in clues.warnings[0]


def test_of_one_thing_close_to_focus_the_side_asked_for_tells_where_focus_was() -> None:
    values = {"blur_px": TOLD.blur_px(1.9), "blur_log_error": -3.0, "p_near": 0.5}
    maps = {name: np.full((128, 192), value, np.float32) for name, value in values.items()}
    read = Read(maps, TOLD, Part(0, 0, 384, 256), 2, (1.0,), 22.0)
    near, far = (Clues.of(read, TOLD, side, [KnownDepth(9, 9, 1.9)]).camera for side in SIDES)
    assert near.focus_distance_m == pytest.approx(2.0, rel=0.04)
    assert far.focus_distance_m < 1.91 < near.focus_distance_m - 0.02


def test_a_side_that_is_known_is_that_of_what_is_like_it_and_near_by(estimator: Estimator) -> None:
    answer = estimator.estimate(photograph(red=EVENLY), TOLD, known=KNOWN)
    near, far = answer.depth_m[110:130, 50:70], answer.depth_m[30:50, 320:340]
    np.testing.assert_allclose(near, LEFT_M, rtol=0.05)
    np.testing.assert_allclose(far, RIGHT_M, rtol=0.1)
    assert (answer.p_near[110:130, 50:70] > 0.9).all()
    assert (answer.p_near[30:50, 320:340] < 0.1).all()


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_a_known_depth_speaks_for_what_is_near_by_and_as_blurred_on_any_copy(scale: float) -> None:
    rows, columns = round(128 * scale), round(192 * scale)
    values = {"blur_px": TRUE.blur_px(LEFT_M) * scale, "blur_log_error": -3.0, "p_near": 0.9}
    maps = {name: np.full((rows, columns), value, np.float32) for name, value in values.items()}
    maps["blur_px"][: rows // 2] *= np.exp(LIKE_BLUR)
    copied = TOLD.resized(2 * columns, 2 * rows)
    read = Read(maps, copied, Part(0, 0, 384, 256), 2, (scale,), 22.0)
    likeness = Clues.of(read, TOLD, "auto", [KnownDepth(100, 130, LEFT_M)]).likeness(read)[0]
    there, above = read.cell_of(100, 130), read.cell_of(100, 125)
    beside, below = read.cell_of(100 + REACH * 384, 130), read.cell_of(100, 130 + REACH * 384)
    assert likeness[there] == pytest.approx(1, abs=0.01)
    assert [likeness[cell] for cell in (above, beside, below)] == pytest.approx([np.exp(-0.5)] * 3, abs=0.03)


@pytest.mark.parametrize(("other_m", "red", "more"), [(0.95, 20, 0.1), (RIGHT_M, 180, -0.1)])
def test_where_the_model_mistakes_a_side_all_others_are_doubted(
    estimator: Estimator, other_m: float, red: int, more: float
) -> None:
    picture = photograph(red=100)
    picture[:40, :40] = brightness_for(TRUE.blur_px(other_m))
    picture[:40, :40, 0] = red  # taken for the other side's
    before, after = (
        estimator.estimate(picture, TOLD, known=known).p_near[250, 380] for known in ((), [KnownDepth(10, 10, other_m)])
    )
    assert (after - before) / more > 1


def test_where_depth_is_known_the_answer_is_that_and_far_from_there_it_is_the_blurs(estimator: Estimator) -> None:
    at_m = 0.93 * LEFT_M  # what blur says is 1 m
    known = [*KNOWN, *(KnownDepth(u, 180, LEFT_M) for u in (120, 140, 160)), KnownDepth(20, 20, at_m)]
    depth_m = estimator.estimate(photograph(), TOLD, "near", known=known).depth_m
    assert depth_m[20, 20] == pytest.approx(at_m, rel=0.005)
    assert depth_m[20, 60] > 1.01 * depth_m[20, 20]
    assert depth_m[120, 60] == pytest.approx(LEFT_M, rel=0.01)
    assert depth_m[240, 100] == pytest.approx(LEFT_M, rel=0.03)


def test_an_error_is_the_tapes_where_depth_is_known_and_the_models_far_from_there(doubtful_model: Path) -> None:
    doubtful = Estimator.from_folder(load_model_folder(doubtful_model))
    stated = {}
    for known in ((), KNOWN):
        answer = doubtful.estimate(photograph(), TOLD, "near", known=known)
        stated[len(known)] = answer.sigma_m / answer.depth_m
    assert stated[0].min() > 0.09
    assert stated[2][120, 60] == pytest.approx(0.02, abs=0.005)
    assert stated[2][120, 60] < stated[2][120, 90] < stated[2][120, 150]
    assert stated[2][250, 180] == pytest.approx(stated[0][250, 180], rel=0.1)


def test_no_known_depth_moves_an_answer_to_more_than_twice_or_half(estimator: Estimator) -> None:
    known = (*KNOWN, KnownDepth(61, 121, LEFT_M), KnownDepth(20, 20, 0.2))
    answer = estimator.estimate(photograph(), TOLD, "near", known=known)
    assert answer.depth_m[20, 20] == pytest.approx(LEFT_M / 2, rel=0.05)
    assert answer.sigma_m[20, 20] / answer.depth_m[20, 20] > np.log(2)
    assert any("for the known depth of 0.2 m" in warning for warning in answer.warnings)


def test_a_known_side_holds_where_the_model_is_sure_of_the_other(estimator: Estimator) -> None:
    answer = estimator.estimate(photograph(red=1), TOLD, known=KNOWN)
    assert answer.depth_m[120, 60] == pytest.approx(LEFT_M, rel=0.03)
    assert answer.p_near[120, 60] > 0.9


@pytest.mark.parametrize(
    ("red", "told"),
    [
        *((red, "60,120 looks surely beyond") for red in (1, 10)),
        *((red, "330,40 looks surely nearer than") for red in (245, 254)),
        *((red, "") for red in (16, EVENLY, 239)),  # 0.95 is 242
    ],
)
def test_a_known_depth_on_the_side_where_the_photograph_surely_is_not_is_told_of(
    estimator: Estimator, red: int, told: str
) -> None:
    answer = estimator.estimate(photograph(red), TOLD, known=KNOWN)
    assert [told in warning for warning in answer.warnings if "looks surely" in warning] == [True] * bool(told)


def test_two_depths_of_one_pixel_are_an_error_of_that_much_and_told_of(estimator: Estimator) -> None:
    known = [*KNOWN, KnownDepth(60, 120, 0.6 * LEFT_M)]
    answer = estimator.estimate(photograph(), TOLD, "near", known=known)
    assert 0.6 * LEFT_M < answer.depth_m[120, 60] < LEFT_M
    assert answer.sigma_m[120, 60] / answer.depth_m[120, 60] > 0.2
    assert sum("for the known depth" in warning for warning in answer.warnings) == len(known)


@pytest.mark.parametrize(("times", "is_told"), [(0.84, False), (0.79, True)])
def test_an_answer_a_tenth_off_what_is_known_is_told_of(estimator: Estimator, times: float, *, is_told: bool) -> None:
    """Half way between two depths of one pixel."""
    known = [*KNOWN, KnownDepth(60, 120, times * LEFT_M)]
    warnings = estimator.estimate(photograph(), TOLD, "near", known=known).warnings
    told = [warning for warning in warnings if "at 60,120 for the known depth" in warning]
    assert len(told) == 2 * is_told


@pytest.mark.parametrize(("side", "pixel", "depth_m"), [("near", (330, 40), RIGHT_M), ("far", (60, 120), LEFT_M)])
def test_a_side_that_is_asked_for_stays_and_a_depth_on_the_other_is_told_of(
    estimator: Estimator, side: Side, pixel: tuple[int, int], depth_m: float
) -> None:
    answer = estimator.estimate(photograph(red=EVENLY), TOLD, side, known=KNOWN)
    u, v = pixel
    focus_m = answer.camera.focus_distance_m
    assert (answer.p_near == (side == "near")).all()
    assert (answer.depth_m <= focus_m).all() if side == "near" else (answer.depth_m >= focus_m).all()
    assert answer.sigma_m[v, u] > 0.5 * abs(answer.depth_m[v, u] - depth_m)
    assert any(f"at {u},{v} for the known depth of {depth_m:g} m" in warning for warning in answer.warnings)


def test_a_depth_that_blur_speaks_against_is_told_of(estimator: Estimator) -> None:
    known = (*KNOWN, KnownDepth(340, 200, RIGHT_M), KnownDepth(90, 200, 1.7))
    answer = estimator.estimate(photograph(), TOLD, known=known)
    assert [warning for warning in answer.warnings if "speaks against" in warning] == [
        "its blur speaks against the known depth of 1.7 m at 90,200"
    ]
    assert answer.camera.focus_distance_m == pytest.approx(1.8, rel=0.05)


def test_a_part_has_the_answers_of_the_whole_wherever_the_known_depths_are(estimator: Estimator) -> None:
    picture, part = photograph(red=EVENLY), Part(192, 128, 384, 256)
    whole = estimator.estimate(picture, TOLD, known=KNOWN)
    asked = estimator.estimate(picture, TOLD, part=part, known=KNOWN)
    assert asked.camera.focus_distance_m == whole.camera.focus_distance_m
    np.testing.assert_allclose(asked.depth_m, whole.depth_m[128:256, 192:384], rtol=1e-3)


def test_a_photograph_that_is_read_on_a_smaller_copy_has_the_same_answer(estimator: Estimator) -> None:
    large = replace(TOLD, image_width_px=1280, image_height_px=853, k_cam_px=10.0)
    true = large.focused_at(1.8)
    picture = np.empty((853, 1280, 3), np.uint8)
    picture[:, :640], picture[:, 640:] = (brightness_for(true.blur_px(z) / 2) for z in (1.3, 2.4))
    known = [KnownDepth(200, 400, 1.3), KnownDepth(1100, 133, 2.4)]
    answer = estimator.estimate(picture, large, "near", known=known)
    assert answer.scales[0] == pytest.approx(0.5, abs=0.05)
    assert answer.camera.focus_distance_m == pytest.approx(1.8, rel=0.03)
    assert answer.depth_m[400, 200] == pytest.approx(1.3, rel=0.03)


@pytest.mark.parametrize("part", [None, Part(192, 128, 384, 256)])
def test_what_one_camera_was_asked_of_is_not_seen_again_for_the_other(
    estimator: Estimator, monkeypatch: pytest.MonkeyPatch, part: Part | None
) -> None:
    see, seen = GraphPair.see, []

    def noting(pair: GraphPair, rgb: NDArray[np.uint8], cancellation: Cancellation) -> RawMaps:
        seen.append(rgb.shape)
        return see(pair, rgb, cancellation)

    monkeypatch.setattr(GraphPair, "see", noting)
    estimator.estimate(photograph(), TOLD, part=part, known=KNOWN)
    assert len(seen) == 1


@pytest.mark.parametrize("at", [(-0.5, -0.5), (383.4, 255.4), (0, 255), (383, 0)])
def test_pixels_may_be_at_the_very_edge(estimator: Estimator, at: tuple[float, float]) -> None:
    depth_m = LEFT_M if at[0] < 192 else RIGHT_M
    answer = estimator.estimate(photograph(), TOLD, known=[KnownDepth(*at, depth_m)])
    assert 1.7 < answer.camera.focus_distance_m < 2.0


def test_what_was_seen_may_be_written_over() -> None:
    sights, picture = Sights(), np.zeros((8, 8, 3), np.uint8)
    sights.of(picture, lambda: {"blur_px": np.ones(3, np.float32)})["blur_px"] *= 2
    assert (sights.of(picture, dict)["blur_px"] == 1).all()


LARGE = Camera(1200, 900, 2.0, 4.0, 0.5)


def large_photograph() -> NDArray[np.uint8]:
    picture = np.empty((900, 1200, 3), np.uint8)
    true = LARGE.focused_at(1.8)
    picture[:] = brightness_for(true.blur_px(RIGHT_M))
    picture[640:700, 800:900] = brightness_for(true.blur_px(LEFT_M))
    return picture


def test_known_depths_of_a_large_photograph_are_read_where_they_are(estimator: Estimator) -> None:
    known = [KnownDepth(850, 670, LEFT_M), KnownDepth(700, 400, RIGHT_M)]
    answer = estimator.estimate(large_photograph(), LARGE, known=known)
    assert answer.camera.focus_distance_m == pytest.approx(1.8, rel=0.05)
    assert answer.depth_m[670, 850] == pytest.approx(LEFT_M, rel=0.05)
    part = Part(700, 600, 950, 750)
    asked = estimator.estimate(large_photograph(), LARGE, part=part, known=known)
    middle = slice(50, 90), slice(110, 190)
    np.testing.assert_allclose(asked.depth_m[middle], part.of(answer.depth_m)[middle], rtol=0.01)
    np.testing.assert_allclose(asked.p_near[middle], part.of(answer.p_near)[middle], atol=0.02)


def test_on_a_copy_the_tape_holds_too(estimator: Estimator) -> None:
    large = replace(TOLD, k_cam_px=24.0)
    true = large.focused_at(1.8)
    picture = np.empty((256, 384, 3), np.uint8)
    picture[:, :192], picture[:, 192:] = (brightness_for(true.blur_px(z) / 2) for z in (1.3, 2.4))
    others = (KnownDepth(u, 180, 1.3) for u in (60, 120, 140, 160))
    known = [KnownDepth(330, 40, 2.4), *others, KnownDepth(20, 20, 0.93 * 1.3)]
    answer = estimator.estimate(picture, large, "near", known=known)
    assert answer.depth_m[20, 20] == pytest.approx(0.93 * 1.3, rel=0.01)


def test_no_tape_moves_an_answer_over_focus(estimator: Estimator) -> None:
    picture = photograph()
    picture[10:60, 10:60] = brightness_for(TRUE.blur_px(1.6))
    known = (*KNOWN[:1], *(KnownDepth(u, 200, LEFT_M) for u in (90, 120, 150)), KnownDepth(35, 35, 1.9))
    answer = estimator.estimate(picture, TOLD, "near", known=known)
    assert answer.depth_m[35, 35] == pytest.approx(answer.camera.focus_distance_m, rel=0.02)
    assert (answer.depth_m <= answer.camera.focus_distance_m).all()


@pytest.mark.parametrize(("side", "pixel"), [("near", (330, 40)), ("far", (60, 120))])
def test_a_known_depth_on_the_other_side_moves_nothing(
    estimator: Estimator, side: Side, pixel: tuple[int, int]
) -> None:
    answer = estimator.estimate(photograph(red=EVENLY), TOLD, side, known=KNOWN)
    blurs = estimator.estimate(photograph(red=EVENLY), answer.camera, side)
    u, v = pixel
    assert answer.depth_m[v, u] == pytest.approx(blurs.depth_m[v, u], rel=0.02)


def test_a_known_depth_makes_no_answer(estimator: Estimator) -> None:
    picture = photograph()
    picture[:60, :60] = brightness_for(1.4 * TRUE.k_cam_px)
    answer = estimator.estimate(picture, TOLD, "far", known=(*KNOWN, KnownDepth(20, 20, 0.7)))
    assert not answer.valid[20, 20]
    assert answer.valid[40, 330]
    assert not any("is answered at 20,20" in warning for warning in answer.warnings)


def test_a_part_may_be_far_from_what_is_known(estimator: Estimator) -> None:
    camera = Camera(1200, 900, 2.0, 4.0, 0.5)
    picture = np.full((900, 1200, 3), brightness_for(camera.blur_px(LEFT_M)), np.uint8)
    part = Part(0, 0, 100, 50)
    answer = estimator.estimate(picture, camera, part=part, known=[KnownDepth(1100.4, 799.6, LEFT_M)])
    assert answer.depth_m.shape == (50, 100)
    np.testing.assert_allclose(answer.depth_m, LEFT_M, rtol=0.05)
