"""Maps at every pixel of the photograph: bilinear, with pixel centres where the conventions put them."""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from service.opencv import cv2

BAND_PX = 100_000
WHOLE_PX = 320_000  # of a picture that maps are brought to at once, where little else is done


class Ratio(NamedTuple):
    """Pixels of a map per pixel of the photograph, along each axis.

    Centres follow from areas: row v of the photograph lies at (v + 1/2) * rows - 1/2 of the map.
    """

    rows: float
    columns: float

    @classmethod
    def between(cls, photograph_size: tuple[int, int], working_size: tuple[int, int], stride: int) -> "Ratio":
        """From a photograph (height, width) to a copy resized to another, whose map has a pixel per ``stride``."""
        return cls(*(working / (whole * stride) for whole, working in zip(photograph_size, working_size, strict=True)))


class Lines(NamedTuple):
    """Rows and columns of a picture, and so the pixels where they cross."""

    rows: NDArray[np.intp]
    columns: NDArray[np.intp]

    @classmethod
    def between(cls, top: int, bottom: int, left: int, right: int) -> Self:
        """All from a row and column to before others."""
        return cls(np.arange(top, bottom), np.arange(left, right))

    @classmethod
    def spread(cls, size: tuple[int, int], smaller: tuple[int, int]) -> Self:
        """Of a picture (height, width) those in which the centres of a smaller copy's pixels lie."""
        return cls(*(((2 * np.arange(few) + 1) * many) // (2 * few) for many, few in zip(size, smaller, strict=True)))

    def of(self, picture: NDArray[Any]) -> NDArray[Any]:
        """What a picture [h, w, ...] has there, copied."""
        return picture[self.rows].take(self.columns, axis=1)

    def within(self, outer: "Lines") -> "Lines":
        """The same lines of the whole, where they are counted among some of it."""
        return Lines(outer.rows[self.rows], outer.columns[self.columns])


def shrunk_size(size: tuple[int, int], longest_px: int) -> tuple[int, int]:
    """The size (height, width) whose longer side is so long; the same where it is no longer."""
    scale = min(1.0, longest_px / max(size))
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))


def bands(size: tuple[int, int], whole_px: int = BAND_PX) -> Iterator[slice]:
    """Rows of an image (height, width), few enough at a time for the processor's cache; all of one of ``whole_px``."""
    height, width = size
    rows = height if height * width <= whole_px else max(1, BAND_PX // width)
    return (slice(top, min(top + rows, height)) for top in range(0, height, rows))


def enlarged(values: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float32]:
    """A map made as large as (width, height), bilinear."""
    return np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_LINEAR), np.float32)


def sample(
    values: NDArray[np.float32], ratio: Ratio, rows: slice | NDArray[np.intp], width: int
) -> NDArray[np.float32]:
    """The map [h, w] at some rows of a photograph so many pixels wide; its edges are continued."""
    if isinstance(rows, slice) and rows.start == 0:  # both ways at once takes a third of the time
        values = values[: math.ceil(rows.stop * ratio.rows) + 1]
        large = cv2.resize(values, None, fx=1 / ratio.columns, fy=1 / ratio.rows, interpolation=cv2.INTER_LINEAR)
        return np.asarray(large, np.float32)[: rows.stop, :width]
    at = (np.r_[rows] + 0.5) * ratio.rows - 0.5
    above = np.floor(at).astype(np.intp)
    upper, lower = (values.take(above + i, axis=0, mode="clip") for i in (0, 1))
    lower -= upper
    lower *= (at - above).astype(np.float32)[:, np.newaxis]
    upper += lower
    wide = cv2.resize(upper, None, fx=1 / ratio.columns, fy=1, interpolation=cv2.INTER_LINEAR)
    return np.asarray(wide, np.float32)[:, :width]
