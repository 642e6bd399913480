"""The two sub-networks: a compact pair of our own, and the paper's pair behind the same interface.

A blur network maps an image [n,3,h,w] (sRGB, 0..1, RGB; h and w multiples of ``MULTIPLE``) to lambda in pixels,
the log of its relative error, and feature maps; a depth network maps relative defocus, its spread, the focus
distance, the focal length in pixels, a side hint and those features to ln(z / s1) on both sides of focus, the
probability of near, and the log of the relative error. All maps are [n,1,h/s,w/s] with s the pair's stride.
"""

import functools
import itertools
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from model_export.band_energy import BandEnergy
from model_export.config import Kind

MULTIPLE = 16
BLUR_BOUNDS_PX = (0.2, 60.0)
LOG_ERROR_BOUNDS = (-5.0, 1.5)
RATIO_BOUND = 3.5
# A network draws towards focus what is little out of it, however well its blur is read. Plain inversion tells where its
# variance, so many times, is below the network's (odds grow with this power of their ratio), and both are hardly apart
# (ln z, standard deviation of a normal law): docs/findings.md
PLAIN_DOUBT, PLAIN_POWER, PLAIN_APART = 6.0, 3.0, 0.1
GREY = 0.5

Features = tuple[Tensor, ...]


@dataclass(frozen=True, slots=True)
class BlurEstimate:
    """lambda in px, the log of the Laplace scale of ln lambda, and what the depth network gets to see."""

    blur_px: Tensor
    log_error: Tensor
    features: Features


@dataclass(frozen=True, slots=True)
class DepthEstimate:
    """ln(z / s1) on the near (<= 0) and far (>= 0) side, logit of near, log of the Laplace scale of ln z."""

    log_ratio_near: Tensor
    log_ratio_far: Tensor
    near_logit: Tensor
    log_scale: Tensor


@dataclass(frozen=True, slots=True)
class LaidOutEstimate(DepthEstimate):
    """With the coarsest map [n,c,h,w], which the layout is seen in, and what that adds to the logit [n,1,h,w]."""

    layout_map: Tensor
    layout_odds: Tensor


@dataclass(frozen=True, slots=True)
class Conditioning:
    """What the depth network knows besides the picture, each [n]: metres, pixels (0 = unknown), -1/0/+1."""

    focus_distance_m: Tensor
    focal_length_px: Tensor
    side: Tensor


@dataclass(frozen=True, slots=True)
class Widths:
    """Channels of both U-Nets, finest level first; the defaults are those of the compact pair that ships."""

    blur: tuple[int, ...] = (16, 32, 48, 96)
    depth: tuple[int, ...] = (16, 16, 16, 48)

    @classmethod
    def of(cls, weights: Mapping[str, Tensor]) -> "Widths":
        """Those of a pair's weights, by the names of ``Pair.modules()``."""
        return cls(*(_widths_of(network, weights) for network in ("blur", "depth")))


def _widths_of(network: str, weights: Mapping[str, Tensor]) -> tuple[int, ...]:
    kernels = (f"{network}.unet.encoder.{level}.layers.0.ways.0.weight" for level in itertools.count())
    return tuple(weights[name].shape[0] for name in itertools.takewhile(weights.__contains__, kernels))


SHIPPED_WIDTHS = Widths()


class Normed(nn.Module):
    """Convolutions, each of a map of its own, added under one batch norm: nothing is joined before it is convolved."""

    def __init__(self, *ways: nn.Module) -> None:
        super().__init__()
        self.ways = nn.ModuleList(ways)
        self.norm: nn.Module = nn.BatchNorm2d(self.convolutions()[-1].out_channels)

    def convolutions(self) -> list[nn.Conv2d]:
        return [module for module in self.ways.modules() if isinstance(module, nn.Conv2d)]

    def forward(self, *maps: Tensor) -> Tensor:
        parts = (way(x) for way, x in zip(self.ways, maps, strict=True))
        normed: Tensor = self.norm(functools.reduce(torch.add, parts))
        return normed


class Block(nn.Module):
    """Normed convolutions, a ReLU after each; the first may see several maps."""

    def __init__(self, first: Normed, *more: Normed) -> None:
        super().__init__()
        self.layers = nn.ModuleList([first, *more])

    def forward(self, *maps: Tensor) -> Tensor:
        first, *more = self.layers
        x = functional.relu(first(*maps))
        for layer in more:
            x = functional.relu(layer(x))
        return x


def convolution(inputs: int, outputs: int, size: int = 3, stride: int = 1, dilation: int = 1) -> nn.Conv2d:
    """A map 1/stride as large; without a bias, for a batch norm follows."""
    padding = dilation * (size - stride) // 2
    return nn.Conv2d(inputs, outputs, size, stride, padding, dilation, bias=False)


