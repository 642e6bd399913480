"""One set of raw maps from two copies of a photograph: what is strongly blurred is read on the smaller one."""

import numpy as np

from service.inference.pair import RawMaps
from service.inference.resampling import Ratio, bands, sample


def blend(maps: RawMaps, coarse: RawMaps, ratio: Ratio, strong_px: float) -> None:
    """Draw the maps [h, w] of a copy towards those of a smaller one, where both show strong blur.

    Not at all where either shows ``strong_px`` (in pixels of the larger copy), wholly where both show twice that, and
    between in proportion to its logarithm: no step shows where one takes over. ``ratio`` is the smaller copy's size in
    the larger one's. ``maps`` are written over.
    """
    height, width = maps["blur_px"].shape
    # a copy's cells may cover half a cell less than there is
    wider = {name: np.pad(values, ((0, 0), (0, 1)), "edge") for name, values in coarse.items()}
    for rows in bands((height, width)):
        told = {name: sample(values, ratio, rows, width) for name, values in wider.items()}
        told["blur_px"] /= np.float32(ratio.columns)
        least_px = np.minimum(told["blur_px"], maps["blur_px"][rows])
        share = np.clip(np.log2(least_px / np.float32(strong_px)), 0, 1)
        for name, values in maps.items():
            values[rows] += share * (told[name] - values[rows])
