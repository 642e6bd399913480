"""What an image file says of itself, without decoding a pixel: kind, size, orientation, and whether it ends.

Each parser walks the file's structure once and believes no length that leads out of the bytes at hand.
All raise ``InvalidImage`` for a file that is cut off or not of the form its kind prescribes.
"""

import re
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

from service.errors import InvalidImage, UnsupportedKind
from service.inference.heic import curve_of_primary, exif_item, is_animated, kind_of, primary_picture
from service.inference.tiff import ORIENTATION, TiffDirectory, exif_orientation
from service.inference.tone_curve import CURVES, LINEAR, SRGB, curve_of_profile, unpacked_profile
from service.inference.vp8 import quality as quality_of_vp8

Kind = Literal["jpeg", "png", "tiff", "webp", "heic", "avif", "raw"]

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
PNG_CLEAR = b"tRNS"  # which of its colours are transparent
PNG_READ = frozenset({b"IHDR", b"eXIf", b"acTL", b"cICP", b"iCCP", b"sRGB", b"gAMA", b"iTXt", PNG_CLEAR})
PNG_ALPHA = 4  # in the number of its kind of colours
PNG_LINEAR = struct.pack(">I", 100_000)  # gamma 1
PNG_GREY, PNG_PALETTE = 0, 3
PNG_XMP = b"XML:com.adobe.xmp\x00"
PNG_ANCILLARY = 0x20  # of a chunk's first letter: no part of the picture (ISO/IEC 15948, 5.4)
EXIF_SIGNATURE = b"Exif\x00\x00"
XMP_SIGNATURE = b"http://ns.adobe.com/xap/1.0/\x00"
ICC_SIGNATURE, ICC_NUMBERING = b"ICC_PROFILE\x00", 2
# of RAF, ORF, RW2, X3F and CR3
OTHER_RAW = re.compile(rb"FUJIFILMCCD-RAW|IIR[OS]|MMOR|IIU\0|FOVb|....ftypcrx ", re.DOTALL)
BIG_TIFF = (b"II+\x00", b"MM\x00+")
WEBP_CLEAR = 0x10  # of a lossless one's fifth byte: alpha is used
JPEG_MARKER_IN_SCAN = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]")
JPEG_FILL = re.compile(rb"\xff*(?=\xff)")
JPEG_END, JPEG_SCAN, JPEG_STEPS, JPEG_APP1, JPEG_APP2 = 0xD9, 0xDA, 0xDB, 0xE1, 0xE2
JPEG_STEPS_OF_50 = 3688  # all 64 of luminance together, where quality is 50 (ITU-T T.81, annex K)
JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
JPEG_BARE = frozenset({0x01, 0xD8, *range(0xD0, 0xD8)})
TIFF_BITS, TIFF_SAMPLE_FORMAT = 258, 339
TIFF_NEW_SUBFILE = 254
TIFF_PLANAR = 284
TIFF_PHOTOMETRIC, TIFF_SUB_DIRECTORIES, TIFF_DNG_VERSION = 262, 330, 50706
# photometric interpretations of sensor values: a filter array, and the same after demosaicing
TIFF_SENSOR = frozenset({32803, 34892})
TIFF_PALETTE = 3
TIFF_RGB, TIFF_RGBA_SAMPLES = 2, 4
TIFF_EXTRA_SAMPLES, TIFF_ALPHA = 338, frozenset({1, 2})
CR2_MARK = b"CR"
MOST_DIRECTORIES = 16
TIFF_PROFILE, TIFF_XMP = 34675, 700
TIFF_TILE_SIZE = (322, 323)
TIFF_SMALL_TILE_PIXELS = 2**20
# of one file: a part costs its reader time, and a scan of a jpeg costs its decoder a pass over the whole picture
MOST_PARTS = 20_000
MOST_SCANS = 64


@dataclass(frozen=True, slots=True)
class Header:
    """Stored size in pixels, before orientation (EXIF, 1..8) is applied; ``exif`` is the EXIF, without a signature.

    Of a tiff or raw file that is the file. ``has_more``: other pages or frames follow. ``curve``: what its values have,
    by H.273's number. ``quality``: of a jpeg or lossy webp, to 100, as most programs count it. ``xmp``: not of
    heic, avif and raw. ``has_few_colours``: of a palette, or of less than 8 bits. ``has_alpha``: parts may be
    transparent; not told of heic and avif.
    """

    kind: Kind
    width_px: int
    height_px: int
    orientation: int = 1
    orientation_offset: int | None = None
    exif: bytes = b""
    has_more: bool = False
    curve: int = SRGB
    quality: float | None = None
    xmp: bytes = b""
    has_few_colours: bool = False
    has_alpha: bool = False

    @property
    def other_curve(self) -> str | None:
        """The name of a curve that is far from sRGB; None where it is about that, as of nearly all photographs."""
        return CURVES.get(self.curve)


