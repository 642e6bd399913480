"""Fewer channels for nearly the same answers: those left out become sums of those kept.

A network that was trained wide computes much of it twice. Of each map between layers those channels are kept from
which the others follow best, by least squares over pictures, and whoever saw the others sees the sums instead (so
ThiNet, Luo et al. 2017, chooses channels). Training goes on from there.
"""

import copy
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import NamedTuple

import torch
from rich.console import Console
from torch import Tensor, nn
from torch.nn import functional

from model_export.batch_norms import batch_norm, norm_gain, restored, spread_norms
from model_export.checkpoint import Checkpoint
from model_export.config import TrainConfig
from model_export.devices import torch_threads
from model_export.losses import Batch, run_pair
from model_export.networks import Normed, Pair, Widths, make_pair
from model_export.pool import Pool, held_out
from model_export.scenes import Material
from model_export.textures import load_photographs
from service.terminal import progress_bar

PIXELS = 10_000  # of a batch, of each map
RIDGE = 1e-7
CONFIG = TrainConfig(pool=320)


class _View:
    """A layer that sees a map, by one of its ways, pooled or not."""

    def __init__(self, layer: Normed, way: int = 0, *, pooled: bool = False) -> None:
        self.norm, self.kernels = batch_norm(layer), layer.convolutions()[way]
        self._pooled = pooled
        channels = self.kernels.in_channels
        self._moments = torch.zeros(channels + 1, channels + 1, dtype=torch.float64)

    def look(self, made: Tensor) -> None:
        """Remember the second moments of a map's channels [n,c,h,w] and a constant 1."""
        maps = functional.max_pool2d(made, 2) if self._pooled else made
        pixels = maps.movedim(1, -1).flatten(0, -2)
        pixels = functional.pad(pixels[:: max(1, len(pixels) // PIXELS)].double(), (0, 1), value=1.0)
        self._moments += pixels.T @ pixels / len(pixels)

    def left_unsaid(self, kept: list[int]) -> float:
        """What part of that which the layer makes of the map does not follow from the kept channels."""
        left, moments, weights = self._left(kept), self._seen, self._weights
        rest = moments[left][:, left] - moments[left][:, [*kept, -1]] @ self._sums(kept)
        return float((weights[left][:, left] * rest).sum() / (weights * moments[:-1, :-1]).sum())

    def see(self, kept: list[int]) -> None:
        """Have the layer see the kept channels alone, and through them what followed from them."""
        left, sums = self._left(kept), self._sums(kept).float()
        kernels = self.kernels.weight.detach()
        of_left = kernels[:, left]
        self.kernels.weight = nn.Parameter(kernels[:, kept] + torch.einsum("oikl,si->oskl", of_left, sums[:-1]))
        self.norm.get_buffer("running_mean").sub_(torch.einsum("oikl,i->o", of_left, sums[-1]))

    def _left(self, kept: list[int]) -> list[int]:
        return sorted(set(range(len(self._moments) - 1)) - set(kept))

    @cached_property
    def _weights(self) -> Tensor:
        """How what the layer makes weighs products of channels [c,c]."""
        kernels = (self.kernels.weight * norm_gain(self.norm)[:, None, None, None]).detach().double()
        return torch.einsum("oikl,ojkl->ij", kernels, kernels)

    @cached_property
    def _seen(self) -> Tensor:
        """The mean moments, once all was looked at [c+1,c+1]."""
        return self._moments / self._moments[-1, -1] + RIDGE * torch.eye(len(self._moments))

    def _sums(self, kept: list[int]) -> Tensor:
        """The channels left out by the kept ones and a constant [k+1,left]."""
        moments, given = self._seen, [*kept, -1]
        sums: Tensor = torch.linalg.solve(moments[given][:, given], moments[given][:, self._left(kept)])
        return sums


@dataclass(frozen=True, slots=True)
class _Map:
    """What a layer makes, by whom it is seen, and how many of its channels are to stay."""

    layer: Normed
    views: tuple[_View, ...]
    channels: int

    def look(self, _layer: nn.Module, _seen: object, made: Tensor) -> None:
        for view in self.views:
            view.look(functional.relu(made))

    def kept(self) -> list[int]:
        """The channels to keep: one after the other goes that is missed least."""
        kept = list(range(batch_norm(self.layer).num_features))
        while len(kept) > self.channels:
            without = [[other for other in kept if other != one] for one in kept]
            kept = min(without, key=lambda some: sum(view.left_unsaid(some) for view in self.views))
        return kept

    def make(self, kept: list[int]) -> None:
        """Have the layer make the kept channels alone."""
        for convolution in self.layer.convolutions():
            convolution.weight = nn.Parameter(convolution.weight.detach()[kept])
        norm = batch_norm(self.layer)
        norm.weight, norm.bias = (nn.Parameter(values.detach()[kept]) for values in (norm.weight, norm.bias))
        for name in ("running_mean", "running_var"):
            norm.register_buffer(name, norm.get_buffer(name)[kept])


def require_fewer(pair: Pair, widths: Widths) -> None:
    """Raise ``ValueError`` for widths larger than a pair's, or 0, or others at the finest or the coarsest level."""
    own = Widths.of(pair.modules().state_dict())
    for has, wanted in ((own.blur, widths.blur), (own.depth, widths.depth)):
        ends = (has[0], has[-1]) == (wanted[0], wanted[-1])
        if not ends or len(has) != len(wanted) or not all(0 < b <= a for a, b in zip(has, wanted, strict=True)):
            raise ValueError(f"of {has} channels only those between the first and the last become fewer: not {wanted}")


def narrowed(pair: Pair, widths: Widths, batches: Iterable[Batch]) -> Pair:
    """The compact pair with fewer channels between its finest and its coarsest level, in evaluation mode.

    What its maps hold for the batches decides which. Raises ``ValueError`` as ``require_fewer`` does.
    """
    require_fewer(pair, widths)
    pair = replace(pair, blur=copy.deepcopy(pair.blur).eval(), depth=copy.deepcopy(pair.depth).eval())
    own = Widths.of(pair.modules().state_dict())
    maps = [*_maps(pair.blur, own.blur, widths.blur), *_maps(pair.depth, own.depth, widths.depth)]
    hooks = [each.layer.register_forward_hook(each.look) for each in maps]
    with torch.inference_mode():
        for batch in batches:
            run_pair(pair, batch)
    for hook in hooks:
        hook.remove()
    with torch.no_grad(), torch_threads(1):  # matrices are small
        kept = [each.kept() for each in maps]
        for each, channels in zip(maps, kept, strict=True):
            for view in each.views:
                view.see(channels)
        for each, channels in zip(maps, kept, strict=True):
            each.make(channels)
    narrow = make_pair(pair.kind, widths)
    narrow.modules().load_state_dict(pair.modules().state_dict())
    narrow.modules().eval()
    return narrow


class Change(NamedTuple):
    """Mean difference of ln lambda and of ln z, the nearer one's."""

    blur: float
    depth: float


def narrow(
    model: Path,
    textures: Path,
    widths: Widths,
    out: Path,
    config: TrainConfig = CONFIG,
    console: Console | None = None,
) -> Change:
    """Write a checkpoint of a model folder's pair with fewer channels; how its answers differ on other scenes.

    Of ``config`` the scenes count, and the pool they are drawn from. Raises ``ValueError`` for a folder of another
    kind, or widths that are not fewer.
    """
    wide, material = restored(model), Material(load_photographs(textures))
    require_fewer(wide, widths)
    pool = Pool(config, material, 0, workers=1)
    with progress_bar(console) as progress:
        for _ in progress.track(pool.fill(), total=config.pool, description="scenes"):
            pass
        batches = list(pool.settling())
        spread_norms(wide, (partial(run_pair, wide, batch) for batch in batches))
        pair = narrowed(wide, widths, progress.track(batches, description="channels"))
        Checkpoint(config, 0, pair.modules().state_dict(), []).save(out)
        numbers = progress.track(range(2 * config.batch), description="held-out scenes")
        test = held_out(config.scenes, material, numbers)
    with torch.inference_mode():
        (blur, depth), (narrow_blur, narrow_depth) = (run_pair(either, test) for either in (wide, pair))
    changed_blur = (torch.log(narrow_blur.blur_px) - torch.log(blur.blur_px)).abs().mean()
    changed_depth = (narrow_depth.log_ratio_near - depth.log_ratio_near).abs().mean()
    return Change(float(changed_blur), float(changed_depth))


def _maps(network: nn.Module, own: tuple[int, ...], widths: tuple[int, ...]) -> Iterator[_Map]:
    """The maps of a network that lose channels: four of each level."""

    def layer(path: str) -> Normed:
        found = network.get_submodule(f"unet.{path}")
        if not isinstance(found, Normed):
            raise TypeError(f"{path} is no normed layer")
        return found

    for level, channels in enumerate(widths):
        if channels < own[level]:
            down, up = (tuple(layer(f"{way}.{level}.layers.{i}") for i in (0, 1)) for way in ("encoder", "decoder"))
            coarser, finer = layer(f"encoder.{level + 1}.layers.0"), layer(f"decoder.{level - 1}.layers.0")
            yield _Map(down[0], (_View(down[1]),), channels)
            yield _Map(down[1], (_View(coarser, pooled=True), _View(up[0], way=1)), channels)
            yield _Map(up[0], (_View(up[1]),), channels)
            yield _Map(up[1], (_View(finer),), channels)
