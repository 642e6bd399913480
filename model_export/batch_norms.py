"""Batch norms folded into the convolutions before them, as networks ship, and back, as training goes on from them."""

import copy
import math
from collections.abc import Callable, Iterable
from pathlib import Path

import onnx
import torch
from onnx import numpy_helper
from torch import Tensor, nn

from model_export.networks import Normed, Pair, Widths, make_pair
from service.inference.artifact import ModelFolder, load_model_folder

PREFIX = "network."
LEAST_LENGTH = 1e-6


def batch_norm(normed: Normed) -> nn.BatchNorm2d:
    """A layer's own; raises ``TypeError`` where it is folded away."""
    if not isinstance(normed.norm, nn.BatchNorm2d):
        raise TypeError("these batch norms are folded already")
    return normed.norm


def norm_gain(norm: nn.BatchNorm2d) -> Tensor:
    """What a batch norm multiplies each channel with in evaluation mode [c]."""
    gain: Tensor = norm.weight / (norm.get_buffer("running_var") + norm.eps).sqrt()
    return gain


def folded(pair: Pair) -> Pair:
    """A copy of a pair, in evaluation mode, that answers the same to rounding."""
    pair = copy.deepcopy(pair)
    pair.modules().eval()
    for layer in _normed(pair):
        _fold(layer)
    return pair


def _fold(normed: Normed) -> None:
    norm = batch_norm(normed)
    with torch.no_grad():
        gain = norm_gain(norm)
        for convolution in normed.convolutions():
            convolution.weight.mul_(gain[:, None, None, None])
        normed.convolutions()[-1].bias = nn.Parameter(norm.bias - gain * norm.get_buffer("running_mean"))
    normed.norm = nn.Identity()


def restored(model: Path) -> Pair:
    """The networks of a float32 model folder, in evaluation mode: the same answers to rounding, ``blur_gain`` within.

    Its batch norms do nothing yet but add: ``spread_norms`` gives them their part. Raises ``ValueError`` for a folder
    whose graphs are not the folded form of the compact pair.
    """
    folder = load_model_folder(model)
    weights = _weights(folder)
    try:
        pair = make_pair("compact", Widths.of(weights))
        pair.modules().eval()
        whole = folded(pair)
        whole.modules().load_state_dict({name: weights[name] for name in whole.modules().state_dict()})
    except (IndexError, KeyError, RuntimeError) as exc:
        raise ValueError(f"{model} has no folded graphs of the compact pair") from exc
    own_layers, layers = (_normed(either) for either in (pair, whole))
    with torch.no_grad():
        for own, other in zip(own_layers, layers, strict=True):
            own.ways.load_state_dict(other.ways.state_dict(), strict=False)
            norm = batch_norm(own)
            norm.weight.fill_((1 + norm.eps) ** 0.5)
            norm.bias.copy_(other.convolutions()[-1].get_parameter("bias"))
    for head, shipped in zip(_heads(pair), _heads(whole), strict=True):
        head.load_state_dict(shipped.state_dict())
    with torch.no_grad():
        pair.blur.get_submodule("head").get_parameter("bias")[0] += math.log(folder.manifest.blur_gain)
    return pair


def _weights(folder: ModelFolder) -> dict[str, Tensor]:
    """What the graphs of a folder hold, by the names of ``Pair.modules()``."""
    graphs = folder.manifest.graphs
    return {
        f"{network}.{tensor.name.removeprefix(PREFIX)}": torch.from_numpy(numpy_helper.to_array(tensor).copy())
        for network, graph in (("blur", graphs.blur), ("depth", graphs.depth))
        for tensor in onnx.load(folder.path / graph.file).graph.initializer
        if tensor.name.startswith(PREFIX)
    }


def _normed(pair: Pair) -> list[Normed]:
    return [module for module in pair.modules().modules() if isinstance(module, Normed)]


def _heads(pair: Pair) -> list[nn.Module]:
    return [pair.blur.get_submodule("head"), pair.depth.get_submodule("head"), pair.depth.get_submodule("layout.head")]


def spread_norms(pair: Pair, passes: Iterable[Callable[[], object]]) -> None:
    """Give batch norms the statistics of what they see, and filters length 1, so that the answers stay as they are.

    Each pass runs the pair, in evaluation mode, on other pictures.
    """
    layers = _normed(pair)
    seen: dict[nn.Module, list[Tensor]] = {batch_norm(layer): [] for layer in layers}

    def look(norm: nn.Module, inputs: tuple[Tensor, ...]) -> None:
        maps = inputs[0].double()
        seen[norm].append(torch.stack([maps.mean((0, 2, 3)), (maps**2).mean((0, 2, 3))]))

    hooks = [norm.register_forward_pre_hook(look) for norm in seen]
    with torch.inference_mode():
        for run in passes:
            run()
    for hook in hooks:
        hook.remove()
    for layer in layers:
        norm, convolutions = batch_norm(layer), layer.convolutions()
        mean, square = torch.stack(seen[norm]).mean(0)
        filters = torch.cat([convolution.weight.detach().flatten(1) for convolution in convolutions], 1)
        length = filters.norm(dim=1).clamp_min(LEAST_LENGTH)
        variance = (square - mean**2).clamp_min(0).float() / length**2
        gain = norm_gain(norm)
        with torch.no_grad():
            norm.bias.add_(gain * (mean.float() - norm.get_buffer("running_mean")))
            norm.weight.copy_(gain * length * (variance + norm.eps).sqrt())
            for convolution in convolutions:
                convolution.weight.div_(length[:, None, None, None])
            norm.get_buffer("running_mean").copy_(mean.float() / length)
            norm.get_buffer("running_var").copy_(variance)
