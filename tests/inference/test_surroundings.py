"""What surrounds a pixel counts as far as the pixel's own reading is in doubt."""

from statistics import NormalDist

import numpy as np
import pytest
from numpy.typing import NDArray

from service.inference.depth_map import NO_ANSWER, Reading, least_error
from service.inference.resampling import Ratio
from service.inference.surroundings import OWN_SPREAD, settle
from service.optics.camera import Camera

SIZE = (120, 160)
STRIDE = 2
FOCUS_M = 2.0
CAMERA = Camera(SIZE[1] * STRIDE, SIZE[0] * STRIDE, FOCUS_M, 6.0)
SURE, UNSURE = 0.02, 0.3

Array = NDArray[np.float32]


def read(
    depth_m: Array | float,
    error: Array | float,
    other_m: Array | float = np.nan,
    p_near: Array | float = 1.0,
    size: tuple[int, int] = SIZE,
) -> Reading:
    """A reading of these maps; without ``other_m`` of near hypotheses alone."""

    def everywhere(values: Array | float) -> Array:
        return np.array(np.broadcast_to(np.asarray(values, np.float32), size))

    maps = everywhere(depth_m), everywhere(other_m), everywhere(p_near), everywhere(error), everywhere(1.0)
    return Reading(*maps, CAMERA, 1.0, Ratio(1 / STRIDE, 1 / STRIDE))


def settled(reading: Reading, limits_m: tuple[float, float] = (0.0, np.inf)) -> Array:
    settle(reading, limits_m, STRIDE, SIZE[1] * STRIDE)
    return reading.depth_m


def floor() -> Array:
    """A floor that comes nearer from the top of the picture to its bottom: inverse depth is linear in the row."""
    inverse = np.linspace(1 / 1.9, 1 / 0.8, SIZE[0], dtype=np.float32)
    return np.repeat(1 / inverse[:, np.newaxis], SIZE[1], axis=1)


def test_what_is_surely_read_stays() -> None:
    truth = floor()
    np.testing.assert_allclose(settled(read(truth, SURE)), truth, rtol=0.003)


