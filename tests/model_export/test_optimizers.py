"""The optimisers: every weight moves, filters in all directions alike."""

import pytest
import torch
from torch import nn
from torch.nn.utils import convert_conv2d_weight_memory_format

from model_export.networks import make_pair
from model_export.optimizers import Muon, Optimizers


def test_a_step_moves_every_weight_that_has_a_gradient() -> None:
    modules = make_pair("compact").modules()
    convert_conv2d_weight_memory_format(modules, torch.channels_last)
    optimizers = Optimizers(modules, weight_decay=0.0)
    before = {name: p.detach().clone() for name, p in modules.named_parameters()}
    for p in modules.parameters():
        p.grad = torch.randn_like(p)
    optimizers.step(1e-3)
    still = [name for name, p in modules.named_parameters() if torch.equal(p, before[name])]
    assert not still


def test_a_step_of_filters_is_even_in_all_directions() -> None:
    torch.manual_seed(0)
    layer = nn.Conv2d(16, 8, 3)
    modules = nn.ModuleList([layer])
    convert_conv2d_weight_memory_format(modules, torch.channels_last)
    before = layer.weight.detach().clone()
    gradient = torch.outer(torch.randn(8), torch.randn(144)) + 0.1 * torch.randn(8, 144)
    layer.weight.grad = gradient.view_as(layer.weight)
    layer.get_parameter("bias").grad = torch.zeros(8)
    Optimizers(modules, weight_decay=0.0).step(1e-2)
    step = (layer.weight.detach() - before).permute(0, 2, 3, 1).flatten(1)
    told = torch.linalg.svdvals(gradient)
    moved = torch.linalg.svdvals(step)
    assert told[0] / told[-1] > 5
    assert moved[0] / moved[-1] < 2
    # as large as a step of AdamW mostly is: a fifth of the learning rate
    assert 0.1 * 1e-2 < step.square().mean().sqrt() < 0.4 * 1e-2


@pytest.mark.parametrize("shape", [(8, 144), (144, 8)])
def test_muon_is_that_of_torch_whose_products_are_in_bfloat16(shape: tuple[int, int]) -> None:
    torch.manual_seed(0)
    ours, torchs = (start := torch.randn(shape)).clone(), start.clone()
    both: list[torch.optim.Optimizer] = [
        Muon([ours], weight_decay=0.1),
        torch.optim.Muon([torchs], weight_decay=0.1, adjust_lr_fn="match_rms_adamw"),
    ]
    for _ in range(3):
        ours.grad = torchs.grad = torch.randn(shape)
        for optimizer in both:
            optimizer.param_groups[0]["lr"] = 1e-2
            optimizer.step()
    torch.testing.assert_close(ours - start, torchs - start, rtol=0.05, atol=2e-4)


def test_muon_goes_on_from_the_state_that_torchs_left() -> None:
    matrix = torch.randn(8, 16)
    torchs: torch.optim.Optimizer = torch.optim.Muon([matrix], adjust_lr_fn="match_rms_adamw")
    matrix.grad = torch.randn(8, 16)
    torchs.step()
    ours = Muon([matrix], weight_decay=0.0)
    ours.load_state_dict(torchs.state_dict())
    torch.testing.assert_close(ours.state[matrix]["momentum_buffer"], torchs.state[matrix]["momentum_buffer"])
