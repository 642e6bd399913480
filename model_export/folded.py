"""Networks in the form that ships: the same answers from fewer operations, weights folded into each other.

Batch norms go into the convolutions before them. A convolution of a map at twice its size and of the maps beside it
becomes two, whose results are added: one of the coarse map as it is, 2x2 taps for each of the four pixels that a coarse
one becomes, and one of the rest; nothing is enlarged or joined. A convolution of a picture in cells of 2x2 becomes one
of the picture, at every other pixel.
"""

import copy
from collections.abc import Iterator
from dataclasses import replace
from typing import TypeVar

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.fusion import fuse_conv_bn_eval

from model_export.networks import GREY, CompactBlur, CompactDepth, Features, Joining, Pair, Stem, Surroundings, UNet

QUARTERS = ((0, 0), (0, 1), (1, 0), (1, 1))

M = TypeVar("M", bound=nn.Module)


def folded(pair: Pair) -> Pair:
    """A copy of a pair, in evaluation mode, that answers the same to rounding; the paper's is left as it is."""
    blur, depth = copy.deepcopy(pair.blur).eval(), copy.deepcopy(pair.depth).eval()
    if not (isinstance(blur, CompactBlur) and isinstance(depth, CompactDepth)):
        return pair
    _fold(blur.unet)
    _fold(depth.unet)
    return replace(pair, blur=blur, depth=depth)


def _fold(unet: UNet) -> None:
    for block in unet.surroundings:
        residual = _as(Surroundings, block)
        residual.convolution = fuse_conv_bn_eval(residual.convolution, _as(nn.BatchNorm2d, residual.norm))
        residual.norm = nn.Identity()
    unet.encoder = nn.ModuleList(map(_folded, unet.encoder))
    unet.decoder = nn.ModuleList(map(_folded, unet.decoder))


def _folded(block: nn.Module) -> nn.Module:
    first, *rest = _without_norms(list(block.children()))
    if isinstance(block, Stem):
        return FoldedStem(_as(nn.Conv2d, first), rest)
    if isinstance(block, Joining):
        return FoldedJoining(block.coarse, _as(nn.Conv2d, first), rest)
    return nn.Sequential(first, *rest)


def _without_norms(layers: list[nn.Module]) -> Iterator[nn.Module]:
    for layer, following in zip(layers, [*layers[1:], None], strict=True):
        if isinstance(following, nn.BatchNorm2d):
            yield fuse_conv_bn_eval(_as(nn.Conv2d, layer), following)
        elif not isinstance(layer, nn.BatchNorm2d):
            yield layer


def _as(kind: type[M], module: nn.Module) -> M:
    if not isinstance(module, kind):
        raise TypeError(f"{module} is no {kind.__name__}")
    return module


def _convolution(weight: Tensor, bias: Tensor | None, stride: int = 1, padding: int = 1) -> nn.Conv2d:
    outputs, inputs, size, _ = weight.shape
    made = nn.Conv2d(inputs, outputs, size, stride, padding, bias=bias is not None)
    made.weight = nn.Parameter(weight.detach())
    if bias is not None:
        made.bias = nn.Parameter(bias.detach())
    return made


class FoldedStem(nn.Module):
    def __init__(self, first: nn.Conv2d, rest: list[nn.Module]) -> None:
        super().__init__()
        cells = 4 * 3
        outputs = first.out_channels
        # [o, (i j c), y, x], where i and j are the pixel's row and column in its cell, to [o, c, (y i), (x j)]
        of_cells = first.weight[:, :cells].reshape(outputs, 2, 2, 3, 3, 3)
        of_pixels = of_cells.permute(0, 3, 4, 1, 5, 2).reshape(outputs, 3, 6, 6)
        self.image = _convolution(of_pixels, first.bias, stride=2, padding=2)
        self.beside = _convolution(first.weight[:, cells:], None)
        self.rest = nn.Sequential(*rest)

    def forward(self, image: Tensor, beside: Tensor) -> Tensor:
        out: Tensor = self.rest(self.image(image - GREY) + self.beside(beside))
        return out


class FoldedJoining(nn.Module):
    def __init__(self, coarse: int, first: nn.Conv2d, rest: list[nn.Module]) -> None:
        super().__init__()
        self.quarters = nn.ModuleList(_convolution(w, None, padding=0) for w in _quarters(first.weight[:, :coarse]))
        self.beside = _convolution(first.weight[:, coarse:], first.bias)
        self.rest = nn.Sequential(*rest)

    def forward(self, coarse: Tensor, beside: Features) -> Tensor:
        parts = []
        for (row, column), quarter in zip(QUARTERS, self.quarters, strict=True):
            parts.append(quarter(functional.pad(coarse, (1 - column, column, 1 - row, row))))
        n, c, h, w = parts[0].shape
        enlarged = torch.stack([torch.stack(parts[:2], -1), torch.stack(parts[2:], -1)], 3).reshape(n, c, 2 * h, 2 * w)
        joined = beside[0] if len(beside) == 1 else torch.cat(beside, 1)
        out: Tensor = self.rest(enlarged + self.beside(joined))
        return out


def _quarters(weight: Tensor) -> Iterator[Tensor]:
    """What a convolution [o,c,3,3] of a map at twice its size does to the map: [o,c,2,2] for each of four pixels.

    Two of the three taps, along either axis, see the same coarse pixel: the last two in even rows, else the first.
    """
    first, middle, last = weight.unbind(2)
    by_row = (torch.stack([first, middle + last], 2), torch.stack([first + middle, last], 2))
    for row, column in QUARTERS:
        first, middle, last = by_row[row].unbind(3)
        yield torch.stack([first, middle + last] if column == 0 else [first + middle, last], 3)
