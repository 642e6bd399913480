"""What a HEIC's or AVIF's boxes say of its primary picture: the size, curve and turn to upright; and its EXIF."""

import struct
from collections.abc import Iterator
from io import BytesIO
from itertools import islice
from typing import Literal

from service.errors import InvalidImage
from service.inference.tone_curve import CURVES, MOST_PROFILE_BYTES, SRGB, curve_of_profile

HEIC_BRANDS = frozenset({b"heic", b"heix", b"heim", b"heis", b"mif1"})
AVIF_BRANDS, ANIMATED = frozenset({b"avif", b"avis"}), b"avis"
MOST_BRANDS = 32
MOST_BOXES = 20_000
MOST_LISTS = 8
# where the corners of the stored picture, numbered row by row, stand upright, by EXIF orientation
ORIENTATIONS = {
    (0, 1, 2, 3): 1,
    (1, 0, 3, 2): 2,
    (3, 2, 1, 0): 3,
    (2, 3, 0, 1): 4,
    (0, 2, 1, 3): 5,
    (2, 0, 3, 1): 6,
    (3, 1, 2, 0): 7,
    (1, 3, 0, 2): 8,
}
QUARTER_LEFT, TOP_TO_BOTTOM, LEFT_TO_RIGHT = (1, 3, 0, 2), (2, 3, 0, 1), (1, 0, 3, 2)

Corners = tuple[int, int, int, int]


def kind_of(data: bytes) -> Literal["heic", "avif"] | None:
    """By its brands, of which a file of the standard's own, mif1, has others too; None for none of these files."""
    if data[4:8] != b"ftyp":
        return None
    end = min(int.from_bytes(data[:4], "big"), 16 + 4 * MOST_BRANDS, len(data))
    brands = {data[8:12], *(data[at : at + 4] for at in range(16, end, 4))}
    if brands & AVIF_BRANDS:
        return "avif"
    return "heic" if data[8:12] in HEIC_BRANDS else None


def is_animated(data: bytes) -> bool:
    """Whether it is an AVIF of several frames."""
    return data[8:12] == ANIMATED


def primary_picture(data: bytes) -> tuple[int, int, int]:
    """Width and height as stored, and the turn to upright as an EXIF orientation; EXIF's own the standard ignores.

    Raises ``InvalidImage``, and ``IndexError`` or ``struct.error`` where the bytes end inside a box.
    """
    width, height, corners = 0, 0, (0, 1, 2, 3)
    for name, at in _primary_properties(data):
        if name == b"ispe":
            width, height = struct.unpack_from(">II", data, at + 4)
        elif name == b"clap":
            across, across_by, down, down_by = struct.unpack_from(">4I", data, at)
            width, height = across // max(1, across_by), down // max(1, down_by)
        elif name == b"irot":
            for _ in range(data[at] & 3):
                width, height, corners = height, width, _moved(corners, QUARTER_LEFT)
        elif name == b"imir":
            corners = _moved(corners, LEFT_TO_RIGHT if data[at] & 1 else TOP_TO_BOTTOM)
    orientation = ORIENTATIONS[corners]
    return (height, width, orientation) if orientation >= 5 else (width, height, orientation)


def curve_of_primary(data: bytes) -> int:
    """The number in H.273 of the curve that the primary picture's values have; raises as ``primary_picture`` does."""
    told = (_curve(data, at) for name, at in _primary_properties(data) if name == b"colr")
    return next((curve for curve in told if curve in CURVES), SRGB)


def exif_item(data: bytes) -> bytes:
    """The EXIF of a file that ``primary_picture`` takes, without a signature; empty where none can be found.

    Boxes and fields are those of ISO/IEC 14496-12, 8.11.3 and 8.11.6, and ISO/IEC 23008-12, A.2.1.
    """
    try:
        start, end = next((start, end) for name, start, end in _boxes(data, 0, len(data)) if name == b"meta")
        inner = {name: (start, end) for name, start, end in _boxes(data, start + 4, end)}
        item = _item_of_kind(data, *inner[b"iinf"], b"Exif")
        at, length = _place(data, inner[b"iloc"][0], item)
        (skipped,) = struct.unpack_from(">I", data, at)
        return data[at + 4 + skipped : at + length]
    except (StopIteration, LookupError, OverflowError, struct.error, InvalidImage):
        return b""


def _item_of_kind(data: bytes, at: int, end: int, kind: bytes) -> int:
    """The number of the first item of a kind; ``LookupError`` without one."""
    for _, start, _ in _boxes(data, at + (8 if data[at] else 6), end):
        form = {2: ">HH4s", 3: ">IH4s"}.get(data[start])
        if form:
            item, _, stated = struct.unpack_from(form, data, start + 4)
            if stated == kind:
                return int(item)
    raise LookupError(kind)


