"""16-bit grey PNG (ISO/IEC 15948), deflated by ISA-L: a fourth of the time that OpenCV's zlib takes, and no larger."""

import struct

import numpy as np
from isal import isal_zlib
from numpy.typing import NDArray

from service.inference.resampling import bands

SIGNATURE = b"\x89PNG\r\n\x1a\n"
BITS, GREY, PLAIN = 16, 0, 0
UP = 2
FAST = 1


def grey_png(levels: NDArray[np.uint16], description: str = "") -> bytes:
    """The file of levels [h, w], each row as its difference to the one above, and a description in Latin-1."""
    height, width = levels.shape
    rows = np.empty((height, 1 + 2 * width), np.uint8)
    rows[:, 0] = UP
    above = np.zeros(2 * width, np.uint8)
    for band in bands(levels.shape):
        octets = levels[band].astype(">u2").view(np.uint8)
        np.subtract(octets[0], above, out=rows[band.start, 1:])
        np.subtract(octets[1:], octets[:-1], out=rows[band, 1:][1:])
        above = octets[-1]
    header = struct.pack(">IIBBBBB", width, height, BITS, GREY, PLAIN, PLAIN, PLAIN)
    deflated = isal_zlib.compress(rows.data, FAST)
    text = b"Description\0" + description.encode("latin-1")
    chunks = ((b"IHDR", header), (b"tEXt", text), (b"IDAT", deflated), (b"IEND", b""))
    return SIGNATURE + b"".join(_chunk(kind, content) for kind, content in chunks)


def _chunk(kind: bytes, content: bytes) -> bytes:
    checksum = isal_zlib.crc32(content, isal_zlib.crc32(kind))
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", checksum)
