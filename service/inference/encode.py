"""A DepthMap as bytes: PNG16, NPY, NPZ, TIFF, PLY and a preview; and the photograph itself.

Units and the sign for no answer are those of ROS REP 118: float metres with NaN, or millimetres with 0.
"""

import io
import json
import math
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, get_args
from zipfile import ZipFile

import numpy as np
import tifffile
from numpy.typing import NDArray

from service.errors import BadRequest
from service.inference.depth_map import DepthMap, fraction
from service.inference.png import grey_png
from service.inference.preview import render_preview
from service.inference.rays import are_met, camera_matrix, distortion_of, rays
from service.inference.resampling import Lines, bands, shrunk_size
from service.opencv import cv2

MILLIMETRE = 0.001
LARGEST_MILLIMETRES = 65535
FEW_MILLIMETRES, CLOSE_MILLIMETRES = 50, 500
SAMPLES = 2**16
GDAL_NODATA = (42113, "s", 0, "nan", True)  # the tag by which GDAL knows what is no answer
COMMENT_LETTERS = 200  # what reads PLY takes lines of 1,000 or so
MapName = Literal["depth_m", "depth_alt_m", "p_near", "sigma_m", "blur_px", "valid"]
MAPS: tuple[MapName, ...] = get_args(MapName)
MEDIA_TYPES: dict[str, str] = {
    "png": "image/png",
    "npy": "application/x-npy",
    "npz": "application/x-npz",
    "tiff": "image/tiff",
    "ply": "application/x-ply",
    "preview": "image/jpeg",
}


@dataclass(frozen=True, slots=True)
class Encoded:
    """A body with its media type, the metres per unit in it, and what was lost."""

    body: bytes
    media_type: str
    depth_scale_m: float = 1.0
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Beside:
    """What goes into files beside depth: the photograph's colours [h, w, 3] into points, these maps into an npz.

    The photograph, or the part of it that is answered, may be larger than the maps.
    ``origin`` is what the answer was made by, for files that have room to say so.
    """

    rgb: NDArray[np.uint8]
    maps: Sequence[MapName] = MAPS
    origin: Mapping[str, object] = field(default_factory=dict)

    def told(self, depth_scale_m: float = 1.0) -> dict[str, object]:
        """The origin, with the metres per unit of a file."""
        return {**self.origin, "depth_scale_m": depth_scale_m}


def encode_png(answer: DepthMap, beside: Beside) -> Encoded:
    """16-bit grey, millimetres along z; 0 is no answer, which includes what lies beyond 65.535 m."""
    size = answer.height_px, answer.width_px
    levels, beyond = np.empty(size, np.uint16), 0
    for rows in bands(size):
        millimetres = np.rint(answer.depth_m[rows] * np.float32(1 / MILLIMETRE))
        too_far = millimetres > LARGEST_MILLIMETRES
        beyond += int(np.count_nonzero(too_far))
        millimetres[too_far | ~answer.valid[rows]] = 0
        levels[rows] = millimetres
    body = grey_png(levels, json.dumps(beside.told(MILLIMETRE)))
    lost = f"{beyond / levels.size:.1%} of the pixels lie beyond the 65.535 m a 16-bit PNG can hold and read 0"
    warnings = (lost,) if beyond else _coarse(levels)
    return Encoded(body, MEDIA_TYPES["png"], MILLIMETRE, warnings)


def _coarse(levels: NDArray[np.uint16]) -> tuple[str, ...]:
    """A warning where millimetres are few for what is close, by some of the pixels: all of them would take long."""
    step = math.ceil(math.sqrt(levels.size / SAMPLES))
    some = levels[::step, ::step]
    if np.count_nonzero(some > CLOSE_MILLIMETRES) >= 0.05 * np.count_nonzero(some):
        return ()
    low, high = np.percentile(some[some > 0], (5, 95))
    if high - low >= FEW_MILLIMETRES:
        return ()
    return (
        f"nine tenths of the depths lie within {high - low:.0f} mm, and a 16-bit PNG holds whole millimetres: npy, npz "
        "and tiff keep what is finer",
    )


def encode_npy(answer: DepthMap, _: Beside) -> Encoded:
    """float32 metres [height, width], NaN where there is no answer."""
    stream = io.BytesIO()
    np.save(stream, answer.depth_m, allow_pickle=False)
    return Encoded(stream.getvalue(), MEDIA_TYPES["npy"])


