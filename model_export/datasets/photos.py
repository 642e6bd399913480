"""Photographs with depth: a folder with ``color/`` and ``depth/`` files of the same stem."""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, TypeAdapter, ValidationError

from model_export.config import Positive, first_error

MILLIMETRE_M = np.float32(1e-3)
MILLIMETRES = 1000.0
FARTHEST_M = 65.0  # what 16 bits of millimetres hold
CAMERAS = "cameras.json"

CameraPart = Literal["focus_distance_m", "k_cam_px", "gamma_px", "fx_px"]
_NAMED = TypeAdapter(dict[str, Any])
_CAMERA = TypeAdapter(dict[CameraPart, Positive], config=ConfigDict(strict=True))


@dataclass(frozen=True, slots=True)
class Photo:
    """A picture uint8 [h,w,3] (RGB) and its depth float32 [h,w] in metres along the axis, NaN where unknown."""

    name: str
    image: NDArray[np.uint8]
    depth_m: NDArray[np.float32]


PhotoAndCamera = tuple[Photo, Mapping[str, float]]  # what is known of the camera, by the names of cameras.json


def pictures_of(folder: Path) -> list[Path]:
    """The pictures of a set in order of names, but hidden files; ``ValueError`` for two of the same stem."""
    files = sorted(file for file in (folder / "color").glob("*") if not file.name.startswith("."))
    stems = [file.stem for file in files]
    if twice := [stem for stem, following in pairwise(sorted(stems)) if stem == following]:
        raise ValueError(f"{folder / 'color'} has two pictures of the name {twice[0]}")
    return files


def load_cameras(folder: Path, needed: Sequence[CameraPart]) -> dict[str, dict[CameraPart, float]]:
    """What took each picture of a set, by its stem, at the picture's own size.

    Raises ``ValueError`` where of a picture something that is ``needed`` is not told, or something else is.
    """
    file = folder / CAMERAS
    if not file.is_file():
        raise ValueError(f"{folder} has no {CAMERAS}, which says by what camera its pictures are")
    cameras: dict[str, dict[CameraPart, float]] = {}
    place = str(file)
    try:
        told = _NAMED.validate_json(file.read_bytes())
        for picture in pictures_of(folder):
            place = f"{file}: {picture.stem}"
            if picture.stem not in told:
                raise ValueError(f"{file} has no {picture.stem}, which is {picture}")
            cameras[picture.stem] = _CAMERA.validate_python(told[picture.stem])
    except ValidationError as exc:
        raise ValueError(f"{place}: {first_error(exc)}") from exc
    for name, camera in cameras.items():
        if lacking := [part for part in needed if part not in camera]:
            hint = f" (sharp frames, as NYU's, are scored in {folder.with_name('rgbd')})"
            raise ValueError(f"{file} has no {lacking[0]} of {name}{hint * (lacking[0] != 'fx_px')}")
    return cameras


def read_image(path: Path) -> NDArray[np.uint8]:
    """An RGB picture uint8 [h,w,3]; ``ValueError`` if it cannot be read."""
    try:
        image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    except cv2.error:  # of more than 2^30 pixels
        image = None
    if image is None:
        raise ValueError(f"{path} is no picture that can be read here: make it a JPEG or PNG")
    return np.ascontiguousarray(image[:, :, ::-1], np.uint8)


def read_depth(path: Path) -> NDArray[np.float32]:
    """A 16-bit PNG in millimetres (0 = unknown) as float32 [h,w] in metres (NaN = unknown)."""
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing: the depth of the picture of this name")
    raw = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if raw is None or raw.dtype != np.uint16 or raw.ndim != 2:
        raise ValueError(f"{path} is no depth: a grey PNG of 16 bits, in mm, 0 where it is unknown")
    return np.where(raw > 0, raw * MILLIMETRE_M, np.float32(np.nan)).astype(np.float32)


def load_photos(folder: Path, every: int = 1) -> Iterator[Photo]:
    """Each ``every``-th pair of the folder in order of names; raises if there is none, or for depth of another size."""
    files = pictures_of(folder)[::every]
    if not files:
        raise FileNotFoundError(f"no pictures in {folder / 'color'}")
    for file in files:
        depth_file = folder / "depth" / f"{file.stem}.png"
        photo = Photo(file.stem, read_image(file), read_depth(depth_file))
        (height, width), (rows, columns) = photo.image.shape[:2], photo.depth_m.shape
        if (height, width) != (rows, columns):
            raise ValueError(f"{depth_file} has {columns}x{rows} pixels, its picture {width}x{height}")
        yield photo


def save_photos(folder: Path, photos: Iterable[PhotoAndCamera]) -> int:
    """Write pictures as a set, or into one: ``color/``, ``depth/`` and, last, ``cameras.json``; how many there were."""
    for part in ("color", "depth"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    cameras = {}
    for photo, camera in photos:
        write_image(folder / "color" / f"{photo.name}.png", photo.image)
        write_depth(folder / "depth" / f"{photo.name}.png", photo.depth_m)
        cameras[photo.name] = dict(camera)
    file = folder / CAMERAS
    others = json.loads(file.read_text()) if file.exists() else {}
    file.write_text(json.dumps(others | cameras, indent=1) + "\n")
    return len(cameras)


def write_image(file: Path, image: NDArray[np.uint8], options: Sequence[int] = ()) -> None:
    """An RGB picture [h,w,3] as a file of the kind that its name says, with OpenCV's options."""
    _write(file, image[:, :, ::-1], options)


def write_depth(file: Path, depth_m: NDArray[np.float32]) -> None:
    """A map [h,w] in metres as a 16-bit PNG in millimetres: 0 where it is unknown, or beyond 65 m."""
    depth_mm = np.where(depth_m < FARTHEST_M, depth_m * MILLIMETRES, 0)
    _write(file, np.rint(depth_mm).astype(np.uint16))


def _write(file: Path, pixels: NDArray[np.uint8] | NDArray[np.uint16], options: Sequence[int] = ()) -> None:
    # cv2.imwrite says nothing of a full disk
    file.write_bytes(cv2.imencode(file.suffix, pixels, options)[1].tobytes())


def filled(depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """A map [h,w] with every NaN given the value of the nearest pixel that has one."""
    known = np.isfinite(depth_m)
    _, labels = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    values = np.zeros(int(labels.max()) + 1, np.float32)
    values[labels[known]] = depth_m[known]
    out: NDArray[np.float32] = values[labels]
    return out
