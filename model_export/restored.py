"""A model folder back to networks that training goes on from: the way back of ``folded.py``."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import onnx
import torch
from onnx import numpy_helper
from torch import Tensor, nn

from model_export.folded import FoldedJoining, FoldedStem, folded
from model_export.networks import Pair, make_pair
from service.inference.artifact import load_model_folder

PREFIX = "network."
PARTS = ("encoder", "decoder", "surroundings")
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
    for own, other in ((pair.blur, whole.blur), (pair.depth, whole.depth)):
        own.get_submodule("head").load_state_dict(other.get_submodule("head").state_dict())
        _unfold(own.get_submodule("unet"), other.get_submodule("unet"))
    return pair


def _unfold(unet: nn.Module, source: nn.Module) -> None:
    for block, other in zip(_blocks(unet), _blocks(source), strict=True):
        for (convolution, norm), (weight, bias) in zip(_normed(block), _weights(other), strict=True):
            with torch.no_grad():
                convolution.weight.copy_(weight)
                norm.weight.fill_((1 + norm.eps) ** 0.5)
                norm.bias.copy_(bias)


def _blocks(unet: nn.Module) -> list[nn.Module]:
    return [block for name in PARTS for block in unet.get_submodule(name).children()]


def _normed(block: nn.Module) -> Iterator[tuple[nn.Conv2d, nn.BatchNorm2d]]:
    """Each convolution with the batch norm after it."""
    convolutions = [module for module in block.modules() if isinstance(module, nn.Conv2d)]
    norms = [module for module in block.modules() if isinstance(module, nn.BatchNorm2d)]
    return zip(convolutions, norms, strict=True)


def _weights(block: nn.Module) -> Iterator[tuple[Tensor, Tensor]]:
    """Weight and bias of each convolution of a folded block, as they were before it was split."""
    if isinstance(block, FoldedStem):
        outputs = block.image.out_channels
        # [o, c, (y i), (x j)] back to [o, (i j c), y, x]
        of_cells = block.image.weight.reshape(outputs, 3, 3, 2, 3, 2).permute(0, 3, 5, 1, 2, 4)
        yield (
            torch.cat([of_cells.reshape(outputs, 12, 3, 3), block.beside.weight], 1),
            block.image.get_parameter("bias"),
        )
        yield from _weights(block.rest)
    elif isinstance(block, FoldedJoining):
        quarters = [quarter.get_parameter("weight") for quarter in block.quarters]
        yield torch.cat([_whole(quarters), block.beside.weight], 1), block.beside.get_parameter("bias")
        yield from _weights(block.rest)
    else:
        for convolution in block.modules():
            if isinstance(convolution, nn.Conv2d):
                yield convolution.weight, convolution.get_parameter("bias")


def _whole(quarters: Sequence[Tensor]) -> Tensor:
    """The convolution [o,c,3,3] whose four quarters [o,c,2,2] these are, by row and then by column."""
    even = _three(quarters[0], quarters[1], 3)
    odd = _three(quarters[2], quarters[3], 3)
    return _three(even, odd, 2)


def _three(even: Tensor, odd: Tensor, axis: int) -> Tensor:
    """Three taps from (first, middle + last) and (first + middle, last)."""
    first, _ = even.unbind(axis)
    both, last = odd.unbind(axis)
    return torch.stack([first, both - first, last], axis)


def spread_norms(pair: Pair, passes: Iterable[Callable[[], object]]) -> None:
    """Give batch norms the statistics of what they see, and filters length 1, so that the answers stay as they are.

    Each pass runs the pair, in evaluation mode, on other pictures.
    """
    unets = [network.get_submodule("unet") for network in pair.modules().children()]
    normed = [found for unet in unets for block in _blocks(unet) for found in _normed(block)]
    seen: dict[nn.Module, list[Tensor]] = {norm: [] for _, norm in normed}

    def look(norm: nn.Module, inputs: tuple[Tensor, ...]) -> None:
        maps = inputs[0].double()
        seen[norm].append(torch.stack([maps.mean((0, 2, 3)), (maps**2).mean((0, 2, 3))]))

    hooks = [norm.register_forward_pre_hook(look) for norm in seen]
    with torch.inference_mode():
        for run in passes:
            run()
    for hook in hooks:
        hook.remove()
    for convolution, norm in normed:
        mean, square = torch.stack(seen[norm]).mean(0)
        length = convolution.weight.detach().flatten(1).norm(dim=1).clamp_min(LEAST_LENGTH)
        variance = (square - mean**2).clamp_min(0).float() / length**2
        gain = norm.weight / (norm.get_buffer("running_var") + norm.eps).sqrt()
        with torch.no_grad():
            norm.bias.add_(gain * (mean.float() - norm.get_buffer("running_mean")))
            norm.weight.copy_(gain * length * (variance + norm.eps).sqrt())
            convolution.weight.div_(length[:, None, None, None])
            norm.get_buffer("running_mean").copy_(mean.float() / length)
            norm.get_buffer("running_var").copy_(variance)
