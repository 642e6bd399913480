"""The directories of a TIFF structure, which is the form of EXIF, too, and of most raw files (TIFF 6.0, 1992).

What leads out of the bytes at hand is not read, and ``struct.error`` where it had to be.
"""

import math
import struct
from collections.abc import Iterator
from typing import Any

from service.errors import InvalidImage

WIDTH, HEIGHT, ORIENTATION, EXIF_DIRECTORY = 256, 257, 274, 34665
STORES = ((273, 279), (324, 325))  # where strips and tiles begin, and their bytes
WHOLE_NUMBERS = {1: "B", 3: "H", 4: "I", 13: "I"}
TYPE_BYTES = dict(enumerate((0, 1, 1, 2, 4, 8, 1, 1, 2, 4, 8, 4, 8, 4, 0, 0, 8, 8, 8)))
# with those that are no whole numbers: a rational is two
NUMBERS = {**WHOLE_NUMBERS, 5: "II", 10: "ii", 11: "f", 12: "d"}
INFINITY = 2**32 - 1  # above a fraction
TEXT, MOST_TEXT = 2, 256
MOST_VALUES = 100_000
MOST_ENTRIES = 4_096


class TiffDirectory:
    """A directory of a TIFF structure: the first, or the one at ``start``. Raises ``InvalidImage`` where it is none."""

    def __init__(self, data: bytes, start: int | None = None) -> None:
        if data[:4] not in (b"II*\x00", b"MM\x00*"):
            raise InvalidImage("The file has no TIFF header.")
        self._data = data
        self._order = "<" if data[:2] == b"II" else ">"
        if start is None:
            (start,) = self._unpack("I", 4)
        (count,) = self._unpack("H", start)
        if count > MOST_ENTRIES:
            raise InvalidImage(f"The file's TIFF directory states {count} entries.")
        self._end = start + 2 + 12 * count
        self._places = range(start + 2, self._end, 12)
        # of a tag that comes twice, decoders take the first
        self._entries = {self._unpack("H", at)[0]: at for at in reversed(self._places)}

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, 0 where they are missing."""
        return self.first(WIDTH), self.first(HEIGHT)

    @property
    def orientation(self) -> int:
        """EXIF's, 1..8; 1 where it says none of these."""
        value = self.first(ORIENTATION, 1)
        return value if 1 <= value <= 8 else 1

    def following(self, most: int) -> Iterator[int]:
        """Where the directories after this one begin, as far as they can be read."""
        at = self._end
        for _ in range(most):
            try:
                (start,) = self._unpack("I", at)
                (count,) = self._unpack("H", start) if start else (0,)
            except struct.error:
                return
            if not count:
                return
            yield start
            at = start + 2 + 12 * count

    def require_stored(self) -> None:
        """Raises ``InvalidImage`` where its picture leads out of the file."""
        if any(offset + count > len(self._data) for offset, count in self._stored()):
            raise InvalidImage.cut_off("tiff")

    def require_own_bytes(self) -> None:
        """Raises ``InvalidImage`` where parts share bytes: each costs a decoder its time and memory anew."""
        stated = (self._unpack("HI", at + 2) for at in self._places)
        described = sum(TYPE_BYTES.get(kind, 0) * count for kind, count in stated)
        if described + sum(count for _, count in self._stored()) > len(self._data):
            raise InvalidImage("The parts that the tiff file states are larger than the file: store it anew.")

    def _stored(self) -> Iterator[tuple[int, int]]:
        """Where the parts of its picture begin, and their bytes."""
        for offsets, counts in STORES:
            yield from zip(self.values(offsets), self.values(counts), strict=False)

    def _unpack(self, form: str, at: int) -> tuple[Any, ...]:
        return struct.unpack_from(self._order + form, self._data, at)

    def _entry(self, tag: int) -> tuple[int, int, int]:
        """A tag's type, how many values it has, and where the first stands in the file; zeros without the tag."""
        entry = self._entries.get(tag)
        if entry is None:
            return 0, 0, 0
        kind, count = self._unpack("HI", entry + 2)
        size = struct.calcsize("=" + ("s" if kind == TEXT else NUMBERS.get(kind, "I"))) * count
        return kind, count, entry + 8 if size <= 4 else self._unpack("I", entry + 8)[0]

    def offset_of(self, tag: int) -> int | None:
        """Where a tag's first value stands in the file, or None without the tag."""
        return self._entry(tag)[2] if tag in self._entries else None

    def values(self, tag: int) -> tuple[int, ...]:
        """A tag's whole numbers; empty without the tag or for another type."""
        kind, count, at = self._entry(tag)
        if kind not in WHOLE_NUMBERS:
            return ()
        if count > MOST_VALUES:
            raise InvalidImage(f"The tiff file states {count} values for tag {tag}.")
        return self._unpack(f"{count}{WHOLE_NUMBERS[kind]}", at)

    def first(self, tag: int, without: int = 0) -> int:
        """The first of a tag's whole numbers, or what stands for none."""
        return next(iter(self.values(tag)), without)

    def bytes_of(self, tag: int) -> bytes:
        """A tag's bytes, from where they begin; empty without the tag."""
        _, count, at = self._entry(tag)
        return self._data[at : at + count]

    def number(self, tag: int, infinity: float | None = None) -> float | None:
        """A tag's first number, of any type; None without one that is positive and finite (all ones: ``infinity``)."""
        kind, _, at = self._entry(tag)
        if kind not in NUMBERS:
            return None
        over, *under = self._unpack(NUMBERS[kind], at)
        if over == INFINITY:
            return infinity
        value = over / (under[0] or math.nan) if under else over
        return value if 0 < value < math.inf else None

    def text(self, tag: int) -> str:
        """A tag's text up to its end; empty without one."""
        kind, count, at = self._entry(tag)
        if kind != TEXT:
            return ""
        return self._data[at : at + min(count, MOST_TEXT)].partition(b"\0")[0].decode("utf-8", "ignore")


def exif_directories(exif: bytes) -> tuple[TiffDirectory, TiffDirectory | None]:
    """The main directory of an EXIF block and that of the shot; ``InvalidImage`` or ``struct.error`` for no such."""
    main = TiffDirectory(exif)
    start = next(iter(main.values(EXIF_DIRECTORY)), None)
    return main, None if start is None else TiffDirectory(exif, start)


def exif_orientation(exif: bytes) -> int:
    """Orientation 1..8 from an EXIF block; a block that cannot be read says nothing, which is 1."""
    try:
        return TiffDirectory(exif).orientation
    except (struct.error, InvalidImage):
        return 1
