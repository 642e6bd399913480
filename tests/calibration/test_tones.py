"""What linear light and tone curves show about circles of a sheet, and sRGB does not."""

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from model_export.render import DISC, GAUSSIAN, PointSpread
from service.calibration.edge import fit_edge
from service.calibration.grid import radii_px
from service.calibration.measure import Measured
from service.calibration.report import PictureReport
from service.calibration.tones import otherwise_toned, radii_by_middles
from service.opencv import cv2
from service.optics.light import decode_srgb, encode_srgb
from tests.calibration.test_edge import circle, photographed
from tests.simulated_sheets import CAMERA, GRID

Levels = NDArray[np.float32]
RADIUS_PX = 24.0
PX_PER_MM = 2 * RADIUS_PX / GRID.diameter_mm
BLUR_PX = (0.7, 1.0, 1.5, 2.0, 3.0, 4.0)


def with_contrast(light: Levels) -> Levels:
    levels = encode_srgb(light)
    return np.asarray(0.4 * levels + 0.6 * (3 * levels**2 - 2 * levels**3), np.float32)


def lighter(light: Levels) -> Levels:
    return np.asarray(encode_srgb(light) ** 0.85, np.float32)


def darker(light: Levels) -> Levels:
    return np.asarray(encode_srgb(light) ** 1.15, np.float32)


def as_it_fell(light: Levels) -> Levels:
    return light


def sheets(develop: Callable[[Levels], Levels], spread: PointSpread, blurs_px: tuple[float, ...]) -> list[Measured]:
    """Photographs, each of which is blurred otherwise, as their files are read."""
    taken = []
    for sigma in blurs_px:
        light = np.clip(photographed(0.8 * circle(RADIUS_PX), sigma, spread, 0.005), 0, 1)
        levels = np.rint(255 * develop(light)) / 255
        edge = fit_edge(decode_srgb(levels.astype(np.float32)), 63, 65, RADIUS_PX)
        one = Measured(PictureReport(f"{sigma} px", "defocused", found=True))
        one.circles, one.edges = [*range(len(GRID.points_mm()))], [edge] * len(GRID.points_mm())
        one.centres_px = [(x, y) for x, y in (GRID.points_mm() * PX_PER_MM).tolist()]
        taken.append(one)
    return taken


@pytest.mark.parametrize("spread", [GAUSSIAN, DISC], ids=["gaussian", "disc"])
@pytest.mark.parametrize("times", [1.0, 1.25], ids=["as told", "of another size"])
@pytest.mark.parametrize(
    ("develop", "said"),
    [
        (encode_srgb, ""),
        (with_contrast, "smaller .* tone curve"),
        (lighter, "smaller .* tone curve"),
        (darker, "larger .* tone curve"),
        (as_it_fell, "larger .* linear light"),
    ],
)
def test_tones_are_told_by_circles_that_change_with_their_blur(
    develop: Callable[[Levels], Levels], said: str, times: float, spread: PointSpread
) -> None:
    told = replace(GRID, diameter_mm=times * GRID.diameter_mm)
    words = otherwise_toned(told, sheets(develop, spread, BLUR_PX))
    assert [bool(re.search(said, one)) for one in words] == [True] * bool(said)


def test_of_photographs_all_as_blurred_of_few_circles_and_of_none_nothing_is_said() -> None:
    alike = sheets(as_it_fell, GAUSSIAN, (1.0, 1.1, 1.2))
    assert not otherwise_toned(GRID, alike)
    few = sheets(as_it_fell, GAUSSIAN, BLUR_PX)
    for one in few:
        one.circles, one.centres_px, one.edges = one.circles[:19], one.centres_px[:19], one.edges[:19]
    assert not otherwise_toned(GRID, few)
    assert not otherwise_toned(GRID, [])


def test_how_large_circles_are_is_told_by_their_middles_through_a_lens_that_distorts() -> None:
    """A rim's area in the picture, as OpenCV projects it: a homography alone is up to 2 % off."""
    matrix, distortion = np.array(CAMERA.intrinsics.matrix), np.array((-0.2, 0.05, 1e-3, -1e-3, 0.0))
    turn, shift = np.array([0.3, -0.2, 0.4]), np.array([-0.02, -0.08, 0.4])
    around = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    rim_mm = 0.05 * GRID.diameter_mm * np.stack([np.cos(around), np.sin(around)], 1)

    def seen(places_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        board = np.column_stack([places_mm, np.zeros(len(places_mm))]) / 1e3
        return np.asarray(cv2.projectPoints(board, turn, shift, matrix, distortion)[0], np.float64).reshape(-1, 2)

    points = GRID.points_mm()
    rims = [seen(middle + rim_mm) for middle in points]
    areas = np.array([0.5 * np.abs(np.sum(x * np.roll(y, 1) - y * np.roll(x, 1))) for x, y in (rim.T for rim in rims)])
    true_px = 10 * np.sqrt(areas / np.pi)
    told_px = radii_by_middles(GRID, range(len(points)), seen(points))
    assert told_px == pytest.approx(true_px, rel=0.003)
    assert np.abs(radii_px(GRID, seen(points)) / true_px - 1).max() > 0.01
