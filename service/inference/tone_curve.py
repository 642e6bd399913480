"""Which curve a file says its values have, by its number in H.273 (ISO/IEC 23091-2) or by an ICC profile.

Every file is read as sRGB. What other curves for display (Adobe RGB, Display P3, BT.709) differ by is little.
"""

import struct
import zlib

# H.273, 8.2: what is far from sRGB
CURVES = {8: "linear light", 16: "HDR by PQ", 18: "HDR by HLG"}
SRGB, LINEAR = 13, 8
ICC_TAGS = 128  # where the list of an ICC profile's tags begins (ICC.1:2022, 7.3)
MOST_TAGS, MOST_PROFILE_BYTES, TAG_HEAD = 100, 2**20, 16
# a curve of no points, one from 0 to 1, and one number of it, 1, as ICC.1:2022, 10.6 and 10.18 store it
LINEAR_CURVES = (
    b"curv" + bytes(8),
    b"curv" + bytes(4) + struct.pack(">IHH", 2, 0, 0xFFFF),
    b"curv" + bytes(4) + struct.pack(">IH", 1, 0x100),
    b"para" + bytes(8) + struct.pack(">I", 0x10000),
)


def curve_of_profile(profile: bytes) -> int:
    """H.273's number of the curve that an ICC profile says it has, sRGB's where it is none of ``CURVES``."""
    try:
        tags = _tags(profile)
    except struct.error:
        return SRGB
    coded = tags.get(b"cicp", b"")
    if len(coded) > 9 and coded[9] in CURVES:
        return coded[9]
    curve = tags.get(b"rTRC", tags.get(b"kTRC", b""))
    return LINEAR if curve.startswith(LINEAR_CURVES) else SRGB


def unpacked_profile(payload: bytes) -> bytes:
    """The profile of a PNG's iCCP part, as far as it is not too large; empty where it cannot be read."""
    try:
        return zlib.decompressobj().decompress(payload.partition(b"\0")[2][1:], MOST_PROFILE_BYTES)
    except zlib.error:
        return b""


def _tags(profile: bytes) -> dict[bytes, bytes]:
    """The beginnings of an ICC profile's tags, by name."""
    (count,) = struct.unpack_from(">I", profile, ICC_TAGS)
    places = (struct.unpack_from(">4sII", profile, ICC_TAGS + 4 + 12 * tag) for tag in range(min(count, MOST_TAGS)))
    return {name: profile[at : at + min(size, TAG_HEAD)] for name, at, size in places}
