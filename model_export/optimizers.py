"""What moves the weights: Muon the filters, AdamW all else.

Muon (Jordan et al. 2024) makes a step of momentum even in all directions of a filter bank, so that rare ones are
learned too. Its steps are scaled to AdamW's (Liu et al. 2025), so one learning rate serves both.
"""

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor, nn

from model_export.devices import computes_bfloat16

MOMENTUM = 0.95
NEWTON_SCHULZ = (3.4445, -4.775, 2.0315)  # Jordan et al.: the steepest at zero that does not run away
NEWTON_SCHULZ_STEPS = 5
RMS_OF_ADAMW = 0.2


def evened(matrix: Tensor, dtype: torch.dtype) -> Tensor:
    """The matrix [m,n] with its singular values brought near 1, by products in ``dtype``."""
    a, b, c = NEWTON_SCHULZ
    tall = matrix.shape[0] > matrix.shape[1]
    x = (matrix.T if tall else matrix).to(dtype)
    x = x / x.norm().clamp(min=1e-7)
    for _ in range(NEWTON_SCHULZ_STEPS):
        gram = x @ x.T
        x = torch.addmm(x, torch.addmm(gram, gram, gram, beta=b, alpha=c), x, beta=a)
    return x.T if tall else x


class Muon(torch.optim.Optimizer):
    """``torch.optim.Muon``, but that its products are in bfloat16 only where that is computed, not emulated."""

    def __init__(self, matrices: Iterable[Tensor], weight_decay: float) -> None:
        super().__init__(matrices, {"lr": 1e-3, "weight_decay": weight_decay})

    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """Move the matrices by their gradients; what ``closure`` gives, if there is one."""
        loss = None if closure is None else closure()
        with torch.no_grad():
            for group in self.param_groups:
                for matrix in group["params"]:
                    if matrix.grad is not None:
                        self._move(matrix, matrix.grad, group["lr"], group["weight_decay"])
        return loss

    def _move(self, matrix: Tensor, gradient: Tensor, rate: float | Tensor, decay: float) -> None:
        if not self.state[matrix]:
            self.state[matrix]["momentum_buffer"] = torch.zeros_like(matrix)
        momentum = self.state[matrix]["momentum_buffer"]
        momentum.lerp_(gradient, 1 - MOMENTUM)
        dtype = torch.bfloat16 if computes_bfloat16(matrix.device) else torch.float32
        matrix.mul_(1 - rate * decay)
        step = RMS_OF_ADAMW * max(matrix.shape) ** 0.5 * rate
        matrix.sub_(evened(gradient.lerp(momentum, MOMENTUM), dtype) * step)


def _as_matrix(filters: Tensor) -> Tensor:
    """[out,in,h,w] as [out,h*w*in]: the same memory where that is channels last."""
    return filters.permute(0, 2, 3, 1).flatten(1)


class Optimizers:
    """Both, as one. Filters larger than a pixel, whose memory must be channels last, are handed to Muon as matrices.

    On a CUDA device the rate is a number there, so that a step can be recorded and done again at another rate.
    """

    def __init__(self, modules: nn.Module, weight_decay: float) -> None:
        banks = [m for m in modules.modules() if isinstance(m, nn.Conv2d) and m.weight[0, 0].numel() > 1]
        self.filters = [bank.get_parameter("weight") for bank in banks]
        self.matrices = [_as_matrix(filters.detach()) for filters in self.filters]
        kept = {id(filters) for filters in self.filters}
        others = [p for p in modules.parameters() if id(p) not in kept]
        self.recordable = others[0].device.type == "cuda"
        self.both: tuple[torch.optim.Optimizer, ...] = (
            Muon(self.matrices, weight_decay),
            torch.optim.AdamW(others, weight_decay=weight_decay, capturable=self.recordable),
        )

    def step(self, learning_rate: float | Tensor) -> None:
        """Move the weights by their gradients."""
        for filters, matrix in zip(self.filters, self.matrices, strict=True):
            matrix.grad = None if filters.grad is None else _as_matrix(filters.grad)
        for optimizer in self.both:
            for group in optimizer.param_groups:
                group["lr"] = learning_rate
            optimizer.step()

    def state_dict(self) -> list[dict[str, Any]]:
        states = [optimizer.state_dict() for optimizer in self.both]
        for state in states:
            for group in state["param_groups"]:
                group["lr"] = float(group["lr"])
        return states

    def load_state_dict(self, states: list[dict[str, Any]]) -> None:
        """Inverse of ``state_dict``."""
        for optimizer, state in zip(self.both, states, strict=True):
            optimizer.load_state_dict(state)
            for group in optimizer.param_groups:
                if "capturable" in group:
                    group["capturable"] = self.recordable
