"""Large photographs in overlapping tiles, so that memory follows the tile and not the photograph."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

PIXEL_BUDGET = 1_500_000
OVERLAP_PX = 128

Maps = dict[str, NDArray[np.float32]]


@dataclass(frozen=True, slots=True)
class Span:
    """Pixels ``start`` (included) to ``stop`` (excluded) along one axis."""

    start: int
    stop: int


def read_in_tiles(
    rgb: NDArray[np.uint8],
    read: Callable[[NDArray[np.uint8]], Maps],
    *,
    multiple: int,
    stride: int,
    pixel_budget: int = PIXEL_BUDGET,
) -> Maps:
    """What ``read`` gives for an image uint8 [h, w, 3]: at once, or from tiles faded into each other.

    ``read`` maps uint8 [h, w, 3] to maps [ceil(h/stride), ceil(w/stride)]. Tiles start at multiples of
    ``multiple``, so that a tile's grid is the photograph's.
    """
    height, width = rgb.shape[:2]
    if height * width <= pixel_budget:
        return read(rgb)
    side = max(math.isqrt(pixel_budget) // multiple * multiple, 2 * OVERLAP_PX + multiple)
    rows, columns = spans(height, side, multiple), spans(width, side, multiple)
    merged = _Merge(-(-height // stride), -(-width // stride))
    for row, fade_row in zip(rows, fades(rows, stride), strict=True):
        for column, fade_column in zip(columns, fades(columns, stride), strict=True):
            maps = read(rgb[row.start : row.stop, column.start : column.stop])
            merged.add(maps, row.start // stride, column.start // stride, np.outer(fade_row, fade_column))
    return merged.maps


def spans(size: int, side: int, multiple: int) -> list[Span]:
    """Spans of about ``side`` that cover ``size`` evenly and overlap by ``OVERLAP_PX`` or more."""
    if size <= side:
        return [Span(0, size)]
    count = math.ceil((size - OVERLAP_PX) / (side - OVERLAP_PX - multiple))
    step = (size - side) / (count - 1)
    starts = [int(place * step) // multiple * multiple for place in range(count)]
    return [Span(start, min(start + side, size)) for start in starts[:-1]] + [Span(starts[-1], size)]


def fades(along: list[Span], stride: int) -> list[NDArray[np.float32]]:
    """A weight per map pixel of each span: it falls towards neighbours, and all sum to 1 everywhere."""
    total = np.zeros(-(-along[-1].stop // stride))
    weights = []
    for place, span in enumerate(along):
        centres = np.arange(span.start // stride, -(-span.stop // stride)) * stride + stride / 2
        weight = np.ones(len(centres))
        if place:
            weight *= np.clip((centres - span.start) / (along[place - 1].stop - span.start), 0, 1)
        if place + 1 < len(along):
            weight *= np.clip((span.stop - centres) / (span.stop - along[place + 1].start), 0, 1)
        first = span.start // stride
        total[first : first + len(weight)] += weight
        weights.append((first, weight))
    # three spans may share a pixel where the photograph is little larger than two
    return [(weight / total[first : first + len(weight)]).astype(np.float32) for first, weight in weights]


class _Merge:
    """A weighted sum of tiles, map by map; the weights sum to 1 everywhere."""

    def __init__(self, rows: int, columns: int) -> None:
        self._shape = (rows, columns)
        self.maps: Maps = {}

    def add(self, maps: Maps, row: int, column: int, weight: NDArray[np.float32]) -> None:
        for name, values in maps.items():
            target = self.maps.setdefault(name, np.zeros(self._shape, np.float32))
            target[row : row + values.shape[0], column : column + values.shape[1]] += values * weight