def encode_npz(answer: DepthMap, beside: Beside) -> Encoded:
    """Maps by their names, ``K`` float64 [3, 3], NaN and a warning if unknown, ``distortion`` if there is any.

    The zip's comment is the origin, JSON: it is in nobody's way who reads arrays.
    """
    distortion = distortion_of(answer)
    matrix = camera_matrix(answer)
    unknown = () if np.isfinite(matrix).all() else ("the camera has no focal length in pixels: K is NaN",)
    arrays: dict[str, Any] = {name: getattr(answer, name) for name in beside.maps} | {"K": matrix}
    if distortion.any():
        arrays["distortion"] = distortion
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    with ZipFile(stream, "a") as archive:
        archive.comment = json.dumps(beside.told()).encode()
    return Encoded(stream.getvalue(), MEDIA_TYPES["npz"], warnings=unknown)


def encode_tiff(answer: DepthMap, beside: Beside) -> Encoded:
    """float32 metres, one page, uncompressed; NaN where there is no answer."""
    stream = io.BytesIO()
    tifffile.imwrite(
        stream,
        answer.depth_m,
        photometric="minisblack",
        description=json.dumps(beside.told()),
        metadata=None,
        software="camind",
        extratags=(GDAL_NODATA,),
    )
    return Encoded(stream.getvalue(), MEDIA_TYPES["tiff"])


def encode_ply(answer: DepthMap, beside: Beside) -> Encoded:
    """Binary little-endian points in metres (x right, y down, z forward) with the photograph's colours.

    Raises ``BadRequest`` without intrinsics: no focal length, no points.
    """
    matrix = camera_matrix(answer)
    if not np.isfinite(matrix).all():
        detail = "A point cloud needs the camera's focal length: register it with intrinsics or lens."
        raise BadRequest.at(detail, "format")
    v, u = np.nonzero(answer.valid)
    met = are_met(answer, u, v)
    v, u = v[met], u[met]
    z = answer.depth_m[v, u]
    points = np.empty(
        len(z), [(axis, "<f4") for axis in "xyz"] + [(colour, "u1") for colour in ("red", "green", "blue")]
    )
    points["x"], points["y"] = rays(answer, u, v) * z
    points["z"] = z
    shown = Lines.spread((beside.rgb.shape[0], beside.rgb.shape[1]), (answer.height_px, answer.width_px))
    points["red"], points["green"], points["blue"] = beside.rgb[shown.rows[v], shown.columns[u]].T
    body = _ply_header(len(z), beside) + points.tobytes()
    why = "by the camera's distortion no ray meets the sensor there"
    lost = () if met.all() else (f"{fraction(~met):.1%} of the points are left out: {why}",)
    return Encoded(body, MEDIA_TYPES["ply"], warnings=lost)


def _ply_header(count: int, beside: Beside) -> bytes:
    told = (f"{name}: {json.dumps(value)}" for name, value in beside.told().items())
    comments = (f"comment {line}" for text in told for line in textwrap.wrap(text, COMMENT_LETTERS))
    fields = [f"property float {axis}" for axis in "xyz"]
    fields += [f"property uchar {colour}" for colour in ("red", "green", "blue")]
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        "comment metres, x right, y down, z forward",
        *comments,
        f"element vertex {count}",
    ]
    return "\n".join([*lines, *fields, "end_header", ""]).encode("ascii")


def encode_preview(answer: DepthMap, _: Beside) -> Encoded:
    """JPEG in turbo colours, near red and far blue, grey without an answer, with a legend in metres."""
    return _jpeg(render_preview(answer.depth_m))


def encode_photograph(rgb: NDArray[np.uint8], longest_px: int) -> Encoded:
    """JPEG of a picture [h, w, 3], its longer side at most so long."""
    size = rgb.shape[0], rgb.shape[1]
    smaller = shrunk_size(size, longest_px)
    if smaller != size:
        rgb = np.asarray(cv2.resize(rgb, smaller[::-1], interpolation=cv2.INTER_AREA), np.uint8)
    return _jpeg(rgb)


def _jpeg(rgb: NDArray[np.uint8]) -> Encoded:
    body = cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), (cv2.IMWRITE_JPEG_QUALITY, 90))[1]
    return Encoded(body.tobytes(), MEDIA_TYPES["preview"])


ENCODERS: dict[str, Callable[[DepthMap, Beside], Encoded]] = {
    "png": encode_png,
    "npy": encode_npy,
    "npz": encode_npz,
    "tiff": encode_tiff,
    "ply": encode_ply,
    "preview": encode_preview,
}
