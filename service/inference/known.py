"""Depths that somebody knows, by a tape: from them follows what no picture shows, where its lens was focused and gamma.

So does on which side of focus things are: there where depth is known, in what is near by and as blurred, and, as a
network that errs about one thing's side errs about others', a little everywhere. What depth is off by where it is known
it is off by in what is near by and as blurred, too.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from service.inference.copies import Read
from service.inference.depth_map import MAX_RELATIVE_ERROR, MOST_STATED, Reading
from service.inference.hypotheses import LEAST_DOUBT, SIGMA_OF_LAPLACE
from service.inference.layout import add_odds
from service.inference.pair import SIDE_RANGES, Side
from service.inference.part import Part
from service.inference.resampling import bands, enlarged
from service.metres import focus_in_words
from service.opencv import cv2, exp, log
from service.optics import thin_lens
from service.optics.camera import Camera
from service.optics.focus import Sighting, fit_focus

MOST_DEVIATIONS = 3.0
# chosen on the development sets, three known depths a picture (docs/findings.md)
SURELY_OUT = 0.15  # x from where on a known depth tells its side
SURE_SIDE = 0.95  # of a right tape's depths that tell their side, a picture is as sure of the other one in 1 of 51
SHARED_ODDS = 2.0  # standard deviation, over pictures, of what all of a picture's log odds of the side are off by
OWN_ODDS = 3.0
REACH = 0.1  # of the longer side: standard deviation of what is near by
LIKE_BLUR = 0.3  # standard deviation of ln lambda of what is as blurred
TAPE_ERROR = np.float32(0.02)
MOST_ANCHORED = float(np.log(2))
MUCH_OFF = 0.1
MOST_CELLS = 320
SHIFTS = np.linspace(-8, 8, 321)

Array = NDArray[np.float32]
Numbers = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class KnownDepth:
    """A pixel of the upright photograph and its depth, in metres along the optical axis."""

    u: float
    v: float
    depth_m: float


def around(known: Sequence[KnownDepth], part: Part | None = None) -> Part:
    """The least part of the photograph that holds all pixels, and another part."""
    left, top, right, bottom = zip(
        *((round(point.u), round(point.v), round(point.u) + 1, round(point.v) + 1) for point in known),
        *([(part.left, part.top, part.right, part.bottom)] if part else []),
        strict=True,
    )
    return Part(min(left), min(top), max(right), max(bottom))


@dataclass(frozen=True, slots=True)
class Clues:
    """What known depths tell: the camera focused where it was and as sharp there, what to know about that, and sides.

    ``leanings`` go from -1, surely beyond focus, to 1, surely nearer; ``blur_px`` are in pixels of the photograph;
    ``shift`` is what to add to all log odds of being near, where no ``side`` was asked for.
    """

    camera: Camera
    side: Side
    warnings: tuple[str, ...]
    known: tuple[KnownDepth, ...]
    blur_px: tuple[float, ...]
    leanings: tuple[float, ...]
    shift: float

    @classmethod
    def of(cls, read: Read, camera: Camera, side: Side, known: Sequence[KnownDepth]) -> Self:
        """From what the networks say, by the camera as it was told, of an area that holds all known depths."""
        cells = [read.cell_of(point.u, point.v) for point in known]
        blur_px, log_error, p_near = (
            [float(read.maps[name][cell]) for cell in cells] for name in ("blur_px", "blur_log_error", "p_near")
        )
        errors = np.exp(log_error) * SIGMA_OF_LAPLACE
        seen = [Sighting(*each) for each in zip((point.depth_m for point in known), blur_px, errors, strict=True)]
        copied = read.camera.blurring_alike(camera.focus_distance_m)
        fit = fit_focus(copied, seen, None if side == "auto" else side == "near")
        fitted = replace(camera.focused_at(fit.focus_distance_m), gamma_px=camera.gamma_px * fit.gamma_ratio)
        defocus = [thin_lens.signed_defocus(point.depth_m, fit.focus_distance_m) for point in known]
        leanings = tuple(max(-1.0, min(1.0, -x / SURELY_OUT)) for x in defocus)
        found, high, before = map(focus_in_words, (fit.focus_distance_m, fit.high_m, camera.focus_distance_m))
        told = [
            f"focused at {found} ({fit.low_m:.4g} to {high.removesuffix(' m')}), where {before} was told, by what is "
            "known of the depth"
        ]
        if fit.gamma_ratio != 1:
            told.append(f"gamma_px taken as {fitted.gamma_px:.3g}, where {camera.gamma_px:.3g} was told")
        told += (
            f"its blur speaks against the known depth of {point.depth_m:g} m at {point.u:g},{point.v:g}"
            for point, deviations in zip(known, fit.deviations, strict=True)
            if deviations > MOST_DEVIATIONS
        )
        told += (
            f"{point.u:g},{point.v:g} looks surely {'nearer than' if near > SURE_SIDE else 'beyond'} what is in focus, "
            f"where the known depth of {point.depth_m:g} m is not: by that it is answered"
            for point, near, leaning in zip(known, p_near, leanings, strict=True)
            if (leaning == 1 and near < 1 - SURE_SIDE) or (leaning == -1 and near > SURE_SIDE)
        )
        return cls(
            fitted,
            side,
            tuple(told),
            tuple(known),
            tuple(blur / read.ratio.columns for blur in blur_px),
            leanings,
            _shift(np.array(p_near), np.array(leanings)),
        )

    def likeness(self, read: Read) -> Array:
        """How much each known depth says of a place in the maps, [n, h, w] of 0 to 1, on no more cells than needed."""
        blur_px = read.maps["blur_px"]
        shrink = max(1.0, max(blur_px.shape) / MOST_CELLS)
        rows, columns = (max(1, round(cells / shrink)) for cells in blur_px.shape)
        coarse = np.asarray(cv2.resize(blur_px, (columns, rows), interpolation=cv2.INTER_AREA), np.float32)
        log_blur = log(coarse / np.float32(read.ratio.columns))
        v, u = read.places(rows, columns)
        reach_px = np.float32(REACH * max(self.camera.image_width_px, self.camera.image_height_px))
        like = np.empty((len(self.known), rows, columns), np.float32)
        for out, point, blur in zip(like, self.known, self.blur_px, strict=True):
            out[:] = ((v - point.v) / reach_px)[:, np.newaxis] ** 2 + ((u - point.u) / reach_px) ** 2
            out += ((log_blur - np.log(blur)) / LIKE_BLUR) ** 2
        return exp(like / -2)

    def lean(self, read: Read, likeness: Array) -> None:
        """Draw maps' probabilities of being near, as this camera has them, towards the sides that are known."""
        p_near = read.maps["p_near"]
        odds = _log_odds(np.array([p_near[read.cell_of(point.u, point.v)] for point in self.known])) + self.shift
        leanings = np.array(self.leanings)
        # where depth is known, so is its side, whatever the picture looks like
        own = np.maximum(OWN_ODDS, OWN_ODDS - np.sign(leanings) * odds)
        add_odds(p_near, self.shift + _spread(leanings * own, likeness), p_near.shape)

    def anchor(self, reading: Reading, read: Read, likeness: Array) -> list[str]:
        """Take what depth is off by where it is known, as a factor, from what is like it and near by.

        As far as that is so, a stated error is the tape's and that by which the answer still is off what is known: a
        warning each where that is much. No answer leaves the side that was asked for.
        """
        depth_m, error, focus_m = reading.depth_m, reading.error, self.camera.focus_distance_m
        low_m, high_m = (ratio * focus_m for ratio in SIDE_RANGES[self.side])
        cells = [read.cell_of(point.u, point.v) for point in self.known]

        def off() -> Numbers:
            return np.log([point.depth_m / float(depth_m[cell]) for point, cell in zip(self.known, cells, strict=True)])

        factor = np.clip(np.where(self._is_possible(), off(), 0), -MOST_ANCHORED, MOST_ANCHORED)
        size = depth_m.shape[::-1]
        log_factor = enlarged(_spread(factor, likeness), size)
        for rows in bands(depth_m.shape):
            depth_m[rows] = (depth_m[rows] * exp(log_factor[rows])).clip(low_m, high_m)
        still_off = off()
        own_error = enlarged(_spread(still_off**2, likeness) + TAPE_ERROR**2, size)
        share = enlarged(likeness.max(0) ** 2, size)
        for rows in bands(depth_m.shape):
            known = np.sqrt((1 - share[rows]) * error[rows] ** 2 + share[rows] * own_error[rows])
            np.copyto(error[rows], np.minimum(known, MOST_STATED), where=error[rows] <= MAX_RELATIVE_ERROR)
        return [
            f"{depth_m[cell]:.4g} m is answered at {point.u:g},{point.v:g} for the known depth of {point.depth_m:g} m"
            for point, cell, by in zip(self.known, cells, still_off, strict=True)
            if abs(by) > MUCH_OFF and error[cell] <= MAX_RELATIVE_ERROR
        ]

    def _is_possible(self) -> NDArray[np.bool_]:
        """Which known depths are not surely on the side of focus that was not asked for."""
        other_side = {"near": -1.0, "far": 1.0, "auto": None}[self.side]
        return np.array([leaning != other_side for leaning in self.leanings])


def _log_odds(p_near: Numbers) -> Numbers:
    kept = np.clip(p_near, LEAST_DOUBT, 1 - LEAST_DOUBT)
    return np.asarray(np.log(kept / (1 - kept)))


def _spread(values: Numbers, likeness: Array) -> Array:
    """A map of values that are known in places: theirs there, their mean where several count, 0 far from all."""
    given = np.tensordot(values.astype(np.float32), likeness, 1)
    return np.asarray(given / np.maximum(likeness.sum(0), 1), np.float32)


def _shift(p_near: Numbers, leanings: Numbers) -> float:
    """The likeliest shift of all log odds, where each known side counts as far as it is sure."""
    odds = _log_odds(p_near) + SHIFTS[:, np.newaxis]
    loss = (np.abs(leanings) * np.logaddexp(0, -np.sign(leanings) * odds)).sum(1) + (SHIFTS / SHARED_ODDS) ** 2 / 2
    return float(SHIFTS[loss.argmin()])
