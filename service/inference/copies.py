"""What the networks read of a photograph's copies.

It is one set of raw maps: what is strongly blurred is read on a smaller copy than all else.
"""

import math
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from service.inference.depth_map import fraction
from service.inference.hypotheses import doubted
from service.inference.pair import RawMaps
from service.inference.part import Part
from service.inference.resampling import Ratio, bands, sample
from service.opencv import cv2, exp, log
from service.optics import thin_lens
from service.optics.camera import Camera
from service.optics.focus import likely_gamma

# of gamma, and of the pixels: what is read too sharp of scenes whose gamma is known is no more
CLEARLY_SHARPER, SHARPER_FRACTION = 0.7, 0.1
MAY_BE_SHARPER_PX = 0.6  # nothing is read as sharper than 0.42 px (docs/findings.md)
SHARPEST = 0.05  # of the pixels, as sharp as whose gamma then is taken to be
SAMPLES = 2**16  # cells that are looked at for them: all of a large photograph would take long
OCTAVES = np.float32(1 / np.log(2))


@dataclass(frozen=True, slots=True)
class Read:
    """The networks' maps of an area of the photograph, and the camera behind the copy of it that was read.

    A cell of the maps is ``stride`` pixels of the copy wide and high. Copies of ``scales`` were read, each of an area
    of its own; blur above ``most_blur_px``, in pixels of the first, is beyond the model.
    """

    maps: RawMaps
    camera: Camera
    area: Part
    stride: int
    scales: tuple[float, ...]
    most_blur_px: float

    @property
    def ratio(self) -> Ratio:
        """Pixels of the copy per pixel of the photograph."""
        camera, area = self.camera, self.area
        return Ratio.between((area.height_px, area.width_px), (camera.image_height_px, camera.image_width_px), 1)

    def doubt_in_focus(self) -> None:
        """Leave the side open, in ``p_near``, which is written over, where blur does not tell it."""
        blur_px, p_near = self.maps["blur_px"], self.maps["p_near"]
        for rows in bands(p_near.shape):
            defocus = thin_lens.relative_defocus_from_blur(blur_px[rows], self.camera.gamma_px, self.camera.k_cam_px)
            p_near[rows] = doubted(p_near[rows], defocus)

    def sharper_gamma_px(self, blur_px: NDArray[np.float32]) -> float | None:
        """gamma, in pixels of the photograph, as its sharpest parts have it; None where the camera's may be true.

        ``blur_px`` is what all of the photograph shows, or some places of it, in pixels of the copy.
        No blur is below gamma (eq. 6): where much of a photograph is clearly sharper, what was told is not its gamma,
        but for instance that of a small copy, which is no softer by the pixel than the large picture it was made of.
        """
        if fraction(blur_px < CLEARLY_SHARPER * self.camera.gamma_px) <= SHARPER_FRACTION:
            return None
        return thin_lens.gamma_before_averaging(
            float(np.quantile(blur_px, SHARPEST)), self.area.width_px, self.camera.image_width_px
        )

    def softened(self) -> Self:
        """By the camera with the gamma that the photograph likely has, by its sharpest parts; maps are written over."""
        camera, maps = self.camera, self.maps
        every = math.ceil(math.sqrt(maps["blur_px"].size / SAMPLES))
        gamma_px = likely_gamma(camera.gamma_px, float(np.quantile(maps["blur_px"][::every, ::every], SHARPEST)))
        if gamma_px == camera.gamma_px:
            return self
        for rows in bands(maps["blur_px"].shape):
            for name, side in (("log_ratio_near", 1), ("log_ratio_far", -1)):
                defocus = side * (exp(-maps[name][rows]) - 1)
                less = thin_lens.relative_defocus_if_softer(defocus, camera.gamma_px, gamma_px, camera.k_cam_px)
                maps[name][rows] = -log(1 + side * less)
        return replace(self, camera=replace(camera, gamma_px=gamma_px))

    def maps_from(self, inner: Part) -> RawMaps:
        """The maps, as views, from where an area within this one begins."""
        begins, ratio = inner.within(self.area), self.ratio
        down, across = round(begins.top * ratio.rows / self.stride), round(begins.left * ratio.columns / self.stride)
        return {name: values[down:, across:] for name, values in self.maps.items()}

    def cell_of(self, u: float, v: float) -> tuple[int, int]:
        """Row and column of the cell that holds a pixel of the photograph, which the area has."""
        rows, columns = self.maps["blur_px"].shape
        row = int((v - self.area.top + 0.5) * self.ratio.rows / self.stride)
        column = int((u - self.area.left + 0.5) * self.ratio.columns / self.stride)
        return min(row, rows - 1), min(column, columns - 1)

    def places(self, rows: int, columns: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Where so many even parts of the maps have their middles, down and across, in pixels of the photograph."""
        height, width = self.maps["blur_px"].shape
        down = (np.arange(rows) + 0.5) * (height * self.stride / rows / self.ratio.rows) + self.area.top - 0.5
        across = (
            (np.arange(columns) + 0.5) * (width * self.stride / columns / self.ratio.columns) + self.area.left - 0.5
        )
        return down.astype(np.float32), across.astype(np.float32)


def blend(maps: RawMaps, coarse: RawMaps, ratio: Ratio, strong_px: float, *, by_coarse: bool = False) -> None:
    """Draw the maps [h, w] of a copy towards those of a smaller one, where both show strong blur.

    Not at all where either shows ``strong_px`` (in pixels of the larger copy), wholly where both show twice that, and
    between in proportion to its logarithm: no step shows where one takes over. ``by_coarse``: where the smaller one
    does, whatever the larger one shows. ``ratio`` is the smaller copy's size in the larger one's. ``maps`` are written
    over.
    """
    height, width = maps["blur_px"].shape
    # a copy's cells may cover half a cell less than there is
    wider = {name: _continued(values) for name, values in coarse.items()}
    for rows in bands((height, width)):
        blur_px = sample(wider["blur_px"], ratio, rows, width) / np.float32(ratio.columns)
        least_px = blur_px if by_coarse else np.minimum(blur_px, maps["blur_px"][rows])
        share = np.clip(log(least_px / np.float32(strong_px)) * OCTAVES, 0, 1)
        if share.any():
            for name, values in maps.items():
                told = blur_px if name == "blur_px" else sample(wider[name], ratio, rows, width)
                values[rows] += share * (told - values[rows])


def _continued(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """A map one row and one column larger."""
    return np.asarray(cv2.copyMakeBorder(values, 0, 1, 0, 1, cv2.BORDER_REPLICATE), np.float32)
