"""What the layout says is seen on the whole of a large picture, and on nothing else."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from model_export.bench_graphs import camera_for, draw_picture
from service.config import SHIPPED_MODEL
from service.inference.artifact import LAYOUT_MAP, load_model_folder
from service.inference.cancellation import Cancellation
from service.inference.layout import add_odds, shrunk
from service.inference.pair import GraphPair, RawMaps, Stopwatch
from service.inference.tiles import read_in_tiles

Array = NDArray[np.float32]


@pytest.fixture(scope="module")
def pair() -> GraphPair:
    return GraphPair(load_model_folder(SHIPPED_MODEL), 1)


def test_log_odds_are_added_to_probabilities() -> None:
    p_near = np.random.default_rng(0).random((30, 50), np.float32)
    expected = 1 / (1 + (1 / p_near - 1) * np.exp(-1.5))
    add_odds(p_near, np.full((4, 7), 1.5, np.float32), (32, 56))
    np.testing.assert_allclose(p_near, expected, rtol=1e-5)


def test_certainty_stays_certain_and_a_number_but_for_more_that_speaks_against_it() -> None:
    p_near = np.array([[0.0, 1.0]], np.float32)
    add_odds(p_near, np.full((1, 1), 3.0, np.float32), (1, 2))
    assert p_near[0, 0] < 1e-4
    assert p_near[0, 1] > 1 - 1e-4
    add_odds(p_near, np.array([[20.0, -20.0]], np.float32), (1, 2))
    assert p_near[0, 0] > 0.9 > 0.1 > p_near[0, 1]


def test_a_smaller_map_has_the_means_of_what_its_cells_cover() -> None:
    layout_map = np.random.default_rng(0).random((3, 12, 20), np.float32)
    np.testing.assert_allclose(
        shrunk(layout_map, 0.25), layout_map.reshape(3, 3, 4, 5, 4).mean((2, 4)), rtol=1e-5, atol=1e-6
    )
    assert shrunk(layout_map, 0.01).shape == (3, 1, 1)


def reading(pair: GraphPair, width: int, height: int, *, is_tile: bool) -> Callable[[NDArray[np.uint8]], RawMaps]:
    """What reads any part of a picture of that size."""
    camera = camera_for(width, height)
    return lambda part: pair.read(part, camera, "auto", Cancellation(), Stopwatch(), is_tile=is_tile)


def test_a_layout_taken_away_and_seen_again_at_its_size_changes_nothing(pair: GraphPair) -> None:
    width, height = 330, 250
    picture = draw_picture(width, height)
    expected, maps = (reading(pair, width, height, is_tile=is_tile)(picture) for is_tile in (False, True))
    assert np.abs(maps["p_near"] - expected["p_near"]).max() > 0.01
    pair.lay_out(maps, 1.0, Cancellation(), Stopwatch())
    np.testing.assert_allclose(maps["p_near"], expected["p_near"], atol=1e-3)
    assert maps.keys() == expected.keys()


def test_tiles_with_the_layout_of_the_whole_tell_sides_as_the_whole_does(pair: GraphPair) -> None:
    width, height = 1600, 1200
    picture = draw_picture(width, height)

    def near(budget: int, *, is_tile: bool) -> NDArray[np.bool_]:
        read = reading(pair, width, height, is_tile=is_tile)
        maps = read_in_tiles(picture, read, multiple=16, stride=2, pixel_budget=budget)
        assert LAYOUT_MAP not in maps or maps[LAYOUT_MAP].shape == (48, 75, 100)
        pair.lay_out(maps, 640 / width, Cancellation(), Stopwatch())
        return maps["p_near"] > 0.5

    each_its_own, of_the_whole = (
        float((near(width * height, is_tile=is_tile) != near(1_250_000, is_tile=is_tile)).mean())
        for is_tile in (False, True)
    )
    assert of_the_whole < 0.7 * each_its_own
