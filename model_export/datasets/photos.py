"""Photographs with depth: a folder with ``color/`` and ``depth/`` files of the same stem."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

MILLIMETRE_M = np.float32(1e-3)


@dataclass(frozen=True, slots=True)
class Photo:
    """A picture uint8 [h,w,3] (RGB) and its depth float32 [h,w] in metres along the axis, NaN where unknown."""

    name: str
    image: NDArray[np.uint8]
    depth_m: NDArray[np.float32]


def read_image(path: Path) -> NDArray[np.uint8]:
    """An RGB picture uint8 [h,w,3]; ``ValueError`` if it cannot be read."""
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise ValueError(f"{path} is no picture")
    return np.ascontiguousarray(image[:, :, ::-1], np.uint8)


def read_depth(path: Path) -> NDArray[np.float32]:
    """A 16-bit PNG in millimetres (0 = unknown) as float32 [h,w] in metres (NaN = unknown)."""
    raw = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if raw is None or raw.dtype != np.uint16 or raw.ndim != 2:
        raise ValueError(f"{path} is no 16-bit depth picture")
    return np.where(raw > 0, raw * MILLIMETRE_M, np.float32(np.nan)).astype(np.float32)


def load_photos(folder: Path, every: int = 1) -> Iterator[Photo]:
    """Each ``every``-th pair of the folder in order of names; raises if there is none."""
    files = sorted((folder / "color").glob("*"))[::every]
    if not files:
        raise FileNotFoundError(f"no pictures in {folder / 'color'}")
    for file in files:
        yield Photo(file.stem, read_image(file), read_depth(folder / "depth" / f"{file.stem}.png"))


def filled(depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """A map [h,w] with every NaN given the value of the nearest pixel that has one."""
    known = np.isfinite(depth_m)
    _, labels = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    values = np.zeros(int(labels.max()) + 1, np.float32)
    values[labels[known]] = depth_m[known]
    out: NDArray[np.float32] = values[labels]
    return out
