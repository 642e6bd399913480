"""The two sub-networks: a compact pair of our own, and the paper's pair behind the same interface.

A blur network maps an image [n,3,h,w] (sRGB, 0..1, RGB; h and w multiples of ``MULTIPLE``) to lambda in pixels,
the log of its relative error, and feature maps; a depth network maps relative defocus, its spread, the focus
distance, the focal length in pixels, a side hint and those features to ln(z / s1) on both sides of focus, the
probability of near, and the log of the relative error. All maps are [n,1,h/s,w/s] with s the pair's stride.
"""

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
    Every Gaussian is a row and a column.
    """

    OCTAVES = 4
    BANDS = 3
    FIRST_SIGMA = 0.6
    SMOOTH_SIGMA = 1.2
    RADIUS = 4
    FLOOR = 1e-6
    first: Tensor
    rest: Tensor
    smooth: Tensor
    luminance: Tensor

    def __init__(self) -> None:
        super().__init__()
        sigmas = [self.FIRST_SIGMA * 2 ** (i / self.BANDS) for i in range(self.BANDS + 1)]
        # later levels start from a picture that is blurred by FIRST_SIGMA already
        more = [max(s * s - self.FIRST_SIGMA**2, 0.0) ** 0.5 for s in sigmas]
        self._keep("first", torch.stack([_gaussian(s, self.RADIUS) for s in sigmas]))
        self._keep("rest", torch.stack([_gaussian(s, self.RADIUS) for s in more]))
        self._keep("smooth", _gaussian(self.SMOOTH_SIGMA, self.RADIUS).repeat(self.BANDS, 1))
        self._keep("luminance", torch.tensor(LUMINANCE)[None, :, None, None])

    def _keep(self, name: str, values: Tensor) -> None:
        self.register_buffer(name, values.float(), persistent=False)

    def forward(self, image: Tensor) -> Tensor:
        level = (image * self.luminance).sum(1, keepdim=True)
        energies = []
        for octave in range(self.OCTAVES):
            blurred = self._blurred(level, self.first if octave == 0 else self.rest)
            bands = blurred[:, :-1] - blurred[:, 1:]
            energy = torch.log(self._blurred(bands**2, self.smooth, stride=2 if octave == 0 else 1) + self.FLOOR)
            if octave > 1:
                factor = 2.0 ** (octave - 1)
                energy = functional.interpolate(energy, scale_factor=factor, mode="bilinear", align_corners=False)
            energies.append(energy * 0.25 + 2.0)
            level = blurred[:, -1:, ::2, ::2]
        return torch.cat(energies, 1)

    def _blurred(self, maps: Tensor, taps: Tensor, stride: int = 1) -> Tensor:
        """Maps [n,1 or c,h,w] by the Gaussians of taps [c,t]: [n,c,h/stride,w/stride], edges continued."""
        padded = functional.pad(maps, (self.RADIUS,) * 4, mode="replicate")
        rows = functional.conv2d(padded, taps[:, None, None, :], stride=(1, stride), groups=maps.shape[1])
        return functional.conv2d(rows, taps[:, None, :, None], stride=(stride, 1), groups=taps.shape[0])


def conv_block(inputs: int, outputs: int, convolutions: int = 2) -> nn.Sequential:
    """3x3 convolution, batch norm and ReLU, as often as said."""
    layers: list[nn.Module] = []
    for i in range(convolutions):
        layers.append(nn.Conv2d(outputs if i else inputs, outputs, 3, padding=1, bias=False))
        layers += [nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers)


class Surroundings(nn.Module):
    """A residual 3x3 convolution with holes, which starts as the identity: a far look at little cost."""

    def __init__(self, width: int, dilation: int) -> None:
        super().__init__()
        self.convolution = nn.Conv2d(width, width, 3, padding=dilation, dilation=dilation, bias=False)
        self.norm: nn.Module = nn.BatchNorm2d(width)
        nn.init.zeros_(self.norm.get_parameter("weight"))

    def forward(self, x: Tensor) -> Tensor:
        change: Tensor = self.norm(self.convolution(x))
        return functional.relu(x + change)


class Stem(nn.ModuleList):
    """A first block: sees a picture in cells of 2x2, and beside it maps of half its size."""

    def forward(self, image: Tensor, beside: Tensor) -> Tensor:
        x = torch.cat([pixel_unshuffle(image) - GREY, beside], 1)
        for layer in self:
            x = layer(x)
        return x


class Joining(nn.ModuleList):
    """A block of a decoder: sees the coarser map, of that many channels, at twice its size, and others beside it."""

    def __init__(self, coarse: int, layers: Iterable[nn.Module]) -> None:
        super().__init__(layers)
        self.coarse = coarse

    def forward(self, coarse: Tensor, beside: Features) -> Tensor:
        x = torch.cat([functional.interpolate(coarse, scale_factor=2.0, mode="nearest"), *beside], 1)
        for layer in self:
            x = layer(x)
        return x


class UNet(nn.Module):
    """Encoder and decoder with skips; ``joined`` are widths of maps added to the decoder's skips, finest first.

    ``dilations`` are those of the residual convolutions at the coarsest level. Who ``sees_picture`` takes that and maps
    of half its size, else the first block takes one map.
    """

    def __init__(
        self,
        inputs: int,
        widths: tuple[int, ...],
        joined: tuple[int, ...] = (),
        decoder_convolutions: int = 2,
        dilations: tuple[int, ...] = (),
        sees_picture: bool = False,
    ) -> None:
        super().__init__()
        self.surroundings = nn.Sequential(*(Surroundings(widths[-1], d) for d in dilations))
        first = conv_block(inputs, widths[0])
        self.encoder = nn.ModuleList([Stem(first) if sees_picture else first])
        self.encoder.extend(conv_block(a, b) for a, b in itertools.pairwise(widths))
        extra = joined or (0,) * (len(widths) - 1)
        self.decoder = nn.ModuleList(
            Joining(widths[i + 1], conv_block(widths[i + 1] + widths[i] + extra[i], widths[i], decoder_convolutions))
            for i in range(len(widths) - 1)
        )

    def forward(self, *inputs: Tensor, joined: Features = ()) -> Features:
        """The encoder's skips, finest first, and last the finest decoder map."""
        x = self.encoder[0](*inputs)
        skips = [x]
        for block in itertools.islice(self.encoder, 1, None):
            x = block(functional.max_pool2d(x, 2))
            skips.append(x)
        x = self.surroundings(x)
        for i in reversed(range(len(self.decoder))):
            x = self.decoder[i](x, (skips[i], *joined[i : i + 1]))
        return (*skips[:-1], x)


