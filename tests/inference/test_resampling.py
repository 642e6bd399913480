"""A map is read between its cells at every pixel of the photograph."""

import numpy as np
import pytest

from service.inference.resampling import BAND_PX, Ratio, bands, sample


@pytest.mark.parametrize("ratio", [Ratio(0.5, 0.25), Ratio(0.3, 0.5), Ratio(1.0, 1.0)])
def test_between_cells_values_change_evenly_down_and_across_and_edges_are_continued(ratio: Ratio) -> None:
    height, width = 40, 60
    rows, columns = (-(-size * part // 1) for size, part in zip((height, width), ratio, strict=True))
    row, column = np.mgrid[: int(rows), : int(columns)]
    values = (10 * row + column).astype(np.float32)
    down = ((np.arange(height) + 0.5) * ratio.rows - 0.5).clip(0, rows - 1)
    across = ((np.arange(width) + 0.5) * ratio.columns - 0.5).clip(0, columns - 1)
    wanted = 10 * down[:, np.newaxis] + across
    np.testing.assert_allclose(sample(values, ratio, slice(0, height), width), wanted, atol=0.02)
    np.testing.assert_allclose(sample(values, ratio, slice(7, 19), width), wanted[7:19], atol=0.02)


@pytest.mark.parametrize("size", [(1, 1), (700, 900), (3, 2 * BAND_PX)])
def test_bands_are_all_rows_once_and_few_at_a_time(size: tuple[int, int]) -> None:
    height, width = size
    found = list(bands(size))
    assert [row for band in found for row in range(band.start, band.stop)] == list(range(height))
    assert all((band.stop - band.start) * width <= max(BAND_PX, width) for band in found)
