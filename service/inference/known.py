"""Depths that somebody knows, by a tape: from them follows what no picture shows, where its lens was focused.

So does on which side of focus things are: there where depth is known, in what is near by and as blurred, and, as a
network that errs about one thing's side errs about others', a little everywhere.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from service.inference.copies import Read
from service.inference.hypotheses import SIGMA_OF_LAPLACE
from service.inference.layout import LEAST_DOUBT, add_odds
from service.inference.part import Part
from service.opencv import cv2
from service.optics import thin_lens
from service.optics.camera import Camera
from service.optics.focus import Sighting, fit_focus

MOST_DEVIATIONS = 3.0
# chosen on the development sets, three known depths a picture (docs/training.md)
SURELY_OUT = 0.15  # x from where on a known depth tells its side
SHARED_ODDS = 2.0  # standard deviation, over pictures, of what all of a picture's log odds of the side are off by
OWN_ODDS = 3.0
REACH = 0.1  # of the longer side: standard deviation of what is near by
LIKE_BLUR = 0.3  # standard deviation of ln lambda of what is as blurred
MOST_CELLS = 320
SHIFTS = np.linspace(-8, 8, 321)

Array = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class KnownDepth:
    """A pixel of the upright photograph and its depth, in metres along the optical axis."""

    u: float
    v: float
    depth_m: float


def around(known: Sequence[KnownDepth]) -> Part:
    """The least part of the photograph that holds all pixels."""
    rows, columns = [round(point.v) for point in known], [round(point.u) for point in known]
    return Part(min(columns), min(rows), max(columns) + 1, max(rows) + 1)


@dataclass(frozen=True, slots=True)
class Clues:
    """What known depths tell: the camera focused where it was, what to know about that, and sides.

    ``leanings`` go from -1, surely beyond focus, to 1, surely nearer; ``blur_px`` are in pixels of the photograph;
    ``shift`` is what to add to all log odds of being near.
    """

    camera: Camera
    warnings: tuple[str, ...]
    known: tuple[KnownDepth, ...]
    blur_px: tuple[float, ...]
    leanings: tuple[float, ...]
    shift: float

    @classmethod
    def of(cls, read: Read, camera: Camera, known: Sequence[KnownDepth]) -> Self:
        """From what the networks say, by the camera as it was told, of an area that holds all known depths."""
        cells = [read.cell_of(point.u, point.v) for point in known]
        blur_px, log_error, p_near = (
            [float(read.maps[name][cell]) for cell in cells] for name in ("blur_px", "blur_log_error", "p_near")
        )
        errors = np.exp(log_error) * SIGMA_OF_LAPLACE
        seen = [Sighting(*each) for each in zip((point.depth_m for point in known), blur_px, errors, strict=True)]
        fit = fit_focus(read.camera, seen)
        defocus = [thin_lens.signed_defocus(point.depth_m, fit.focus_distance_m) for point in known]
        leanings = tuple(max(-1.0, min(1.0, -x / SURELY_OUT)) for x in defocus)
        told = (
            f"focused at {fit.focus_distance_m:.3g} m ({fit.low_m:.3g} to {fit.high_m:.3g}), where "
            f"{camera.focus_distance_m:.4g} m was told, by what is known of the depth"
        )
        doubted = (
            f"its blur speaks against the known depth of {point.depth_m:g} m at {point.u:g},{point.v:g}"
            for point, deviations in zip(known, fit.deviations, strict=True)
            if deviations > MOST_DEVIATIONS
        )
        return cls(
            camera.focused_at(fit.focus_distance_m),
            (told, *doubted),
            tuple(known),
            tuple(blur / read.ratio.columns for blur in blur_px),
            leanings,
            _shift(np.array(p_near), np.array(leanings)),
        )

    def lean(self, read: Read) -> None:
        """Draw ``p_near`` of maps that were read with this camera towards the sides that are known."""
        p_near, blur_px = read.maps["p_near"], read.maps["blur_px"]
        shrink = max(1.0, max(blur_px.shape) / MOST_CELLS)
        rows, columns = (max(1, round(cells / shrink)) for cells in blur_px.shape)
        coarse = np.asarray(cv2.resize(blur_px, (columns, rows), interpolation=cv2.INTER_AREA), np.float32)
        log_blur = np.log(coarse / np.float32(read.ratio.columns))
        v, u = read.places(rows, columns)
        reach_px = REACH * max(self.camera.image_width_px, self.camera.image_height_px)
        odds = np.full_like(log_blur, self.shift)
        for point, blur, leaning in zip(self.known, self.blur_px, self.leanings, strict=True):
            off = ((v - point.v) / reach_px)[:, np.newaxis] ** 2 + ((u - point.u) / reach_px) ** 2
            off += ((log_blur - np.log(blur)) / LIKE_BLUR) ** 2
            odds += OWN_ODDS * leaning * np.exp(-off / 2)
        add_odds(p_near, odds, p_near.shape)


def _shift(p_near: NDArray[np.float64], leanings: NDArray[np.float64]) -> float:
    """The likeliest shift of all log odds, where each known side counts as far as it is sure."""
    kept = np.clip(p_near, LEAST_DOUBT, 1 - LEAST_DOUBT)
    odds = np.log(kept / (1 - kept)) + SHIFTS[:, np.newaxis]
    loss = (np.abs(leanings) * np.logaddexp(0, -np.sign(leanings) * odds)).sum(1) + (SHIFTS / SHARED_ODDS) ** 2 / 2
    return float(SHIFTS[loss.argmin()])
