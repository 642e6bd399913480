"""Where a lens is focused, from the blur of things whose depth is known."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from service.optics.camera import Camera

# standard deviations of a logarithm: of the focus distance that was told, as by a ring, and the least of a blur read
TOLD_ERROR = 0.1
READING_ERROR = 0.1
# Cauchy's loss: what is off by more deviations than this counts ever less, so that one thing mistaken does not decide,
# be it what was told
TAIL = 2.5
FARTHEST_OFF, CANDIDATES = 2.5, 601
LEAST_BLUR_PX = 0.1
CONFIDENCE_95 = 1.92  # half of the 95 % quantile of chi squared with one degree of freedom


@dataclass(frozen=True, slots=True)
class Sighting:
    """A thing at ``depth_m`` whose blur was read as ``blur_px``, with that relative standard deviation."""

    depth_m: float
    blur_px: float
    error: float


@dataclass(frozen=True, slots=True)
class FocusFit:
    """The likeliest focus distance in metres, its 95 % interval, and by how many deviations each sighting is off it."""

    focus_distance_m: float
    low_m: float
    high_m: float
    deviations: tuple[float, ...]


def fit_focus(camera: Camera, sightings: Sequence[Sighting]) -> FocusFit:
    """The focus distance whose blur (eq. 3 and 5) is nearest to what was read, and near to the camera's own.

    Blur is in pixels of the camera's pictures. A known depth tells its side of focus, so that, other than depth from
    blur, this has one answer; from a single sighting close to focus the interval holds both. Its ends are no farther
    from the camera's focus distance than 2.5 times. Raises ``ValueError`` without a sighting.
    """
    if not sightings:
        raise ValueError("a focus distance is fitted to one known depth or more")
    nearest_m = camera.focal_length_m or 0.0
    factors = (FARTHEST_OFF ** (2 * place / (CANDIDATES - 1) - 1) for place in range(CANDIDATES))
    distances_m = [m for m in (camera.focus_distance_m * factor for factor in factors) if m > nearest_m]
    deviations = [_deviations(camera.focused_at(focus_m), sightings) for focus_m in distances_m]
    losses = [
        sum(map(_loss, (math.log(focus_m / camera.focus_distance_m) / TOLD_ERROR, *offs)))
        for focus_m, offs in zip(distances_m, deviations, strict=True)
    ]
    best = losses.index(min(losses))
    likely_m = [m for m, loss in zip(distances_m, losses, strict=True) if loss <= losses[best] + CONFIDENCE_95]
    return FocusFit(distances_m[best], likely_m[0], likely_m[-1], deviations[best])


def _loss(deviations: float) -> float:
    return TAIL**2 / 2 * math.log1p((deviations / TAIL) ** 2)


def _deviations(camera: Camera, sightings: Sequence[Sighting]) -> tuple[float, ...]:
    """By how many standard deviations of its reading each blur is off the camera's, in ln lambda."""

    def off(seen: Sighting) -> float:
        shown_px = camera.blur_px(seen.depth_m)
        ratio = max(seen.blur_px, LEAST_BLUR_PX) / max(shown_px, LEAST_BLUR_PX)
        return abs(math.log(ratio)) / max(seen.error, READING_ERROR)

    return tuple(map(off, sightings))
