"""Evaluation, with a pair whose answers are known."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from model_export.calibrated import calibrated
from model_export.cases import (
    REFERENCE,
    Case,
    d200_cases,
    enlarged_cases,
    procedural_cases,
    sharp_cases,
    shuffled_cases,
    viewed_cases,
)
from model_export.cli import commands
from model_export.corrections import blur_gain, record_corrections, temperature, unseen_cases
from model_export.evaluate import Examiner, evaluate
from model_export.evaluation_sets import ORACLE_FACTORS, EvaluationSet, evaluation_sets
from model_export.modes import ESTIMATED_K_CAM, MODES, RIGHT_SIDE, UNSEEN_K_CAM_PX
from model_export.report_page import write
from model_export.summary import EQUAL_BLUR_PX, Pixels, Relief, Report, Sides, blur_ranges, summarise
from model_export.tables import beside, tables
from service.inference.artifact import Interval, load_model_folder, write_manifest
from service.inference.hypotheses import in_metres
from service.inference.pair import Side
from service.optics import thin_lens
from service.optics.camera import Camera
from tests.inference.oracle_pair import LOG_DEPTH_SCALE, RELATIVE_BLUR_ERROR, blur_of, build_oracle_pair

CAMERA = Camera(96, 64, 2.0, 6.0, 0.5)
LEVEL = 85


@pytest.fixture(scope="module")
def oracle(tiny_model_dir: Path) -> Examiner:
    return Examiner(tiny_model_dir)


def case(factor: float) -> Case:
    """A grey picture whose depth the oracle knows, and a truth that is that depth times a factor."""
    x = thin_lens.relative_defocus_from_blur(blur_of(LEVEL), CAMERA.gamma_px, CAMERA.k_cam_px)
    truth = np.full((64, 96), thin_lens.depth_near(x, CAMERA.focus_distance_m) * factor, np.float32)
    truth[:, :10] = np.nan
    return Case("grey", np.full((64, 96, 3), LEVEL, np.uint8), truth, CAMERA, "near")


def test_a_right_answer_scores_nothing_and_a_wrong_one_its_error(oracle: Examiner) -> None:
    for factor, error in ((1.0, 0.0), (2.0, 0.5)):
        outcome, _ = oracle.answer(case(factor))
        assert outcome.scores.abs_rel == pytest.approx(error, abs=1e-3)
        assert outcome.scored_pixels == 64 * 86


def test_a_large_picture_is_seen_all_over_and_no_larger_in_what_is_kept_of_it(oracle: Examiner) -> None:
    """Every 100th of its pixels, which are 3000 such, would be its left column."""
    truth = np.tile(np.linspace(1, 3, 100, dtype=np.float32), (3000, 1))
    camera = Camera(100, 3000, 2.0, 6.0, 0.5)
    large = Case("large", np.full((3000, 100, 3), LEVEL, np.uint8), truth, camera, "near", truth)
    outcome, example = oracle.answer(large)
    assert outcome.depth.truth.mean() == pytest.approx(2, abs=0.05)
    assert np.unique(outcome.depth.truth).size > 90
    assert outcome.blur is not None
    assert outcome.blur.truth.size < 2**16
    assert example.image.shape[0] == example.sigma_m.shape[0] == 1500


def test_a_summary_is_pooled_over_pixels_and_averaged_over_pictures(oracle: Examiner) -> None:
    small = case(2.0)
    small.truth_m[:, :53] = np.nan
    summary = summarise("two", "gt", [oracle.answer(case(1.0))[0], oracle.answer(small)[0]])
    assert summary.pictures == 2
    assert summary.answered == 1
    assert summary.mean.abs_rel == pytest.approx(0.25, abs=1e-3)
    assert summary.pooled.abs_rel == pytest.approx(0.5 / 3, abs=1e-3)
    with pytest.raises(ValueError, match="no picture"):
        summarise("none", "gt", [])


def test_errors_are_told_by_how_far_out_of_focus_the_truth_is(oracle: Examiner) -> None:
    """Both truths are nearer than focus: one at x 0.58, the other at half of its depth."""
    summary = summarise("two", "gt", [oracle.answer(case(factor))[0] for factor in (1.0, 0.5)])
    near, nearer = (CAMERA.focus_distance_m / one.truth_m[0, -1] - 1 for one in (case(1.0), case(0.5)))
    assert 0.5 < near < 1.0 < nearer < 2.2
    blurs = [thin_lens.blur_from_defocus(x * CAMERA.k_cam_px, CAMERA.gamma_px) for x in (near, nearer)]
    for value, error in zip(blurs, (0.0, 1.0), strict=True):
        (span,) = (f"{low:g}-{high:g}" for low, high in EQUAL_BLUR_PX if low <= value < high)
        assert summary.equal_blur[span] == pytest.approx(error, abs=1e-3)
    assert summary.equal_defocus["0.5-1"] == pytest.approx(0, abs=1e-3)
    assert summary.equal_defocus["0.1-0.25"] is None


def test_a_wrong_k_cam_is_told_to_the_estimator(oracle: Examiner) -> None:
    """x is read too small by a tenth, so s1 / (1 + x) too far."""
    right = case(1.0)
    x = CAMERA.focus_distance_m / right.truth_m[0, -1] - 1
    outcome, _ = oracle.answer(right, "k_cam +10%")
    assert outcome.median_error == pytest.approx((1 + x) / (1 + x / 1.1) - 1, rel=1e-3)


@pytest.mark.parametrize(("mode", "factor"), [("focus -10%", 0.9), ("focus +10%", 1.1)])
def test_a_wrong_focus_distance_is_told_to_the_estimator(oracle: Examiner, mode: str, factor: float) -> None:
    """k_cam follows it, so x is read so many times as large."""
    right = case(1.0)
    x = CAMERA.focus_distance_m / right.truth_m[0, -1] - 1
    outcome, _ = oracle.answer(right, mode)
    assert outcome.median_error == pytest.approx(abs(factor * (1 + x) / (1 + factor * x) - 1), rel=1e-3)


def test_known_depths_make_up_for_a_wrong_focus_distance(oracle: Examiner) -> None:
    told, known = (
        oracle.answer(case(1.0), mode)[0].scores.abs_rel for mode in ("focus +10%", "focus +10%, known depths")
    )
    assert told > 0.03
    assert known < told / 3


def test_what_a_user_knows_is_something_near_something_between_and_something_far() -> None:
    truth = np.linspace(0.5, 3.5, 61, dtype=np.float32).reshape(1, 61).repeat(4, 0)
    truth[:2] = np.nan
    known = replace(case(1.0), truth_m=truth).known_depths
    np.testing.assert_allclose([point.depth_m for point in known], [1.0, 2.0, 3.0], atol=0.05)
    assert all(truth[int(point.v), int(point.u)] == point.depth_m for point in known)


def test_a_whole_evaluation_answers_by_cameras_known_by_their_sheets_too(data: Path) -> None:
    modes = {each.name: each.modes for each in evaluation_sets(data, quick=False)}
    assert all(ESTIMATED_K_CAM in modes[f"rgbd k_cam {k_cam_px:g}"] for k_cam_px in UNSEEN_K_CAM_PX)


def test_a_camera_known_by_its_sheets_alone_is_nearly_the_true_one() -> None:
    found = MODES[ESTIMATED_K_CAM](REFERENCE)
    assert 0 < abs(found.k_cam_px / REFERENCE.k_cam_px - 1) < 0.03
    assert found.focus_distance_m == pytest.approx(REFERENCE.focus_distance_m, rel=0.01)
    assert found.gamma_px == pytest.approx(REFERENCE.gamma_px, abs=0.03)
    assert found.intrinsics is not None
    assert REFERENCE.intrinsics is not None
    assert found.intrinsics.fx_px == pytest.approx(REFERENCE.intrinsics.fx_px, rel=0.01)
    assert (found.image_width_px, found.image_height_px) == (640, 480)


def test_a_camera_that_no_sheet_can_be_photographed_with_is_refused() -> None:
    with pytest.raises(ValueError, match="intrinsics"):
        calibrated(replace(REFERENCE, intrinsics=None))


def test_the_right_side_is_that_of_each_pixel(oracle: Examiner) -> None:
    """Half of a wall as far behind the plane in focus as the other half is before it, in blur."""
    both = replace(case(1.0), side="auto")
    x = thin_lens.relative_defocus_from_blur(blur_of(LEVEL), CAMERA.gamma_px, CAMERA.k_cam_px)
    both.truth_m[:, 48:] = thin_lens.depth_far(x, CAMERA.focus_distance_m)
    assert oracle.answer(both, RIGHT_SIDE)[0].scores.abs_rel == pytest.approx(0, abs=1e-3)
    assert oracle.answer(both)[0].scores.abs_rel > 0.2


def test_the_oracle_finds_the_one_factor_that_all_pictures_like_best(tiny_model_dir: Path) -> None:
    wrong = replace(CAMERA, k_cam_px=CAMERA.k_cam_px / 1.25)
    pictures = [replace(case(1.0), camera=wrong) for _ in range(2)]
    (report,) = evaluate([tiny_model_dir], [EvaluationSet("grey", partial(iter, pictures), factors=ORACLE_FACTORS)])
    assert report.summary("grey").mean.abs_rel > 0.05
    assert report.summary("grey", "oracle k_cam, x 1.25").mean.abs_rel == pytest.approx(0, abs=1e-3)


def test_two_models_are_compared_on_the_same_pictures(tiny_model_dir: Path, tmp_path: Path) -> None:
    """One answers a picture 0.25 too far; the other, whose blur is a tenth less, 0.25 and a bit more."""
    other = tmp_path / "other"
    shutil.copytree(tiny_model_dir, other)
    write_manifest(other, load_model_folder(other).manifest.model_copy(update={"blur_gain": 0.9}))
    pictures = [case(0.8)]
    pictures[0].image[:, :10] = 0
    both = evaluate([tiny_model_dir, other], [EvaluationSet("grey", partial(iter, pictures), ("gt", "k_cam +10%"))])
    own, others = (report.summary("grey").mean.abs_rel for report in both)
    assert own == pytest.approx(0.25, abs=1e-3)
    assert others > own + 0.02
    head, (row, worst) = beside(*both)
    assert row[:4] == ["grey", f"{own:.3f}", f"{others:.3f}", f"{others / own:.3f}"]
    assert worst[head.index("times")] == row[3]
    warning = "a black border, 10% of the photograph, shows nothing: no answer there"
    assert tables(both[0])["Warnings"][1] == [["grey", "1", "grey", warning]]
    assert "Warnings" not in tables(replace(both[0], warnings={"rgbd k_cam 3.81": {warning: ["one"]}}))


def test_plots_of_depth_show_a_users_own_sets(oracle: Examiner, tmp_path: Path) -> None:
    outcome, example = oracle.answer(case(1.0))
    sets = [summarise(name, "gt", [outcome]) for name in ("desk", "d200", "rgbd view 0.8", "plane 1 m")]
    flat = Pixels(*np.full((3, 100), 3.2564103603363037, np.float32))  # whose logarithms round to falling ones
    write(Report("grey", sets, [], {"desk": flat, "d200": flat}, {"desk": example}), tmp_path)
    for plot in ("calibration", "error_by_certainty", "error_against_distance", "error_against_blur"):
        drawn = (tmp_path / f"{plot}.svg").read_text()
        assert [name for name in ("desk", "d200", "rgbd", "plane") if f"<!-- {name}" in drawn] == ["desk", "d200"]


def test_a_report_of_a_set_without_an_answer_is_json(oracle: Examiner, tmp_path: Path) -> None:
    outcome, _ = oracle.answer(case(1.0))
    nothing = replace(outcome, depth=replace(outcome.depth, stated=np.full_like(outcome.depth.stated, np.inf)))
    write(Report("grey", [summarise("dark", "gt", [nothing])], [], {}, {}), tmp_path)
    (found,) = json.loads((tmp_path / "report.json").read_text(), parse_constant=pytest.fail)["sets"]
    assert found["within"] == [None, None]


def _no_picture() -> Iterator[Case]:
    raise OSError("no such picture")


def test_a_picture_that_cannot_be_read_ends_the_evaluation_and_is_told_of(tiny_model_dir: Path) -> None:
    heard: list[tuple[str, int]] = []
    sets = [EvaluationSet("grey", partial(iter, [case(1.0)])), EvaluationSet("missing", _no_picture)]
    with pytest.raises(OSError, match="no such picture"):
        evaluate([tiny_model_dir], sets, lambda said, finished: heard.append((said, finished)))
    assert ("missing", 1) not in heard


def test_certainty_and_blur_are_scored_where_they_are_known(oracle: Examiner) -> None:
    known = replace(case(1.0), blur_px=np.full((64, 96), blur_of(LEVEL) * 0.8, np.float32))
    outcome, _ = oracle.answer(known)
    stated = in_metres(np.array(LOG_DEPTH_SCALE * 2**0.5, np.float32))
    assert outcome.depth.stated == pytest.approx(float(stated), rel=1e-3)
    assert outcome.blur is not None
    assert outcome.blur.stated == pytest.approx(RELATIVE_BLUR_ERROR * 2**0.5, rel=1e-3)
    (found,) = (row for row in blur_ranges("grey", outcome.blur) if row.low_px == 2.0)
    assert found.bias == found.median == found.certain_median == pytest.approx(0.25, rel=1e-3)


def test_what_a_smaller_copy_shows_is_not_remembered_of_the_larger_one(tmp_path: Path) -> None:
    folder = build_oracle_pair(tmp_path / "model", blur_range=Interval(0.3, 10.0))
    known = replace(case(1.0), blur_px=np.ones((64, 96), np.float32))
    examiner = Examiner(folder)
    first, again = (examiner.answer(known)[0] for _ in range(2))
    assert first.blur is not None
    assert again.blur is not None
    np.testing.assert_array_equal(first.blur.answer, again.blur.answer)
    np.testing.assert_array_equal(first.depth.answer, again.depth.answer)


def test_the_certain_half_is_that_of_the_least_stated_error() -> None:
    stated = np.array([0.1, 0.2, np.inf, 0.9], np.float32)
    pixels = Pixels(np.ones(4, np.float32), np.array([1, 1.1, 3, 2], np.float32), stated)
    assert pixels.certain().tolist() == [True, True, False, False]
    assert pixels.error == pytest.approx([0, 0.1, 2, 1])


def test_certainty_that_says_something_has_its_errors_in_order() -> None:
    stated = np.linspace(0.01, 1, 100, dtype=np.float32)
    pixels = Pixels(np.ones(100, np.float32), 1 + stated, stated)
    assert pixels.order == pytest.approx(stated[:10].mean() / stated[50:].mean(), rel=1e-3)
    (found,) = (row for row in blur_ranges("grey", pixels) if (row.low_px, row.high_px) == (1.0, 8.0))
    assert (found.p90, found.order) == pytest.approx((0.9, pixels.order), rel=0.02)


def test_sides_of_many_pixels_count_as_many() -> None:
    joined = Sides.joined([Sides(1.0, 1.0, 300), Sides(0.0, 0.5, 100)])
    assert joined == Sides(0.75, 0.875, 400)
    assert Sides.joined([Sides(0.0, 0.0, 0)]) is None


def test_a_model_s_scores_are_of_cameras_that_are_known_and_its_report_is_json(oracle: Examiner) -> None:
    known = replace(case(1.0), blur_px=np.full((64, 96), blur_of(LEVEL), np.float32))
    outcomes = [oracle.answer(known, mode)[0] for mode in ("gt", "k_cam +10%")]
    sets = [summarise("desk", mode, [one]) for mode, one in zip(("gt", "k_cam +10%"), outcomes, strict=True)]
    blur = outcomes[0].blur
    assert blur is not None
    report = Report("grey", sets, blur_ranges("desk", blur), {}, {})
    assert report.scores()["desk.abs_rel"] == pytest.approx(0, abs=1e-3)
    assert "Infinity" not in json.dumps(report.as_dict())


def test_relief_is_what_of_the_differences_within_a_picture_is_answered() -> None:
    """Not what pictures differ by: one is twice as far as the other, and answered so."""
    truth = np.geomspace(0.5, 2, 101).astype(np.float32)
    other = np.cos(np.linspace(0, 40 * np.pi, 101))
    pictures = [Pixels(f * truth, f * truth**0.5, np.ones_like(truth)) for f in (1, 2)]
    relief = Relief.of(pictures)
    assert relief is not None
    assert relief.true == pytest.approx(np.log(truth).std(), abs=1e-3)
    assert relief.slope == pytest.approx(0.5, abs=1e-3)
    assert relief.correlation == pytest.approx(1, abs=1e-3)
    unrelated = Relief.of([Pixels(truth, np.exp(other).astype(np.float32), truth)])
    assert unrelated is not None
    assert abs(unrelated.correlation) < 0.05


def test_a_single_depth_answered_has_no_relief_and_a_true_one_is_not_scored() -> None:
    truth, level = np.array([1, 2], np.float32), np.ones(2, np.float32)
    relief = Relief.of([Pixels(truth, level, level)])
    assert relief is not None
    assert (relief.slope, relief.correlation) == (0, 0)
    assert Relief.of([Pixels(level, truth, level)]) is None


def test_intervals_hold_what_lies_within_them() -> None:
    truth = np.array([1.0, 1.05, 1.15, 1.5], np.float32)
    pixels = Pixels(truth, np.ones(4, np.float32), np.full(4, 0.1, np.float32))
    assert pixels.within(1) == 0.5
    assert pixels.within(2) == 0.75


def test_a_summary_tells_of_intervals_of_one_and_two_deviations_and_compares_no_few_pixels(oracle: Examiner) -> None:
    truth, level = np.array([1.0, 1.05, 1.15, 1.5], np.float32), np.full(4, 1.5, np.float32)
    few = Pixels(truth, np.ones(4, np.float32), np.full(4, 0.1, np.float32))
    outcome = replace(oracle.answer(case(1.0))[0], depth=few, depth_blur_px=level, depth_defocus=level)
    summary = summarise("few", "gt", [outcome])
    assert summary.within == (0.5, 0.75)
    assert set(summary.equal_blur.values()) == {None}


def test_what_has_no_answer_is_in_no_interval() -> None:
    filled = np.array([1.0, 1.0, 1.0], np.float32)
    pixels = Pixels(np.array([1.05, 1.5, 9.0], np.float32), filled, np.array([0.1, 0.1, np.inf], np.float32))
    assert pixels.within(1) == 0.5
    assert np.isnan(Pixels(filled, filled, np.full(3, np.inf, np.float32)).within(1))


def test_the_temperature_makes_intervals_hold_what_they_promise() -> None:
    rng = np.random.default_rng(1)
    told = np.full(20_000, 0.04, np.float32)
    pixels = Pixels((1 + 0.1 * rng.standard_normal(20_000)).astype(np.float32), np.ones_like(told), told)
    assert temperature(pixels) == pytest.approx(2.5, rel=0.05)


def test_the_gain_makes_blur_right_in_the_median_where_it_is_well_read() -> None:
    truth = np.array([0.5, 2, 4, 7.9, 16], np.float32)
    answer = truth * np.array([3, 1.25, 1.25, 1.0, 0.1], np.float32)
    assert blur_gain(Pixels(truth, answer, np.ones_like(truth))) == pytest.approx(0.8)


@pytest.mark.parametrize("side", ["near", "far"])
def test_what_the_graph_states_by_itself_is_its_hypothesis_on_the_side_told_and_its_own_law(
    oracle: Examiner, side: Side
) -> None:
    """Beyond focus an answer states more: what the error of blur makes of it. The temperature is not found of that."""
    own = oracle.stated_by_graph(replace(case(1.0), side=side))
    x = thin_lens.relative_defocus_from_blur(blur_of(LEVEL), CAMERA.gamma_px, CAMERA.k_cam_px)
    depth_m = {"near": thin_lens.depth_near, "far": thin_lens.depth_far}[side](x, CAMERA.focus_distance_m)
    np.testing.assert_allclose(own.answer, depth_m, rtol=1e-3)
    np.testing.assert_allclose(own.stated, in_metres(np.full_like(own.stated, np.sqrt(2) * LOG_DEPTH_SCALE)), rtol=1e-3)
    assert own.truth.size == 32 * 43


def _told(found: float, _: Pixels) -> float:
    return found


@pytest.mark.parametrize("found", [0.5, 2.0])
def test_what_is_found_is_written_down(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, found: float) -> None:
    folder = build_oracle_pair(tmp_path / "model")
    monkeypatch.setattr("model_export.corrections.SCENES", 1)
    monkeypatch.setattr("model_export.corrections.blur_gain", partial(_told, 0.9))
    monkeypatch.setattr("model_export.corrections.temperature", partial(_told, found))
    assert record_corrections(folder, list(unseen_cases())) == (0.9, found)
    manifest = load_model_folder(folder).manifest
    assert (manifest.blur_gain, manifest.temperature) == (0.9, found)


@pytest.mark.parametrize(("factor", "right", "either"), [(1.0, 0, 1), (1.05, 0, 1), (0.7, 0, 0)])
def test_sides_are_scored_where_the_picture_is_clearly_out_of_focus(
    oracle: Examiner, factor: float, right: float, either: float
) -> None:
    """The oracle takes what is not red for far, and the truth is near: the other hypothesis has it."""
    as_bright = np.full((64, 96, 3), (0, LEVEL, 2 * LEVEL), np.uint8)
    outcome, _ = oracle.answer(replace(case(factor), image=as_bright, side="auto"))
    assert outcome.sides == Sides(right, either, 64 * 86)
    told, _ = oracle.answer(case(factor))
    assert told.sides is None


def write_photo(folder: Path, name: str, depth_mm: int) -> None:
    for part in ("color", "depth"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    depth = np.full((480, 640), depth_mm, np.uint16)
    depth[:, 320:] *= 2
    cv2.imwrite(str(folder / "color" / f"{name}.png"), rng.integers(0, 255, (480, 640, 3), np.uint8))
    cv2.imwrite(str(folder / "depth" / f"{name}.png"), depth)


def test_real_lenses_are_scored_away_from_steps(tmp_path: Path) -> None:
    write_photo(tmp_path, "one", 1000)
    (found,) = d200_cases(tmp_path, 1)
    scored = np.isfinite(found.truth_m)
    assert not scored[:, 296:344].any()
    assert scored[:, :290].all()
    assert found.camera.k_cam_px == pytest.approx(1.5326 * 640 / 645, rel=1e-3)


def test_real_lenses_are_scored_to_five_metres(tmp_path: Path) -> None:
    write_photo(tmp_path, "one", 3000)
    (found,) = d200_cases(tmp_path, 1)
    assert np.nanmax(found.truth_m) == pytest.approx(3.0)


def test_a_frame_made_larger_has_the_camera_of_its_size(tmp_path: Path) -> None:
    write_photo(tmp_path, "one", 900)
    (found,) = enlarged_cases(tmp_path, 1, REFERENCE, 2)
    assert found.image.shape == (960, 1280, 3)
    assert found.truth_m.shape == (found.camera.image_height_px, found.camera.image_width_px) == (960, 1280)
    assert found.camera.k_cam_px == pytest.approx(2 * REFERENCE.k_cam_px)
    assert found.truth_m[500, [100, 1200]] == pytest.approx([0.9, 1.8])


def test_a_narrower_view_is_enlarged_and_blurs_alike(tmp_path: Path) -> None:
    write_photo(tmp_path, "one", 900)
    (found,) = viewed_cases(tmp_path, 1, 0.5)
    assert found.image.shape == (480, 640, 3)
    assert found.camera.intrinsics is not None
    assert found.camera.intrinsics.fx_px == 1050
    assert np.nanmin(found.truth_m) == pytest.approx(0.9)


def test_a_wider_view_is_made_smaller_and_blurs_alike(tmp_path: Path) -> None:
    write_photo(tmp_path, "one", 900)
    (found,) = viewed_cases(tmp_path, 1, 1.5)
    assert found.image.shape == (320, 427, 3)
    assert (found.camera.image_width_px, found.camera.image_height_px) == (427, 320)
    assert found.camera.k_cam_px == REFERENCE.k_cam_px
    assert found.camera.intrinsics is not None
    assert found.camera.intrinsics.fx_px == 350


def test_the_control_in_focus_is_the_frame_as_it_is(tmp_path: Path) -> None:
    write_photo(tmp_path, "one", 900)
    (found,) = sharp_cases(tmp_path, 1)
    photo = cv2.imread(str(tmp_path / "color" / "one.png"))
    assert photo is not None
    np.testing.assert_array_equal(found.image, photo[:, :, ::-1])
    assert np.nanmax(found.truth_m) == pytest.approx(1.8)


def test_the_control_blurs_a_frame_by_the_depth_of_another(tmp_path: Path) -> None:
    write_photo(tmp_path, "flat", 1000)
    write_photo(tmp_path, "near", 500)
    flat, near = shuffled_cases(tmp_path, 2)
    assert np.nanmin(flat.truth_m) == pytest.approx(1.0)
    contrast = [float(case.image[:, :300].std()) for case in (flat, near)]
    assert contrast[0] < contrast[1]


@pytest.mark.parametrize("side", [-1, 0, 1])
def test_procedural_scenes_come_with_both_truths(side: int) -> None:
    (found,) = procedural_cases(1, side)
    assert found.blur_px is not None
    camera = found.camera
    expected = thin_lens.blur_at_depth(found.truth_m, camera.focus_distance_m, camera.k_cam_px, camera.gamma_px)
    np.testing.assert_allclose(found.blur_px, expected, rtol=2e-3, atol=2e-3)
    beyond = (found.truth_m > camera.focus_distance_m).mean()
    assert beyond == {-1: 0, 1: 1}.get(side, beyond)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    write_photo(folder / "rgbd", "one", 900)
    write_photo(folder / "rgbd", "blind", 0)
    write_photo(folder / "tabletop", "two", 700)
    write_photo(folder / "desk", "three", 0)  # no depth is known
    camera = {"focus_distance_m": 2.0, "k_cam_px": 3.0, "gamma_px": 0.5}
    (folder / "desk" / "cameras.json").write_text(json.dumps({"three": camera}))
    return folder


def test_the_command_prints_and_writes_what_it_found(data: Path, tiny_model_dir: Path, tmp_path: Path) -> None:
    out = tmp_path / "report"
    models = ["--model", tiny_model_dir, "--beside", tiny_model_dir]
    arguments = ["--data", data, *models, "--quick", "--out", out]
    result = CliRunner().invoke(commands, ["evaluate", *map(str, arguments)])
    assert result.exit_code == 0, result.output
    for said in ("rgbd k_cam 3.81", "k_cam -10%", "tabletop shuffled", "procedural mixed", "worst", "report.html"):
        assert said in result.output
    assert "without desk" in result.output
    assert json.loads((out / "beside" / "report.json").read_text()) == json.loads((out / "report.json").read_text())
    report = json.loads((out / "report.json").read_text())
    sets = {(s["name"], s["mode"]): s for s in report["sets"]}
    assert sets["indoor k_cam 3.81", "gt"]["pictures"] == 2
    assert sets["rgbd k_cam 3.81", "no k_cam"]["pooled"]["rmse"] > 0
    assert ("indoor k_cam 3.81", "estimated k_cam") not in sets
    assert sets["tabletop in focus", "gt"]["pictures"] == 1
    assert sets["procedural mixed", "gt"]["relief"]["true"] > 0
    assert sets["plane 1 m", "gt"]["relief"] is None
    page = (out / "report.html").read_text()
    shown = [part.split('"')[0] for part in page.split('src="')[1:]]
    assert len(shown) > 10
    assert all((out / name).stat().st_size > 500 for name in shown)
