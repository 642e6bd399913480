"""The two sub-networks: a compact pair of our own, and the paper's pair behind the same interface.

A blur network maps an image [n,3,h,w] (sRGB, 0..1, RGB; h and w multiples of ``MULTIPLE``) to lambda in pixels,
the log of its relative error, and feature maps; a depth network maps relative defocus, its spread, the focus
distance, the focal length in pixels, a side hint and those features to ln(z / s1) on both sides of focus, the
probability of near, and the log of the relative error. All maps are [n,1,h/s,w/s] with s the pair's stride.
"""

import functools
import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional

from model_export.config import Kind

MULTIPLE = 16
BLUR_BOUNDS_PX = (0.2, 60.0)
LOG_ERROR_BOUNDS = (-5.0, 1.5)
SPREAD_BOUNDS = (0.01, 2.0)
RATIO_BOUND = 3.5
LUMINANCE = (0.299, 0.587, 0.114)
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
class Scene:
    """What the depth network knows besides the picture, each [n]: metres, pixels (0 = unknown), -1/0/+1."""

    focus_distance_m: Tensor
    focal_length_px: Tensor
    side: Tensor


class BlurNetwork(Protocol):
    def __call__(self, image: Tensor) -> BlurEstimate: ...


class DepthNetwork(Protocol):
    def __call__(self, defocus: Tensor, spread: Tensor, scene: Scene, features: Features) -> DepthEstimate: ...


def _gaussian(sigma: float, radius: int) -> Tensor:
    """Taps [2 radius + 1] that sum to 1; sigma 0 leaves a picture as it is."""
    t = torch.arange(-radius, radius + 1, dtype=torch.float64)
    g = torch.exp(-0.5 * (t / max(sigma, 1e-6)) ** 2)
    return g / g.sum()


class BandEnergy(nn.Module):
    """Fixed front end: log energy of twelve luminance bands, three an octave, from 0.6 px up, at half size.

    Bands are differences of Gaussians on a pyramid whose next level starts where this one's Gaussian has
    doubled, so each octave costs a quarter of the one before; each energy is smoothed at 1.2 px of its level.
    Beyond the picture its edge goes on. The first octave is computed in cells of 2x2: its energies are needed at half
    size alone, so every band is four maps of that size, which the smoothing sums. The last of the maps that are seen is
    the next level.
    """

    OCTAVES = 4
    BANDS = 3
    FIRST_SIGMA = 0.6
    SMOOTH_SIGMA = 1.2
    RADIUS = 4
    FLOOR = 1e-6
    luminance: Tensor
    first_bands: Tensor
    first_rows: Tensor
    first_columns: Tensor
    bands: Tensor
    rows: Tensor
    columns: Tensor

    def __init__(self) -> None:
        super().__init__()
        sigmas = [self.FIRST_SIGMA * 2 ** (i / self.BANDS) for i in range(self.BANDS + 1)]
        # later levels start from a picture that is blurred by FIRST_SIGMA already
        more = [max(s * s - self.FIRST_SIGMA**2, 0.0) ** 0.5 for s in sigmas]
        smooth = _gaussian(self.SMOOTH_SIGMA, self.RADIUS)
        self._keep("luminance", torch.tensor(LUMINANCE)[None])
        self._keep("first_bands", _in_cells(self._kernels(sigmas)))
        self._keep("first_rows", _cell_sums(smooth, 2 * self.BANDS).transpose(2, 3))
        self._keep("first_columns", _cell_sums(smooth, self.BANDS))
        self._keep("bands", self._kernels(more))
        self._keep("rows", smooth.repeat(self.BANDS, 1)[:, None, None, :])
        self._keep("columns", smooth.repeat(self.BANDS, 1)[:, None, :, None])

    def _kernels(self, sigmas: list[float]) -> Tensor:
        """The bands between neighbours among Gaussians, and the last Gaussian [b+1,1,t,t]."""
        squares = [torch.outer(g, g) for g in (_gaussian(s, self.RADIUS) for s in sigmas)]
        return torch.stack([*(a - b for a, b in itertools.pairwise(squares)), squares[-1]])[:, None]

    def _keep(self, name: str, values: Tensor) -> None:
        self.register_buffer(name, values.float(), persistent=False)

    def forward(self, image: Tensor) -> Tensor:
        n, c, h, w = image.shape
        level = torch.matmul(self.luminance, image.reshape(n, c, h * w)).reshape(n, 1, h, w)
        energies = []
        for octave in range(self.OCTAVES):
            # room for a band and for the smoothing of its energy
            padded = functional.pad(level, (2 * self.RADIUS,) * 4, mode="replicate")
            if octave == 0:
                seen = functional.conv2d(padded, self.first_bands, stride=2)
                squares = seen[:, : 4 * self.BANDS] ** 2
                energy = functional.conv2d(functional.conv2d(squares, self.first_rows), self.first_columns)
                margin, step = self.RADIUS // 2, 1
            else:
                seen = functional.conv2d(padded, self.bands)
                rows = functional.conv2d(seen[:, : self.BANDS] ** 2, self.rows, groups=self.BANDS)
                energy = functional.conv2d(rows, self.columns, groups=self.BANDS)
                margin, step = self.RADIUS, 2
            level = seen[:, -1:, margin:-margin:step, margin:-margin:step]
            energy = torch.log(energy + self.FLOOR)
            if octave > 1:
                factor = 2.0 ** (octave - 1)
                energy = functional.interpolate(energy, scale_factor=factor, mode="bilinear", align_corners=False)
            energies.append(energy)
        return torch.cat(energies, 1) * 0.25 + 2.0


