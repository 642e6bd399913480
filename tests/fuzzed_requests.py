"""Requests that are nearly right: real small files of every kind, mutated the same way for the same number."""

import json
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from io import BytesIO
from random import Random
from typing import Any

import numpy as np
import tifffile

from service.opencv import cv2
from tests.fake_calibration import SETTINGS
from tests.inference.heics import heic
from tests.inference.photographs import avif, corners, encoded, exif_block, jpeg, png, png_chunk, tiff, webp
from tests.inference.raws import dng, with_preview

SEED = 20261122
ISOLATED = frozenset({"heic", "avif", "raw"})
ISOLATED_SHARE = 0.04
BOUNDARY = b"fuzz"
# what length fields and dimensions are blown up to
VALUES = (0, 1, 0x7F, 0xFF, 0x100, 0x7FFF, 0xFFFF, 0x10000, 25_600, 0x7FFFFFFF, 0x80000000, 0xFFFFFFF0, 0xFFFFFFFF)


@dataclass(frozen=True, slots=True)
class Request:
    """A body and where it goes."""

    path: str
    content_type: str
    body: bytes


def request(number: int) -> Request:
    """The request of this number."""
    random = Random(f"{SEED}-{number}")
    return random.choices((_photograph, _depth_form, _calibration), (6, 1, 1))[0](random)


def _photograph(random: Random) -> Request:
    kind = _kind(random)
    form = random.choice(
        (
            "",
            "&format=json&at=3,3",
            "&format=ply",
            "&format=preview",
            "&roi=1,1,9,9&longest_px=16&format=npz",
            "&known=3,3,1.5",
        )
    )
    return Request(f"/depth?camera=bench{form}", _declared(random, kind), _mutated_file(random, kind))


def _depth_form(random: Random) -> Request:
    kind = _kind(random)
    body = _form((b'name="image"; filename="a.jpg"', _declared(random, kind).encode(), _maybe_mutated(random, kind)))
    return Request("/depth?camera=bench", _form_type(random), _mutated(random, body))


def _calibration(random: Random) -> Request:
    told = json.dumps(SETTINGS).encode()
    if random.random() < 0.6:
        told = _mutated(random, told) if random.random() < 0.5 else json.dumps(_changed(random, SETTINGS)).encode()
    pictures = [
        (b'name="%s"; filename="%d.jpg"' % (role, number), b"image/jpeg", _maybe_mutated(random, _kind(random)))
        for number, role in enumerate(random.choices((b"focused", b"defocused"), k=random.randint(1, 3)))
    ]
    body = _form((b'name="settings"', b"application/json", told), *pictures)
    return Request("/calibrate?camera=fuzzed", _form_type(random), _mutated(random, body, 0.4))


def _kind(random: Random) -> str:
    names = sorted(ISOLATED) if random.random() < ISOLATED_SHARE else sorted(set(FILES) - ISOLATED)
    return random.choice(names)


def _declared(random: Random, kind: str) -> str:
    right = {"heic": "image/heic", "raw": "image/x-adobe-dng"}.get(kind, f"image/{kind}")
    return random.choices((right, random.choice(("image/png", "image/tiff", "", "image/*"))), (4, 1))[0]


def _form(*parts: tuple[bytes, bytes, bytes]) -> bytes:
    heads = (b"Content-Disposition: form-data; %s\r\nContent-Type: %s\r\n\r\n" % part[:2] for part in parts)
    middle = (b"--%s\r\n%s%s\r\n" % (BOUNDARY, head, part[2]) for head, part in zip(heads, parts, strict=True))
    return b"".join(middle) + b"--%s--\r\n" % BOUNDARY


def _form_type(random: Random) -> str:
    odd = ("; charset=undefined", "; charset=utf-16", "; boundary=other", '; charset="', "; charset=\\")
    return f"multipart/form-data; boundary={BOUNDARY.decode()}" + (random.choice(odd) if random.random() < 0.1 else "")


