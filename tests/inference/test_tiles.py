"""Tiles cover the photograph, fade into each other, and change nothing but the memory."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from service.inference.artifact import load_model_folder
from service.inference.estimator import Estimator
from service.inference.pair import GraphPair
from service.inference.tiles import OVERLAP_PX, PIXEL_BUDGET, fades, layout, read_in_tiles, spans
from service.opencv import cv2
from service.optics.camera import Camera
from tests.inference.oracle_pair import build_oracle_pair


@given(size=st.integers(300, 9000), count=st.integers(1, 12))
def test_spans_cover_everything_and_overlap_enough(size: int, count: int) -> None:
    count = min(count, max(1, size // (2 * OVERLAP_PX + 16)))
    found = spans(size, count, 16)
    assert len(found) == count
    assert found[0].start == 0
    assert found[-1].stop == size
    for one, following in pairwise(found):
        assert following.start % 16 == 0
        assert one.stop - following.start >= OVERLAP_PX
    sizes = [span.stop - span.start for span in found]
    assert max(sizes) - min(sizes) <= 16 * len(found)


def longest(along: list[slice]) -> int:
    return max(int(span.stop - span.start) for span in along)


@pytest.mark.parametrize(
    ("height", "width", "budget"),
    [(1250, 5000, 1_000_000), (3500, 1700, 1_000_000), (3072, 4080, 1_000_000), (3072, 4080, PIXEL_BUDGET)],
)
def test_of_all_tiles_within_the_budget_those_are_taken_that_read_the_least_twice(
    height: int, width: int, budget: int
) -> None:
    most = [size // (2 * OVERLAP_PX + 16) for size in (height, width)]
    reads = [
        longest(spans(height, down, 16)) * longest(spans(width, across, 16)) * down * across
        for down in range(1, most[0] + 1)
        for across in range(1, most[1] + 1)
        if longest(spans(height, down, 16)) * longest(spans(width, across, 16)) <= budget
    ]
    rows, columns = layout(height, width, 16, budget)
    tile = longest(rows) * longest(columns)
    assert tile <= budget
    assert tile * len(rows) * len(columns) == min(reads)


def test_no_tile_is_narrower_than_two_overlaps_however_small_the_budget() -> None:
    for size, counts in (((1300, 400), (2, 1)), ((400, 1300), (1, 2))):
        rows, columns = layout(*size, 16, 1)
        assert (len(rows), len(columns)) == counts


@given(size=st.integers(300, 5000), stride=st.sampled_from([1, 2, 4]))
def test_weights_sum_to_one_at_every_pixel(size: int, stride: int) -> None:
    found = spans(size, max(1, size // 250), 16)  # three of them share pixels
    total = np.zeros(-(-size // stride))
    for span, weight in zip(found, fades(found, stride), strict=True):
        assert (weight >= 0).all()
        total[span.start // stride : span.start // stride + len(weight)] += weight
    np.testing.assert_allclose(total, 1, atol=1e-5)


def test_what_a_tile_says_near_its_edge_counts_nothing() -> None:
    left, right = fades(spans(2000, 2, 16), 2)
    edge = OVERLAP_PX // 4 // 2
    assert not left[-edge:].any()
    assert not right[:edge].any()
    assert left.max() == right.max() == 1


def test_a_reader_that_disagrees_with_itself_leaves_no_seam() -> None:
    answers = iter(range(100))

    def read(tile: NDArray[np.uint8]) -> dict[str, NDArray[np.float32]]:
        return {"level": np.full(tile.shape[:2], next(answers), np.float32)}

    rgb = np.zeros((1500, 1800, 3), np.uint8)
    level = read_in_tiles(rgb, read, multiple=16, stride=1, pixel_budget=500_000)["level"]
    assert level.max() > 2
    steps = max(np.abs(np.diff(level, axis=0)).max(), np.abs(np.diff(level, axis=1)).max())
    assert steps < 0.06


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> GraphPair:
    # so unsure that depth does not jump where neither side is likelier
    folder = build_oracle_pair(tmp_path_factory.mktemp("model"), depth_scale=0.3)
    return GraphPair(load_model_folder(folder), 1)


@pytest.mark.parametrize(("height", "width"), [(501, 1303), (1700, 480)])
def test_tiled_equals_untiled(pair: GraphPair, height: int, width: int) -> None:
    rgb = np.random.default_rng(0).integers(30, 130, (height // 20, width // 20, 3), np.uint8)
    rgb = np.asarray(cv2.resize(rgb, (width, height), interpolation=cv2.INTER_CUBIC), np.uint8)
    camera = Camera(width, height, 2.0, 6.0, 0.5)
    whole = Estimator(pair, pixel_budget=10**9).estimate(rgb, camera)
    tiled = Estimator(pair, pixel_budget=200_000).estimate(rgb, camera)
    for name in ("depth_m", "p_near", "sigma_m", "blur_px"):
        np.testing.assert_allclose(getattr(tiled, name), getattr(whole, name), rtol=1e-4, atol=1e-5, err_msg=name)
    # there the last digit says which side is the other
    same = np.isclose(tiled.depth_alt_m, whole.depth_alt_m, rtol=1e-4, atol=1e-5)
    assert same.mean() > 0.999


def test_a_tile_is_never_much_larger_than_the_budget() -> None:
    sizes: list[int] = []

    def read(tile: NDArray[np.uint8]) -> dict[str, NDArray[np.float32]]:
        sizes.append(tile.shape[0] * tile.shape[1])
        return {"level": np.zeros((-(-tile.shape[0] // 2), -(-tile.shape[1] // 2)), np.float32)}

    rgb: NDArray[np.uint8] = np.broadcast_to(np.zeros(3, np.uint8), (3072, 4080, 3))
    merged = read_in_tiles(rgb, read, multiple=16, stride=2)
    assert merged["level"].shape == (1536, 2040)
    assert max(sizes) <= PIXEL_BUDGET


def test_a_model_folder_path_with_a_stride_of_one_is_read_alike(tmp_path: Path) -> None:
    estimator = Estimator.from_folder(load_model_folder(build_oracle_pair(tmp_path / "m", stride=1)))
    answer = estimator.estimate(np.full((33, 47, 3), 90, np.uint8), Camera(47, 33, 2.0, 6.0), "near")
    np.testing.assert_allclose(answer.depth_m, answer.depth_m[0, 0], rtol=1e-5)