def plain_layers(*widths: int) -> list[Normed]:
    """Convolutions of one map, from each width to the next."""
    return [Normed(convolution(a, b)) for a, b in itertools.pairwise(widths)]


class Enlarged(nn.Module):
    """A convolution of a map, made twice as large after it: a quarter of the work, and no joint at the cells' edges."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.convolution = convolution(inputs, outputs)

    def forward(self, x: Tensor) -> Tensor:
        return functional.interpolate(self.convolution(x), scale_factor=2.0, mode="bilinear", align_corners=False)


class Concatenated(Block):
    """The paper's block of a decoder: the first map, a coarser one, at twice its size, concatenated with the rest."""

    def forward(self, *maps: Tensor) -> Tensor:
        coarse, *beside = maps
        enlarged = functional.interpolate(coarse, scale_factor=2.0, mode="nearest")
        return super().forward(torch.cat([enlarged, *beside], 1))


class Surroundings(nn.Module):
    """A residual 3x3 convolution with holes, which starts as the identity: a far look at little cost."""

    def __init__(self, width: int, dilation: int) -> None:
        super().__init__()
        self.change = Normed(convolution(width, width, dilation=dilation))
        nn.init.zeros_(self.change.norm.get_parameter("weight"))

    def forward(self, x: Tensor) -> Tensor:
        return functional.relu(x + self.change(x))


class UNet(nn.Module):
    """Encoder and decoder with skips: blocks finest first, the encoder's one more than the decoder's.

    A decoder's block sees the coarser map, the encoder's map of its size, and what is joined there. ``dilations`` are
    those of the residual convolutions at the coarsest level, of that many channels.
    """

    def __init__(
        self, encoder: Iterable[Block], decoder: Iterable[Block], coarsest: int, dilations: tuple[int, ...] = ()
    ) -> None:
        super().__init__()
        self.encoder, self.decoder = nn.ModuleList(encoder), nn.ModuleList(decoder)
        self.surroundings = nn.Sequential(*(Surroundings(coarsest, d) for d in dilations))

    def forward(self, *inputs: Tensor, joined: Features = ()) -> Features:
        """The encoder's skips, finest first, the coarsest map, and last the finest decoder map."""
        x = self.encoder[0](*inputs)
        skips = [x]
        for block in itertools.islice(self.encoder, 1, None):
            x = block(functional.max_pool2d(x, 2))
            skips.append(x)
        skips[-1] = x = self.surroundings(x)
        for i in reversed(range(len(self.decoder))):
            x = self.decoder[i](x, skips[i], *joined[i : i + 1])
        return (*skips, x)


class Layout(nn.Module):
    """What the arrangement of a picture adds to the log odds of near [n,1,h,w], from a U-Net's coarsest map [n,c,h,w].

    A floor is nearer below, what stands before a wall is nearer than it: that is seen from afar alone. Each of the
    residual convolutions with holes looks twice as far as the one before. In the beginning it adds nothing.
    """

    WIDTH = 32
    DILATIONS = (1, 2, 4, 8)

    def __init__(self, coarsest: int) -> None:
        super().__init__()
        first = Block(*plain_layers(coarsest, self.WIDTH))
        self.look = nn.Sequential(first, *(Surroundings(self.WIDTH, d) for d in self.DILATIONS))
        self.head = nn.Conv2d(self.WIDTH, 1, 1)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.get_parameter("bias"))

    def forward(self, coarse: Tensor) -> Tensor:
        seen = self.look(coarse)
        with torch.autocast(coarse.device.type, enabled=False):
            return functional.conv2d(seen.float(), self.head.weight, self.head.bias)


def _compact_unet(first: Normed, widths: tuple[int, ...], dilations: tuple[int, ...]) -> UNet:
    """Ours: two convolutions a block, the first of all being given."""
    encoder = [Block(first, *plain_layers(*widths[:1] * 2))]
    encoder += [Block(*plain_layers(a, b, b)) for a, b in itertools.pairwise(widths)]
    decoder = [
        Block(Normed(Enlarged(coarse, own), convolution(own, own)), *plain_layers(own, own))
        for own, coarse in itertools.pairwise(widths)
    ]
    return UNet(encoder, decoder, widths[-1], dilations)