def _changed(random: Random, value: Any) -> Any:
    """JSON with something of another type, size or name at one place."""
    if isinstance(value, dict) and value and random.random() < 0.8:
        key = random.choice(sorted(value))
        return {
            **value,
            random.choice((key, key, key, key.upper(), "más")): _changed(random, value[key]),
        }
    odd: list[Any] = [None, True, -1, 0, 1e308, 10**400, "", "edge", [], {}, [[]] * 9, float("nan"), "x" * 9_000]
    return random.choice(odd)


# photographs


def _files() -> dict[str, list[bytes]]:
    rgb = corners()
    deep = rgb.astype(np.uint16) * 257
    scene = np.random.default_rng(SEED).integers(0, 255, (48, 64, 3), np.uint8)

    def stored(**options: Any) -> bytes:
        out = BytesIO()
        tifffile.imwrite(out, scene, photometric="rgb", metadata=None, **options)
        return out.getvalue()

    lossy = encoded(".webp", scene, cv2.IMWRITE_WEBP_QUALITY, 50)
    return {
        "jpeg": [
            jpeg(rgb, 6),
            jpeg(scene),
            encoded(".jpg", scene, cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
            encoded(".jpg", scene[..., 0]),
            encoded(".jpg", scene, cv2.IMWRITE_JPEG_RST_INTERVAL, 4),
            *map(_with_exif, _looping_exif()),
        ],
        "png": [png(rgb, 6), png(scene), encoded(".png", deep), encoded(".png", scene[..., 0]), _animated(scene)],
        "tiff": [
            tiff(rgb, 6),
            tiff(deep, 3, ">"),
            stored(compression="zlib", predictor=True),
            stored(compression="zlib", tile=(16, 16)),
            stored(rowsperstrip=5),
        ],
        "webp": [webp(rgb, 6), webp(scene), lossy],
        "heic": [heic(3), heic(1, 1), heic(crop=None)],
        "avif": [avif(rgb, 6), avif(rgb, 1, scene)],
        "raw": [dng(6), dng(), with_preview()],
    }


def _with_exif(block: bytes) -> bytes:
    data, payload = jpeg(corners()), b"Exif\x00\x00" + block
    return data[:2] + b"\xff\xe1" + struct.pack(">H", len(payload) + 2) + payload + data[2:]


def _looping_exif() -> Iterator[bytes]:
    """Directories that lead to themselves, to each other and to nowhere, and one of more entries than bytes."""
    block = exif_block(6)
    yield block[:-4] + struct.pack("<I", 8)
    for target in (8, 0, 4, 2**31, 2**32 - 1):
        links = b"".join(struct.pack("<HHII", tag, 4, 1, target) for tag in (274, 330, 34665, 34853, 40965))
        yield b"II*\x00" + struct.pack("<IH", 8, 5) + links + struct.pack("<I", target)
    yield b"MM\x00*" + struct.pack(">IH", 8, 65_535) + bytes(40)


def _animated(rgb: np.ndarray[Any, np.dtype[np.uint8]]) -> bytes:
    """A PNG of two frames."""
    data = png(rgb)
    at = data.index(b"IDAT") - 4
    end = data.index(b"IEND") - 4
    pixels = data[at + 8 : data.index(b"IDAT") + 4 + struct.unpack_from(">I", data, at)[0]]
    frame = struct.pack(">IIIIHHBB", rgb.shape[1], rgb.shape[0], 0, 0, 1, 10, 0, 0)
    first = png_chunk(b"acTL", struct.pack(">II", 2, 0)) + png_chunk(b"fcTL", struct.pack(">I", 0) + frame)
    second = png_chunk(b"fcTL", struct.pack(">I", 1) + frame) + png_chunk(b"fdAT", struct.pack(">I", 2) + pixels)
    return data[:33] + first + data[33:end] + second + data[end:]


FILES = _files()


# mutations


def _maybe_mutated(random: Random, kind: str) -> bytes:
    return _mutated_file(random, kind) if random.random() < 0.7 else random.choice(FILES[kind])


def _mutated_file(random: Random, kind: str) -> bytes:
    data = _mutated(random, random.choice(FILES[kind]))
    return _with_right_checksums(data) if kind == "png" and random.random() < 0.7 else data


def _mutated(random: Random, data: bytes, chance: float = 1.0) -> bytes:
    if random.random() >= chance:
        return data
    changed = bytearray(data)
    for _ in range(random.choice((1, 1, 1, 2, 4))):
        if changed:
            random.choice(MUTATIONS)(random, changed)
    return bytes(changed)


def _flip(random: Random, data: bytearray) -> None:
    for _ in range(random.randint(1, 8)):
        data[random.randrange(len(data))] ^= 1 << random.randrange(8)


def _cut(random: Random, data: bytearray) -> None:
    del data[random.randrange(len(data)) :]


def _blow_up(random: Random, data: bytearray) -> None:
    """Overwrite what may be a length, a size or an offset: mostly in the head, where those stand."""
    reach = len(data) if random.random() < 0.3 else min(len(data), 400)
    width = random.choice((1, 2, 2, 4, 4))
    at = random.randrange(reach)
    value = random.choice(VALUES) & (1 << 8 * width) - 1
    data[at : at + width] = value.to_bytes(width, random.choice(("little", "big")))


def _resize(random: Random, data: bytearray) -> None:
    """State another size, where each kind states it."""
    width, height = random.choices((1, 5, 64, 65, 4_000, 6_000, 25_600, 65_535, 2**31 - 1), k=2)
    if data.startswith(b"\x89PNG"):
        data[16:24] = struct.pack(">II", width, height)
    elif data.startswith(b"\xff\xd8"):
        for frame in (b"\xff\xc0", b"\xff\xc2"):
            at = data.find(frame)
            if at > 0:
                data[at + 5 : at + 9] = struct.pack(">HH", height & 0xFFFF, width & 0xFFFF)
    elif data[8:12] == b"WEBP" and data[12:16] == b"VP8X":
        data[24:30] = (width & 0xFFFFFF).to_bytes(3, "little") + (height & 0xFFFFFF).to_bytes(3, "little")
    elif data.startswith((b"II", b"MM")):
        _set_tag(data, random.choice((256, 257, 278, 322, 323, 277, 258)), width)
    at = data.find(b"ispe")
    if at > 0:
        data[at + 8 : at + 16] = struct.pack(">II", width, height)


def _set_tag(data: bytearray, tag: int, value: int) -> None:
    order = "<" if data[:2] == b"II" else ">"
    for at in range(8, len(data) - 12):
        if struct.unpack_from(order + "HHI", data, at) in ((tag, 3, 1), (tag, 4, 1)):
            data[at + 2 : at + 12] = struct.pack(order + "HII", 4, 1, value)
            return


def _splice(random: Random, data: bytearray) -> None:
    """Put a piece of another file, or of this one, somewhere."""
    other = random.choice(FILES[random.choice(sorted(FILES))]) if random.random() < 0.5 else bytes(data)
    start = random.randrange(len(other))
    piece = other[start : start + random.choice((1, 2, 4, 12, 100, 1_000))] * random.choice((1, 1, 1, 50))
    at = random.randrange(len(data))
    data[at : at + random.choice((0, 0, len(piece)))] = piece


def _remove(random: Random, data: bytearray) -> None:
    at = random.randrange(len(data))
    del data[at : at + random.choice((1, 2, 4, 12, 100))]


MUTATIONS: tuple[Callable[[Random, bytearray], None], ...] = (
    _flip,
    _cut,
    _blow_up,
    _blow_up,
    _resize,
    _splice,
    _remove,
)


def _with_right_checksums(data: bytes) -> bytes:
    """A PNG whose chunks, as far as they can be walked, have checksums that fit: else nothing gets past them."""
    right = bytearray(data)
    at = 8
    while at + 12 <= len(right):
        (length,) = struct.unpack_from(">I", right, at)
        end = at + 8 + length
        if end + 4 > len(right):
            break
        right[end : end + 4] = struct.pack(">I", zlib.crc32(right[at + 4 : end]))
        at = end + 4
    return bytes(right)
