"""DDFF 12-Scene's focal stacks (Hazirbas et al. 2018): an HDF5 file with ``stack_val`` and ``disp_val``, or ``_train``.

A stack is a light field of 9 x 9 views, shifted by what a plane's disparity is and averaged: a point whose disparity
from view to view is off by d is spread over 9 places d apart on either axis, whose standard deviation is 2.58 d.
"""

import math
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np

from model_export.datasets.photos import Photo, PhotoAndCamera

FX_PX = 521.4052
BASELINE_M = 1982.0250823695178 / 7317.020641763665 * 1e-3  # between neighbouring views
DISPARITY_PX_M = FX_PX * BASELINE_M
NEAREST_M, FARTHEST_M = 0.5, 7.0  # where a stack's first and last picture are focused, in equal steps of disparity
VIEWS = 9
SPREAD = math.sqrt((VIEWS**2 - 1) / 12)
GAMMA_PX = 0.5  # not known


def photos(path: Path) -> Iterator[PhotoAndCamera]:
    """Every picture of every stack of the validation set, or of the training set of a file without one.

    Raises ``ValueError`` for a file of another layout, ``OSError`` for one that is no HDF5.
    """
    with h5py.File(path) as file:
        part = next((part for part in ("val", "train") if f"stack_{part}" in file and f"disp_{part}" in file), None)
        if part is None:
            raise ValueError(f"{path} has no stack_val and disp_val")
        stacks, disparities = file[f"stack_{part}"], file[f"disp_{part}"]
        for number in range(len(stacks)):
            stack, disparity = stacks[number].astype(np.uint8), np.squeeze(disparities[number])
            with np.errstate(divide="ignore", invalid="ignore"):
                depth_m = np.where(disparity > 0, DISPARITY_PX_M / disparity, np.nan).astype(np.float32)
            shifts = np.linspace(DISPARITY_PX_M / NEAREST_M, DISPARITY_PX_M / FARTHEST_M, len(stack))
            for place, (image, shift) in enumerate(zip(stack, shifts.tolist(), strict=True)):
                camera = {
                    "focus_distance_m": DISPARITY_PX_M / shift,
                    "k_cam_px": SPREAD * shift,  # d is x times the shift
                    "gamma_px": GAMMA_PX,
                    "fx_px": FX_PX,
                }
                yield Photo(f"{part}_{number:04d}_{place:02d}", image, depth_m), camera
