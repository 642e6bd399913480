"""A look at one photograph of the sheet: a few circles stand for all of it."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from model_export.photographed_sheets import GridCamera, draw_pose, photograph
from service.calibration.look import MOST_MEASURED, look
from service.calibration.measure import Measured, measure
from service.calibration.report import PictureReport
from service.calibration.target import CircleGrid
from service.optics.camera import Intrinsics
from service.optics.light import decode_srgb

CAMERA = GridCamera(800, 600, 12.0, 0.7, 0.5, Intrinsics(900, 900, 400, 300))
SHEETS = (CircleGrid("asymmetric_circles", 11, 4, 12.0, 8.0), CircleGrid("symmetric_circles", 6, 6, 22.0, 12.0))


@pytest.mark.parametrize("sheet", SHEETS, ids=lambda sheet: sheet.kind)
def test_the_blur_of_a_few_circles_is_that_of_all(sheet: CircleGrid) -> None:
    rng = np.random.default_rng(3)
    taken = photograph(rng, CAMERA, draw_pose(rng, CAMERA, sheet, 0.42), sheet, focused=False)
    whole = Measured(PictureReport("", "defocused", found=False))
    measure(whole, taken, sheet, lambda _: None)
    # the sheet leans: its blur differs from end to end
    assert np.ptp(whole.blur_px()) > 0.1 * np.median(whole.blur_px())
    seen = look(taken, sheet, None)
    assert 0.6 * MOST_MEASURED <= seen.measured <= MOST_MEASURED
    assert seen.blur_px == pytest.approx(np.median(whole.blur_px()), rel=0.04)


@pytest.mark.parametrize("sheet", SHEETS, ids=lambda sheet: sheet.kind)
@pytest.mark.parametrize("wrong", ["spacing_mm", "diameter_mm", None])
def test_a_sheet_whose_circles_are_not_as_told_beside_their_spacing_is_noticed(
    sheet: CircleGrid, wrong: str | None
) -> None:
    rng = np.random.default_rng(3)
    taken = photograph(rng, CAMERA, draw_pose(rng, CAMERA, sheet, 0.42), sheet, focused=False)
    told = (
        replace(sheet, **{wrong: getattr(sheet, wrong) * (1.41 if wrong == "spacing_mm" else 0.71)})
        if wrong
        else replace(sheet, diameter_mm=0.95 * sheet.diameter_mm)  # as ink spreads
    )
    said = [warning for warning in look(taken, told, None).warnings if "one of spacing_mm and diameter_mm" in warning]
    assert [" 1.4" in warning for warning in said] == [True] * bool(wrong)


def test_a_file_of_linear_light_is_said_to_be_one_perhaps() -> None:
    rng = np.random.default_rng(3)
    taken = photograph(rng, CAMERA, draw_pose(rng, CAMERA, SHEETS[0], 0.38), SHEETS[0], focused=False)
    linear = np.rint(230 * decode_srgb(np.asarray(taken / 255, np.float32))).astype(np.uint8)
    assert "linear light" in " ".join(look(linear, SHEETS[0], None).warnings)
    assert "linear light" not in " ".join(look(taken, SHEETS[0], None).warnings)


@pytest.mark.parametrize("level", [251, 235, None])
def test_white_that_is_cut_off_below_the_file_s_own_white_is_noticed(level: int | None) -> None:
    rng = np.random.default_rng(3)
    taken = photograph(rng, CAMERA, draw_pose(rng, CAMERA, SHEETS[0], 0.42), SHEETS[0], focused=False)
    if level:
        taken = np.minimum(taken * 1.5, level).astype(np.uint8)
    said = [warning for warning in look(taken, SHEETS[0], None).warnings if "cut off" in warning]
    assert [f"level {level} " in warning for warning in said] == [True] * bool(level)


@pytest.mark.parametrize("told", [{"spacing_mm": 24.0}, {"spacing_mm": 6.0, "diameter_mm": 4.0}, {"diameter_mm": 4.0}])
def test_what_is_told_half_or_twice_as_large_is_said_to_be_of_another_size(told: dict[str, Any]) -> None:
    rng = np.random.default_rng(3)
    taken = photograph(rng, CAMERA, draw_pose(rng, CAMERA, SHEETS[0], 0.42), SHEETS[0], focused=False)
    said = " ".join(look(taken, replace(SHEETS[0], **told), None).warnings)
    assert ("of quite another size than spacing_mm and diameter_mm say" in said) == (len(told) == 1), said


def test_circles_at_the_border_of_the_picture_are_left_out() -> None:
    rng = np.random.default_rng(3)
    taken = photograph(rng, CAMERA, draw_pose(rng, CAMERA, SHEETS[0], 0.42), SHEETS[0], focused=True)
    whole, part = (Measured(PictureReport("", "focused", found=False)) for _ in range(2))
    measure(whole, taken, SHEETS[0], lambda _: None)
    right, bottom = (np.max(whole.centres_px, 0) + 1.4 * whole.edges[0].radius_px).astype(int)
    measure(part, np.ascontiguousarray(taken[:bottom, :right]), SHEETS[0], lambda _: None)
    assert 0 < len(part.circles) < len(whole.circles)
    assert "too near the border" in " ".join(part.report.warnings)


def test_a_look_stops_while_it_searches_for_the_sheet() -> None:
    calls = 0

    class Stopped(Exception):
        pass

    def check() -> None:
        nonlocal calls
        calls += 1
        if calls == 4:
            raise Stopped

    dots = np.full((480, 640, 3), 255, np.uint8)
    for v in range(20, 460, 24):
        for u in range(20, 620, 24):
            dots[v : v + 9, u : u + 9] = 0
    with pytest.raises(Stopped):
        look(dots, SHEETS[0], None, check)


def test_a_partner_of_another_size_does_not_serve() -> None:
    rng = np.random.default_rng(3)
    taken = photograph(rng, CAMERA, draw_pose(rng, CAMERA, SHEETS[0], 0.42), SHEETS[0], focused=True)
    partner, out = (Measured(PictureReport("", "defocused", found=False)) for _ in range(2))
    measure(partner, taken, SHEETS[0], lambda _: None)
    measure(out, np.full((300, 400, 3), 200, np.uint8), SHEETS[0], lambda _: None, partner=partner)
    assert partner.grid is not None
    assert out.grid is None


@pytest.mark.parametrize(("part", "is_dark"), [(0.3, True), (0.5, False)])
def test_a_photograph_too_dark_to_measure_well_is_noticed(part: float, is_dark: bool) -> None:
    rng = np.random.default_rng(3)
    taken = photograph(rng, CAMERA, draw_pose(rng, CAMERA, SHEETS[0], 0.42), SHEETS[0], focused=False)
    dark = (part * taken).astype(np.uint8)
    said = [warning for warning in look(dark, SHEETS[0], None).warnings if "exposed" in warning]
    assert ["expose more" in warning for warning in said] == [True] * is_dark
