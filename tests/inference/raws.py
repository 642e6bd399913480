"""Raw files of a sensor's values: the smallest DNG that a decoder takes, and what only looks like one."""

from io import BytesIO

import numpy as np
import tifffile

from tests.inference.photographs import corners

COLOUR_MATRIX = (32404542, -15371385, -4985314, -9692660, 18760108, 415560, 556434, -2040259, 10572252)
SENSOR_VALUES = 32803
DNG_TAGS = [
    (50706, 1, 4, bytes([1, 4, 0, 0]), False),  # DNGVersion
    (50707, 1, 4, bytes([1, 1, 0, 0]), False),
    (50708, 2, 0, "camind", False),  # UniqueCameraModel
    (50714, 3, 1, 0, False),  # black
    (50717, 3, 1, 65535, False),  # white
    (50721, 10, 9, tuple(number for value in COLOUR_MATRIX for number in (value, 10_000_000)), False),
    (50728, 5, 3, (1, 1) * 3, False),  # AsShotNeutral
    (50778, 3, 1, 21, False),
]


def dng(orientation: int = 1, *, is_told: bool = True) -> bytes:
    """``corners()`` behind red, green, green and blue filters; without the DNG's own tags unless ``is_told``."""
    rgb = corners().astype(np.uint16) * 257
    sensor = rgb[..., 1].copy()
    sensor[::2, ::2], sensor[1::2, 1::2] = rgb[::2, ::2, 0], rgb[1::2, 1::2, 2]
    tags = [(274, 3, 1, orientation, False), (33421, 3, 2, (2, 2), False), (33422, 1, 4, bytes([0, 1, 1, 2]), False)]
    out = BytesIO()
    tifffile.imwrite(
        out, sensor, photometric=SENSOR_VALUES, extratags=tags + DNG_TAGS * is_told, metadata=None, software=False
    )
    return out.getvalue()


def with_preview() -> bytes:
    """A small preview in front and the sensor's values in a sub-directory, as most makers' raw files have it."""
    out = BytesIO()
    with tifffile.TiffWriter(out) as writer:
        writer.write(corners(12, 16), photometric="rgb", subifds=1, metadata=None, software=False)
        writer.write(np.zeros((48, 64), np.uint16), photometric=SENSOR_VALUES, metadata=None, software=False)
    return out.getvalue()
