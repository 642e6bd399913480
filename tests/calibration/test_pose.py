"""Where sheets are placed, on centres whose camera is known; and what is said of too little or of bad views."""

import numpy as np
import pytest
from numpy.typing import NDArray

from service.calibration.pose import Placement, PoseError, View, place, stand
from service.calibration.target import CircleGrid
from service.opencv import cv2

GRID = CircleGrid("asymmetric_circles", 11, 4, 20.0, 12.0)
FEWER = CircleGrid("asymmetric_circles", 7, 3, 34.0, 12.0)  # on as large a sheet: quicker to place
SIZE = (1280, 960)
MATRIX = np.array([[1300.0, 0, 650], [0, 1290.0, 470], [0, 0, 1]])
DISTORTION = np.array([-0.1, 0.05, 1e-3, -1e-3, 0])
TILTS = ((0.35, 0.0), (-0.3, 0.1), (0.0, 0.4), (0.1, -0.35), (0.2, 0.2), (-0.25, -0.25), (0.05, 0.3), (0.3, -0.1))
DEPTHS_M = (0.4, 0.45, 0.5, 0.55, 0.6, 0.65, 0.7, 0.75)

Array = NDArray[np.float64]


def flat(grid: CircleGrid = GRID) -> Array:
    return np.column_stack([grid.points_mm(), np.zeros(grid.rows * grid.columns)])


def views(
    sheet: Array, count: int = 8, *, noise_px: float = 0.03, tilted: float = 1.0, size: float = 1.0
) -> tuple[list[View], list[Array]]:
    """The centres of the circles' outlines as photographs show them, and their true depths in metres.

    Of a sheet of another ``size``, all is so much smaller or larger, the distances too.
    """
    rng = np.random.default_rng(0)
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    rim = np.stack([np.cos(angle), np.sin(angle), np.zeros(60)], 1) * size * GRID.diameter_mm / 2
    seen, depths = [], []
    for (a, b), depth_m in zip(TILTS[:count], DEPTHS_M[:count], strict=True):
        turn = np.array([tilted * a, tilted * b, 1.5])
        rotation = np.asarray(cv2.Rodrigues(turn)[0])
        shift = size * np.array([5.0, -8.0, 1e3 * depth_m]) - rotation @ sheet.mean(0)
        outlines, _ = cv2.projectPoints((sheet[:, None] + rim).reshape(-1, 3), turn, shift, MATRIX, DISTORTION)
        ellipses = [cv2.fitEllipseDirect(rim_px.astype(np.float32)) for rim_px in outlines.reshape(-1, 60, 2)]
        centres = np.array([ellipse[0] for ellipse in ellipses]) + noise_px * rng.standard_normal((len(sheet), 2))
        seen.append(View(np.arange(len(sheet)), centres))
        depths.append(((sheet @ rotation.T)[:, 2] + shift[2]) / 1e3)
    return seen, depths


@pytest.fixture(scope="module")
def depths() -> list[Array]:
    return views(flat())[1]


@pytest.fixture(scope="module")
def found() -> Placement:
    return place(GRID, views(flat())[0], SIZE)


def test_the_camera_and_every_circle_s_depth_come_out(found: Placement, depths: list[Array]) -> None:
    assert found.intrinsics.fx_px == pytest.approx(1300, rel=2e-3)
    assert found.intrinsics.fy_px == pytest.approx(1290, rel=2e-3)
    assert (found.intrinsics.cx_px, found.intrinsics.cy_px) == pytest.approx((650, 470), abs=3)
    for got, true in zip(found.depth_m, depths, strict=True):
        np.testing.assert_allclose(got, true, rtol=3e-3)
    assert found.overall_rms_px < 0.06
    assert found.focal_error < 2e-3
    assert not found.warnings


def test_a_sheet_s_distance_and_tilt_are_those_of_its_circles(found: Placement, depths: list[Array]) -> None:
    assert found.distance_m == pytest.approx(DEPTHS_M, rel=3e-3)
    for tilt_deg, depth_m in zip(found.tilt_deg, depths, strict=True):
        across = np.column_stack([GRID.points_mm() / 1e3, np.ones(len(depth_m))])
        per_metre = np.linalg.lstsq(across, depth_m)[0][:2]
        assert np.sin(np.radians(tilt_deg)) == pytest.approx(np.hypot(*per_metre), rel=0.02)


def test_circles_that_were_not_measured_are_not_missed() -> None:
    seen, depths = views(flat())
    measured = [np.flatnonzero(np.arange(len(depths[0])) % 5 != number % 5) for number in range(len(seen))]
    parts = [View(part, view.centres_px[part]) for view, part in zip(seen, measured, strict=True)]
    found = place(GRID, parts, SIZE)
    assert found.intrinsics.fx_px == pytest.approx(1300, rel=3e-3)
    for got, true, part in zip(found.depth_m, depths, measured, strict=True):
        np.testing.assert_allclose(got, true[part], rtol=3e-3)


