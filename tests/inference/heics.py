"""HEIC files: the boxes by hand, around a picture that an encoder made once, for no codec here writes HEVC."""

import struct
from base64 import b64decode

HVCC = b64decode(
    "AQQIAAAAnjgAAAAAHvAA/P/4+AAADwNgAAEAF0ABDAH//wQIAAADAJ44AAADAAAeugJAYQABACpCAQEECAAAAwCeOAAAAwAAHpAEECCy3VyU1zcBDQYEAAAD"
    "AGQAAAMABCBiAAEACEQBwXMYMAiQ"
)
# ``corners()`` of 64x48 pixels, filled up to 64x64
CODED = b64decode(
    "AAABKigBrwY4Wve238zgf//5Wm+h/euKidFb8aVjaq+5AjffwOd//6yYj3gPv4lOiKGcK1CvR5BP9oXvbr8Q3I6sr7pTBA6LN3exXHIQ39El9OlIjHE/eWC0"
    "Ywt/vQSoB3TbBNdWgHVFcDhz8xv3/ff/0igP/7TxHfzCGSdf3wRsPsrIse6Ri5finIX+aJo/4e+2IZf53gwH5Y+i7R6H+hOh++IgGQrqxbXAJjqqtZ8TvnyL"
    "sCaB72xPXFKDTLSzTNaMSZcS+6I6OXGbguWXzablLax8MuofmH9ecXcSz7Cf8t8QDQaU9dVrrJ/0dkaPsgRLX92Z5RptLxiNzz6jJFra7dnHsrALLOzqDALX"
    "SQHlQCb9ExXXaveGWF/0vvPtg+jXQfOGGtRU/hhivEA="
)
CROP = struct.pack(">8I", 64, 1, 48, 1, 0, 1, 2**32 - 16, 2)


def box(name: bytes, *content: bytes) -> bytes:
    """A box, its length in front."""
    body = b"".join(content)
    return struct.pack(">I4s", len(body) + 8, name) + body


def whole(name: bytes, *content: bytes, version: int = 0) -> bytes:
    """A box with a version and no flags."""
    return box(name, bytes([version, 0, 0, 0]), *content)


def heic(
    quarters_left: int | None = None,
    mirror_axis: int | None = None,
    *,
    stated: tuple[int, int] = (64, 64),
    crop: bytes | None = CROP,
    exif: bytes = b"",
    colour: bytes = b"",
    version: int = 0,
) -> bytes:
    """``corners()``, turned to the left by quarters and then mirrored by whoever decodes it.

    EXIF, if any, is listed in a table of places of that version; ``colour`` is the content of a ``colr`` property.
    """
    properties = [box(b"hvcC", HVCC), whole(b"ispe", struct.pack(">II", *stated))]
    if colour:
        properties.append(box(b"colr", colour))
    if crop is not None:
        properties.append(box(b"clap", crop))
    if quarters_left is not None:
        properties.append(box(b"irot", bytes([quarters_left])))
    if mirror_axis is not None:
        properties.append(box(b"imir", bytes([mirror_axis])))
    links = bytes([len(properties), *(0x80 | number for number in range(1, len(properties) + 1))])
    kind = box(b"ftyp", b"heic", bytes(4), b"mif1heic")

    told = bytes(4) + exif
    items = [(b"hvc1", CODED), *([(b"Exif", told)] if exif else [])]

    def meta(offset: int) -> bytes:
        number = ">I" if version == 2 else ">H"
        places, names = [], []
        for item, (name, stored) in enumerate(items, 1):
            method = b"" if version == 0 else bytes(2)
            at = struct.pack(">HII", 1, offset, len(stored))
            places.append(struct.pack(number, item) + method + bytes(2) + at)
            names.append(whole(b"infe", struct.pack(">HH", item, 0), name, b"\0", version=2))
            offset += len(stored)
        return whole(
            b"meta",
            whole(b"hdlr", bytes(4), b"pict", bytes(13)),
            whole(b"pitm", struct.pack(">H", 1)),
            whole(b"iloc", bytes([0x44, 0]), struct.pack(number, len(items)), *places, version=version),
            whole(b"iinf", struct.pack(">H", len(items)), *names),
            box(b"iprp", box(b"ipco", *properties), whole(b"ipma", struct.pack(">IH", 1, 1), links)),
        )

    return kind + meta(len(kind) + len(meta(0)) + 8) + box(b"mdat", *(stored for _, stored in items))
