"""What a reading leaves open about depth, taken from what surrounds it.

Inverse depth of anything flat is linear in the picture. So what is read around a pixel, the surer the more it counts,
has a plane at it, and is off that plane by more where things of several depths meet. A depth that is surely read stays
as it is; one in doubt is drawn towards the plane as far as a normal law for either says.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from service.inference.depth_map import MAX_RELATIVE_ERROR, MOST_STATED, Reading, least_error
from service.inference.resampling import bands, enlarged
from service.opencv import cv2, exp, log, where

CELLS = 8  # of the maps, each way, whose mean is one in what surrounds them
FEWER = 2  # cells each way that are drawn alike
REACH, MOST_REACH_PX = 0.15, 96  # to all sides, of the copy that was read: a part of its longer side, and at most
# chosen on the development sets, where half or twice as much hardly matters (docs/findings.md)
OWN_SPREAD = 0.2  # by how much a thing is off what surrounds it (ln z, standard deviation), where that is flat
UNEVEN_WEIGHT = 4.0  # how often the variance of what surrounds it comes to that
LEVELNESS = 0.2  # what a plane's slopes are held back by, in variances of even surroundings of half-width 1
LEAST_ERROR, MOST_ERROR = np.float32(0.02), np.float32(1)
MOST_LIKELIER = np.float32(50)  # ln

Array = NDArray[np.float32]
Grid = NDArray[np.float64]


def settle(reading: Reading, limits_m: tuple[float, float], stride: int, longer_px: float) -> None:
    """Draw the reading's depth, which is written over, towards what surrounds it, within limits.

    ``longer_px`` is the longer side of the copy that was read, all of it where the reading is of a part. Which of both
    hypotheses is true is in doubt as far as it still is when what surrounds a pixel has been heard: of a thing that is
    either a little before its table or far behind it, the table says which. Errors stay as they are stated, but for
    what optics asks of the depth that is answered now.
    """
    depth_m, other_m, error = reading.depth_m, reading.other_m, reading.error
    variance = np.square(np.clip(error, LEAST_ERROR, MOST_ERROR))
    reach = max(1, round(min(REACH * longer_px, MOST_REACH_PX) / (stride * CELLS)))
    plane, unevenness = _surroundings(depth_m, np.reciprocal(variance), reach)
    maps = depth_m, where(np.isfinite(other_m), other_m, depth_m), reading.p_near, variance
    own_m, other_m, p_near, variance = (_means(values, FEWER) for values in maps)
    plane, unevenness = (_enlarged(values, CELLS // FEWER, own_m.shape) for values in (plane, unevenness))

    off, gap = log(own_m * plane), log(other_m / own_m)
    spread = OWN_SPREAD**2 + UNEVEN_WEIGHT * unevenness
    doubt = where(gap < 0, p_near, 1 - p_near)
    read = np.maximum(variance - doubt * gap**2, LEAST_ERROR**2)
    likelier = np.clip((off**2 - (off + gap) ** 2) / (2 * (read + spread)), -MOST_LIKELIER, MOST_LIKELIER)
    odds = doubt * exp(likelier)
    doubt = odds / (odds + 1 - doubt)
    in_doubt = np.minimum(read + doubt * gap**2, variance)
    towards = -off * in_doubt / (in_doubt + spread)

    towards = _enlarged(towards, FEWER, depth_m.shape)
    for rows in bands(depth_m.shape):
        depth_m[rows] = np.clip(depth_m[rows] * exp(towards[rows]), *limits_m)
        stated = np.minimum(np.maximum(error[rows], least_error(depth_m[rows], reading.camera)), MOST_STATED)
        error[rows] = where(error[rows] <= MAX_RELATIVE_ERROR, stated, error[rows])


def _surroundings(depth_m: Array, certainty: Array, reach: int) -> tuple[Array, Array]:
    """Inverse depth of the plane through what surrounds each of a few cells, and its variance about it, relative."""
    weight, inverse = (_means(values, CELLS).astype(np.float64) for values in (certainty, certainty / depth_m))
    inverse /= weight
    v, u = np.meshgrid(*(np.arange(cells) / reach for cells in weight.shape), indexing="ij")
    size = (2 * reach + 1, 2 * reach + 1)

    def means(*fields: Grid) -> Iterator[Grid]:
        weighed = np.stack([weight, *(weight * field for field in fields)], 2)
        sums = np.asarray(cv2.blur(weighed, size, borderType=cv2.BORDER_REFLECT), np.float64)
        return (sums[..., number] / sums[..., 0] for number in range(1, len(fields) + 1))

    row, column, middle, vv, uu, uv, vq, uq = means(v, u, inverse, v * v, u * u, u * v, v * inverse, u * inverse)
    vv, uu, uv = vv - row**2 + LEVELNESS, uu - column**2 + LEVELNESS, uv - row * column
    vq, uq = vq - row * middle, uq - column * middle
    level = vv * uu - uv**2
    plane = middle + ((vq * uu - uq * uv) * (v - row) + (uq * vv - vq * uv) * (u - column)) / level
    np.maximum(plane, middle / 2, out=plane)
    (variance,) = means(np.square(inverse - plane))
    return plane.astype(np.float32), (variance / plane**2).astype(np.float32)


def _means(values: Array, cells: int) -> Array:
    """Of so many cells each way, the last ones continued."""
    height, width = values.shape
    whole = cv2.copyMakeBorder(values, 0, -height % cells, 0, -width % cells, cv2.BORDER_REPLICATE)
    size = (whole.shape[1] // cells, whole.shape[0] // cells)
    return np.asarray(cv2.resize(whole, size, interpolation=cv2.INTER_AREA), np.float32)


def _enlarged(values: Array, cells: int, shape: tuple[int, ...]) -> Array:
    """A map of means as one of so many cells each way, without those that were added."""
    height, width = values.shape
    return enlarged(values, (width * cells, height * cells))[: shape[0], : shape[1]]
