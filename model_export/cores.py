"""What torch and OpenCV work on: how many cores, and in which numbers."""

from collections.abc import Iterator
from contextlib import contextmanager

import cv2
import torch


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """torch on so many cores for a while."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def one_core() -> None:
    """For worker processes: each has a core."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)


def computes_bfloat16(device: torch.device) -> bool:
    """Whether the device multiplies bfloat16 itself."""
    return device.type != "cpu" or torch.cpu._is_avx512_bf16_supported()