def _place(data: bytes, at: int, item: int) -> tuple[int, int]:
    """Where in the file an item's first extent begins, and its length; ``LookupError`` where it is not in the file."""
    version, sizes = data[at], struct.unpack_from(">H", data, at + 4)[0]
    offset_size, length_size, base_size, index_size = (sizes >> shift & 15 for shift in (12, 8, 4, 0))
    stream = BytesIO(data)
    stream.seek(at + 6)

    def number(size: int) -> int:
        return int.from_bytes(stream.read(size), "big")

    id_size, index_size = 4 if version == 2 else 2, index_size if version else 0
    for _ in range(min(number(id_size), MOST_BOXES)):
        found, method = number(id_size), number(2) & 15 if version else 0
        number(2)  # of another file, which nothing here is in
        base, extents = number(base_size), number(2)
        if found == item and method == 0 and extents:
            number(index_size)
            return base + number(offset_size), number(length_size)
        stream.seek(extents * (index_size + offset_size + length_size), 1)
    raise LookupError(item)


def _curve(data: bytes, at: int) -> int:
    """What a ``colr`` property says, by a number or by a profile, which ends with its box."""
    if data[at : at + 4] == b"nclx":
        return int.from_bytes(data[at + 6 : at + 8], "big")
    (size,) = struct.unpack_from(">I", data, at - 8)
    return curve_of_profile(data[at + 4 : at - 8 + min(size, MOST_PROFILE_BYTES)])


def _moved(corners: Corners, order: Corners) -> Corners:
    return corners[order[0]], corners[order[1]], corners[order[2]], corners[order[3]]


def _primary_properties(data: bytes) -> Iterator[tuple[bytes, int]]:
    top = {name: (start, end) for name, start, end in _boxes(data, 0, len(data))}
    if b"meta" not in top:
        raise InvalidImage(f"The {kind_of(data)} file holds no picture.")
    start, end = top[b"meta"]
    inner = {name: (start, end) for name, start, end in _boxes(data, start + 4, end)}
    if not {b"pitm", b"iprp"} <= inner.keys():
        raise InvalidImage(f"The {kind_of(data)} file holds no picture.")
    if b"mdat" not in top and b"idat" not in inner:
        raise InvalidImage.cut_off(str(kind_of(data)))
    at = inner[b"pitm"][0]
    primary = int.from_bytes(data[at + 4 : at + (8 if data[at] else 6)], "big")
    yield from _properties(data, *inner[b"iprp"], primary)


def _properties(data: bytes, start: int, end: int, item: int) -> Iterator[tuple[bytes, int]]:
    """An item's properties in the order they apply, each with where its content begins."""
    held: list[tuple[bytes, int]] = []
    for name, at, stop in islice(_boxes(data, start, end), MOST_LISTS):
        if name == b"ipco":
            held = [(each, begins) for each, begins, _ in _boxes(data, at, stop)]
        elif name == b"ipma":
            for index in _associations(data, at, item):
                if 1 <= index <= len(held):
                    yield held[index - 1]


def _associations(data: bytes, at: int, item: int) -> Iterator[int]:
    """The numbers of an item's properties; the bit above them says which a reader must know."""
    form, id_size = ">H" if data[at + 3] & 1 else ">B", 4 if data[at] else 2
    size = struct.calcsize(form)
    (count,) = struct.unpack_from(">I", data, at + 4)
    at += 8
    for _ in range(min(count, MOST_BOXES)):
        found, links = int.from_bytes(data[at : at + id_size], "big"), data[at + id_size]
        at += id_size + 1
        if found == item:
            essential = 1 << 8 * size - 1
            for place in range(at, at + size * links, size):
                yield struct.unpack_from(form, data, place)[0] & ~essential
            return
        at += size * links


def _boxes(data: bytes, at: int, end: int) -> Iterator[tuple[bytes, int, int]]:
    """The boxes of a stretch: name, where the content begins, where it ends."""
    for _ in range(MOST_BOXES):
        if at + 8 > end:
            return
        size, name = struct.unpack_from(">I4s", data, at)
        start = at + 8
        if size == 1:
            (size,) = struct.unpack_from(">Q", data, start)
            start += 8
        stop = at + size if size else end
        if stop > end:
            raise InvalidImage.cut_off(str(kind_of(data)))
        if stop < start:
            raise InvalidImage(f"The {kind_of(data)} file is damaged: one of its boxes has no room for its head.")
        yield name, start, stop
        at = stop
    raise InvalidImage(f"The {kind_of(data)} file has more than {MOST_BOXES} boxes.")