def _in_cells(kernels: Tensor) -> Tensor:
    """Kernels [k,1,t,t] for every other pixel [4k-3,1,t+1,t+1]: all but the last of each pixel in a cell of 2x2."""
    placed = torch.stack([functional.pad(kernels, (j, 1 - j, i, 1 - i)) for i in (0, 1) for j in (0, 1)], 1)
    return torch.cat([placed[:-1].flatten(0, 1), placed[-1, :1]])


def _cell_sums(taps: Tensor, sums: int) -> Tensor:
    """What taps [t] of pixels do to both pixels of a cell [sums, 2 sums, (t+1)/2, 1]: each sum has its own two maps."""
    of_cells = torch.cat([taps, taps.new_zeros(1)]).reshape(-1, 2)
    kernels = taps.new_zeros(sums, sums, 2, len(of_cells), 1)
    for number in range(sums):
        kernels[number, number, :, :, 0] = of_cells.T
    return kernels.flatten(1, 2)


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
        """The encoder's skips, finest first, and last the finest decoder map."""
        x = self.encoder[0](*inputs)
        skips = [x]
        for block in itertools.islice(self.encoder, 1, None):
            x = block(functional.max_pool2d(x, 2))
            skips.append(x)
        x = self.surroundings(x)
        for i in reversed(range(len(self.decoder))):
            x = self.decoder[i](x, skips[i], *joined[i : i + 1])
        return (*skips[:-1], x)


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


class CompactBlur(nn.Module):
    """Ours: pixels and band energies at half size into a small U-Net; hands its last features on."""

    WIDTHS = (16, 48, 64, 96)
    DILATIONS = (2, 4)

    def __init__(self) -> None:
        super().__init__()
        self.front = BandEnergy()
        finest = self.WIDTHS[0]
        image = convolution(3, finest, size=6, stride=2)
        energies = convolution(BandEnergy.OCTAVES * BandEnergy.BANDS, finest)
        self.unet = _compact_unet(Normed(image, energies), self.WIDTHS, self.DILATIONS)
        self.head = nn.Conv2d(self.WIDTHS[0], 2, 1)
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

    Where blur is certain the gate lets eq. 7 through; on flat ground the free estimate fills in. Either way
    near stays at or before the plane in focus and far behind it.
    """

    WIDTHS = (16, 32, 32, 48)
    DILATIONS = (2, 4)
    PLANES = 8

    def __init__(self) -> None:
        super().__init__()
        finest = self.WIDTHS[0]
        first = Normed(convolution(CompactBlur.WIDTHS[0], finest), convolution(self.PLANES, finest))
        self.unet = _compact_unet(first, self.WIDTHS, self.DILATIONS)
        self.head = nn.Conv2d(self.WIDTHS[0], 5, 1)
        with torch.no_grad():
            self.head.weight.mul_(0.1)
            self.head.get_parameter("bias").copy_(torch.tensor([-0.5, -0.5, 1.5, 0.0, -1.5]))

    def forward(self, defocus: Tensor, spread: Tensor, scene: Scene, features: Features) -> DepthEstimate:
        with torch.autocast(defocus.device.type, enabled=False):
            near = -torch.log1p(defocus)
            far = -torch.log1p(-defocus.clamp(max=0.97))
            known = (scene.focal_length_px > 0).float()
            focal = torch.log(scene.focal_length_px.clamp_min(50.0) / 600.0) * known
            planes = [torch.log(scene.focus_distance_m), focal, known, scene.side]
            inputs = [near, far, defocus.clamp(max=3.0), torch.log(spread.clamp(1e-3, 10.0)) * 0.3]
            inputs += [_plane(p, defocus) for p in planes]
        x = self.unet(*features, torch.cat(inputs, 1))[-1]
        with torch.autocast(defocus.device.type, enabled=False):
            out = functional.conv2d(x.float(), self.head.weight, self.head.bias)
            free_near, free_far = functional.logsigmoid(-out[:, 0:1]), -functional.logsigmoid(-out[:, 1:2])
            gate = torch.sigmoid(out[:, 2:3])
            log_near = (gate * near + (1 - gate) * free_near).clamp(-RATIO_BOUND, 0.0)
            log_far = (gate * far + (1 - gate) * free_far).clamp(0.0, RATIO_BOUND)
        return DepthEstimate(log_near, log_far, out[:, 3:4], _bounded_log_error(out[:, 4:5]))


class PaperBlur(nn.Module):
    """The paper's blur U-Net after DefocusNet: 16 base filters, four poolings; hands its encoder's skips on."""

    WIDTHS = (16, 32, 64, 128, 256)
    START_PX = 2.0

    def __init__(self) -> None:
        super().__init__()
        self.unet = _papers_unet(3, self.WIDTHS, (0,) * (len(self.WIDTHS) - 1))
        self.head = nn.Conv2d(self.WIDTHS[0], 1, 1)

    def forward(self, image: Tensor) -> BlurEstimate:
        *skips, x = self.unet(image)
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

    def forward(self, defocus: Tensor, _spread: Tensor, scene: Scene, features: Features) -> DepthEstimate:
        inputs = torch.cat([defocus.clamp(max=8.0), _plane(scene.focus_distance_m, defocus)], 1)
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


def make_pair(kind: Kind) -> Pair:
    """A fresh pair with random weights (seed torch before)."""
    if kind == "compact":
        return Pair(kind, CompactBlur(), CompactDepth(), stride=2)
    return Pair(kind, PaperBlur(), PaperDepth(), stride=1)


def parameter_count(pair: Pair) -> int:
    return sum(p.numel() for p in pair.modules().parameters())
