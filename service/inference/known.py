"""Depths that somebody knows, by a tape: they tell where the lens was focused, which no picture shows by itself."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.inference.cancellation import Cancellation
from service.inference.estimator import Estimator, Read
from service.inference.hypotheses import SIGMA_OF_LAPLACE
from service.inference.pair import Stopwatch
from service.inference.part import Part
from service.optics.camera import Camera
from service.optics.focus import Sighting, fit_focus

MOST_DEVIATIONS = 3.0


@dataclass(frozen=True, slots=True)
class KnownDepth:
    """A pixel of the upright photograph and its depth, in metres along the optical axis."""

    u: float
    v: float
    depth_m: float


def refocused(
    estimator: Estimator,
    rgb: NDArray[np.uint8],
    camera: Camera,
    known: Sequence[KnownDepth],
    cancellation: Cancellation | None = None,
    stopwatch: Stopwatch | None = None,
) -> tuple[Camera, tuple[str, ...]]:
    """The camera focused where the photograph's blur at known depths says it was, and what to know about that.

    ``rgb``, uint8 [h, w, 3], is upright and of the camera's size; all pixels lie within it. The photograph is read for
    it, from the first of the pixels to the last.
    """
    rows, columns = [round(point.v) for point in known], [round(point.u) for point in known]
    part = Part(min(columns), min(rows), max(columns) + 1, max(rows) + 1)
    read = estimator.read(rgb, camera, cancellation=cancellation, part=part, stopwatch=stopwatch)
    fit = fit_focus(read.camera, [_sighted(read, point, estimator.manifest.stride) for point in known])
    told = (
        f"focused at {fit.focus_distance_m:.3g} m ({fit.low_m:.3g} to {fit.high_m:.3g}) by what is known of "
        f"{len(known)} depths, where {camera.focus_distance_m:.4g} m was told"
    )
    doubted = tuple(
        f"its blur speaks against the known depth of {point.depth_m:g} m at ({point.u:g}, {point.v:g})"
        for point, deviations in zip(known, fit.deviations, strict=True)
        if deviations > MOST_DEVIATIONS
    )
    return camera.focused_at(fit.focus_distance_m), (told, *doubted)


def _sighted(read: Read, point: KnownDepth, stride: int) -> Sighting:
    """What was read in the cell that holds a pixel, in pixels of the copy that was read."""
    places = (point.v - read.area.top, point.u - read.area.left)
    blur_px, log_error = read.maps["blur_px"], read.maps["blur_log_error"]
    row, column = (
        min(int((place + 0.5) * ratio / stride), cells - 1)
        for place, ratio, cells in zip(places, read.ratio, blur_px.shape, strict=True)
    )
    error = float(SIGMA_OF_LAPLACE * np.exp(log_error[row, column]))
    return Sighting(point.depth_m, float(blur_px[row, column]), error)
