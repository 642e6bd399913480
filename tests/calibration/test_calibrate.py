"""Whole calibrations, on photographs simulated with the project's renderer; and what goes wrong with photographs."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from model_export.photographed_sheets import picture
from service.calibration.calibrate import _corner_ratio as corner_ratio
from service.calibration.calibrate import _uneven as uneven
from service.calibration.calibrate import calibrate
from service.calibration.measure import Measured, aperture_of, ill_exposed, measure, too_blurred
from service.calibration.plot import as_svg
from service.calibration.report import PictureReport, Report, Role
from service.calibration.task import Picture, Shot, Task
from service.errors import InvalidImage
from service.inference.cancellation import Cancelled
from service.opencv import cv2
from service.optics.light import decode_srgb
from tests.simulated_sheets import CAMERA, DEPTHS_M, GRID, SheetPhoto, sheet_photos

LEVELS = np.arange(256) / 255
CONTRASTED = np.rint(255 * (LEVELS - 0.3 * np.sin(2 * np.pi * LEVELS) / (2 * np.pi))).astype(np.uint8)
AS_LIGHT = np.rint(255 * decode_srgb(np.arange(256, dtype=np.float32) / np.float32(255))).astype(np.uint8)


def pictures(taken: Sequence[SheetPhoto]) -> list[Picture]:
    return [picture(*shot) for shot in taken]


@pytest.fixture(scope="module")
def taken() -> list[SheetPhoto]:
    return sheet_photos(CAMERA, DEPTHS_M)


@pytest.fixture(scope="module")
def few(taken: list[SheetPhoto]) -> list[SheetPhoto]:
    """Of those taken, as many as are enough that nothing is warned of."""
    return [taken[i] for i in (0, 2, 3, 5)]


@pytest.fixture(scope="module")
def report(taken: list[SheetPhoto]) -> Report:
    return calibrate(Task(GRID), pictures(taken))


def test_the_camera_comes_out_of_its_photographs(report: Report) -> None:
    assert report.problem is None
    assert report.result is not None
    found = report.result
    assert found.k_cam_px.value == pytest.approx(4.0, rel=0.04)
    assert found.focus_distance_m.value == pytest.approx(0.5, rel=0.02)
    assert found.gamma_px.value == pytest.approx(0.7, abs=0.08)
    assert found.intrinsics.fx_px == pytest.approx(900, rel=0.01)
    assert found.reprojection_rms_px < 0.1
    assert found.k_cam_px.low < 4.0 < found.k_cam_px.high
    assert found.to_camera().k_cam_px == found.k_cam_px.value
    assert not found.warnings


def test_every_photograph_is_told_of(report: Report) -> None:
    assert [picture.distance_m for picture in report.pictures] == pytest.approx(DEPTHS_M, rel=0.03)
    assert all(picture.found and picture.circles == 21 and not picture.warnings for picture in report.pictures)
    assert all(picture.tilt_deg is not None and 3 < picture.tilt_deg < 26 for picture in report.pictures)


def test_the_plot_is_the_same_picture_every_time(report: Report) -> None:
    assert report.result is not None
    drawn = as_svg(report.result)
    assert drawn.startswith(b"<?xml")
    assert b"k_cam picture by picture" in drawn
    assert as_svg(report.result) == drawn
    samples = tuple(replace(sample, image="a$_{$.jpg") for sample in report.result.samples)
    assert b"a$_{$.jpg" in as_svg(replace(report.result, samples=samples))


def test_pairs_as_in_the_paper_by_both_methods() -> None:
    """The slice of eq. 9 reads a third too much (its derivation: tests/calibration/test_edge.py)."""
    depths_m = (0.32, 0.34, 0.36)
    both = pictures(sheet_photos(CAMERA, depths_m, "focused", seed=3) + sheet_photos(CAMERA, depths_m, seed=3))
    edge = calibrate(Task(GRID, 0.5), both).result
    paper = calibrate(Task(GRID, 0.5, "paper"), both).result
    assert edge is not None
    assert paper is not None
    assert edge.k_cam_px.value == pytest.approx(4.0, rel=0.02)
    assert edge.focus_distance_m.low == edge.focus_distance_m.high == 0.5
    assert 1.25 < paper.k_cam_px.value / 4.0 < 1.6


def test_a_partner_that_comes_later_serves_as_well() -> None:
    sheet = (0.3,)
    blurred = sheet_photos(replace(CAMERA, k_cam_px=45.0), sheet, seed=3)  # its circles run into each other
    focused = sheet_photos(replace(CAMERA, k_cam_px=1e-3), sheet, "focused", seed=3)
    partner, found = calibrate(Task(GRID), pictures([*blurred, *focused])).pictures
    assert (partner.role, found.role) == ("focused", "defocused")
    assert "looked for the circles where its focused partner has them" in found.warnings


def test_a_portrait_among_landscapes_is_turned_and_circles_of_another_size_are_told_of(few: list[SheetPhoto]) -> None:
    turned: list[SheetPhoto] = [
        (name, role, np.rot90(p, -1).copy() if i == 2 else p) for i, (name, role, p) in enumerate(few)
    ]
    found = calibrate(Task(replace(GRID, diameter_mm=22.0)), pictures(turned)).result
    assert found is not None
    assert found.k_cam_px.value == pytest.approx(4.0, rel=0.04)
    assert [words.startswith("the circles are 0.8") for words in found.warnings] == [True]


@pytest.mark.parametrize(("in_corners", "is_told"), [(4.2, False), (3.4, True), (4.6, True)])
def test_blur_that_is_otherwise_in_the_corners_is_told_where_enough_circles_are_there(
    report: Report, in_corners: float, *, is_told: bool
) -> None:
    assert report.result is not None
    placed = replace(report.result.intrinsics, cx_px=399.5, cy_px=299.5)

    def ratio(used: int) -> float | None:
        (one, *_) = report.result.samples if report.result else ()
        rows = [(400, 300, 4.0), (450, 380, 4.0), (650, 500, 9.0), (90, 560, in_corners), (710, 40, in_corners)]
        samples = [replace(one, u_px=u, v_px=v, k_cam_px=k, used=i < used) for u, v, k in rows for i in range(8)]
        return corner_ratio(tuple(samples), placed, (800, 600))

    assert ratio(5) is None
    assert ratio(6) == pytest.approx(in_corners / 4)
    assert len([*uneven(ratio(6))]) == is_told
    assert not [*uneven(None)]


def test_all_in_focus_is_a_problem_and_no_k_cam(taken: list[SheetPhoto]) -> None:
    sharp = replace(CAMERA, k_cam_px=1e-3)
    report = calibrate(Task(GRID), pictures(sheet_photos(sharp, (0.4, 0.5, 0.6, 0.7))))
    assert report.result is None
    assert report.problem is not None
    assert "no circle is blurred" in report.problem
    assert calibrate(Task(GRID), pictures(taken[:1])).result is None


def test_another_camera_among_them_is_left_out_or_warned_of(taken: list[SheetPhoto]) -> None:
    other = replace(CAMERA, intrinsics=replace(CAMERA.intrinsics, fx_px=1400, fy_px=1400))
    strange: list[SheetPhoto] = [("strange", role, pixels) for _, role, pixels in sheet_photos(other, (0.7,))]
    report = calibrate(Task(GRID), pictures([*taken, *strange]))
    told = [*report.pictures[-1].warnings, *(report.result.warnings if report.result else ())]
    assert told


def test_sharpening_by_the_camera_is_told_amid_contrast_too(taken: list[SheetPhoto]) -> None:
    level = np.linspace(0, 1, 256)
    contrast = np.rint(255 * (3 * level**2 - 2 * level**3)).astype(np.uint8)
    altered: list[SheetPhoto] = []
    for name, role, pixels in taken:
        shown = contrast[pixels].astype(np.float32)
        sharp = shown + 0.6 * (shown - cv2.GaussianBlur(shown, (0, 0), 1.0))
        altered.append((name, role, np.clip(sharp, 0, 255).astype(np.uint8)))
    report = calibrate(Task(GRID), pictures(altered))
    assert report.result is not None
    told = " ".join(report.result.warnings)
    assert "as sharpening leaves it" in told


def moved(shot: SheetPhoto) -> SheetPhoto:
    """The photograph as it would be if the camera had moved along while it was taken."""
    name, role, pixels = shot
    return name, role, np.asarray(cv2.blur(pixels, (9, 1)), np.uint8)


def test_linear_light_is_told_though_its_circles_look_little_larger(few: list[SheetPhoto]) -> None:
    """As an industrial camera writes it, without a profile: blur reads a seventh too small, by the same curve."""
    linear: list[SheetPhoto] = [(name, role, AS_LIGHT[levels]) for name, role, levels in few]
    found = calibrate(Task(GRID), pictures(linear)).result
    assert found is not None
    assert found.k_cam_px.value == pytest.approx(0.86 * 4.0, rel=0.04)
    assert [words.startswith("circles look the larger the more") for words in found.warnings] == [True]
    assert "linear light" in found.warnings[0]


def test_a_tone_curve_is_told_by_circles_that_shrink_with_their_blur(taken: list[SheetPhoto]) -> None:
    curved: list[SheetPhoto] = [(name, role, CONTRASTED[levels]) for name, role, levels in taken]
    found = calibrate(Task(GRID), pictures(curved)).result
    assert found is not None
    assert found.k_cam_px.value == pytest.approx(0.94 * 4.0, rel=0.03)
    assert ["smaller the more" in words and "tone curve" in words for words in found.warnings] == [True]


def test_one_that_moved_and_one_that_was_there_before_are_left_out(taken: list[SheetPhoto]) -> None:
    again: SheetPhoto = ("again", "defocused", taken[4][2])
    report = calibrate(Task(GRID), pictures([*taken[:2], moved(taken[2]), *taken[3:], again]))
    told = [picture.warnings for picture in report.pictures]
    assert [bool(words) for words in told] == [False, False, True, False, False, False, True]
    assert told[2][0].startswith("left out: its circles are blurred otherwise than those of the others")
    assert told[6][0].startswith(f"left out: the same photograph as {taken[4][0]}")
    assert report.result is not None
    assert report.result.k_cam_px.value == pytest.approx(4.0, rel=0.04)
    assert report.result.k_cam_px.low < 4.0 < report.result.k_cam_px.high
    assert report.result.k_cam_px.relative_width < 0.1
    assert {sample.image for sample in report.result.samples} == {taken[i][0] for i in (0, 1, 3, 4, 5)}


def test_of_four_photographs_none_is_left_out_for_its_blur(taken: list[SheetPhoto]) -> None:
    report = calibrate(Task(GRID), pictures([taken[0], moved(taken[2]), *taken[4:]]))
    assert not any(words.startswith("left out") for picture in report.pictures for words in picture.warnings)


def test_what_most_photographs_are_exposed_like_is_said_once_more_of_all() -> None:
    dark, good, bright = (
        Measured(
            PictureReport("", "defocused", found=True),
            paper_levels=[*[180.0] * 7, level, level] if level > 180 else [level] * 9,
        )
        for level in (79.0, 81.0, 254.0)
    )
    assert ill_exposed([dark, good, dark])[0].startswith("2 of 3 photographs are underexposed")
    assert ill_exposed([good, bright, bright])[0].startswith("2 of 3 photographs are overexposed")
    assert ill_exposed([dark, bright, good]) == ill_exposed([]) == ()


def test_an_aperture_is_told_where_all_defocused_photographs_have_one() -> None:
    def at(f_number: float | None, role: Role = "defocused") -> Measured:
        return Measured(PictureReport("", role, found=True), f_number=f_number)

    assert aperture_of([at(2.8), at(None), at(2.8), at(2.83), at(8.0, "focused")]) == (2.8, ())
    assert aperture_of([at(None), at(0.0), at(1e9), at(8.0, "focused")]) == aperture_of([]) == (None, ())
    for opened in ((2.8, 4.0), (5.6, 6.3)):  # a stop, a third of one
        found, (warning,) = aperture_of([at(opened[0]), *map(at, opened)])
        assert found is None
        assert warning.startswith(f"their EXIF says f/{opened[0]:.3g} to f/{opened[1]:.3g},")


def test_what_is_too_far_out_of_focus_is_said_of_each_and_of_most(taken: list[SheetPhoto]) -> None:
    far, good = (Measured(PictureReport("", "defocused", found=False)) for _ in range(2))
    _, _, pixels = taken[4]  # its circles are 22 px across
    measure(far, np.asarray(cv2.GaussianBlur(pixels, (0, 0), 6.0), np.uint8), GRID, lambda _: None, every=4)
    measure(good, np.asarray(cv2.GaussianBlur(pixels, (0, 0), 4.0), np.uint8), GRID, lambda _: None, every=4)
    assert far.report.warnings[0].startswith("its circles are blurred by 0.5")
    assert not good.report.warnings
    assert too_blurred([far, good, far])[0].startswith("2 of 3 photographs are too far out of focus")
    assert too_blurred([far, good]) == too_blurred([]) == ()


def test_what_is_no_photograph_is_said_and_the_others_count(taken: list[SheetPhoto], few: list[SheetPhoto]) -> None:
    def broken() -> Shot:
        raise InvalidImage("The file is empty.")

    blank: list[SheetPhoto] = [("blank", "defocused", np.full((600, 800, 3), 90, np.uint8))]
    lamp = taken[1][2].copy()
    lamp[:, 320:, 0] = np.minimum(lamp[:, 320:, 0].astype(int) * 2, 253)  # red light: one channel alone is cut off
    bright: list[SheetPhoto] = [("bright", "defocused", lamp)]
    small: list[SheetPhoto] = [("small", "defocused", np.ascontiguousarray(taken[0][2][::2, ::2]))]
    report = calibrate(
        Task(GRID),
        [Picture("empty", "defocused", broken), *pictures(blank + bright + few + small)],
    )
    assert report.pictures[0].warnings == ("The file is empty.",)
    assert report.pictures[1].warnings == ("no grid of dark circles was found",)
    assert (
        report.pictures[2].warnings[0].startswith("15 of 21 circles not measured: the paper around it is overexposed")
    )
    assert report.pictures[2].warnings[1:] == ("left out: 6 circles do not place the sheet, 8 are needed",)
    assert "left out: 400x300 px, while most are 800x600" in report.pictures[-1].warnings
    assert report.result is not None
    assert report.result.k_cam_px.value == pytest.approx(4.0, rel=0.04)
    assert "4 of 8 photographs were of no use" in report.result.warnings[0]


def test_it_tells_how_far_it_is_and_can_be_stopped(taken: list[SheetPhoto]) -> None:
    told: list[tuple[float, tuple[PictureReport, ...]]] = []
    calls = 0

    def check() -> None:
        nonlocal calls
        calls += 1
        if calls > 100:
            raise Cancelled

    with pytest.raises(Cancelled):
        calibrate(Task(GRID), pictures(taken), tell=lambda done, seen: told.append((done, seen)), check=check)
    assert told[0] == (0.0, ())
    assert all(0 <= done <= 1 for done, _ in told)
