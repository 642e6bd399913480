"""Pixel values and light: the sRGB curve (IEC 61966-2-1), for NumPy arrays and torch tensors alike."""

from typing import Any, Protocol, TypeVar

from service.optics.thin_lens import Arithmetic


class Values(Arithmetic, Protocol):
    """Arrays and tensors of numbers: they are clipped and compared alike, too."""

    def __le__(self, other: Any, /) -> Any: ...
    def clip(self, low: Any, high: Any, /) -> Any: ...


V = TypeVar("V", bound=Values)


def decode_srgb(encoded: V) -> V:
    """sRGB values in 0..1 to linear light, of the same shape and type."""
    is_dark = encoded <= 0.04045
    return encoded / 12.92 * is_dark + ((encoded.clip(0.04, None) + 0.055) / 1.055) ** 2.4 * ~is_dark


def encode_srgb(linear: V) -> V:
    """Linear light, cut off at 0 and 1, to sRGB values, of the same shape and type."""
    clipped = linear.clip(0, 1)
    is_dark = clipped <= 0.0031308
    return clipped * 12.92 * is_dark + (1.055 * clipped.clip(1e-4, None) ** (1 / 2.4) - 0.055) * ~is_dark
