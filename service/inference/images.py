"""The only door for photographs: bytes in, upright RGB out.

Kind, size and wholeness are decided on the header, before anything is decoded. EXIF orientation is applied
here and nowhere else; a calibration, which measures the lens, asks for the stored frame. HEIC, AVIF and raw files
are decoded in a process of their own.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from service import PIXEL_CEILING
from service.config import Settings
from service.errors import InvalidImage, TooLarge, UnsupportedKind
from service.inference.border import Mask
from service.inference.exif import Exif, read_exif
from service.inference.headers import Header, Kind, picture_of_png, read_header
from service.inference.isolated import decode_isolated
from service.inference.making import signs_of_making
from service.opencv import cv2

PHOTOGRAPH_TYPES: dict[str, Kind] = {
    "image/jpeg": "jpeg",
    "image/png": "png",
    "image/tiff": "tiff",
    "image/webp": "webp",
    "image/heic": "heic",
    "image/heif": "heic",
    "image/avif": "avif",
    "image/x-adobe-dng": "raw",
    "image/x-canon-cr2": "raw",
    "image/x-nikon-nef": "raw",
    "image/x-sony-arw": "raw",
}
# what some browsers and programs call them
ALIASES: dict[str, Kind] = {"image/jpg": "jpeg", "image/pjpeg": "jpeg", "image/x-png": "png"}
ISOLATED = frozenset({"heic", "avif", "raw"})
CURL_S_OWN = "application/x-www-form-urlencoded"
UNDECLARED = frozenset({"", "application/octet-stream", "image/*"})

# how files of these kinds end
SUFFIXES = frozenset(
    {
        ".jpg",
        ".jpeg",
        ".jfif",
        ".mpo",
        ".png",
        ".tif",
        ".tiff",
        ".webp",
        ".heic",
        ".heif",
        ".hif",
        ".avif",
        ".dng",
        ".cr2",
        ".nef",
        ".arw",
    }
)

# (transposed, flipped left-right, flipped top-bottom), in this order, by EXIF orientation
TURNS: dict[int, tuple[bool, bool, bool]] = {
    1: (False, False, False),
    2: (False, True, False),
    3: (False, True, True),
    4: (False, False, True),
    5: (True, False, False),
    6: (True, True, False),
    7: (True, True, True),
    8: (True, False, True),
}
# the orientation that undoes each
UNTURNS = {orientation: {6: 8, 8: 6}.get(orientation, orientation) for orientation in TURNS}
# not IMREAD_COLOR_RGB for all: OpenCV 5.0 leaves a 16-bit TIFF read so uninitialised
DECODE_FLAGS = cv2.IMREAD_COLOR_BGR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
JPEG_FLAGS = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION
# below which metres go wrong: faint texture is lost, and a webp's filter blurs
LEAST_QUALITY: dict[Kind, int] = {"jpeg": 75, "webp": 76}
CLIPPED_LEVEL, CLIPPED_SHARE, CLIPPED_EVERY = 253, 0.25, 4  # of all colours; of the pixels, from where on it is told


@dataclass(frozen=True, slots=True)
class ImageLimits:
    """The most that is accepted: bytes of the file, pixels of the picture, and its longer side over its shorter."""

    max_bytes: int = Settings.model_fields["max_image_bytes"].default
    max_pixels: int = Settings.model_fields["max_image_pixels"].default
    max_aspect: float = Settings.model_fields["max_image_aspect"].default

    @classmethod
    def of(cls, settings: Settings) -> Self:
        """What the operator chose."""
        return cls(settings.max_image_bytes, settings.max_image_pixels, settings.max_image_aspect)


@dataclass(frozen=True, slots=True)
class Photograph:
    """``rgb``: uint8 [height, width, 3], sRGB, upright; ``orientation`` is the EXIF's of the file, 1..8.

    ``hidden``: bool [height, width], where it is more transparent than not; None where that is nowhere.
    """

    rgb: NDArray[np.uint8]
    kind: Kind
    orientation: int
    warnings: tuple[str, ...] = ()
    exif: Exif = field(default_factory=Exif)
    hidden: Mask | None = None

    @property
    def width_px(self) -> int:
        return int(self.rgb.shape[1])

    @property
    def height_px(self) -> int:
        return int(self.rgb.shape[0])


@dataclass(frozen=True, slots=True)
class StoredFrame:
    """``rgb``: uint8 [height, width, 3], sRGB, as the file has it, whatever its EXIF's ``orientation``, 1..8."""

    rgb: NDArray[np.uint8]
    orientation: int
    exif: Exif