def _bounded_log_error(raw: Tensor) -> Tensor:
    return raw.clamp(*LOG_ERROR_BOUNDS)


def _plane(values: Tensor, like: Tensor) -> Tensor:
    """A number per image [n] as a constant map [n,1,h,w]."""
    return values[:, None, None, None].expand(-1, 1, like.shape[2], like.shape[3])


def pixel_unshuffle(image: Tensor) -> Tensor:
    """[n,c,h,w] to [n,4c,h/2,w/2], written as slices, which every exporter and runtime takes."""
    return torch.cat([image[:, :, i::2, j::2] for i in (0, 1) for j in (0, 1)], 1)


class CompactBlur(nn.Module):
    """Ours: pixels and band energies at half size into a small U-Net; hands its last features on."""

    WIDTHS = (24, 40, 64, 96)
    DILATIONS = (2, 4)

    def __init__(self) -> None:
        super().__init__()
        self.front = BandEnergy()
        inputs = 12 + BandEnergy.OCTAVES * BandEnergy.BANDS
        self.unet = UNet(inputs, self.WIDTHS, dilations=self.DILATIONS, sees_picture=True)
        self.head = nn.Conv2d(self.WIDTHS[0], 2, 1)
        nn.init.constant_(self.head.get_parameter("bias")[0:1], math.log(2.0))

    def forward(self, image: Tensor) -> BlurEstimate:
        with torch.autocast(image.device.type, enabled=False):
            energies = self.front(image.float())
        features = self.unet(image, energies)[-1]
        with torch.autocast(image.device.type, enabled=False):
            out = functional.conv2d(features.float(), self.head.weight, self.head.bias)
        log_blur = out[:, :1].clamp(*(math.log(b) for b in BLUR_BOUNDS_PX))
        return BlurEstimate(torch.exp(log_blur), _bounded_log_error(out[:, 1:]), (features,))


class CompactDepth(nn.Module):
    """Ours: starts from the plain inversion and mixes in what the surroundings say, by a learned gate.

    Where blur is certain the gate lets eq. 7 through; on flat ground the free estimate fills in. Either way
    near stays at or before the plane in focus and far behind it.
    """

    WIDTHS = (16, 24, 32, 48)
    DILATIONS = (2, 4)
    INPUTS = 8

    def __init__(self) -> None:
        super().__init__()
        self.unet = UNet(CompactBlur.WIDTHS[0] + self.INPUTS, self.WIDTHS, dilations=self.DILATIONS)
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
        x = self.unet(torch.cat([*features, *inputs], 1))[-1]
        with torch.autocast(defocus.device.type, enabled=False):
            out = functional.conv2d(x.float(), self.head.weight, self.head.bias)
            free_near, free_far = -functional.softplus(out[:, 0:1]), functional.softplus(out[:, 1:2])
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
        self.unet = UNet(3, self.WIDTHS, decoder_convolutions=1)
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
        self.unet = UNet(2, self.WIDTHS, joined=self.WIDTHS[:-1], decoder_convolutions=1)
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
