"""A model folder back to networks that training goes on from: the way back of ``folded.py``."""

from collections.abc import Callable, Iterable
from pathlib import Path

import onnx
import torch
from onnx import numpy_helper
from torch import Tensor, nn

from model_export.folded import folded
from model_export.networks import Normed, Pair, make_pair
from service.inference.artifact import load_model_folder

PREFIX = "network."
LEAST_LENGTH = 1e-6


def restored(model: Path) -> Pair:
    """The networks of a float32 model folder, in evaluation mode: the same answers to rounding.

    Its batch norms do nothing yet but add: ``spread_norms`` gives them their part. Raises ``ValueError`` for a folder
    whose graphs are not the folded form of the compact pair.
    """
    folder = load_model_folder(model)
    pair = make_pair("compact")
    pair.modules().eval()
    whole = folded(pair)
    for network, graph in ((whole.blur, folder.manifest.graphs.blur), (whole.depth, folder.manifest.graphs.depth)):
        weights = {
            tensor.name.removeprefix(PREFIX): torch.from_numpy(numpy_helper.to_array(tensor).copy())
            for tensor in onnx.load(model / graph.file).graph.initializer
            if tensor.name.startswith(PREFIX)
        }
        wanted = network.state_dict()
        try:
            network.load_state_dict({name: weights[name] for name in wanted})
        except (KeyError, RuntimeError) as exc:
            raise ValueError(f"{model / graph.file} is no folded graph of the compact pair") from exc
    own_layers, layers = (_normed(either) for either in (pair, whole))
    with torch.no_grad():
        for own, other in zip(own_layers, layers, strict=True):
            own.ways.load_state_dict(other.ways.state_dict(), strict=False)
            norm = _norm(own)
            norm.weight.fill_((1 + norm.eps) ** 0.5)
            norm.bias.copy_(other.convolutions()[-1].get_parameter("bias"))
    for head, shipped in zip(_heads(pair), _heads(whole), strict=True):
        head.load_state_dict(shipped.state_dict())
    return pair


def _normed(pair: Pair) -> list[Normed]:
    return [module for module in pair.modules().modules() if isinstance(module, Normed)]


def _norm(normed: Normed) -> nn.BatchNorm2d:
    norm = normed.norm
    if not isinstance(norm, nn.BatchNorm2d):
        raise TypeError("these batch norms are folded away")
    return norm


def _heads(pair: Pair) -> list[nn.Module]:
    return [network.get_submodule("head") for network in (pair.blur, pair.depth)]


def spread_norms(pair: Pair, passes: Iterable[Callable[[], object]]) -> None:
    """Give batch norms the statistics of what they see, and filters length 1, so that the answers stay as they are.

    Each pass runs the pair, in evaluation mode, on other pictures.
    """
    layers = _normed(pair)
    seen: dict[nn.Module, list[Tensor]] = {_norm(layer): [] for layer in layers}

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
        norm, convolutions = _norm(layer), layer.convolutions()
        mean, square = torch.stack(seen[norm]).mean(0)
        filters = torch.cat([convolution.weight.detach().flatten(1) for convolution in convolutions], 1)
        length = filters.norm(dim=1).clamp_min(LEAST_LENGTH)
        variance = (square - mean**2).clamp_min(0).float() / length**2
        gain = norm.weight / (norm.get_buffer("running_var") + norm.eps).sqrt()
        with torch.no_grad():
            norm.bias.add_(gain * (mean.float() - norm.get_buffer("running_mean")))
            norm.weight.copy_(gain * length * (variance + norm.eps).sqrt())
            for convolution in convolutions:
                convolution.weight.div_(length[:, None, None, None])
            norm.get_buffer("running_mean").copy_(mean.float() / length)
            norm.get_buffer("running_var").copy_(variance)
