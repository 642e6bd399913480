"""Networks in the form that ships: batch norms folded into the convolutions before them."""

import copy
from dataclasses import replace

import torch
from torch import nn

from model_export.networks import Normed, Pair, batch_norm, norm_gain


def folded(pair: Pair) -> Pair:
    """A copy of a pair, in evaluation mode, that answers the same to rounding."""
    blur, depth = copy.deepcopy(pair.blur).eval(), copy.deepcopy(pair.depth).eval()
    for network in (blur, depth):
        for module in network.modules():
            if isinstance(module, Normed):
                _fold(module)
    return replace(pair, blur=blur, depth=depth)


def _fold(normed: Normed) -> None:
    norm = batch_norm(normed)
    with torch.no_grad():
        gain = norm_gain(norm)
        for convolution in normed.convolutions():
            convolution.weight.mul_(gain[:, None, None, None])
        normed.convolutions()[-1].bias = nn.Parameter(norm.bias - gain * norm.get_buffer("running_mean"))
    normed.norm = nn.Identity()
