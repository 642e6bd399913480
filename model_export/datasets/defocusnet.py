"""DefocusNet's focal stacks (Maximov et al. 2020): ``NNNNNN_NNAll.tif``, and ``NNNNNNDpt.exr`` in metres."""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from model_export.datasets.photos import Photo, PhotoAndCamera, read_image
from service.optics.camera import Lens

FOCUS_DISTANCES_M = (0.1, 0.15, 0.3, 0.7, 1.5)
LENS = Lens(2.9, 1.0, 3100 / 256, 256)  # a sensor 3.1 mm wide
GAMMA_PX = 0.5  # taken for what Cycles' pixels blur
PICTURE = re.compile(r"(.+)_(\d\d)All\.tif")


def photos(folder: Path) -> Iterator[PhotoAndCamera]:
    """Every picture of every stack. Raises ``ValueError`` if there is none, or of another focus, ``OSError``."""
    pictures = [found for path in sorted(folder.glob("*All.tif")) if (found := PICTURE.fullmatch(path.name))]
    if not pictures:
        raise ValueError(f"no NNNNNN_NNAll.tif in {folder}")
    for found in pictures:
        stack, number = found[1], int(found[2])
        if number >= len(FOCUS_DISTANCES_M):
            raise ValueError(f"{folder / found[0]}: a stack has {len(FOCUS_DISTANCES_M)} pictures, from 00")
        focus_m = FOCUS_DISTANCES_M[number]
        image = read_image(folder / found[0])
        width_px = image.shape[1]
        camera = {
            "focus_distance_m": focus_m,
            # Cycles' image plane is at the focal length: s1 where eq. 2 has s1 - f
            "k_cam_px": LENS.k_cam_px(focus_m + LENS.focal_length_m, width_px),
            "gamma_px": GAMMA_PX,
            "fx_px": LENS.fx_px(width_px),
        }
        yield Photo(f"{stack}_{number:02d}", image, _read_depth(folder / f"{stack}Dpt.exr")), camera


def _read_depth(path: Path) -> NDArray[np.float32]:
    """The red channel [h,w] in metres, NaN where nothing is."""
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            depth_m = np.asarray(file.channels()["R"].pixels, np.float32)
    except (KeyError, RuntimeError) as exc:
        raise ValueError(f"{path} is no EXR picture of depth") from exc
    return np.where(np.isfinite(depth_m) & (depth_m > 0), depth_m, np.float32(np.nan))
