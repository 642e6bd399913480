"""The optimisers: every weight moves, filters in all directions alike."""

import torch
from torch import nn
from torch.nn.utils import convert_conv2d_weight_memory_format

from model_export.networks import make_pair
from model_export.optimizers import Optimizers


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
