"""Maps at every pixel of the photograph: bilinear, with pixel centres where the conventions put them."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from service.opencv import cv2

BAND_PX = 100_000


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


def bands(size: tuple[int, int]) -> Iterator[slice]:
    """Rows of an image (height, width), few enough at a time to stay in the processor's cache."""
    height, width = size
    rows = max(1, BAND_PX // width)
    return (slice(top, min(top + rows, height)) for top in range(0, height, rows))


def enlarged(values: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float32]:
    """A map made as large as (width, height), bilinear."""
    return np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_LINEAR), np.float32)


def sample(values: NDArray[np.float32], ratio: Ratio, rows: slice, width: int) -> NDArray[np.float32]:
    """The map [h, w] at some rows of a photograph so many pixels wide; its edges are continued."""
    at = (np.arange(rows.start, rows.stop) + 0.5) * ratio.rows - 0.5
    above = np.floor(at).astype(np.intp)
    upper, lower = (values.take(above + i, axis=0, mode="clip") for i in (0, 1))
    lower -= upper
    lower *= (at - above).astype(np.float32)[:, np.newaxis]
    upper += lower
    wide = cv2.resize(upper, None, fx=1 / ratio.columns, fy=1, interpolation=cv2.INTER_LINEAR)
    return np.asarray(wide, np.float32)[:, :width]