def photographs_in(folder: Path) -> list[Path]:
    """The files of a folder that end as photographs do, by name, but hidden ones: macOS puts a ``._`` beside each."""
    return sorted(path for path in folder.glob("[!.]*") if path.suffix.lower() in SUFFIXES)


def read_photograph(data: bytes, media_type: str | None = None, limits: ImageLimits | None = None) -> Photograph:
    """Decode a photograph; the bytes decide its kind, whatever ``media_type`` declares.

    Raises ``InvalidImage`` (empty, cut off, damaged), ``TooLarge`` (before decoding), ``UnsupportedKind``
    (a declared type or bytes that are not listed) and ``MemoryError``.
    """
    declared = declared_kind(media_type)
    header, stored, hidden, warnings = _read(data, limits or ImageLimits())
    kind, orientation = header.kind, header.orientation
    if declared not in (None, kind):
        warnings += (f"declared {media_type}, read as {kind}",)
    if header.has_more:
        warnings += ("the file has more than one picture: the first was read",)
    if header.other_curve is not None:
        warnings += (f"its colour profile is {header.other_curve}, and it was read as sRGB: export it as sRGB",)
    if header.quality is not None and round(header.quality) < LEAST_QUALITY[kind]:
        said = f"a {kind} of quality {header.quality:.0f}, below the {LEAST_QUALITY[kind]} that metres need"
        warnings += (f"{said}: send what the camera stored",)
    if header.has_few_colours:
        warnings += ("it has a palette's few colours, whose steps are taken for edges: send what the camera stored",)
    warnings += (*_overexposed(stored, hidden), *signs_of_making(data, header, stored))
    hidden = None if hidden is None else turned(hidden, orientation)
    return Photograph(turned(stored, orientation), kind, orientation, warnings, read_exif(header.exif), hidden)


def read_stored_frame(data: bytes, limits: ImageLimits | None = None) -> StoredFrame:
    """The photograph as the sensor had it, orientation not applied: a lens belongs to its sensor.

    Raises as ``read_photograph`` does, and ``UnsupportedKind`` for light that would be measured by a wrong curve.
    """
    header, stored, _, _ = _read(data, limits or ImageLimits())
    if header.other_curve is not None:
        raise UnsupportedKind(f"Its colour profile is {header.other_curve}: export it as sRGB, to be measured.")
    return StoredFrame(stored, header.orientation, read_exif(header.exif))


def turned(pixels: NDArray[Any], orientation: int) -> NDArray[Any]:
    """The upright picture [h, w, ...] of a stored one; ``orientation`` is EXIF's, 1..8."""
    transposed, flip_u, flip_v = TURNS[orientation]
    if transposed:
        pixels = pixels.swapaxes(0, 1)
    if flip_u:
        pixels = pixels[:, ::-1]
    if flip_v:
        pixels = pixels[::-1]
    return np.ascontiguousarray(pixels)


def declared_kind(media_type: str | None) -> Kind | None:
    """The kind a media type names, None where it names none; ``UnsupportedKind`` for one not listed."""
    name = (media_type or "").partition(";")[0].strip().lower()
    if name in UNDECLARED:
        return None
    if name == CURL_S_OWN:
        raise UnsupportedKind(f"{name} is what curl says of any body: add -H 'Content-Type: image/jpeg'.")
    kind = PHOTOGRAPH_TYPES.get(name) or ALIASES.get(name)
    if kind is None:
        raise UnsupportedKind(f"{name[:100]} is not a kind of photograph: send one of {', '.join(PHOTOGRAPH_TYPES)}.")
    return kind


def _read(data: bytes, limits: ImageLimits) -> tuple[Header, NDArray[np.uint8], Mask | None, tuple[str, ...]]:
    """The header, the stored frame, where it is hidden, and warnings of how it was decoded."""
    if len(data) > limits.max_bytes:
        raise TooLarge(f"The file has {len(data)} bytes, more than the {limits.max_bytes} accepted.")
    header = read_header(data)
    _require_size(header.width_px, header.height_px, limits)
    if header.kind not in ISOLATED:
        return header, *_decode(data, header)
    stored = decode_isolated(header.kind, data, min(limits.max_pixels, PIXEL_CEILING))
    _require_size(stored.shape[1], stored.shape[0], limits)
    stored, hidden = _without_alpha(stored if header.kind == "raw" else _stored_pixels(stored, header))
    return header, stored, hidden, ()


def _require_size(width_px: int, height_px: int, limits: ImageLimits) -> None:
    most = min(limits.max_pixels, PIXEL_CEILING)
    if width_px * height_px > most:
        raise TooLarge(f"The picture has {width_px}x{height_px} pixels, more than the {most} accepted.")
    if max(width_px, height_px) > limits.max_aspect * min(width_px, height_px):
        raise TooLarge(f"The picture has {width_px}x{height_px} pixels, more than {limits.max_aspect:g} to 1.")


