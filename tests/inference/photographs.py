"""Photographs as bytes, made by the codecs themselves or, where no codec writes them, by hand."""

import struct
import zlib
from collections.abc import Iterator, Mapping
from io import BytesIO
from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from service.opencv import cv2

Pixels = NDArray[Any]
Order = Literal["<", ">"]
ExifValue = int | float | str | tuple[int, int]
ExifTags = Mapping[int, ExifValue]


def never_read() -> Iterator[bytes]:
    """A body that nobody may receive."""
    pytest.fail("a photograph that is refused was received")
    yield b""


def corners(height: int = 48, width: int = 64) -> NDArray[np.uint8]:
    """Red top left, green top right, blue bottom left, white bottom right: no two turns look alike."""
    rgb = np.empty((height, width, 3), np.uint8)
    top, left = height // 2, width // 2
    rgb[:top, :left], rgb[:top, left:] = (255, 0, 0), (0, 255, 0)
    rgb[top:, :left], rgb[top:, left:] = (0, 0, 255), (255, 255, 255)
    return rgb


def encoded(kind: str, rgb: Pixels, *options: int) -> bytes:
    """RGB, RGBA or grey pixels in the file format of an extension (``.png``)."""
    bgr = rgb
    if rgb.ndim == 3:
        bgr = rgb[..., [2, 1, 0, 3]] if rgb.shape[2] == 4 else rgb[..., ::-1]
    is_written, body = cv2.imencode(kind, np.ascontiguousarray(bgr), options)
    assert is_written
    return body.tobytes()


def exif_block(orientation: int, order: Order = "<") -> bytes:
    """A TIFF structure whose only entry is the orientation."""
    mark = b"II*\x00" if order == "<" else b"MM\x00*"
    entry = struct.pack(order + "HHIHH", 274, 3, 1, orientation, 0)
    return mark + struct.pack(order + "IH", 8, 1) + entry + struct.pack(order + "I", 0)


def exif_of(main: ExifTags, shot: ExifTags, place: ExifTags | None = None) -> bytes:
    """A TIFF structure with these tags in its main, EXIF and GPS directories: numbers, text and rationals."""
    out = bytearray(b"II*\x00\x00\x00\x00\x00")
    pointers: dict[int, ExifValue] = {0x8769: _add_directory(out, shot)}
    if place:
        pointers[0x8825] = _add_directory(out, place)
    out[4:8] = struct.pack("<I", _add_directory(out, {**main, **pointers}))
    return bytes(out)


def _add_directory(out: bytearray, tags: ExifTags) -> int:
    entries = b""
    for tag, value in sorted(tags.items()):
        if isinstance(value, int):
            entries += struct.pack("<HHII", tag, 4, 1, value)
            continue
        kind, count, stored = _stored(value)
        if len(stored) <= 4:
            entries += struct.pack("<HHI", tag, kind, count) + stored.ljust(4, b"\x00")
        else:
            entries += struct.pack("<HHII", tag, kind, count, len(out))
            out += stored
    offset = len(out)
    out += struct.pack("<H", len(tags)) + entries + struct.pack("<I", 0)
    return offset


def _stored(value: float | str | tuple[int, int]) -> tuple[int, int, bytes]:
    """Type, count and bytes of a value that has no place in its entry."""
    if isinstance(value, str):
        text = value.encode() + b"\x00"
        return 2, len(text), text
    return (12, 1, struct.pack("<d", value)) if isinstance(value, float) else (5, 1, struct.pack("<II", *value))


def exif_with_thumbnail(small: bytes) -> bytes:
    """A TIFF structure whose second directory is of a small JPEG."""
    out = bytearray(b"II*\x00\x00\x00\x00\x00")
    first = _add_directory(out, {271: "Maker"})
    out[4:8] = struct.pack("<I", first)
    start = len(out)
    out += small
    second = _add_directory(out, {513: start, 514: len(small)})
    struct.pack_into("<I", out, first + 2 + 12, second)
    return bytes(out)


def with_exif(data: bytes, exif: bytes) -> bytes:
    """A JPEG with an EXIF block."""
    payload = b"Exif\x00\x00" + exif
    return data[:2] + b"\xff\xe1" + struct.pack(">H", len(payload) + 2) + payload + data[2:]


def jpeg(rgb: Pixels, orientation: int | None = None, order: Order = "<", quality: int = 98) -> bytes:
    """A JPEG, with an EXIF orientation if one is given."""
    data = encoded(".jpg", rgb, cv2.IMWRITE_JPEG_QUALITY, quality)
    return data if orientation is None else with_exif(data, exif_block(orientation, order))


def png_chunk(name: bytes, payload: bytes) -> bytes:
    return struct.pack(">I", len(payload)) + name + payload + struct.pack(">I", zlib.crc32(name + payload))