def sniff(data: bytes) -> Kind | None:
    """The kind by its magic bytes, or None for one that is not listed."""
    if data.startswith(b"\xff\xd8\xff"):
        return "jpeg"
    if data.startswith(PNG_SIGNATURE):
        return "png"
    if data[:4] in (b"II*\x00", b"MM\x00*"):
        return "tiff"
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        return "webp"
    return kind_of(data)


def read_header(data: bytes) -> Header:
    """The header of a photograph; ``UnsupportedKind`` for anything else. What a tiff holds may be a raw file."""
    if not data:
        raise InvalidImage("The file is empty: send the bytes of one photograph.")
    kind = sniff(data)
    if kind is None:
        if OTHER_RAW.match(data):
            raise UnsupportedKind("Raw files of this kind are not read: convert it to DNG, or send the camera's JPEG.")
        if data[:4] in BIG_TIFF:
            raise UnsupportedKind("A BigTIFF is not read: store it as a TIFF of the usual form.")
        raise UnsupportedKind(
            "This is not a JPEG, PNG, TIFF, WebP, HEIC, AVIF or DNG file: send a photograph of one of these kinds."
        )
    try:
        header = PARSERS[kind](data)
    except (struct.error, IndexError) as exc:
        raise InvalidImage.cut_off(kind) from exc
    if header.width_px < 1 or header.height_px < 1:
        raise InvalidImage(f"The {header.kind} file states a size of {header.width_px}x{header.height_px} pixels.")
    return header


def _too_many_parts(kind: str) -> InvalidImage:
    return InvalidImage(f"The {kind} file has more than {MOST_PARTS} parts: store it anew.")


def _jpeg(data: bytes) -> Header:
    size: tuple[int, int] | None = None
    exif = profile = xmp = b""
    quality: float | None = None
    scans = 0
    for marker, payload in _jpeg_segments(data):
        scans += marker == JPEG_SCAN
        if scans > MOST_SCANS:
            raise InvalidImage(f"The jpeg file has more than {MOST_SCANS} scans: store it as a baseline jpeg.")
        if marker in JPEG_FRAMES and size is None:
            height, width = struct.unpack_from(">HH", payload, 1)
            size = (width, height)
        elif marker == JPEG_APP1 and payload.startswith(EXIF_SIGNATURE):
            exif = exif or payload[len(EXIF_SIGNATURE) :]
        elif marker == JPEG_APP1 and payload.startswith(XMP_SIGNATURE):
            xmp = xmp or payload
        elif marker == JPEG_APP2 and payload.startswith(ICC_SIGNATURE):
            profile = profile or payload[len(ICC_SIGNATURE) + ICC_NUMBERING :]
        elif marker == JPEG_STEPS and quality is None:
            quality = _jpeg_quality(payload)
    if size is None:
        raise InvalidImage("The jpeg file holds no picture.")
    curve = curve_of_profile(profile)
    return Header("jpeg", *size, exif_orientation(exif), exif=exif, curve=curve, quality=quality, xmp=xmp)


def _jpeg_quality(tables: bytes) -> float:
    """libjpeg's quality whose steps are as coarse in all as those of the first table, luminance's."""
    steps: tuple[int, ...] = struct.unpack_from(">64H" if tables[0] >> 4 else ">64B", tables, 1)
    coarseness = sum(steps) / JPEG_STEPS_OF_50
    return 50 / coarseness if coarseness > 1 else 100 - 50 * coarseness