def _decode(data: bytes, header: Header) -> tuple[NDArray[np.uint8], Mask | None, tuple[str, ...]]:
    is_jpeg = header.kind == "jpeg"
    flags = cv2.IMREAD_UNCHANGED if header.has_alpha else JPEG_FLAGS if is_jpeg else DECODE_FLAGS
    try:
        pixels = cv2.imdecode(np.frombuffer(_picture(data, header), np.uint8), flags)
    except cv2.error as exc:
        if exc.code == cv2.Error.StsNoMem:
            raise MemoryError(exc.err) from exc
        raise InvalidImage(f"The {header.kind} file cannot be decoded: it is damaged.") from exc
    if pixels is None or pixels.shape[:2] != (header.height_px, header.width_px):
        raise InvalidImage(f"The {header.kind} file cannot be decoded: it is damaged or of an unusual form.")
    colours, hidden = _without_alpha(pixels)
    eight_bits, warnings = _eight_bits(colours)
    rgb = eight_bits if is_jpeg else cv2.cvtColor(eight_bits, cv2.COLOR_BGR2RGB)
    return np.asarray(rgb, np.uint8), hidden, warnings


def _without_alpha(pixels: NDArray[Any]) -> tuple[NDArray[Any], Mask | None]:
    """The colours alone, and where they are hidden: nowhere where all of them were, as by a sensor's unused channel."""
    if pixels.ndim != 3 or pixels.shape[2] != 4:
        return pixels, None
    hidden = pixels[..., 3] <= np.iinfo(pixels.dtype).max // 2
    return np.ascontiguousarray(pixels[..., :3]), hidden if hidden.any() and not hidden.all() else None


def _picture(data: bytes, header: Header) -> bytes:
    """The file as it is to be decoded, with no orientation of its own: OpenCV turns every TIFF, whatever it is told."""
    if header.kind == "png":
        return picture_of_png(data)
    if header.orientation_offset is None or header.orientation == 1:
        return data
    stored = bytearray(data)
    upright = (1).to_bytes(2, "little" if data[:2] == b"II" else "big")
    stored[header.orientation_offset : header.orientation_offset + 2] = upright
    return bytes(stored)


def _overexposed(pixels: NDArray[np.uint8], hidden: Mask | None) -> Iterator[str]:
    """A warning where much of a picture is white, whose blur is lost and misleads what is beside it."""
    every = (slice(None, None, CLIPPED_EVERY),) * 2
    red, green, blue = np.moveaxis(pixels[every], 2, 0)
    white = (red >= CLIPPED_LEVEL) & (green >= CLIPPED_LEVEL) & (blue >= CLIPPED_LEVEL)
    share = float((white if hidden is None else white & ~hidden[every]).mean())
    if share > CLIPPED_SHARE:
        yield f"{100 * share:.0f} % of it is overexposed, and no blur is seen there: metres may be wrong, beside it too"


def _eight_bits(pixels: NDArray[Any]) -> tuple[NDArray[np.uint8], tuple[str, ...]]:
    warnings: tuple[str, ...] = ()
    if pixels.dtype == np.uint16:
        bits = _bits(int(pixels.max()))
        most = 2**bits - 1
        if bits < 16:
            warnings = (f"nothing in its 16 bits is above {most}: read as {bits} bits, and as sRGB",)
        pixels = cv2.convertScaleAbs(pixels, alpha=255 / most)
    if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] != 3:
        raise InvalidImage(f"Pixels of type {pixels.dtype} are not supported: send 8 or 16 bits a channel.")
    return np.asarray(pixels, np.uint8), warnings


def _bits(brightest: int) -> int:
    """How many there are to a pixel, where an industrial camera's 10, 12 or 14 stand in 16 as they are."""
    if 2**8 <= brightest < 2**10:  # what is darker may be 12 bits of a lens cap
        return 10
    return next((bits for bits in (12, 14) if 0 < brightest < 2**bits), 16)


def _stored_pixels(decoded: NDArray[np.uint8], header: Header) -> NDArray[np.uint8]:
    """The stored frame of a HEIC, whose decoder turns it, or of an AVIF, whose does not."""
    stored = turned(decoded, UNTURNS[header.orientation]) if header.kind == "heic" else decoded
    if stored.shape[:2] != (header.height_px, header.width_px):
        raise InvalidImage(f"The {header.kind} file's picture is not of the size that it states.")
    return stored
