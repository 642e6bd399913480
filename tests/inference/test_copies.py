"""What was read of a smaller copy is found again at its place in the photograph."""

import math

import numpy as np
import pytest

from service.inference.copies import Read, blend
from service.inference.part import Part
from service.inference.resampling import Ratio
from service.optics.camera import Camera

STRIDE = 2


def read(rows: int, columns: int, area: Part) -> Read:
    """Maps of a copy of an area, two of its pixels a cell."""
    maps = {"blur_px": np.ones((rows, columns), np.float32)}
    copied = Camera(columns * STRIDE, rows * STRIDE, 2.0, 6.0)
    return Read(maps, copied, area, STRIDE, (columns * STRIDE / area.width_px,), 22.0)


@pytest.mark.parametrize(("rows", "columns"), [(100, 200), (50, 100), (30, 70)])
def test_a_cell_is_found_by_where_its_middle_lies(rows: int, columns: int) -> None:
    area = Part(80, 40, 80 + 400, 40 + 200)
    seen = read(rows, columns, area)
    down, across = seen.places(rows, columns)
    assert [seen.cell_of(80, v)[0] for v in down] == list(range(rows))
    assert [seen.cell_of(u, 40)[1] for u in across] == list(range(columns))
    # each as far from the area's edges as half a cell
    assert (down[0] - 39.5, 239.5 - down[-1]) == pytest.approx((100 / rows,) * 2, rel=1e-4)
    assert (across[0] - 79.5, 479.5 - across[-1]) == pytest.approx((200 / columns,) * 2, rel=1e-4)
    # and as far to either side of its middle it holds what it covers
    assert [seen.cell_of(80, v - 0.49 * 200 / rows)[0] for v in down] == list(range(rows))
    assert [seen.cell_of(u + 0.49 * 400 / columns, 40)[1] for u in across] == list(range(columns))
    last = seen.cell_of(math.nextafter(479.5, 0), math.nextafter(239.5, 0))
    assert last == (rows - 1, columns - 1)


@pytest.mark.parametrize(("by_coarse", "told"), [(False, 1.0), (True, 3.0)])
def test_what_only_the_smaller_copy_shows_as_strong_blur_is_told_where_that_one_is_believed(
    by_coarse: bool, told: float
) -> None:
    fine = {"blur_px": np.full((40, 60), 2.0, np.float32), "p_near": np.full((40, 60), 1.0, np.float32)}
    coarse = {"blur_px": np.full((20, 30), 8.0, np.float32), "p_near": np.full((20, 30), 3.0, np.float32)}
    blend(fine, coarse, Ratio(0.5, 0.5), 4.0, by_coarse=by_coarse)
    np.testing.assert_allclose(fine["p_near"], told)
    np.testing.assert_allclose(fine["blur_px"], 16.0 if by_coarse else 2.0)


def test_what_a_smaller_copy_shows_is_told_at_its_place() -> None:
    blur_px, slope = np.full((20, 30), 8.0, np.float32), np.add.outer(np.arange(20), 3 * np.arange(30))
    fine = {"blur_px": np.ones((40, 60), np.float32), "p_near": np.zeros((40, 60), np.float32)}
    blend(fine, {"blur_px": blur_px, "p_near": slope.astype(np.float32)}, Ratio(0.5, 0.5), 4.0, by_coarse=True)
    down, across = ((np.arange(size) + 0.5) / 2 - 0.5 for size in (40, 60))
    inner = slice(1, -1), slice(1, -1)
    np.testing.assert_allclose(fine["p_near"][inner], np.add.outer(down, 3 * across)[inner], atol=1e-4)
