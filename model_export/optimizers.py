"""What moves the weights: Muon the filters, AdamW all else.

Muon (Jordan et al. 2024) makes a step of momentum even in all directions of a filter bank, so that rare ones are
learned too. Its steps are scaled to AdamW's (Liu et al. 2025), so one learning rate serves both.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn


def _as_matrix(filters: Tensor) -> Tensor:
    """[out,in,h,w] as [out,h*w*in]: the same memory where that is channels last."""
    return filters.permute(0, 2, 3, 1).flatten(1)


class FilterMuon(torch.optim.Muon):
    """torch's Muon, which takes matrices, over the filters of convolutions that lie channels last."""

    def __init__(self, filters: list[nn.Parameter], lr: float, weight_decay: float) -> None:
        self.filters = filters
        matrices = [_as_matrix(f.detach()) for f in filters]
        super().__init__(matrices, lr=lr, weight_decay=weight_decay, adjust_lr_fn="match_rms_adamw")

    def step(self, closure: Callable[[], float] | None = None) -> None:  # type: ignore[override]
        for filters, matrix in zip(self.filters, self.param_groups[0]["params"], strict=True):
            matrix.grad = None if filters.grad is None else _as_matrix(filters.grad)
        super().step(closure)  # type: ignore[no-untyped-call]

    def zero_grad(self, set_to_none: bool = True) -> None:
        super().zero_grad(set_to_none)
        for filters in self.filters:
            filters.grad = None


class Optimizers:
    """Both, as one: the step of a training."""

    def __init__(self, modules: nn.Module, weight_decay: float) -> None:
        banks = [m for m in modules.modules() if isinstance(m, nn.Conv2d) and m.weight[0, 0].numel() > 1]
        filters = [bank.get_parameter("weight") for bank in banks]
        kept = {id(f) for f in filters}
        others = [p for p in modules.parameters() if id(p) not in kept]
        self.both = (
            FilterMuon(filters, 0.0, weight_decay),
            torch.optim.AdamW(others, lr=0.0, weight_decay=weight_decay),
        )

    def step(self, learning_rate: float) -> None:
        """Move the weights by their gradients."""
        for optimizer in self.both:
            for group in optimizer.param_groups:
                group["lr"] = learning_rate
            optimizer.step()

    def zero_grad(self) -> None:
        for optimizer in self.both:
            optimizer.zero_grad(set_to_none=True)

    def state_dict(self) -> list[dict[str, Any]]:
        return [optimizer.state_dict() for optimizer in self.both]

    def load_state_dict(self, states: list[dict[str, Any]]) -> None:
        """Inverse of ``state_dict``."""
        for optimizer, state in zip(self.both, states, strict=True):
            optimizer.load_state_dict(state)