def _papers_unet(inputs: int, widths: tuple[int, ...], joined: tuple[int, ...]) -> UNet:
    """The paper's: two convolutions a block on the way down, one on the way up; ``joined`` are widths of more skips."""
    encoder = [Block(*plain_layers(a, b, b)) for a, b in itertools.pairwise((inputs, *widths))]
    decoder = [
        Concatenated(*plain_layers(coarse + own + more, own))
        for (own, coarse), more in zip(itertools.pairwise(widths), joined, strict=True)
    ]
    return UNet(encoder, decoder, widths[-1])


def _bounded_log_error(raw: Tensor) -> Tensor:
    return raw.clamp(*LOG_ERROR_BOUNDS)


def _plane(values: Tensor, like: Tensor) -> Tensor:
    """A number per image [n] as a constant map [n,1,h,w]."""
    return values[:, None, None, None].expand(-1, 1, like.shape[2], like.shape[3])


def _weighed(plain: Tensor, free: Tensor, freedom: Tensor, surer: Tensor) -> Tensor:
    """ln(z / s1): plain inversion with a share of the free estimate, or without where plain inversion tells.

    ``surer`` is the logarithm of how far below the depth network's error that of x is, to the power: an error of x is
    one of z / s1 times that in ln z, on either side (eq. 7).
    """
    apart = freedom * (plain - free)
    doubt = apart * apart * (0.5 / PLAIN_APART**2) + plain * (2 * PLAIN_POWER) - surer
    return plain - torch.sigmoid(doubt) * apart


class CompactBlur(nn.Module):
    """Ours: pixels and band energies at half size into a small U-Net; hands its last features on."""

    DILATIONS = (2, 4)

    def __init__(self, widths: tuple[int, ...]) -> None:
        super().__init__()
        self.front = BandEnergy()
        finest = widths[0]
        image = convolution(3, finest, size=6, stride=2)
        energies = convolution(BandEnergy.OCTAVES * BandEnergy.BANDS, finest)
        self.unet = _compact_unet(Normed(image, energies), widths, self.DILATIONS)
        self.head = nn.Conv2d(finest, 2, 1)
        nn.init.constant_(self.head.get_parameter("bias")[0:1], math.log(2.0))

    def forward(self, image: Tensor) -> BlurEstimate:
        with torch.autocast(image.device.type, enabled=False):
            energies = self.front(image.float())
        features = self.unet(image - GREY, energies)[-1]
        with torch.autocast(image.device.type, enabled=False):
            out = functional.conv2d(features.float(), self.head.weight, self.head.bias)
        log_blur = out[:, :1].clamp(*(math.log(b) for b in BLUR_BOUNDS_PX))
        return BlurEstimate(torch.exp(log_blur), _bounded_log_error(out[:, 1:]), (features,))


class CompactDepth(nn.Module):
    """Ours: starts from the plain inversion and mixes in what the surroundings say, by a learned gate.

    Where blur is certain the gate lets eq. 7 through, and so do the errors that are stated; on flat ground the free
    estimate fills in. Either way near stays at or before the plane in focus and far behind it. Which it is the finest
    map tells, and the layout: but for where ``lays_out`` is off, while all else is learned of scenes too small to show
    one.
    """

    DILATIONS = (2, 4)
    PLANES = 8

    def __init__(self, features: int, widths: tuple[int, ...]) -> None:
        super().__init__()
        finest = widths[0]
        first = Normed(convolution(features, finest), convolution(self.PLANES, finest))
        self.unet = _compact_unet(first, widths, self.DILATIONS)
        self.coarsest, self.times = widths[-1], 2.0 ** (len(widths) - 1)
        self.layout, self.lays_out = Layout(self.coarsest), True
        self.head = nn.Conv2d(finest, 5, 1)
        with torch.no_grad():
            self.head.weight.mul_(0.1)
            self.head.get_parameter("bias").copy_(torch.tensor([-0.5, -0.5, 1.5, 0.0, -1.5]))

    def forward(
        self, defocus: Tensor, spread: Tensor, conditioning: Conditioning, features: Features
    ) -> LaidOutEstimate:
        with torch.autocast(defocus.device.type, enabled=False):
            near = -torch.log1p(defocus)
            far = -torch.log1p(-defocus.clamp(max=0.97))
            known = (conditioning.focal_length_px > 0).float()
            focal = torch.log(conditioning.focal_length_px.clamp_min(50.0) / 600.0) * known
            planes = [torch.log(conditioning.focus_distance_m), focal, known, conditioning.side]
            log_spread = torch.log(spread.clamp(1e-3, 10.0))
            inputs = [near, far, defocus.clamp(max=3.0), log_spread * 0.3]
            inputs += [_plane(p, defocus) for p in planes]
        *_, coarsest, x = self.unet(*features, torch.cat(inputs, 1))
        layout_odds = self.layout(coarsest) if self.lays_out else torch.zeros_like(coarsest[:, :1])
        enlarged = functional.interpolate(layout_odds, scale_factor=self.times, mode="bilinear", align_corners=False)
        with torch.autocast(defocus.device.type, enabled=False):
            out = functional.conv2d(x.float(), self.head.weight, self.head.bias)
            free_near, free_far = functional.logsigmoid(-out[:, 0:1]), -functional.logsigmoid(-out[:, 1:2])
            freedom, log_scale = torch.sigmoid(-out[:, 2:3]), _bounded_log_error(out[:, 4:5])
            surer = (log_scale - log_spread) * (2 * PLAIN_POWER) - PLAIN_POWER * math.log(PLAIN_DOUBT)
            log_near = _weighed(near, free_near, freedom, surer).clamp(-RATIO_BOUND, 0.0)
            log_far = _weighed(far, free_far, freedom, surer).clamp(0.0, RATIO_BOUND)
        near_logit = enlarged + out[:, 3:4]
        return LaidOutEstimate(log_near, log_far, near_logit, log_scale, coarsest, layout_odds)


