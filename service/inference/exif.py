"""What a photograph's EXIF says of lens and sensor. Nothing else in it is looked at, least of all the position."""

import math
import struct
from dataclasses import dataclass, replace

from service.errors import InvalidImage
from service.inference.tiff import TiffDirectory, exif_directories
from service.optics import thin_lens

MAKE, MODEL = 271, 272
F_NUMBER, FOCAL_LENGTH, RENDERED, DIGITAL_ZOOM = 0x829D, 0x920A, 0xA401, 0xA404
SUBJECT_DISTANCE, FOCAL_LENGTH_35MM, LENS_MODEL = 0x9206, 0xA405, 0xA434
WIDTH, HEIGHT, PLANE_RESOLUTION, PLANE_UNIT = 0xA002, 0xA003, 0xA20E, 0xA210
THUMBNAIL_START, THUMBNAIL_BYTES = 513, 514
MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}
MOST_TEXT = 64
MOST_ZOOM = 1.01  # of what is none
FULL_FRAME_DIAGONAL_MM = math.hypot(36.0, 24.0)  # of what a 35-mm equivalent is seen on
# what phones write beyond the standard's 0 and 1
RENDERINGS = {6: "a panorama", 7: "a portrait mode", 8: "a portrait mode"}


@dataclass(frozen=True, slots=True)
class Exif:
    """The tags that make a camera, and what it did; None where a tag is missing, empty or no positive number.

    ``subject_distance_m`` alone may be infinite.
    """

    make: str | None = None
    model: str | None = None
    lens: str | None = None
    focal_length_mm: float | None = None
    focal_length_35mm: float | None = None
    f_number: float | None = None
    subject_distance_m: float | None = None
    digital_zoom: float | None = None
    width_px: int | None = None
    height_px: int | None = None
    focal_plane_pitch_um: float | None = None
    rendering: str | None = None

    @property
    def zoom(self) -> float:
        """How many times a part of the sensor was enlarged; 1 where it was not, or where nothing says so."""
        return max(self.digital_zoom or 1.0, 1.0)

    @property
    def is_zoomed(self) -> bool:
        """Whether the frame is a part of the sensor's, enlarged."""
        return self.zoom > MOST_ZOOM

    @property
    def equivalent_by_pitch_mm(self) -> float | None:
        """The 35-mm equivalent of the focal length by a pixel's size, for Canon notes none; None where unknown."""
        if self.focal_length_mm is None or self.focal_plane_pitch_um is None or not self.width_px or not self.height_px:
            return None
        diagonal_mm = self.focal_plane_pitch_um / 1e3 * math.hypot(self.width_px, self.height_px)
        return self.focal_length_mm / diagonal_mm * FULL_FRAME_DIAGONAL_MM

    @property
    def focus_from_lens_m(self) -> float | None:
        """Where the lens was focused, if ``subject_distance_m`` counts from the sensor; None where none is so near."""
        distance_m, focal_length_mm = self.subject_distance_m, self.focal_length_mm
        if distance_m is None or focal_length_mm is None or distance_m < 4 * focal_length_mm / 1e3:
            return None
        return thin_lens.focus_from_lens(distance_m, focal_length_mm / 1e3)


def read_exif(exif: bytes) -> Exif:
    """The tags of an EXIF block (``Header.exif``); empty where there is none, or none that can be read."""
    try:
        main, shot = exif_directories(exif)
        body = Exif(make=_text(main, MAKE), model=_text(main, MODEL))
        return body if shot is None else _with_shot(body, shot)
    except (struct.error, InvalidImage):
        return Exif()


def thumbnail_in(exif: bytes) -> bytes:
    """The small JPEG in an EXIF block; empty without one. Raises as ``TiffDirectory`` does."""
    start = next(TiffDirectory(exif).following(1), None)
    if start is None:
        return b""
    small = TiffDirectory(exif, start)
    at, size = small.first(THUMBNAIL_START), small.first(THUMBNAIL_BYTES)
    return exif[at : at + size]


def _with_shot(body: Exif, shot: TiffDirectory) -> Exif:
    width, height = shot.number(WIDTH), shot.number(HEIGHT)
    return replace(
        body,
        lens=_text(shot, LENS_MODEL),
        focal_length_mm=shot.number(FOCAL_LENGTH),
        focal_length_35mm=shot.number(FOCAL_LENGTH_35MM),
        f_number=shot.number(F_NUMBER),
        subject_distance_m=shot.number(SUBJECT_DISTANCE, math.inf),
        digital_zoom=shot.number(DIGITAL_ZOOM),
        width_px=int(width) if width else None,
        height_px=int(height) if height else None,
        focal_plane_pitch_um=_pitch_um(shot),
        rendering=RENDERINGS.get(int(shot.number(RENDERED) or 0)),
    )


def _pitch_um(shot: TiffDirectory) -> float | None:
    pixels_per_unit, unit = shot.number(PLANE_RESOLUTION), shot.number(PLANE_UNIT) or 2
    if pixels_per_unit is None or unit not in MM_PER_UNIT:
        return None
    return 1e3 * MM_PER_UNIT[int(unit)] / pixels_per_unit


def _text(directory: TiffDirectory, tag: int) -> str | None:
    text = "".join(letter for letter in directory.text(tag) if letter.isprintable())
    return text.strip()[:MOST_TEXT] or None
