"""Whether tiles of a large photograph show: the same pictures read whole and in tiles, and depth's steps compared."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from statistics import fmean

import numpy as np
from numpy.typing import NDArray

from model_export.bench_graphs import SEED, THREADS, camera_for, draw_picture
from model_export.cases import to_pixels
from model_export.render import refocus
from service.inference.artifact import load_model_folder
from service.inference.estimator import Estimator
from service.inference.pair import GraphPair
from service.inference.tiles import layout

SIZE = (2000, 1500)
BUDGETS = (1_800_000, 900_000)  # pixels of a tile: two tiles, and six
PICTURES = 6  # what tiles change is not alike in all
K_CAM_PX = 3.0
DEPTHS_M = (0.8, 4.0)  # of a wall that runs away to the right, focused at 2 m
NEAR_BORDER_PX = 2  # what is read at half size is enlarged
ALIKE = 0.01
ELSEWHERE, OVERLAP, BORDER = PLACES = range(3)

Map = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class SeamRow:
    """Mean steps of ln z from pixel to pixel in tiles, over those of the picture read whole, by where they are.

    ``borders`` are within two pixels of where a tile ends, ``overlaps`` where two tiles are faded into each other.
    ``alike`` is the share of pixels whose depth is the same within 1 %, ``largest`` the largest relative difference.
    All but that are means over some pictures.
    """

    tiles: int
    borders: float
    overlaps: float
    elsewhere: float
    alike: float
    largest: float


def compare(model: Path, on_round: Callable[[], None] = lambda: None) -> list[SeamRow]:
    """Read drawn pictures whole and within each of the budgets."""
    pair = GraphPair(load_model_folder(model), THREADS[-1])
    width, height = SIZE
    camera = camera_for(width, height, K_CAM_PX)
    away_m = 1 / np.linspace(1 / DEPTHS_M[0], 1 / DEPTHS_M[1], width)
    wall_m = np.tile(away_m.astype(np.float32), (height, 1))
    found: dict[int, list[SeamRow]] = {budget: [] for budget in BUDGETS}
    for number in range(PICTURES):
        sharp = draw_picture(width, height, SEED + number).astype(np.float32) / np.float32(255)
        picture = to_pixels(refocus(sharp, wall_m, camera))
        whole = Estimator(pair, width * height).estimate(picture, camera).depth_m
        for budget, rows in found.items():
            tiled = Estimator(pair, budget).estimate(picture, camera).depth_m
            rows.append(_row(whole, tiled, *layout(height, width, pair.manifest.multiple, budget)))
        on_round()
    return [_mean(rows) for rows in found.values()]


def _mean(rows: list[SeamRow]) -> SeamRow:
    borders, overlaps, elsewhere, alike = (
        fmean(getattr(row, name) for row in rows) for name in ("borders", "overlaps", "elsewhere", "alike")
    )
    return SeamRow(rows[0].tiles, borders, overlaps, elsewhere, alike, max(row.largest for row in rows))


def _row(whole_m: Map, tiled_m: Map, rows: list[slice], columns: list[slice]) -> SeamRow:
    off = np.abs(tiled_m / whole_m - 1)
    known = np.isfinite(off)
    places = np.concatenate([_places(rows), _places(columns)])
    in_whole, in_tiles = (
        _steps(np.where(known, np.log(depth_m), np.float32(np.nan))) for depth_m in (whole_m, tiled_m)
    )
    times = {place: float(in_tiles[places == place].sum() / in_whole[places == place].sum()) for place in PLACES}
    return SeamRow(
        tiles=len(rows) * len(columns),
        borders=times[BORDER],
        overlaps=times[OVERLAP],
        elsewhere=times[ELSEWHERE],
        alike=float((off[known] < ALIKE).mean()),
        largest=float(off[known].max()),
    )


def _steps(log_m: Map) -> Map:
    """All absolute steps from each row to the next, then from each column to the next, added up [h + w - 2]."""
    return np.concatenate([np.nansum(np.abs(np.diff(log_m, axis=axis)), axis=1 - axis) for axis in (0, 1)])


def _places(along: list[slice]) -> NDArray[np.int64]:
    """Of each step along one axis: across a border, in an overlap, or elsewhere."""
    places = np.full(along[-1].stop - 1, ELSEWHERE)
    for one, following in pairwise(along):
        places[following.start : one.stop] = OVERLAP
        for border in (following.start, one.stop):
            places[border - NEAR_BORDER_PX : border + NEAR_BORDER_PX] = BORDER
    return places