class PaperBlur(nn.Module):
    """The paper's blur U-Net after DefocusNet: 16 base filters, four poolings; hands its encoder's skips on."""

    WIDTHS = (16, 32, 64, 128, 256)
    START_PX = 2.0

    def __init__(self) -> None:
        super().__init__()
        self.unet = _papers_unet(3, self.WIDTHS, (0,) * (len(self.WIDTHS) - 1))
        self.head = nn.Conv2d(self.WIDTHS[0], 1, 1)

    def forward(self, image: Tensor) -> BlurEstimate:
        *skips, _, x = self.unet(image)
        with torch.autocast(image.device.type, enabled=False):
            raw = functional.conv2d(x.float(), self.head.weight, self.head.bias)
        blur_px = functional.softplus(raw + self.START_PX).clamp(*BLUR_BOUNDS_PX)
        return BlurEstimate(blur_px, torch.full_like(blur_px, math.log(0.2)), tuple(skips))


class PaperDepth(nn.Module):
    """The paper's depth U-Net: fed relative defocus and focus distance, its decoder joined to the image's skips.

    It answers one depth, on whichever side: both hypotheses are that one, and the error it states is a constant.
    """

    WIDTHS = PaperBlur.WIDTHS

    def __init__(self) -> None:
        super().__init__()
        self.unet = _papers_unet(2, self.WIDTHS, self.WIDTHS[:-1])
        self.head = nn.Conv2d(self.WIDTHS[0], 1, 1)

    def forward(
        self, defocus: Tensor, _spread: Tensor, conditioning: Conditioning, features: Features
    ) -> DepthEstimate:
        inputs = torch.cat([defocus.clamp(max=8.0), _plane(conditioning.focus_distance_m, defocus)], 1)
        x = self.unet(inputs, joined=features)[-1]
        with torch.autocast(defocus.device.type, enabled=False):
            log_ratio = functional.conv2d(x.float(), self.head.weight, self.head.bias)
        log_ratio = log_ratio.clamp(-RATIO_BOUND, RATIO_BOUND)
        return DepthEstimate(log_ratio, log_ratio, -10 * log_ratio, torch.full_like(log_ratio, math.log(0.2)))


@dataclass(frozen=True, slots=True)
class Pair:
    """A blur and a depth network that belong together."""

    kind: Kind
    blur: nn.Module
    depth: nn.Module
    stride: int

    def modules(self) -> nn.ModuleDict:
        return nn.ModuleDict({"blur": self.blur, "depth": self.depth})


def make_pair(kind: Kind, widths: Widths = SHIPPED_WIDTHS) -> Pair:
    """A fresh pair with random weights (seed torch before); ``widths`` are the compact one's: the paper's are fixed."""
    if kind == "compact":
        return Pair(kind, CompactBlur(widths.blur), CompactDepth(widths.blur[0], widths.depth), stride=2)
    return Pair(kind, PaperBlur(), PaperDepth(), stride=1)


def with_fresh_decoders(pair: Pair) -> Pair:
    """The pair's encoders below decoders and heads that begin anew, with random weights (seed torch before)."""
    own = pair.modules().state_dict()
    fresh = make_pair(pair.kind, Widths.of(own))
    kept = {name: value for name, value in own.items() if not {"decoder", "head"} & set(name.split("."))}
    fresh.modules().load_state_dict(fresh.modules().state_dict() | kept)
    return fresh


def parameter_count(pair: Pair) -> int:
    return sum(p.numel() for p in pair.modules().parameters())
