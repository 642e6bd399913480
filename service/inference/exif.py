"""What a photograph's EXIF says of lens and sensor. Nothing else in it is looked at, least of all the position."""

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass
from io import BytesIO

import exifread
import structlog
from exifread.core.ifd_tag import IfdTag

MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}
MOST_TEXT = 64

logging.getLogger("exifread").setLevel(logging.CRITICAL)
log = structlog.stdlib.get_logger("camind.exif")


@dataclass(frozen=True, slots=True)
class Exif:
    """The tags that make a camera; None where a tag is missing, empty or no positive number."""

    make: str | None = None
    model: str | None = None
    lens: str | None = None
    focal_length_mm: float | None = None
    focal_length_35mm: float | None = None
    f_number: float | None = None
    subject_distance_m: float | None = None
    digital_zoom: float | None = None
    width_px: int | None = None
    focal_plane_pitch_um: float | None = None


def read_exif(data: bytes) -> Exif:
    """The EXIF of a photograph's file, or of the block in it; empty where there is none, or none that can be read."""
    try:
        tags = exifread.process_file(BytesIO(data), details=False, extract_thumbnail=False)
    except Exception as exc:  # its readers raise whatever a damaged file makes of their indices
        log.debug("exif_unreadable", cause=type(exc).__name__)
        return Exif()
    found = {name: tag for name, tag in tags.items() if isinstance(tag, IfdTag)}
    width = _number(found, "EXIF ExifImageWidth")
    return Exif(
        make=_text(found, "Image Make"),
        model=_text(found, "Image Model"),
        lens=_text(found, "EXIF LensModel"),
        focal_length_mm=_number(found, "EXIF FocalLength"),
        focal_length_35mm=_number(found, "EXIF FocalLengthIn35mmFilm"),
        f_number=_number(found, "EXIF FNumber"),
        subject_distance_m=_number(found, "EXIF SubjectDistance"),
        digital_zoom=_number(found, "EXIF DigitalZoomRatio"),
        width_px=int(width) if width else None,
        focal_plane_pitch_um=_pitch_um(found),
    )


def _pitch_um(tags: Mapping[str, IfdTag]) -> float | None:
    pixels_per_unit = _number(tags, "EXIF FocalPlaneXResolution")
    unit = _number(tags, "EXIF FocalPlaneResolutionUnit") or 2
    if pixels_per_unit is None or unit not in MM_PER_UNIT:
        return None
    return 1e3 * MM_PER_UNIT[int(unit)] / pixels_per_unit


def _number(tags: Mapping[str, IfdTag], name: str) -> float | None:
    values = tags[name].values if name in tags else None
    value = values[0] if isinstance(values, list) and values else math.nan
    try:
        # what is stored as a floating-point number comes in a tuple
        number = float(value[0] if isinstance(value, tuple) else value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    # all ones stand for infinity in a distance
    return number if 0 < number < 2**32 - 1 else None


def _text(tags: Mapping[str, IfdTag], name: str) -> str | None:
    text = "".join(letter for letter in str(tags[name]) if letter.isprintable()) if name in tags else ""
    return text.strip()[:MOST_TEXT] or None
