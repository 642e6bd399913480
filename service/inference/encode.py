"""A DepthMap as bytes: PNG16, NPY, NPZ, TIFF, PLY and a preview; its numbers for JSON; and the photograph itself.

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
from service.inference.part import Part
from service.inference.png import grey_png
from service.inference.preview import render_preview
from service.inference.resampling import Lines, bands, shrunk_size
from service.opencv import cv2
from service.optics.camera import Intrinsics

MILLIMETRE = 0.001
LARGEST_MILLIMETRES = 65535
FEW_MILLIMETRES, CLOSE_MILLIMETRES = 50, 500
SAMPLES = 2**16
# towards the corners of a wide lens 20 rounds are too few; a place that no ray meets is left out, and costs all of them
UNDISTORTING = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-6)
LENS_CELL_PX, MOST_OFF_PX = 8, 0.5
RAY_CELL_PX, MOST_BENT_PX = 4, 0.01
PERCENTILES = (0, 5, 50, 95, 100)
GDAL_NODATA = (42113, "s", 0, "nan", True)  # the tag by which GDAL knows what is no answer
COMMENT_LETTERS = 200  # what reads PLY takes lines of 1,000 or so
UNKNOWN = Intrinsics(math.nan, math.nan, math.nan, math.nan)
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


@dataclass(frozen=True, slots=True)
class PointReading:
    """Depth at one pixel; None is no answer."""

    u: float
    v: float
    depth_m: float | None
    depth_alt_m: float | None
    sigma_m: float | None
    p_near: float


@dataclass(frozen=True, slots=True)
class Spread:
    """Depth over all pixels with an answer, in metres; None without one."""

    min: float | None
    p5: float | None
    median: float | None
    p95: float | None
    max: float | None


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
    distortion = _distortion(answer)
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
    is_met = _is_met(answer)[v // LENS_CELL_PX, u // LENS_CELL_PX]
    v, u = v[is_met], u[is_met]
    z = answer.depth_m[v, u]
    points = np.empty(
        len(z), [(axis, "<f4") for axis in "xyz"] + [(colour, "u1") for colour in ("red", "green", "blue")]
    )
    points["x"], points["y"] = _rays(answer, u, v) * z
    points["z"] = z
    shown = Lines.spread((beside.rgb.shape[0], beside.rgb.shape[1]), (answer.height_px, answer.width_px))
    points["red"], points["green"], points["blue"] = beside.rgb[shown.rows[v], shown.columns[u]].T
    body = _ply_header(len(z), beside) + points.tobytes()
    why = "by the camera's distortion no ray meets the sensor there"
    lost = () if is_met.all() else (f"{fraction(~is_met):.1%} of the points are left out: {why}",)
    return Encoded(body, MEDIA_TYPES["ply"], warnings=lost)


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


def camera_matrix(answer: DepthMap) -> NDArray[np.float64]:
    """K [3, 3] at the maps' size; NaN for the four numbers of unknown intrinsics."""
    return np.array((answer.camera.intrinsics or UNKNOWN).matrix)


def _distortion(answer: DepthMap) -> NDArray[np.float64]:
    """The lens' distortion in OpenCV's order; empty where there is none."""
    return np.array(answer.camera.intrinsics.distortion if answer.camera.intrinsics else (), np.float64)


