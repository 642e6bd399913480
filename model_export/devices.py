"""What torch and OpenCV work on: how many cores, in which numbers, and how numbers get to a device."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

new_stream: Callable[[torch.device], torch.cuda.Stream] = torch.cuda.Stream  # whose own signature has no types


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


def sent(values: NDArray[Any] | Tensor, device: torch.device) -> Tensor:
    """Numbers on the device, without waiting for what it has still to do."""
    tensor = values if isinstance(values, Tensor) else torch.from_numpy(np.ascontiguousarray(values))
    return tensor.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else tensor


def columns(device: torch.device, *values: NDArray[Any]) -> tuple[Tensor, ...]:
    """Numbers [n] each to go with maps, [n,1,1] each, sent together: to send costs more than what is sent."""
    return sent(np.stack(values).astype(np.float32), device)[:, :, None, None].unbind()
