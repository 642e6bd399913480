"""Pixel values and light: the sRGB curve (IEC 61966-2-1)."""

import numpy as np
from numpy.typing import NDArray


def decode_srgb(encoded: NDArray[np.float32]) -> NDArray[np.float32]:
    """sRGB values in 0..1 to linear light (IEC 61966-2-1)."""
    low = encoded / 12.92
    high = ((np.maximum(encoded, 0.04) + 0.055) / 1.055) ** 2.4
    return np.where(encoded <= 0.04045, low, high).astype(np.float32)


def encode_srgb(linear: NDArray[np.float32]) -> NDArray[np.float32]:
    """Linear light in 0..1 to sRGB values (IEC 61966-2-1)."""
    clipped = np.clip(linear, 0, 1)
    high = 1.055 * np.maximum(clipped, 1e-4) ** (1 / 2.4) - 0.055
    return np.where(clipped <= 0.0031308, clipped * 12.92, high).astype(np.float32)