def _jpeg_segments(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Every marker with its payload up to the end marker, which a whole file has after its last scan."""
    at = 2
    for _ in range(MOST_PARTS):
        filled = JPEG_FILL.match(data, at)
        at = filled.end() if filled else at
        if data[at] != 0xFF:
            raise InvalidImage("The jpeg file is damaged: no marker where one must be.")
        marker, at = data[at + 1], at + 2
        if marker == JPEG_END:
            return
        if marker in JPEG_BARE:
            continue
        (length,) = struct.unpack_from(">H", data, at)
        yield marker, data[at + 2 : at + length]
        at += length
        if marker == JPEG_SCAN:
            found = JPEG_MARKER_IN_SCAN.search(data, at)
            if found is None:
                raise InvalidImage.cut_off("jpeg")
            at = found.start()
    raise _too_many_parts("jpeg")


def _png(data: bytes) -> Header:
    found: dict[bytes, bytes] = {}
    xmp = b""
    for name, payload in _png_chunks(data):
        if name == b"iTXt":
            xmp = xmp or (payload if payload.startswith(PNG_XMP) else b"")
        else:
            found[name] = payload
    width, height, bits, colours = struct.unpack_from(">IIBB", found.get(b"IHDR", b"").ljust(10, b"\0"))
    exif, frames = found.get(b"eXIf", b""), int.from_bytes(found.get(b"acTL", b"")[:4], "big")
    orientation, has_more = exif_orientation(exif), frames > 1
    few, curve = bits < 8 or colours == PNG_PALETTE, _png_curve(found)
    clear = colours & PNG_ALPHA or (colours != PNG_GREY and PNG_CLEAR in found)  # its decoder knows no other
    header = Header("png", width, height, orientation, None, exif, has_more, curve, xmp=xmp)
    return replace(header, has_few_colours=few, has_alpha=bool(clear))


def _png_curve(found: dict[bytes, bytes]) -> int:
    """By the part that counts most (W3C PNG, third edition, 4.3)."""
    if coded := found.get(b"cICP", b"")[1:2]:
        return coded[0]
    if b"iCCP" in found:
        return curve_of_profile(unpacked_profile(found[b"iCCP"]))
    return LINEAR if b"sRGB" not in found and found.get(b"gAMA") == PNG_LINEAR else SRGB


def _png_chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Every chunk up to the last, each with the checksum it states."""
    for name, start, end in _png_places(data):
        (checksum,) = struct.unpack_from(">I", data, end - 4)
        if zlib.crc32(memoryview(data)[start + 4 : end - 4]) != checksum:
            raise InvalidImage(f"The png file is damaged: its {name.decode('latin-1')!r} part fails its checksum.")
        yield name, data[start + 8 : end - 4] if name in PNG_READ else b""


def _png_places(data: bytes) -> Iterator[tuple[bytes, int, int]]:
    """Every chunk up to the last: its name, where it begins and where it ends."""
    at = len(PNG_SIGNATURE)
    for _ in range(MOST_PARTS):
        length, name = struct.unpack_from(">I4s", data, at)
        end = at + 12 + length
        yield name, at, end
        at = end
        if name == b"IEND":
            return
    raise _too_many_parts("png")


def picture_of_png(data: bytes) -> bytes:
    """A png that ``read_header`` takes without all that its decoder would unpack, and tell the log, for nothing."""
    places = _png_places(data)
    kept = (data[at:end] for name, at, end in places if not name[0] & PNG_ANCILLARY or name == PNG_CLEAR)
    return PNG_SIGNATURE + b"".join(kept)


def _webp(data: bytes) -> Header:
    (length,) = struct.unpack_from("<I", data, 4)
    if length + 8 > len(data):
        raise InvalidImage.cut_off("webp")
    size: tuple[int, int] | None = None
    exif = profile = xmp = b""
    quality: float | None = None
    frames = 0
    clear = False
    at = 12
    for _ in range(MOST_PARTS):
        if at > length:
            break
        name, chunk = struct.unpack_from("<4sI", data, at)
        size = size or _webp_size(name, data[at + 8 : at + 18])
        frames += name == b"ANMF"
        clear |= name == b"ALPH" or (name == b"VP8L" and bool(data[at + 12] & WEBP_CLEAR))
        if name == b"EXIF":
            exif = data[at + 8 : at + 8 + chunk].removeprefix(EXIF_SIGNATURE)
        elif name == b"ICCP":
            profile = data[at + 8 : at + 8 + chunk]
        elif name == b"VP8 " and quality is None:
            quality = quality_of_vp8(data[at + 8 : at + 8 + chunk])
        elif name == b"XMP ":
            xmp = data[at + 8 : at + 8 + chunk]
        at += 8 + chunk + chunk % 2
    else:
        raise _too_many_parts("webp")
    if size is None:
        raise InvalidImage("The webp file holds no picture.")
    curve, orientation = curve_of_profile(profile), exif_orientation(exif)
    return Header("webp", *size, orientation, None, exif, frames > 1, curve, quality, xmp, has_alpha=clear)


def _webp_size(name: bytes, payload: bytes) -> tuple[int, int] | None:
    if name == b"VP8X":
        return 1 + int.from_bytes(payload[4:7], "little"), 1 + int.from_bytes(payload[7:10], "little")
    if name == b"VP8L":
        bits = int.from_bytes(payload[1:5], "little")
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    if name == b"VP8 ":
        width, height = struct.unpack_from("<HH", payload, 6)
        return width & 0x3FFF, height & 0x3FFF
    return None


def _tiff(data: bytes) -> Header:
    directory = TiffDirectory(data)
    directory.require_stored()
    sensor = _sensor_size(data, directory)
    if sensor is not None:
        return Header("raw", *sensor, directory.orientation, exif=data)
    if 3 in directory.values(TIFF_SAMPLE_FORMAT):
        raise UnsupportedKind("A tiff of floating-point numbers is no photograph: send 8 or 16 bits, sRGB.")
    if not {*(directory.values(TIFF_BITS) or [1])} <= {8, 16}:
        raise UnsupportedKind("A tiff must have 8 or 16 bits a channel.")
    directory.require_own_bytes()
    _require_usual(directory)
    _require_tiles(directory)
    at = directory.offset_of(ORIENTATION)
    has_more, curve = _has_more_pages(data, directory), curve_of_profile(directory.bytes_of(TIFF_PROFILE))
    xmp, few = directory.bytes_of(TIFF_XMP), TIFF_PALETTE in directory.values(TIFF_PHOTOMETRIC)
    size, orientation, clear = directory.size, directory.orientation, _has_alpha(directory)
    return Header("tiff", *size, orientation, at, data, has_more, curve, xmp=xmp, has_few_colours=few, has_alpha=clear)


def _has_alpha(directory: TiffDirectory) -> bool:
    is_rgba = len(directory.values(TIFF_BITS)) == TIFF_RGBA_SAMPLES and TIFF_RGB in directory.values(TIFF_PHOTOMETRIC)
    return is_rgba and not TIFF_ALPHA.isdisjoint(directory.values(TIFF_EXTRA_SAMPLES))


def _require_usual(directory: TiffDirectory) -> None:
    """What the decoder takes for something else: a small copy for its picture; in 16 bits colours one after the other,
    and white as 0.
    """
    if _is_small_copy(directory):
        raise UnsupportedKind("The first picture of this tiff is a small copy of another: store the large one alone.")
    if 16 not in directory.values(TIFF_BITS):
        return
    if 2 in directory.values(TIFF_PLANAR) and len(directory.values(TIFF_BITS)) > 1:
        raise UnsupportedKind("A tiff of 16 bits that stores one colour after the other is not read: interleave them.")
    if 0 in directory.values(TIFF_PHOTOMETRIC):
        raise UnsupportedKind("A tiff of 16 bits whose 0 is white is not read: store black as 0.")


def _has_more_pages(data: bytes, first: TiffDirectory) -> bool:
    """Whether pages follow; a smaller copy of the first is none."""
    pages = (TiffDirectory(data, start) for start in first.following(MOST_DIRECTORIES))
    return not all(_is_small_copy(page) for page in pages)


def _is_small_copy(page: TiffDirectory) -> bool:
    return bool(1 & page.first(TIFF_NEW_SUBFILE))


def _require_tiles(directory: TiffDirectory) -> None:
    """Tiles far larger than the picture, which a decoder makes room for, mean harm."""
    width, height = directory.size
    across, down = (directory.first(tag) for tag in TIFF_TILE_SIZE)
    if across * down > max(TIFF_SMALL_TILE_PIXELS, 2 * width * height):
        raise InvalidImage(f"The tiff file states tiles of {across}x{down} pixels for {width}x{height} pixels.")


def _sensor_size(data: bytes, first: TiffDirectory) -> tuple[int, int] | None:
    """The size of the largest picture where the file holds a sensor's values, None for any other tiff."""
    starts = [*first.values(TIFF_SUB_DIRECTORIES)[:MOST_DIRECTORIES], *first.following(MOST_DIRECTORIES)]
    directories = [first, *(TiffDirectory(data, start) for start in starts)]
    is_raw = data[8:10] == CR2_MARK or first.offset_of(TIFF_DNG_VERSION) is not None
    if not is_raw and not any(TIFF_SENSOR & {*each.values(TIFF_PHOTOMETRIC)} for each in directories):
        return None
    for each in directories:
        each.require_stored()
    return max((each.size for each in directories), key=lambda size: size[0] * size[1])


def _heic(data: bytes) -> Header:
    return Header("heic", *primary_picture(data), exif=exif_item(data), curve=curve_of_primary(data))


def _avif(data: bytes) -> Header:
    return replace(_heic(data), kind="avif", has_more=is_animated(data))


PARSERS: dict[Kind, Callable[[bytes], Header]] = {
    "jpeg": _jpeg,
    "png": _png,
    "tiff": _tiff,
    "webp": _webp,
    "heic": _heic,
    "avif": _avif,
}
