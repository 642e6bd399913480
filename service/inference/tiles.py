"""Large photographs in overlapping tiles, so that memory follows the tile and not the photograph."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

PIXEL_BUDGET = 6_800_000  # two tiles of 4080x3072, a phone's
# a tile knows too little of what surrounds its edge, so where two overlap both are read, but faded into each other in
# the middle alone (docs/performance.md)
OVERLAP_PX, FADED = 304, 0.4

Maps = dict[str, NDArray[np.float32]]


def read_in_tiles(
    rgb: NDArray[np.uint8],
    read: Callable[[NDArray[np.uint8]], Maps],
    *,
    multiple: int,
    stride: int,
    pixel_budget: int = PIXEL_BUDGET,
) -> Maps:
    """What ``read`` gives for an image uint8 [h, w, 3]: at once, or from tiles faded into each other.

    ``read`` maps uint8 [h, w, 3] to maps [ceil(h/stride), ceil(w/stride)], or coarse ones with channels
    [c, ceil(h/multiple), ceil(w/multiple)]. Tiles start at multiples of ``multiple``, so that a tile's grid is the
    photograph's.
    """
    height, width = rgb.shape[:2]
    if height * width <= pixel_budget:
        return read(rgb)
    rows, columns = layout(height, width, multiple, pixel_budget)
    merged: Maps = {}
    weights = {step: [fades(along, step) for along in (rows, columns)] for step in (stride, multiple)}
    for down, row in enumerate(rows):
        for across, column in enumerate(columns):
            for name, values in read(rgb[row, column]).items():
                step = stride if values.ndim == 2 else multiple
                size = (*values.shape[:-2], -(-height // step), -(-width // step))
                weight = np.outer(weights[step][0][down], weights[step][1][across])
                into = merged.setdefault(name, np.zeros(size, np.float32))
                top, left = row.start // step, column.start // step
                into[..., top : top + values.shape[-2], left : left + values.shape[-1]] += values * weight
    return merged


def layout(height: int, width: int, multiple: int, pixel_budget: int) -> tuple[list[slice], list[slice]]:
    """Rows and columns of tiles of at most ``pixel_budget``, so that the least is read twice.

    No tile is narrower than two overlaps, whatever the budget.
    """
    least = 2 * OVERLAP_PX + multiple
    best: tuple[int, int, int] | None = None
    for across in range(1, max(1, width // least) + 1):
        for down in range(1, max(1, height // least) + 1):
            tile = _side(height, down, multiple) * _side(width, across, multiple)
            if tile <= pixel_budget and (best is None or tile * down * across < best[0]):
                best = (tile * down * across, down, across)
    _, down, across = best or (0, max(1, height // least), max(1, width // least))
    return spans(height, down, multiple), spans(width, across, multiple)


def _side(size: int, count: int, multiple: int) -> int:
    """What ``count`` spans must measure to cover ``size`` and overlap, wherever starts are moved to multiples."""
    if count == 1:
        return size
    return -(-(size + (count - 1) * (OVERLAP_PX + multiple)) // (count * multiple)) * multiple


def spans(size: int, count: int, multiple: int) -> list[slice]:
    """So many even spans that cover ``size`` and overlap by ``OVERLAP_PX`` or more, each from a multiple."""
    side = _side(size, count, multiple)
    starts = [(size - side) * place // max(1, count - 1) // multiple * multiple for place in range(count)]
    return [slice(start, min(start + side, size)) for start in starts[:-1]] + [slice(starts[-1], size)]


def fades(along: list[slice], stride: int) -> list[NDArray[np.float32]]:
    """A weight per map pixel of each span: it falls softly towards neighbours, and all sum to 1 everywhere."""
    total = np.zeros(-(-along[-1].stop // stride))
    weights = []
    for place, span in enumerate(along):
        centres = np.arange(span.start // stride, -(-span.stop // stride)) * stride + stride / 2
        weight = np.ones(len(centres))
        if place:
            weight *= _soft_step((centres - span.start) / (along[place - 1].stop - span.start))
        if place + 1 < len(along):
            weight *= _soft_step((span.stop - centres) / (span.stop - along[place + 1].start))
        first = span.start // stride
        total[first : first + len(weight)] += weight
        weights.append((first, weight))
    # three spans may share a pixel where the photograph is little larger than two
    return [(weight / total[first : first + len(weight)]).astype(np.float32) for first, weight in weights]


def _soft_step(t: NDArray[np.float64]) -> NDArray[np.float64]:
    """From 0 to 1 in the middle of an overlap, which t goes through from 0 to 1, level where it begins and ends."""
    t = np.clip((t - 0.5) / FADED + 0.5, 0, 1)
    return t * t * (3 - 2 * t)
