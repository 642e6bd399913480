"""NYU Depth v2's labelled frames (Silberman et al. 2012): ``nyu_depth_v2_labeled.mat``, sharp pictures with depth."""

from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np

from model_export.datasets.photos import Photo, PhotoAndCamera

FX_PX = 518.8579
SEEN = (slice(45, 471), slice(41, 601))  # rows and columns that the depth camera saw, of 480 and 640


def photos(path: Path) -> Iterator[PhotoAndCamera]:
    """Every frame, its depth unknown where it was made up beyond what was seen.

    Raises ``ValueError`` for a file of another layout, ``OSError`` for one that is no HDF5.
    """
    with h5py.File(path) as file:
        if "images" not in file or "depths" not in file:
            raise ValueError(f"{path} has no images and depths")
        for number, (image, depth_m) in enumerate(zip(file["images"], file["depths"], strict=True)):
            # MATLAB's order of axes: colour, column, row
            upright = depth_m.T.astype(np.float32)
            seen = np.full_like(upright, np.nan)
            seen[SEEN] = upright[SEEN]
            yield Photo(f"nyu_{number:04d}", np.ascontiguousarray(image.T), seen), {"fx_px": FX_PX}