def _rays(answer: DepthMap, u: NDArray[np.intp], v: NDArray[np.intp]) -> NDArray[np.float64]:
    """Where pixels look: x and y [2, n] at a depth of 1, without the lens' distortion.

    That is looked for on a grid, and between its places linear where that is right to a hundredth of a pixel.
    """
    matrix = camera_matrix(answer)
    if not _distortion(answer).any() or len(u) == 0:
        return np.stack([(u - matrix[0, 2]) / matrix[0, 0], (v - matrix[1, 2]) / matrix[1, 1]])
    height, width = answer.depth_m.shape
    down, across = (np.arange(0, size + RAY_CELL_PX, RAY_CELL_PX) for size in (height, width))
    corners = _grid_rays(answer, down, across).astype(np.float32)
    to_corners = np.array([[1 / RAY_CELL_PX, 0, 0], [0, 1 / RAY_CELL_PX, 0]])
    linear = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    between_corners = (cv2.warpAffine(values, to_corners, (width, height), flags=linear) for values in corners)
    rays = np.array([values[v, u] for values in between_corners], np.float64)
    middles = (corners[:, :-1, :-1] + corners[:, :-1, 1:] + corners[:, 1:, :-1] + corners[:, 1:, 1:]) / 4
    off = _grid_rays(answer, down[:-1] + RAY_CELL_PX / 2, across[:-1] + RAY_CELL_PX / 2) - middles
    is_bent = ~(np.hypot(*off) * matrix[0, 0] <= MOST_BENT_PX)
    alone = is_bent[v // RAY_CELL_PX, u // RAY_CELL_PX]
    if alone.any():
        rays[:, alone] = _undistorted(answer, u[alone], v[alone])
    return rays


def _grid_rays(answer: DepthMap, down: NDArray[Any], across: NDArray[Any]) -> NDArray[np.float64]:
    """Where the places of a grid look: x and y [2, h, w] at a depth of 1."""
    u, v = (places.ravel() for places in np.meshgrid(across, down))
    return _undistorted(answer, u, v).reshape(2, len(down), len(across))


def _undistorted(answer: DepthMap, u: NDArray[Any], v: NDArray[Any]) -> NDArray[np.float64]:
    """Where places look, each by its own search, which takes long for all of a photograph."""
    places = np.stack([u, v], 1).astype(np.float64)[:, None]
    found = cv2.undistortPoints(places, camera_matrix(answer), _distortion(answer), criteria=UNDISTORTING)
    return np.asarray(found, np.float64)[:, 0].T


def _is_met(answer: DepthMap) -> NDArray[np.bool_]:
    """Whether rays meet the sensor in cells of ``LENS_CELL_PX`` each way, by their corners.

    Towards the corners of a wide picture a lens' polynomial may turn back: nothing is distorted to what lies beyond.
    """
    down, across = (np.arange(0, size + LENS_CELL_PX, LENS_CELL_PX) for size in answer.depth_m.shape)
    distortion = _distortion(answer)
    if not distortion.any():
        return np.ones((len(down) - 1, len(across) - 1), np.bool_)
    u, v = (places.ravel() for places in np.meshgrid(across, down))
    ahead = np.column_stack([*_undistorted(answer, u, v), np.ones(len(u))])
    back = cv2.projectPoints(ahead, np.zeros(3), np.zeros(3), camera_matrix(answer), distortion)[0][:, 0]
    is_met = (np.hypot(*(back - np.stack([u, v], 1)).T) <= MOST_OFF_PX).reshape(len(down), len(across))
    return np.asarray(is_met[:-1, :-1] & is_met[1:, :-1] & is_met[:-1, 1:] & is_met[1:, 1:])


def spread_of(answer: DepthMap) -> Spread:
    """Least, 5 %, median, 95 % and greatest depth of the pixels with an answer."""
    known = answer.depth_m[answer.valid]
    if known.size == 0:
        return Spread(None, None, None, None, None)
    return Spread(*(float(value) for value in np.percentile(known, PERCENTILES)))


def read_point(answer: DepthMap, u: float, v: float, part: Part | None = None) -> PointReading:
    """The answer at the photograph's pixel whose area holds (u, v); raises ``BadRequest`` outside.

    The answer is to all of the photograph, or to a ``part`` of it.
    """
    row, column = pixel_at(u, v, part or Part(0, 0, answer.width_px, answer.height_px))
    # the layers of this pixel alone: all of a large photograph's are half a second
    there = answer.layers_at(Lines.between(row, row + 1, column, column + 1))
    return PointReading(
        u,
        v,
        _number_or_none(answer.depth_m[row, column]),
        _number_or_none(there.depth_alt_m[0, 0]),
        _number_or_none(there.sigma_m[0, 0]),
        float(there.p_near[0, 0]),
    )


def pixel_at(u: float, v: float, part: Part, asked_in: str = "at") -> tuple[int, int]:
    """Row and column, in a part of the photograph, of the pixel whose area holds (u, v).

    Raises ``BadRequest``, with the option it was ``asked_in``, outside [left - 0.5, right - 0.5) x [top - 0.5,
    bottom - 0.5).
    """
    row, column = math.floor(v + 0.5) - part.top, math.floor(u + 0.5) - part.left
    if not (0 <= row < part.height_px and 0 <= column < part.width_px):
        asked = f"({part.left}, {part.top}) to ({part.right}, {part.bottom})"
        detail = f"({u:g}, {v:g}) is outside the part of the upright photograph that is asked for, {asked}."
        raise BadRequest.at(detail, asked_in)
    return row, column


def _number_or_none(value: np.float32) -> float | None:
    return float(value) if np.isfinite(value) else None


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
