"""Whether a picture is what a lens showed: by its shape a part may seem a small copy, and a phone may compute blur.

What the XMP says is looked for in its text, which no parser of XML has to be trusted with.
"""

import re
import struct
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from service.errors import CamindError
from service.inference.exif import thumbnail_in
from service.inference.headers import Header, read_header
from service.opencv import cv2

LARGEST_PX, SEEN_PX = 1024, 160  # of a thumbnail's longer side: at the most, and as it is looked at
SHARES = tuple(float(share) for share in np.geomspace(1, 0.3, 25))  # of a thumbnail's width
ALL_OF_IT = 0.96
# correlations: of what is the same place in both, and by how much less the whole must be like it
ALIKE, CLEARLY = 0.9, 0.1
# by Lightroom and Camera Raw; what they have yet to do to the pixels they note as well
CROPPED, APPLIED = (re.compile(rb"crs:" + name + rb"(=[\'\"]|>)True", re.I) for name in (b"HasCrop", b"AlreadyApplied"))
# of Google's cameras, and of others as theirs do
RENDERINGS = {b"GPano:ProjectionType": "a panorama", b"SpecialType-PORTRAIT": "a portrait mode"}
SAMSUNG_PORTRAIT = b"Shot_DepthMap_"  # DualShot and SingeShot: a part behind the picture, with what it was blurred by
ADVICE = "send the whole frame, for a part that is taken for a small copy gives wrong metres"
GREY_EVERY = 16  # pixels each way, before all are looked at
MOSAIC_CELLS, MOSAIC_LEVELS, MOSAIC_ERRORS = 256, 1.5, 5.0  # looked at, each way; least of 255, and standard errors

Grey = NDArray[np.uint8]


def signs_of_making(data: bytes, header: Header, stored: NDArray[np.uint8]) -> Iterator[str]:
    """Warnings where the stored frame [h, w, 3] RGB is a part of what was taken, was computed, or never developed."""
    yield from noted_making(data, header)
    if _is_mosaic(stored):
        yield "its grey pixels alternate, as a colour sensor's do before they are developed (Bayer): demosaic it first"
    if _is_noted_crop(header):
        return
    thumbnail = _thumbnail(header)
    if thumbnail is not None and _shows_more(thumbnail, stored):
        yield f"the thumbnail in its EXIF shows more than it does, so it was cropped: {ADVICE}"


def noted_making(data: bytes, header: Header) -> Iterator[str]:
    """Those of these warnings that need no pixels."""
    for mark, rendering in RENDERINGS.items():
        if mark in header.xmp:
            yield f"its XMP says {rendering}: its blur may be computed, and no lens'"
    if header.kind in ("jpeg", "heic") and SAMSUNG_PORTRAIT in data:
        yield "it holds the depth map of a portrait mode: its blur may be computed, and no lens'"
    if _is_noted_crop(header):
        yield f"its XMP says that it was cropped: {ADVICE}"


def _is_noted_crop(header: Header) -> bool:
    return bool(CROPPED.search(header.xmp) and APPLIED.search(header.xmp))


def _is_mosaic(stored: NDArray[np.uint8]) -> bool:
    """Whether all is grey and one diagonal of every two by two pixels brighter, which is so of nothing a lens shows."""
    height, width = (size // 2 for size in stored.shape[:2])
    if not height or not width or not _is_grey(stored[::GREY_EVERY, ::GREY_EVERY]):
        return False
    down, across = (-(-size // MOSAIC_CELLS) for size in (height, width))
    cells = stored[: 2 * height, : 2 * width].reshape(height, 2, width, 2, 3)[::down, :, ::across].astype(np.float32)
    if not _is_grey(cells):
        return False
    first, second, third, fourth = (cells[:, row, :, column, 0] for row in (0, 1) for column in (0, 1))
    off = (first + fourth - second - third) / 2
    return bool(abs(off.mean()) > MOSAIC_LEVELS + MOSAIC_ERRORS * off.std() / np.sqrt(off.size))


def _is_grey(pixels: NDArray[np.generic]) -> bool:
    return bool((pixels == pixels[..., :1]).all())


def _thumbnail(header: Header) -> Grey | None:
    """The small picture in the EXIF, grey; None without one that can be read."""
    try:
        data = thumbnail_in(header.exif) if header.kind not in ("tiff", "raw") else b""
        small = read_header(data)
    except (struct.error, CamindError):
        return None
    if small.kind != "jpeg" or max(small.width_px, small.height_px) > LARGEST_PX:
        return None
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        return None
    return None if pixels is None else np.asarray(pixels, np.uint8)


def _made_small(pixels: Grey, scale: float) -> Grey:
    size = [max(1, round(side * scale)) for side in pixels.shape[1::-1]]
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8)


def _shows_more(thumbnail: Grey, stored: NDArray[np.uint8]) -> bool:
    """Whether the picture is found in a part of the thumbnail, and not in all of it but for bars at its sides."""
    thumbnail = _made_small(thumbnail, min(1.0, SEEN_PX / max(thumbnail.shape)))
    fit = min(own / whole for own, whole in zip(thumbnail.shape, stored.shape[:2], strict=True))
    picture = np.asarray(cv2.cvtColor(_made_small(stored, fit), cv2.COLOR_RGB2GRAY), np.uint8)
    whole = part = -1.0
    for share in SHARES:
        found = float(cv2.matchTemplate(thumbnail, _made_small(picture, share), cv2.TM_CCOEFF_NORMED).max())
        if share >= ALL_OF_IT:
            whole = max(whole, found)
        else:
            part = max(part, found)
    return part >= ALIKE and part - whole >= CLEARLY