def test_circles_that_are_seen_exactly_are_placed_exactly() -> None:
    """The middle of a circle's image is not its centre's image."""
    seen, depths = views(flat(), 4, noise_px=0.0)
    for got, true in zip(place(GRID, seen, SIZE).depth_m, depths, strict=True):
        np.testing.assert_allclose(got, true, rtol=1e-5)


def test_depth_is_along_the_axis_and_not_along_the_ray(found: Placement, depths: list[Array]) -> None:
    assert np.ptp(depths[0]) > 0.02, "the sheet is tilted"
    assert np.corrcoef(found.depth_m[0], depths[0])[0, 1] > 0.9999


@pytest.mark.parametrize("size", [0.1, 1.0])
def test_a_small_sheet_is_as_bent_as_a_large_one(size: float) -> None:
    bent = flat()
    bent[:, 2] = 2e-4 * (bent[:, 1] - bent[:, 1].mean()) ** 2  # 2 mm at the ends
    grid = CircleGrid(GRID.kind, GRID.rows, GRID.columns, size * GRID.spacing_mm, size * GRID.diameter_mm)
    found = place(grid, views(size * bent, size=size)[0], SIZE)
    assert any("bent or unevenly printed" in warning for warning in found.warnings)


def test_a_bent_and_stretched_sheet_is_found_and_said() -> None:
    bent = flat()
    bent[:, 2] = 3e-4 * (bent[:, 1] - bent[:, 1].mean()) ** 2  # 3 mm at the ends
    bent[:, 0] *= 1.01
    seen, depths = views(bent)
    found = place(GRID, seen, SIZE)
    assert any("bent or unevenly printed" in warning for warning in found.warnings)
    assert found.overall_rms_px < 0.1
    assert found.intrinsics.fx_px == pytest.approx(1300, rel=5e-3)
    for got, true in zip(found.depth_m, depths, strict=True):
        np.testing.assert_allclose(got, true, rtol=8e-3)


@pytest.mark.parametrize(("wave_mm", "is_said"), [(0.5, False), (1.0, True)])
def test_a_sheet_that_waves_is_accounted_for_and_said_if_by_much(wave_mm: float, *, is_said: bool) -> None:
    waving = flat()
    waving[:, 2] = wave_mm * np.sin(2 * np.pi * waving[:, 1] / np.ptp(waving[:, 1]))
    seen, depths = views(waving)
    found = place(GRID, seen, SIZE)
    assert [("bent or unevenly printed" in warning) for warning in found.warnings] == [True] * is_said
    assert found.overall_rms_px < 0.06
    for got, true in zip(found.depth_m, depths, strict=True):
        np.testing.assert_allclose(got, true, rtol=1e-3)


def test_few_views_and_no_tilt_are_said_and_one_view_is_an_error() -> None:
    seen, _ = views(flat(), 3)
    assert any("3 usable photographs" in warning for warning in place(GRID, seen, SIZE).warnings)
    with pytest.raises(PoseError, match="1 photograph shows"):
        place(GRID, seen[:1], SIZE)


@pytest.mark.parametrize("count", [2, 3])
def test_few_sheets_tell_the_focal_length_as_well_as_they_say(count: int) -> None:
    """Of a camera whose axis is not in the very middle and whose pixels are not quite square."""
    found = place(GRID, views(flat(), count)[0], SIZE)
    off = (found.intrinsics.fx_px / MATRIX[0, 0] - 1, found.intrinsics.fy_px / MATRIX[1, 1] - 1)
    assert max(abs(part) for part in off) < min(3 * found.focal_error, 0.01)
    assert found.focal_error < 0.01
    assert not any("bent" in warning for warning in found.warnings)


@pytest.mark.parametrize("count", [3, 5])
def test_few_sheets_tell_that_they_bend(count: int) -> None:
    """Taken for flat and even, the focal length was 1.0 and 1.4 % off, with 0.3 % stated."""
    bent = flat()
    across, along = (bent - bent.mean(0)).T[:2]
    bent[:, 2] = 1e-4 * along**2 + 2e-4 * across * along  # 1 mm at the ends, and twisted
    bent[:, 0] *= 1.005
    seen, depths = views(bent, count)
    found = place(GRID, seen, SIZE)
    assert any("bent or unevenly printed" in warning for warning in found.warnings)
    off = abs(found.intrinsics.fx_px / MATRIX[0, 0] - 1)
    assert off < min(3 * found.focal_error, 0.002)
    for got, true in zip(found.depth_m, depths, strict=True):
        np.testing.assert_allclose(got, true, rtol=5e-3)


