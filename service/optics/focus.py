"""Where a lens is focused, from the blur of things whose depth is known."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from service.optics.camera import Camera

# standard deviations of a logarithm: of the focus distance that was told, as by a ring, and the least of a blur read
TOLD_ERROR = 0.1
READING_ERROR = 0.1
# Huber's loss: what is off by more deviations counts in proportion, so that one thing mistaken does not decide
TAIL = 1.5
FARTHEST_OFF, CANDIDATES = 1.7, 401
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
    from the camera's focus distance than 1.7 times. Raises ``ValueError`` without a sighting.
    """
    if not sightings:
        raise ValueError("a focus distance is fitted to one known depth or more")
    factors = np.geomspace(1 / FARTHEST_OFF, FARTHEST_OFF, CANDIDATES)
    factors = factors[factors * camera.focus_distance_m > (camera.focal_length_m or 0.0)]
    candidates = [camera.focused_at(camera.focus_distance_m * factor) for factor in factors.tolist()]
    shown_px = np.array([[candidate.blur_px(seen.depth_m) for seen in sightings] for candidate in candidates])
    read_px = np.array([seen.blur_px for seen in sightings])
    errors = np.array([max(seen.error, READING_ERROR) for seen in sightings])
    off = np.abs(np.log(np.maximum(read_px, LEAST_BLUR_PX) / np.maximum(shown_px, LEAST_BLUR_PX))) / errors
    loss = np.where(off < TAIL, off**2 / 2, TAIL * off - TAIL**2 / 2).sum(1)
    loss += (np.log(factors) / TOLD_ERROR) ** 2 / 2
    best = int(loss.argmin())
    likely = np.flatnonzero(loss <= loss[best] + CONFIDENCE_95)
    fitted_m, low_m, high_m = (candidates[place].focus_distance_m for place in (best, likely[0], likely[-1]))
    return FocusFit(fitted_m, low_m, high_m, tuple(off[best].tolist()))