def png(rgb: Pixels, orientation: int | None = None) -> bytes:
    """A PNG, with an EXIF orientation if one is given."""
    data = encoded(".png", rgb)
    if orientation is None:
        return data
    return data[:33] + png_chunk(b"eXIf", exif_block(orientation)) + data[33:]


def webp(rgb: Pixels, orientation: int | None = None, exif: bytes | None = None) -> bytes:
    """A lossless WebP, with an EXIF orientation or EXIF block if one is given."""
    data = encoded(".webp", rgb, cv2.IMWRITE_WEBP_QUALITY, 101)
    if orientation is not None:
        exif = exif_block(orientation)
    if exif is None:
        return data
    start = data.index(b"VP8L")
    size: bytes = (rgb.shape[1] - 1).to_bytes(3, "little") + (rgb.shape[0] - 1).to_bytes(3, "little")
    extended = b"VP8X" + struct.pack("<I", 10) + b"\x08\x00\x00\x00" + size
    chunks = extended + data[start:] + b"EXIF" + struct.pack("<I", len(exif)) + exif + bytes(len(exif) % 2)
    return b"RIFF" + struct.pack("<I", len(chunks) + 4) + b"WEBP" + chunks


def avif(rgb: Pixels, orientation: int = 1, *others: Pixels) -> bytes:
    """An AVIF of EXIF that says its maker, turned by its own boxes; with others it is one of several frames."""
    exif, body = Image.Exif(), BytesIO()
    exif[271], exif[274] = "Maker", orientation
    pictures = [Image.fromarray(picture) for picture in (rgb, *others)]
    options = {"quality": 95, "subsampling": "4:4:4", "speed": 10, "exif": exif.tobytes(), "save_all": bool(others)}
    pictures[0].save(body, "AVIF", append_images=pictures[1:], **options)
    return body.getvalue()


def tiff(rgb: NDArray[np.uint8] | NDArray[np.uint16], orientation: int = 1, order: Order = "<") -> bytes:
    """An uncompressed RGB TIFF of one strip."""
    height, width, _ = rgb.shape
    stored = rgb.astype(rgb.dtype.newbyteorder(order)).tobytes()
    bits = rgb.dtype.itemsize * 8
    mark = b"II*\x00" if order == "<" else b"MM\x00*"
    tags = [
        (256, 3, 1, width),
        (257, 3, 1, height),
        (258, 3, 3, 8),
        (259, 3, 1, 1),
        (262, 3, 1, 2),
        (273, 4, 1, 14),
        (274, 3, 1, orientation),
        (277, 3, 1, 3),
        (278, 3, 1, height),
        (279, 4, 1, len(stored)),
    ]
    head = mark + struct.pack(order + "I", 14 + len(stored)) + struct.pack(order + "HHH", bits, bits, bits)
    directory = struct.pack(order + "H", len(tags))
    for tag, kind, count, value in tags:
        is_short = kind == 3 and count == 1
        directory += struct.pack(order + "HHI", tag, kind, count)
        directory += struct.pack(order + "HH", value, 0) if is_short else struct.pack(order + "I", value)
    return head + stored + directory + struct.pack(order + "I", 0)


def tiff_with(data: bytes, tags: dict[int, tuple[int, int, int]]) -> bytes:
    """A little-endian TIFF with more tags: the type, count and value or place of each."""
    start = int.from_bytes(data[4:8], "little")
    count = int.from_bytes(data[start : start + 2], "little")
    entries = [data[at : at + 12] for at in range(start + 2, start + 2 + 12 * count, 12)]
    entries += [struct.pack("<HHII", tag, *stated) for tag, stated in tags.items()]
    entries.sort(key=lambda entry: int.from_bytes(entry[:2], "little"))  # stable: what was there comes first
    directory = struct.pack("<H", len(entries)) + b"".join(entries) + bytes(4)
    return data[:4] + len(data).to_bytes(4, "little") + data[8:] + directory


def hostile_png(side: int = 20_000, bits: int = 1) -> bytes:
    """A valid PNG of side x side black pixels, whole hundreds: some hundred kB at most, and gigabytes decoded."""
    rows = bytes(100 * (1 + -(-side * bits // 8)))
    # rows that are packed on their own need be packed once
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    packed = packer.compress(rows) + packer.flush(zlib.Z_FULL_FLUSH)
    checksum = 1
    for _ in range(side // 100):
        checksum = zlib.adler32(rows, checksum)
    pixels = b"\x78\xda" + packed * (side // 100) + b"\x03\x00" + checksum.to_bytes(4, "big")
    header = struct.pack(">IIBBBBB", side, side, bits, 0, 0, 0, 0)
    chunks = png_chunk(b"IHDR", header) + png_chunk(b"IDAT", pixels) + png_chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + chunks