@pytest.mark.parametrize("tilted", [0.08, 0.15, 0.3])
def test_the_less_the_sheet_is_tilted_the_larger_is_the_error_stated(tilted: float) -> None:
    seen, depths = views(flat(FEWER), tilted=tilted)
    found = place(FEWER, seen, SIZE)
    off = max(float(np.abs(got / true - 1).max()) for got, true in zip(found.depth_m, depths, strict=True))
    assert off < 3 * found.focal_error
    assert found.focal_error * tilted**2 == pytest.approx(2.6e-4, rel=0.2), "as the square of the tilt"


def test_a_focal_length_that_is_uncertain_by_nearly_a_tenth_is_told() -> None:
    assert 0.07 < place(FEWER, views(flat(FEWER), tilted=0.065)[0], SIZE).focal_error < 0.1


@pytest.mark.parametrize("tilted", [0.0, 0.05])
def test_sheets_that_were_hardly_tilted_tell_no_focal_length(tilted: float) -> None:
    seen, _ = views(flat(FEWER), tilted=tilted)
    with pytest.raises(PoseError, match="tilt the sheet by 15 to 25 degrees"):
        place(FEWER, seen, SIZE)


def test_two_cameras_mixed_are_said() -> None:
    seen, _ = views(flat(FEWER))
    others = [View(view.circles, (view.centres_px - 480) * 1.3 + 480) for view in seen[::2]]
    found = place(FEWER, [*seen[1::2], *others], SIZE)
    assert any("one camera" in warning for warning in found.warnings)


def test_another_camera_s_view_does_not_fit() -> None:
    seen, _ = views(flat(FEWER))
    seen[3] = View(seen[3].circles, (seen[3].centres_px - 480) * 1.3 + 480)
    found = place(FEWER, seen, SIZE)
    assert np.argmax(found.rms_px) == 3


@pytest.mark.parametrize("seed", [0, 2])
def test_circles_where_no_camera_would_see_them_are_said(seed: int) -> None:
    """Two such sheets may give a focal length below 0."""
    rng = np.random.default_rng(seed)
    mixed = [View(view.circles, rng.permutation(view.centres_px)) for view in views(flat(FEWER), 2)[0]]
    with pytest.raises(PoseError, match="no camera would see the grid like that"):
        place(FEWER, mixed, SIZE)


def test_too_few_circles_stand_nowhere(found: Placement) -> None:
    view = views(flat())[0][0]
    assert stand(GRID, View(view.circles[:3], view.centres_px[:3]), found.intrinsics) == (None, None)


def test_one_sheet_that_is_not_tilted_is_no_matter() -> None:
    (straight, *_), _ = views(flat(FEWER), tilted=0.0)
    tilted, _ = views(flat(FEWER))
    assert not any("never tilted" in warning for warning in place(FEWER, [straight, *tilted[1:]], SIZE).warnings)
    said = [place(FEWER, views(flat(FEWER), tilted=tilted)[0], SIZE).warnings for tilted in (0.35, 0.45)]
    assert [any("never tilted" in warning for warning in each) for each in said] == [True, False]


def test_sheets_in_mirrored_pictures_stand_as_in_others(found: Placement) -> None:
    mirrored = [View(view.circles, view.centres_px * (-1, 1) + (SIZE[0] - 1, 0)) for view in views(flat())[0]]
    placed = place(GRID, mirrored, SIZE)
    assert placed.distance_m == pytest.approx(found.distance_m, rel=1e-3)
    assert placed.tilt_deg == pytest.approx(found.tilt_deg, abs=0.1)


@pytest.mark.parametrize(("noise_px", "is_said"), [(0.2, False), (0.7, True)])
def test_circles_a_little_off_are_no_other_camera_s(noise_px: float, *, is_said: bool) -> None:
    warnings = place(FEWER, views(flat(FEWER), noise_px=noise_px)[0], SIZE).warnings
    assert ["one camera" in warning for warning in warnings] == [True] * is_said


def test_a_sheet_stands_where_it_was_placed(found: Placement) -> None:
    for number, view in enumerate(views(flat())[0]):
        expected = found.distance_m[number], found.tilt_deg[number]
        assert stand(GRID, view, found.intrinsics) == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("size", [0.001, 0.012, 0.02])
def test_a_sheet_told_in_metres_is_noticed(size: float) -> None:
    grid = CircleGrid(GRID.kind, GRID.rows, GRID.columns, size * GRID.spacing_mm, size * GRID.diameter_mm)
    said = [warning for warning in place(grid, views(flat())[0], SIZE).warnings if "in millimetres" in warning]
    assert [f"{750 * size:.2g} mm from the lens" in warning for warning in said] == [True] * (size < 0.0133)
