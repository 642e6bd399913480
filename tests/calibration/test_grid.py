"""The grid found: in the sample photographs drawn here, sharp, blurred, turned, cropped and misnamed."""

import math
from collections.abc import Sequence

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from service.calibration.grid import THRESHOLDS, GridError, find_grid
from service.calibration.target import CircleGrid

TALL = CircleGrid("asymmetric_circles", 11, 4, 20.0, 14.0)
SQUARE = CircleGrid("symmetric_circles", 7, 7, 20.0, 9.0)
WIDE, HIGH = 900, 700


def view(grid: CircleGrid, *, turn_deg: float = 0.0, lean: float = 0.0, px_per_mm: float = 2.2) -> NDArray[np.float64]:
    """A homography [3,3] from millimetres on the sheet to pixels, the grid's middle in the picture's."""
    middle = grid.points_mm().mean(0)
    c, s = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
    centred = np.array([[1, 0, -middle[0]], [0, 1, -middle[1]], [0, 0, 1.0]])
    turned = np.array([[c, -s, 0], [s, c, 0], [lean / 1000, 0, 1]])
    return np.asarray(np.array([[px_per_mm, 0, WIDE / 2], [0, px_per_mm, HIGH / 2], [0, 0, 1]]) @ turned @ centred)


def drawn(grid: CircleGrid, matrix: NDArray[np.float64], *, fine: int = 4) -> NDArray[np.uint8]:
    """Black circles on white, each where the homography takes it, on a busy table."""
    canvas = np.full((HIGH * fine, WIDE * fine), 225, np.uint8)
    rng = np.random.default_rng(0)
    for x, y, w, h in rng.integers(0, 160, (40, 4)) * fine:
        cv2.rectangle(canvas, (int(x) // 4, int(y)), (int(x + w) // 4, int(y + h)), int(rng.integers(0, 255)), -1)
    angle = np.linspace(0, 2 * np.pi, 90)
    rim = np.stack([np.cos(angle), np.sin(angle)], 1) * grid.diameter_mm / 2
    for centre in grid.points_mm():
        through = np.column_stack([centre + rim, np.ones(len(rim))]) @ matrix.T
        outline = (through[:, :2] / through[:, 2:] + 0.5) * fine
        cv2.fillPoly(canvas, [outline.astype(np.int32)], 25)
    return np.asarray(cv2.resize(canvas, (WIDE, HIGH), interpolation=cv2.INTER_AREA), np.uint8)


def centres(grid: CircleGrid, matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    through = np.column_stack([grid.points_mm(), np.ones(grid.rows * grid.columns)]) @ matrix.T
    return np.asarray(through[:, :2] / through[:, 2:])


@pytest.mark.parametrize("turn_deg", [0, 35, 90, 180, 250])
def test_every_circle_is_found_and_named_in_any_turn(turn_deg: float) -> None:
    matrix = view(TALL, turn_deg=turn_deg, lean=0.5)
    found = find_grid(drawn(TALL, matrix), TALL)
    assert found.seen.all()
    assert np.abs(found.centres_px - centres(TALL, matrix)).max() < 1.0
    assert found.radii_px.mean() == pytest.approx(2.2 * 7, rel=0.1)


def test_a_symmetric_grid_begins_at_its_upper_left() -> None:
    matrix = view(SQUARE, turn_deg=12)
    assert np.abs(find_grid(drawn(SQUARE, matrix), SQUARE).centres_px - centres(SQUARE, matrix)).max() < 1.0
    upside_down = view(SQUARE, turn_deg=192)
    assert np.abs(find_grid(drawn(SQUARE, upside_down), SQUARE).centres_px - centres(SQUARE, matrix)).max() < 1.0


@pytest.mark.parametrize("blur_part", [0.2, 0.4])
def test_blur_of_a_third_of_the_radius_hides_nothing(blur_part: float) -> None:
    matrix = view(TALL, turn_deg=15, lean=0.4)
    sigma = blur_part * 7 * 2.2
    found = find_grid(np.asarray(cv2.GaussianBlur(drawn(TALL, matrix), (0, 0), sigma), np.uint8), TALL)
    assert np.abs(found.centres_px - centres(TALL, matrix)).max() < 0.1 * 7 * 2.2


def test_a_hidden_circle_is_filled_in_and_said_so() -> None:
    matrix = view(TALL)
    picture = drawn(TALL, matrix)
    x, y = centres(TALL, matrix)[21].astype(int)
    cv2.rectangle(picture, (int(x) - 18, int(y) - 18), (int(x) + 18, int(y) + 18), 225, -1)
    found = find_grid(picture, TALL)
    assert np.flatnonzero(~found.seen).tolist() == [21]
    assert np.abs(found.centres_px[21] - centres(TALL, matrix)[21]).max() < 1.0


def test_the_outline_of_a_white_sheet_is_not_the_circle_in_its_middle() -> None:
    matrix = view(SQUARE, px_per_mm=1.2)
    low, high = (place.astype(int) for place in (centres(SQUARE, matrix)[0] - 20, centres(SQUARE, matrix)[-1] + 20))
    table = np.full((HIGH, WIDE), 60, np.uint8)
    sheet = np.s_[low[1] : high[1], low[0] : high[0]]
    table[sheet] = drawn(SQUARE, matrix)[sheet]
    found = find_grid(table, SQUARE)
    assert found.seen.all()
    assert np.abs(found.centres_px - centres(SQUARE, matrix)).max() < 1.0


SAME_UPSIDE_DOWN = (
    CircleGrid("symmetric_circles", 7, 10, 20.0, 12.0),
    CircleGrid("symmetric_circles", 6, 6, 20.0, 12.0),
    CircleGrid("asymmetric_circles", 10, 4, 20.0, 14.0),
)


def without(grid: CircleGrid, matrix: NDArray[np.float64], hidden: Sequence[int]) -> NDArray[np.uint8]:
    """The grid drawn, some of its circles under white paper."""
    picture = drawn(grid, matrix)
    for x, y in centres(grid, matrix)[list(hidden)].astype(int).tolist():
        cv2.rectangle(picture, (x - 18, y - 18), (x + 18, y + 18), 225, -1)
    return picture


@pytest.mark.parametrize("hidden", [(0,), (15,), (3, 8, 14, 15, 21, 27, 29)], ids=len)
@pytest.mark.parametrize("grid", SAME_UPSIDE_DOWN, ids=lambda grid: f"{grid.kind}-{grid.rows}x{grid.columns}")
def test_what_is_hidden_is_filled_in_where_a_sheet_looks_the_same_upside_down(
    grid: CircleGrid, hidden: tuple[int, ...]
) -> None:
    matrix = view(grid, turn_deg=8)
    found = find_grid(without(grid, matrix, hidden), grid)
    assert np.flatnonzero(~found.seen).tolist() == list(hidden)
    assert np.abs(found.centres_px - centres(grid, matrix)).max() < 1.0


def test_an_outer_row_that_is_hidden_may_be_that_of_either_side() -> None:
    grid = SAME_UPSIDE_DOWN[0]
    with pytest.raises(GridError, match="60 of the grid's 70 circles"):
        find_grid(without(grid, view(grid), range(60, 70)), grid)


@pytest.mark.parametrize(
    ("wrong", "instead"),
    [
        (CircleGrid("asymmetric_circles", 10, 4, 20.0, 14.0), "it looks like 11 rows, 4 columns: check"),
        (CircleGrid("asymmetric_circles", 4, 11, 20.0, 14.0), "it looks like 11 rows, 4 columns: check"),
        (
            CircleGrid("asymmetric_circles", 12, 4, 20.0, 14.0),
            "or the sheet has other rows and columns; it looks like 11",
        ),
        (CircleGrid("symmetric_circles", 11, 4, 20.0, 14.0), "11 rows, 4 columns of asymmetric_circles"),
        (CircleGrid("symmetric_circles", 11, 8, 20.0, 14.0), "11 rows, 4 columns of asymmetric_circles"),
    ],
)
def test_another_pattern_than_the_one_given_is_refused_and_what_it_looks_like_is_said(
    wrong: CircleGrid, instead: str
) -> None:
    with pytest.raises(GridError, match=f"circles.*{instead}"):
        find_grid(drawn(TALL, view(TALL)), wrong)


def test_a_dot_beside_the_sheet_makes_no_row() -> None:
    matrix = view(TALL, turn_deg=90)
    picture = drawn(TALL, matrix)
    x, y = (2 * centres(TALL, matrix)[36] - centres(TALL, matrix)[28]).astype(int)  # where a twelfth row would begin
    cv2.circle(picture, (int(x), int(y)), 12, 40, -1)
    assert find_grid(picture, TALL).seen.all()
    with pytest.raises(GridError, match="looks like 11 rows, 4 columns"):
        find_grid(picture, CircleGrid("asymmetric_circles", 12, 4, 20.0, 14.0))


def test_a_mirrored_grid_of_even_rows_is_refused() -> None:
    even = CircleGrid("asymmetric_circles", 10, 4, 20.0, 14.0)
    picture = drawn(even, view(even, turn_deg=10))
    assert find_grid(picture, even).seen.all()
    with pytest.raises(GridError, match="mirrored"):
        find_grid(np.ascontiguousarray(picture[:, ::-1]), even)


def test_a_cropped_grid_says_how_much_is_there() -> None:
    picture = drawn(TALL, view(TALL))
    edge = int(centres(TALL, view(TALL))[-1, 1]) - 60
    with pytest.raises(GridError, match=r"\d\d of the grid's 44 circles"):
        find_grid(np.ascontiguousarray(picture[:edge]), TALL)


def test_small_circles_are_too_small_and_nothing_is_nothing() -> None:
    small = cv2.resize(drawn(TALL, view(TALL)), None, fx=0.17, fy=0.17, interpolation=cv2.INTER_AREA)
    with pytest.raises(GridError):
        find_grid(np.asarray(small, np.uint8), TALL)
    with pytest.raises(GridError, match="no grid"):
        find_grid(np.full((400, 500), 128, np.uint8), TALL)


@pytest.mark.parametrize("shape", [(1, 1), (1, 5000), (5000, 2), (13, 13), (70, 3300)])
def test_a_picture_of_no_size_is_no_grid(shape: tuple[int, int]) -> None:
    with pytest.raises(GridError, match="no grid"):
        find_grid(np.full(shape, 200, np.uint8), TALL)


def test_a_picture_full_of_dots_is_told_apart_from_the_pattern() -> None:
    cell = np.full((8, 8), 240, np.uint8)
    cv2.circle(cell, (4, 4), 3, 20, -1)
    with pytest.raises(GridError, match=r"at least 1[78]\d circles"):
        find_grid(np.tile(cell, (60, 80)), TALL)


def test_a_sheet_on_a_board_of_holes_is_found() -> None:
    matrix = view(TALL, turn_deg=10, lean=2, px_per_mm=1.3)
    picture = drawn(TALL, matrix)
    low, high = centres(TALL, matrix).min(0) - 30, centres(TALL, matrix).max(0) + 30
    for x in range(200, WIDE, 32):
        for y in range(20, HIGH, 32):
            if not (low[0] < x < high[0] and low[1] < y < high[1]):
                cv2.circle(picture, (x, y), 4, 25, -1)
    found = find_grid(picture, TALL)
    assert found.seen.all()
    assert np.abs(found.centres_px - centres(TALL, matrix)).max() < 1


def test_three_of_four_circles_are_no_grid() -> None:
    four = CircleGrid("symmetric_circles", 2, 2, 60.0, 40.0)
    picture = without(four, view(four), [3])
    cv2.circle(picture, (800, 100), 30, 25, -1)
    with pytest.raises(GridError):
        find_grid(picture, four)


def test_blobs_are_looked_for_in_steps_that_can_be_stopped() -> None:
    class Stopped(Exception):
        pass

    looks: list[int] = []

    def check() -> None:
        looks.append(len(looks))
        if len(looks) == len(THRESHOLDS) // 2:
            raise Stopped

    with pytest.raises(Stopped):
        find_grid(drawn(TALL, view(TALL)), TALL, check)


@pytest.mark.parametrize("columns", [3, 6])
def test_what_it_looks_like_has_the_circles_that_were_seen(columns: int) -> None:
    sheet = CircleGrid("asymmetric_circles", 7, 3, 26.0, 18.0)  # all but the corners of 5 rows of 5, aslant
    with pytest.raises(GridError, match="looks like 7 rows, 3 columns of asymmetric_circles"):
        find_grid(drawn(sheet, view(sheet)), CircleGrid("symmetric_circles", 7, columns, 26.0, 18.0))
