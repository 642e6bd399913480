"""Sharp pictures with depth (``camind homes``), to be photographed by cameras that training draws."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from model_export.datasets.photos import filled, load_cameras, load_photos
from service.optics import thin_lens
from service.optics.light import decode_srgb

SIZES = (0.65, 1.0)  # of the frame's own size, but no less than what holds the window
CONTRASTS = (0.75, 1.3)  # power of the light
TINTS = (0.8, 1.2)
# rendered rooms are looked at from 1.6 m, photographs of rooms from 2.3: what is out of focus is mostly behind
FAR_LEAN = 1.25
Map = NDArray[np.float32]


@dataclass(frozen=True)
class Frame:
    """A sharp picture uint8 [h,w,3] (sRGB), its depth in metres as float16 [h,w], and its focal length in px."""

    image: NDArray[np.uint8]
    depth_m: NDArray[np.float16]
    focal_length_px: float

    @cached_property
    def typical_m(self) -> float:
        """The geometric mean of the depth."""
        return float(np.exp(np.log(self.depth_m.astype(np.float32)).mean()))


@dataclass(frozen=True, slots=True)
class Crop:
    """A part of a frame, perhaps made small: linear light [h,w,3], depth in metres [h,w], focal length in px.

    ``softness`` is the variance (px^2) of the blur that it has beside its pixels' box, for having been made small.
    """

    light: Map
    depth_m: Map
    focal_length_px: float
    softness: float


def load_frames(folder: Path) -> list[Frame]:
    """All frames of a folder with ``color/``, ``depth/`` and ``cameras.json``. Raises if there is none."""
    cameras = load_cameras(folder, ("fx_px",))
    return [
        Frame(photo.image, filled(photo.depth_m).astype(np.float16), cameras[photo.name]["fx_px"])
        for photo in load_photos(folder)
    ]


def draw_frame(rng: np.random.Generator, frames: Sequence[Frame]) -> Frame:
    """One of some frames, the more often the farther it looks (its typical depth to the power ``FAR_LEAN``).

    So that of what cameras focused at 1 and 2 m see out of focus 11 and 32 % is nearer; all alike it would be 31 and
    60 %, and 17 % is in photographs by a lens focused at 2 m.
    """
    weights = np.array([frame.typical_m for frame in frames]) ** FAR_LEAN
    return frames[int(rng.choice(len(frames), p=weights / weights.sum()))]


def draw_crop(rng: np.random.Generator, frame: Frame, size: int) -> Crop:
    """A square of that many pixels of the frame, mirrored where it ends, under other light."""
    least = min(max(SIZES[0], size / min(frame.image.shape[:2])), SIZES[1])
    grow = math.exp(rng.uniform(math.log(least), math.log(SIZES[1])))
    height, width = (round(grow * side) for side in frame.image.shape[:2])
    image = cv2.resize(frame.image, (width, height), interpolation=cv2.INTER_AREA)
    # of the others, INTER_NEAREST takes the upper left pixel of an area and not its middle one
    depth_m = cv2.resize(frame.depth_m.astype(np.float32), (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
    rows, columns = (_window(rng, side, size) for side in (height, width))
    light = decode_srgb(np.asarray(image, np.float32)[rows][:, columns] / np.float32(255))
    light = (light ** rng.uniform(*CONTRASTS)) * rng.uniform(*TINTS, 3).astype(np.float32)
    depth = np.asarray(depth_m, np.float32)[rows][:, columns]
    softness = thin_lens.averaging_variance(frame.image.shape[1], width)
    return Crop(light.astype(np.float32), depth, grow * frame.focal_length_px, softness)


def _window(rng: np.random.Generator, side: int, size: int) -> NDArray[np.intp]:
    """Which rows or columns a window of that size shows; past the borders it goes back."""
    spare = side - size
    first = int(rng.integers(0, spare + 1)) if spare > 0 else spare // 2
    at = np.arange(first, first + size)
    return np.asarray(np.minimum(np.abs(at), 2 * (side - 1) - at), np.intp) if spare < 0 else at
