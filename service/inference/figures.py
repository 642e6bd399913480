"""An answer in numbers, as JSON has them: at some pixels, and over all of them."""

import math
from dataclasses import dataclass

import numpy as np

from service.errors import BadRequest
from service.inference.depth_map import DepthMap
from service.inference.part import Part
from service.inference.resampling import Lines

PERCENTILES = (0, 5, 50, 95, 100)


@dataclass(frozen=True, slots=True)
class PointReading:
    """Depth at one pixel; None is no answer."""

    u: float
    v: float
    depth_m: float | None
    depth_alt_m: float | None
    sigma_m: float | None
    p_near: float


@dataclass(frozen=True, slots=True)
class Spread:
    """Depth over all pixels with an answer, in metres; None without one."""

    min: float | None
    p5: float | None
    median: float | None
    p95: float | None
    max: float | None


def spread_of(answer: DepthMap) -> Spread:
    """Least, 5 %, median, 95 % and greatest depth of the pixels with an answer."""
    known = answer.depth_m[answer.valid]
    if known.size == 0:
        return Spread(None, None, None, None, None)
    return Spread(*(float(value) for value in np.percentile(known, PERCENTILES)))


def read_point(answer: DepthMap, u: float, v: float, part: Part | None = None) -> PointReading:
    """The answer at the photograph's pixel whose area holds (u, v); raises ``BadRequest`` outside.

    The answer is to all of the photograph, or to a ``part`` of it.
    """
    row, column = pixel_at(u, v, part or Part(0, 0, answer.width_px, answer.height_px))
    # the layers of this pixel alone: all of a large photograph's are half a second
    there = answer.layers_at(Lines.between(row, row + 1, column, column + 1))
    return PointReading(
        u,
        v,
        _number_or_none(answer.depth_m[row, column]),
        _number_or_none(there.depth_alt_m[0, 0]),
        _number_or_none(there.sigma_m[0, 0]),
        float(there.p_near[0, 0]),
    )


def pixel_at(u: float, v: float, part: Part, asked_in: str = "at") -> tuple[int, int]:
    """Row and column, in a part of the photograph, of the pixel whose area holds (u, v).

    Raises ``BadRequest``, with the option it was ``asked_in``, outside [left - 0.5, right - 0.5) x [top - 0.5,
    bottom - 0.5).
    """
    row, column = math.floor(v + 0.5) - part.top, math.floor(u + 0.5) - part.left
    if not (0 <= row < part.height_px and 0 <= column < part.width_px):
        asked = f"({part.left}, {part.top}) to ({part.right}, {part.bottom})"
        detail = f"({u:g}, {v:g}) is outside the part of the upright photograph that is asked for, {asked}."
        raise BadRequest.at(detail, asked_in)
    return row, column


def _number_or_none(value: np.float32) -> float | None:
    return float(value) if np.isfinite(value) else None
