"""A black border about a photograph: bars of a film, corners of a rectified or turned picture, what a fisheye leaves.

It shows nothing, but its outline is a sharp line, and what is near that is read as in focus: table tops with bars an
eighth of the height were off by 0.36 for 0.10, with the border of rectified pictures by 0.71 (docs/findings.md). So
what is seen is continued into it, mirrored, and nothing is answered there.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.inference.resampling import bands
from service.opencv import cv2

BLACK, NEARLY_BLACK = 1, 20  # grey levels, at most: of half of it, and of all of it, where compression spoils it
STEP = 12  # levels that most of what is beside it has more: shadows that are black all over end softly
LEAST_OF_EDGES, LEAST_FRACTION = 0.02, 0.002
SPOILT_PX = 2  # about it

Mask = NDArray[np.bool_]


def black_border(rgb: NDArray[np.uint8]) -> Mask | None:
    """Where an upright photograph, uint8 [h, w, 3], has a black border; None where it has none, at next to no cost."""
    edges = np.concatenate([rgb[0], rgb[-1], rgb[:, 0], rgb[:, -1]])
    if (edges <= BLACK).all(1).mean() < LEAST_OF_EDGES:
        return None
    parts = _dark_parts(rgb)
    count = int(parts.max()) + 1
    beside = _widened(parts, 2 * SPOILT_PX) * (_widened(parts, SPOILT_PX) == 0)
    outline = beside > 0
    steps = rgb[outline].max(1) > NEARLY_BLACK + STEP
    is_sudden = np.bincount(beside[outline], steps, count) > np.bincount(beside[outline], minlength=count) / 2
    within = parts > 0
    is_same = np.bincount(parts[within], (rgb[within] <= BLACK).all(1), count)
    is_border = is_sudden & (is_same > np.bincount(parts[within], minlength=count) / 2)
    border: Mask = is_border[parts]
    return border if border.any() else None


def _dark_parts(rgb: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Numbers from 1 for what is dark, connected, not small and at the photograph's edges; 0 elsewhere."""
    dark = cv2.inRange(rgb, (0,) * 3, (NEARLY_BLACK,) * 3)
    _, labels, found, _ = cv2.connectedComponentsWithStats(dark, connectivity=4)
    at_edges = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    large = at_edges[(at_edges > 0) & (found[at_edges, cv2.CC_STAT_AREA] >= LEAST_FRACTION * dark.size)]
    number = np.zeros(len(found), np.uint16)
    number[large] = np.arange(1, large.size + 1)
    parts: NDArray[np.uint16] = number[labels]
    return parts


def continued(rgb: NDArray[np.uint8], border: Mask) -> NDArray[np.uint8]:
    """The photograph with each pixel of the border, and what it spoils, from as far beyond its outline."""
    hidden = _widened(border.astype(np.uint8), SPOILT_PX) > 0
    if hidden.all():
        return rgb
    height, width = hidden.shape
    _, labels = cv2.distanceTransformWithLabels(hidden.astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    place_of = np.zeros(int(labels.max()) + 1, np.int32)
    for rows in bands(hidden.shape):
        down, across = np.nonzero(~hidden[rows])
        place_of[labels[rows][down, across]] = (down + rows.start) * width + across
    filled = rgb.copy()
    for rows in bands(hidden.shape):
        down, across = np.nonzero(hidden[rows])
        v, u = np.divmod(place_of[labels[rows][down, across]], width)
        down += rows.start
        beyond_v, beyond_u = np.clip(2 * v - down, 0, height - 1), np.clip(2 * u - across, 0, width - 1)
        is_seen = ~hidden[beyond_v, beyond_u]
        filled[down, across] = rgb[np.where(is_seen, beyond_v, v), np.where(is_seen, beyond_u, u)]
    return filled


def _widened(parts: NDArray[Any], by_px: int) -> NDArray[Any]:
    size = 2 * by_px + 1
    return np.asarray(cv2.dilate(parts, np.ones((size, size), np.uint8)))