@pytest.mark.parametrize("cells", [8, 24])
def test_one_thing_in_doubt_is_drawn_to_the_floor_around_it(cells: int) -> None:
    truth, thing = floor(), (slice(54 - cells // 2, 54 + cells // 2), slice(74 - cells // 2, 74 + cells // 2))
    depth_m, error = truth.copy(), np.full(SIZE, SURE, np.float32)
    depth_m[thing] *= 1.5
    error[thing] = UNSURE
    off = settled(read(depth_m, error)) / truth
    assert off[52:56, 72:76].max() < 1.22
    assert np.abs(np.log(off[: 50 - cells // 2])).max() < 0.003


def test_an_even_floor_in_doubt_keeps_most_of_its_slope() -> None:
    truth = floor()
    depth_m = settled(read(truth, UNSURE))
    middle = slice(48, 72), slice(64, 96)
    np.testing.assert_allclose(depth_m[middle], truth[middle], rtol=0.03)
    assert (depth_m[8] > 1.3 * depth_m[-8]).all()


def test_noise_of_what_is_in_doubt_grows_less() -> None:
    coarse = np.random.default_rng(1).normal(0, UNSURE, (SIZE[0] // 4, SIZE[1] // 4))
    noise = np.exp(coarse.repeat(4, 0).repeat(4, 1)).astype(np.float32)
    truth = floor()
    depth_m = settled(read(truth * noise, UNSURE))
    assert np.abs(np.log(depth_m / truth)).mean() < 0.8 * np.abs(np.log(noise)).mean()


@pytest.mark.parametrize(("other_m", "least_kept", "most_kept"), [(3.0, 0.85, 1.0), (1.35, 0.5, 0.82)])
def test_the_table_says_on_which_side_its_box_is(other_m: float, least_kept: float, most_kept: float) -> None:
    """A box at 1.05 m before a table at 1.35 m, in doubt between that and beyond focus, or the table's own depth."""
    box = (slice(50, 66), slice(70, 90))
    table_m, box_m, p_near = 1.35, 1.05, 0.7
    depth_m, other = np.full(SIZE, table_m, np.float32), np.full(SIZE, np.nan, np.float32)
    error, near = np.full(SIZE, SURE, np.float32), np.ones(SIZE, np.float32)
    depth_m[box], other[box], near[box] = box_m, other_m, p_near
    error[box] = np.sqrt(0.06**2 + (1 - p_near) * np.log(other_m / box_m) ** 2)
    answer = settled(read(depth_m, error, other, near))[box]
    kept = np.log(answer / table_m) / np.log(box_m / table_m)
    assert least_kept <= kept.min()
    assert kept.max() <= most_kept


@pytest.mark.parametrize(
    ("box_m", "other_m", "p_near"),
    [(1.05, 3.0, 0.7), (1.05, 1.2, 0.6), (0.9, 1.1, 0.9), (2.6, 1.6, 0.3), (2.1, 1.1, 0.45), (60.0, 1.4, 0.4)],
)
def test_what_surrounds_a_box_is_heard_as_far_as_a_normal_law_says(box_m: float, other_m: float, p_near: float) -> None:
    """Of things about a table each depth is as likely as a normal law of its logarithm says, of either hypothesis."""
    box, table_m, own = (slice(48, 56), slice(72, 80)), 1.35, 0.1
    is_near = box_m < other_m
    doubt, gap = (1 - p_near) if is_near else p_near, np.log(other_m / box_m)
    depth_m, other = np.full(SIZE, table_m, np.float32), np.full(SIZE, np.nan, np.float32)
    error, near = np.full(SIZE, SURE, np.float32), np.ones(SIZE, np.float32)
    depth_m[box], other[box], near[box] = box_m, other_m, p_near
    error[box] = stated = min(np.sqrt(own**2 + doubt * gap**2), 1.0)
    own = np.sqrt(max(stated**2 - doubt * gap**2, SURE**2))
    law = NormalDist(np.log(table_m), np.hypot(own, OWN_SPREAD))
    chances = doubt * law.pdf(np.log(other_m)), (1 - doubt) * law.pdf(np.log(box_m))
    in_doubt = min(own**2 + chances[0] / sum(chances) * gap**2, stated**2)
    middle = settled(read(depth_m, error, other, near))[52, 76]
    kept = np.log(middle / table_m) / np.log(box_m / table_m)
    assert kept == pytest.approx(OWN_SPREAD**2 / (in_doubt + OWN_SPREAD**2), rel=0.02)


@pytest.mark.parametrize("limits_m", [(0.3, FOCUS_M), (FOCUS_M, 16.0)])
def test_a_side_that_is_given_is_kept(limits_m: tuple[float, float]) -> None:
    away = np.abs(np.random.default_rng(2).normal(0, 0.2, SIZE))
    truth = FOCUS_M * np.exp(away if limits_m[0] == FOCUS_M else -away)
    depth_m = settled(read(truth.astype(np.float32), UNSURE), limits_m)
    assert limits_m[0] <= depth_m.min()
    assert depth_m.max() <= limits_m[1]


def test_what_is_drawn_farther_states_no_less_than_optics_allow() -> None:
    depth_m, error = np.full(SIZE, 1.8, np.float32), np.full(SIZE, SURE, np.float32)
    thing, unknown = (slice(50, 58), slice(70, 78)), (slice(10, 14), slice(10, 14))
    depth_m[thing] = 1.0
    error[thing] = 1.001 * least_error(depth_m[thing], CAMERA)
    error[unknown] = NO_ANSWER
    reading = read(depth_m, error)
    assert settled(reading)[thing].max() > 1.0
    assert (reading.error[60:] == np.float32(SURE)).all()
    assert (reading.error >= least_error(reading.depth_m, CAMERA)).all()
    assert (reading.error[unknown] == NO_ANSWER).all()


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (3, 2), (17, 33)])
def test_small_maps_are_settled(size: tuple[int, int]) -> None:
    np.testing.assert_allclose(settled(read(1.2, UNSURE, size=size)), 1.2, rtol=1e-5)


def test_what_surrounds_a_pixel_is_near_by_in_a_large_copy_too() -> None:
    halves = np.ones(SIZE, np.float32)
    halves[:, SIZE[1] // 2 :] = 2.0
    reading = read(halves, UNSURE)
    settle(reading, (0.0, np.inf), STRIDE, 2000)
    np.testing.assert_allclose(reading.depth_m[:, :20], 1.0, rtol=1e-4)


@pytest.mark.parametrize(("axis", "least"), [(0, 0.925), (1, 0.94)])
def test_a_plane_is_one_to_the_edge(axis: int, least: float) -> None:
    inverse = np.linspace(1 / 1.9, 1 / 0.8, SIZE[axis])
    truth = np.broadcast_to(1 / (inverse[:, np.newaxis] if axis == 0 else inverse), SIZE).astype(np.float32)
    off = settled(read(truth, UNSURE)) / truth
    assert least < off.min() < 1 < off.max() < 2 - least


def test_it_is_the_same_in_any_unit() -> None:
    rng = np.random.default_rng(3)
    noise = np.exp(rng.normal(0, UNSURE, (SIZE[0] // 8, SIZE[1] // 8)).repeat(8, 0).repeat(8, 1))
    depth_m, other_m = floor() * noise, 2.5 * floor()
    once, tenfold = (settled(read(times * depth_m, UNSURE, times * other_m, 0.7)) for times in (1, 10))
    np.testing.assert_allclose(tenfold, 10 * once, rtol=1e-4)


def test_what_surrounds_a_pixel_is_never_beyond_infinity() -> None:
    depth_m, error = np.full(SIZE, 30.0, np.float32), np.full(SIZE, 1.0, np.float32)
    error[32:56, 32:56] = SURE
    depth_m[32:40, 32:40] = 0.05
    assert np.isfinite(settled(read(depth_m, error))).all()
