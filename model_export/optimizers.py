"""What moves the weights: Muon the filters, AdamW all else.

Muon (Jordan et al. 2024) makes a step of momentum even in all directions of a filter bank, so that rare ones are
learned too. Its steps are scaled to AdamW's (Liu et al. 2025), so one learning rate serves both.
"""

from typing import Any

import torch
from torch import Tensor, nn


def _as_matrix(filters: Tensor) -> Tensor:
    """[out,in,h,w] as [out,h*w*in]: the same memory where that is channels last."""
    return filters.permute(0, 2, 3, 1).flatten(1)


class Optimizers:
    """Both, as one. Filters larger than a pixel, whose memory must be channels last, are handed to Muon as matrices."""

    def __init__(self, modules: nn.Module, weight_decay: float) -> None:
        banks = [m for m in modules.modules() if isinstance(m, nn.Conv2d) and m.weight[0, 0].numel() > 1]
        self.filters = [bank.get_parameter("weight") for bank in banks]
        self.matrices = [_as_matrix(filters.detach()) for filters in self.filters]
        kept = {id(filters) for filters in self.filters}
        others = [p for p in modules.parameters() if id(p) not in kept]
        self.both: tuple[torch.optim.Optimizer, ...] = (
            torch.optim.Muon(self.matrices, weight_decay=weight_decay, adjust_lr_fn="match_rms_adamw"),
            torch.optim.AdamW(others, weight_decay=weight_decay),
        )

    def step(self, learning_rate: float) -> None:
        """Move the weights by their gradients."""
        for filters, matrix in zip(self.filters, self.matrices, strict=True):
            matrix.grad = None if filters.grad is None else _as_matrix(filters.grad)
        for optimizer in self.both:
            for group in optimizer.param_groups:
                group["lr"] = learning_rate
            optimizer.step()

    def state_dict(self) -> list[dict[str, Any]]:
        return [optimizer.state_dict() for optimizer in self.both]

    def load_state_dict(self, states: list[dict[str, Any]]) -> None:
        """Inverse of ``state_dict``."""
        for optimizer, state in zip(self.both, states, strict=True):
            optimizer.load_state_dict(state)
