"""The occlusion-aware refocuser: sharp layers with depth to the picture a lens would take.

Works in linear light. Every layer's colour is blurred premultiplied with its alpha, and layers are put
over each other front to back, so a blurred edge of a near object shows what is behind it, a constant
image stays constant, and no depth edge leaves a halo. Blurring is a product in the frequency domain with
the transfer function of the point spread, so discs of any diameter cost the same.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model_export.datasets.photos import filled
from model_export.devices import columns, sent
from service.optics import thin_lens
from service.optics.camera import Camera
from service.optics.light import decode_srgb, encode_srgb

LEVEL_RATIO = 1.25
LEVEL_OFFSET_PX = 0.5
SLICES_PER_LEVEL = 0.5  # of a picture whose blur varies within each
MARGIN_SIGMAS = 3.0
SOFT_EDGE_VARIANCE = 0.25
UNSEEN = 2e-4  # of the light that comes through what is nearer
SAMPLED_BELOW_VARIANCE = 0.8
SAMPLED_TAPS = 8
JOBS = {"cpu": 2**22, "cuda": 2**27}  # numbers that are transformed at a time
Numbers = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PointSpread:
    """The shape of defocus, whatever its size.

    ``disc_share`` of the variance is a uniform disc (whose standard deviation is a quarter of its diameter), the rest
    a Gaussian; 0 is a Gaussian, 1 a disc with edges as soft as a pixel. ``squeeze`` is the ratio of the disc's axes and
    ``angle`` (rad) where the longer one points, as the barrel of a lens cuts it away from the axis (cat's eye); the
    mean variance per axis stays. ``chromatic_px`` moves red and blue along the signed defocus, green being in place.
    """

    disc_share: float = 0.0
    squeeze: float = 1.0
    angle: float = 0.0
    chromatic_px: tuple[float, float] = (0.0, 0.0)

    def reach_px(self, sigma_px: float) -> float:
        """How far from its middle one of this standard deviation has light: its disc, and what softens that."""
        of_gauss, longer_px = Spreads.of([self]).parts(np.array([sigma_px**2]))
        return float(longer_px[0] + MARGIN_SIGMAS * math.sqrt(of_gauss[0]))


GAUSSIAN = PointSpread()
DISC = PointSpread(1.0)


@dataclass(frozen=True, slots=True)
class Layer:
    """A sharp surface: premultiplied linear colour [3,h,w], alpha [1,h,w], signed defocus k_cam d [h,w] in px."""

    color: Tensor
    alpha: Tensor
    defocus_px: Tensor


@lru_cache
def _sampled_parameters() -> tuple[Numbers, Numbers]:
    """Variances of sampled Gaussians, and their parameters."""
    parameters = np.concatenate([[1e-4], np.linspace(0.02, 2 * SAMPLED_BELOW_VARIANCE, 4000)])
    x2 = np.arange(1, SAMPLED_TAPS + 1) ** 2
    weights = np.exp(-x2 / (2 * parameters[:, None]))
    return 2 * (weights * x2).sum(1) / (1 + 2 * weights.sum(1)), parameters


def sampled_taps(variance: Numbers) -> Numbers:
    """What the sampled Gaussians of these variances [n] weigh at 0, 1, ... px [n,taps], both sides together."""
    parameter = np.interp(variance, *_sampled_parameters())
    weights = np.exp(-(np.arange(SAMPLED_TAPS + 1) ** 2) / (2 * parameter[:, None]))
    weights[:, 1:] *= 2
    return np.asarray(weights / weights.sum(1, keepdims=True))


@lru_cache
def _frequencies(height: int, width: int, device: torch.device) -> tuple[tuple[Tensor, Tensor], ...]:
    """Down and across: cycles per pixel [f] of a spectrum, and their cosines at 0, 1, ... px [taps,f]."""
    both = torch.fft.fftfreq(height), torch.fft.rfftfreq(width)
    offsets = torch.arange(SAMPLED_TAPS + 1)[:, None]
    return tuple((f.to(device), torch.cos(2 * math.pi * offsets * f).to(device)) for f in both)


@dataclass(frozen=True, slots=True)
class Spreads:
    """Point spreads, a column [n] each: how much is disc, how squeezed, at which angle."""

    disc_share: Numbers
    squeeze: Numbers
    angle: Numbers

    @classmethod
    def of(cls, spreads: Sequence[PointSpread]) -> "Spreads":
        told = [(spread.disc_share, spread.squeeze, spread.angle) for spread in spreads]
        return cls(*np.array(told, np.float64).T)

    def at(self, items: NDArray[np.intp]) -> "Spreads":
        """Those of some items, in their order."""
        return Spreads(self.disc_share[items], self.squeeze[items], self.angle[items])

    def parts(self, variance: Numbers) -> tuple[Numbers, Numbers]:
        """Of point spreads with this variance per axis [n]: that of their Gaussian, their disc's longer half axis."""
        of_gauss = np.maximum((1 - self.disc_share) * variance, np.minimum(variance, SOFT_EDGE_VARIANCE))
        return of_gauss, 2 * np.sqrt(np.maximum(variance - of_gauss, 0) * 2 / (1 + self.squeeze**2))


def transfers(height: int, width: int, sigma_px: Numbers, spreads: Spreads, device: torch.device) -> Tensor:
    """Transfer functions [n,h,w//2+1] of point spreads with these standard deviations per axis [n].

    The Gaussians are sampled ones: positive and of exact variance at any sigma, where a band-limited one of half a
    pixel rings.
    """
    of_gauss, longer_px = spreads.parts(sigma_px**2)
    told = (of_gauss, of_gauss < SAMPLED_BELOW_VARIANCE, longer_px, np.cos(spreads.angle), np.sin(spreads.angle))
    gauss, narrow, longer, cos, sin, squeeze = columns(device, *told, spreads.squeeze)
    taps = sent(sampled_taps(of_gauss).astype(np.float32), device)
    (fy, cosines_down), (fx, cosines_across) = _frequencies(height, width, device)

    def along_axis(f: Tensor, cosines: Tensor) -> Tensor:
        smooth = torch.exp(-2 * math.pi**2 * gauss[:, :, 0] * f**2)
        return torch.where(narrow[:, :, 0] > 0, taps @ cosines, smooth)

    both = along_axis(fy, cosines_down)[:, :, None] * along_axis(fx, cosines_across)[:, None]
    if not longer_px.any():
        return both
    fy = fy[:, None]
    along, across = fx * cos + fy * sin, squeeze * (fy * cos - fx * sin)
    t = (2 * math.pi * longer * torch.sqrt(along**2 + across**2)).clamp_min(1e-4)
    disc: Tensor = 2 * torch.special.bessel_j1(t) / t
    return both * disc


def blur(image: Tensor, sigma_px: float, spread: PointSpread = GAUSSIAN) -> Tensor:
    """Blur [..., h, w] by one point spread; the image wraps around, so callers give it a margin."""
    height, width = image.shape[-2:]
    otf = transfers(height, width, np.array([sigma_px]), Spreads.of([spread]), image.device)[0]
    out: Tensor = torch.fft.irfft2(torch.fft.rfft2(image) * otf, s=(height, width))
    return out


@dataclass(frozen=True, slots=True)
class Levels:
    """The blurs of pictures whose blur varies, one after the other: whose, how strong, what is next below and above.

    They are close enough for a linear mix of two to pass for one between; NaN where nothing is below or above.
    """

    item: NDArray[np.intp]
    sigma_px: Numbers
    below: Numbers
    above: Numbers

    @classmethod
    def between(cls, low_px: Numbers, high_px: Numbers, ratio: float = LEVEL_RATIO) -> "Levels":
        """From the least to the strongest blur [n] of each picture."""
        span = np.log((high_px + LEVEL_OFFSET_PX) / (low_px + LEVEL_OFFSET_PX))
        count = np.maximum(1, np.ceil(span / math.log(ratio))).astype(int) + 1
        alike = high_px - low_px < 0.02
        count[alike] = 1
        item = np.repeat(np.arange(len(count)), count)
        rank = np.arange(len(item)) - np.repeat(np.cumsum(count) - count, count)
        part = rank / np.maximum(count - 1, 1)[item]
        sigma_px = (low_px + LEVEL_OFFSET_PX)[item] * np.exp(span[item] * part) - LEVEL_OFFSET_PX
        sigma_px = np.where(alike[item], ((low_px + high_px) / 2)[item], np.maximum(sigma_px, 0))
        below = np.where(rank > 0, np.roll(sigma_px, 1), np.nan)
        above = np.where(rank + 1 < count[item], np.roll(sigma_px, -1), np.nan)
        return cls(item, sigma_px, below, above)


def blur_varying(
    images: Tensor,
    sigma_px: Tensor,
    spreads: Spreads,
    bounds: tuple[Numbers, Numbers] | None = None,
    ratio: float = LEVEL_RATIO,
) -> Tensor:
    """Blur each of [n,c,h,w] by a point spread whose sigma [n,h,w] varies slowly: mixed so that variance is exact.

    ``bounds`` are the least and the most sigma of each [n], asked of the device if they are not told. Levels are
    ``ratio`` apart. A mix of two discs is no disc: who asks for its width as a disc's finds it 3.5 % too wide at the
    default, 1 % at 1.06.
    """
    device, (height, width) = images.device, images.shape[-2:]
    if bounds is None:
        low, high = (end.double().cpu().numpy() for end in torch.aminmax(sigma_px.flatten(1), dim=1))
        bounds = low, high
    levels = Levels.between(*bounds, ratio)
    spectra, variance = torch.fft.rfft2(images), sigma_px**2
    out = torch.zeros_like(images)
    step = max(1, JOBS[device.type] // images[0].numel())
    for start in range(0, len(levels.item), step):
        part = slice(start, start + step)
        item, level = levels.item[part], levels.sigma_px[part] ** 2
        at = sent(item, device)
        slopes, firsts = [], []
        for other in (levels.below[part], levels.above[part]):
            slopes.append(np.nan_to_num(1 / (level - other**2)))
            firsts.append(np.where(np.isnan(other), 1, -slopes[-1] * np.nan_to_num(other) ** 2))
        rise, fall, first, last = columns(device, *slopes, *firsts)
        seen = variance[at]
        weight = torch.minimum(rise * seen + first, fall * seen + last).clamp(0, 1)
        otf = transfers(height, width, levels.sigma_px[part], spreads.at(item), device)
        out.index_add_(0, at, weight[:, None] * torch.fft.irfft2(spectra[at] * otf[:, None], s=(height, width)))
    return out


def composite(layers: Iterable[tuple[Tensor, Tensor]]) -> Tensor:
    """Put blurred (colour premultiplied [3,h,w], alpha [1 or 3,h,w]) over each other, nearest first.

    The last layer must be opaque; what little it lacks is divided out, so a constant stays constant. Alpha is
    not clamped: a band-limited disc rings by a percent, colour and alpha alike, and cutting one alone would show.
    """
    (image, alpha), *others = layers
    clear = 1 - alpha
    for color, alpha in others:
        image = image + clear * color
        clear = clear * (1 - alpha)
    return image / (1 - clear).clamp_min(1e-3)


def _blurred(layer: Layer, spread: PointSpread) -> tuple[Tensor, Tensor]:
    """Colour [3,h,w] and alpha [1 or 3,h,w]; each colour by its own defocus where the lens is not achromatic."""
    red, blue = spread.chromatic_px
    if red == blue == 0:
        both = torch.cat([layer.color, layer.alpha])[None]
        out = blur_varying(both, layer.defocus_px.abs()[None], Spreads.of([spread]))[0]
        return out[:3], out[3:]
    planes = torch.stack([layer.color, layer.alpha.expand(3, -1, -1)], 1)
    sigma_px = torch.stack([(layer.defocus_px + shift).abs() for shift in (red, 0.0, blue)])
    out = blur_varying(planes, sigma_px, Spreads.of([spread] * 3))
    return out[:, 0], out[:, 1]


def render_layers(layers: list[Layer], spread: PointSpread) -> tuple[Tensor, Tensor]:
    """Linear picture [3,h,w] of layers given nearest first, the last one opaque, and each pixel's layer [h,w].

    A pixel belongs to the layer that most of its (green) light comes from: a twig blurred over more than its width is
    not what one sees there.
    """
    parts = [_blurred(layer, spread) for layer in layers]
    alpha = torch.stack([part[len(part) // 2] for _, part in parts])
    clear = torch.cat([torch.ones_like(alpha[:1]), torch.cumprod(1 - alpha, 0)[:-1]])
    return composite(parts), (clear * alpha).max(0).indices  # argmax is four times as slow


def _slices(defocus_px: NDArray[np.float32], per_level: float = 2.0) -> NDArray[np.int32]:
    """Number the slices of a signed defocus map [h,w], nearest 0, so many to a step of ``Levels``."""
    scaled = np.sign(defocus_px) * np.log1p(np.abs(defocus_px) / LEVEL_OFFSET_PX) / math.log(LEVEL_RATIO) * per_level
    index = np.round(scaled).astype(np.int32)
    return np.unique(index, return_inverse=True)[1].reshape(index.shape).astype(np.int32)


def _filled(image: NDArray[np.float32], known: NDArray[np.bool_]) -> NDArray[np.float32]:
    """The image with every unknown pixel given the colour of the nearest known one."""
    _, told = cv2.distanceTransformWithLabels((~known).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    labels, own = np.asarray(told, np.int32).ravel(), np.flatnonzero(known)
    nearest = np.zeros(len(own) + 1, np.intp)
    nearest[labels[own]] = own
    return image.reshape(-1, 3).take(nearest.take(labels), axis=0).reshape(image.shape)


def _slice(linear: NDArray[np.float32], index: NDArray[np.int32], number: int) -> tuple[Tensor, Tensor]:
    """Premultiplied colour [3,h,w] and alpha [1,h,w] of one slice of a picture [h,w,3], nearer ones taken away."""
    shown = torch.from_numpy((index <= number).astype(np.float32))[None]
    color = torch.from_numpy(_filled(linear, index >= number)).permute(2, 0, 1).float()
    return color * shown, shown


def sliced(linear: NDArray[np.float32], defocus_px: NDArray[np.float32]) -> tuple[list[Layer], NDArray[np.int32]]:
    """A sharp picture [h,w,3] in linear light with its signed defocus [h,w] as layers, and each pixel's layer [h,w].

    Nearest first; each is continued behind what is nearer, with the nearest colour of its own or farther ones.
    """
    index = _slices(defocus_px, SLICES_PER_LEVEL)
    layers = []
    for number in range(int(index.max()) + 1):
        color, alpha = _slice(linear, index, number)
        own = filled(np.where(index == number, defocus_px, np.float32(np.nan)))
        layers.append(Layer(color, alpha, torch.from_numpy(own)))
    return layers, index


def _strips(shown: NDArray[np.bool_], lit: NDArray[np.bool_], axis: int, reach: int) -> tuple[slice, slice]:
    """Along one axis of a picture [h,w]: where a slice is drawn, and what is blurred for it, with room for its blur.

    It is drawn as far as it reaches from where it is ``shown``, but only where it is ``lit`` through what is nearer.
    """
    size = shown.shape[axis]
    (first, last), (first_lit, last_lit) = (np.flatnonzero(seen.any(1 - axis))[[0, -1]] for seen in (shown, lit))
    low = max(first - reach, first_lit)
    high = max(low, min(last + reach, last_lit) + 1)
    start = max(0, low - reach)
    length = min(size, cv2.getOptimalDFTSize(min(size, high + reach) - start))
    start = min(start, size - length)
    return slice(low, high), slice(start, start + length)


def refocus(image: NDArray[np.float32], depth_m: NDArray[np.float32], camera: Camera) -> NDArray[np.float32]:
    """The picture [h,w,3] in 0..1 (sRGB) that ``camera`` would take of a sharp RGB picture with depth [h,w].

    ``depth_m`` is finite and positive everywhere. Depth is sliced; each slice is continued behind what is
    nearer, with the nearest colour of its own or farther slices, so background shows behind a blurred
    edge. The lens blurs by discs; gamma is applied to the whole picture, less the pixel's own box which the input has
    already.
    """
    signed = thin_lens.signed_defocus(depth_m, camera.focus_distance_m) * camera.k_cam_px
    sigma = np.abs(signed)
    margin = math.ceil(DISC.reach_px(float(sigma.max())) + GAUSSIAN.reach_px(camera.gamma_px)) + 1
    margin = min(margin, min(depth_m.shape) - 1)
    height, width = depth_m.shape
    pad = tuple((margin, cv2.getOptimalDFTSize(size + 2 * margin) - size - margin) for size in (height, width))
    linear = np.pad(decode_srgb(image), (*pad, (0, 0)), mode="reflect")
    sigma = np.pad(sigma, pad, mode="reflect")
    index = np.pad(_slices(signed), pad, mode="reflect")

    levels = np.bincount(index.ravel(), sigma.ravel()) / np.bincount(index.ravel())
    picture, clear = torch.zeros(3, *index.shape), torch.ones(1, *index.shape)
    reach = 0
    for number, level in enumerate(levels):
        # what is hidden may be seen as far as anything nearer is blurred
        reach = max(reach, math.ceil(DISC.reach_px(level)))
        shown, lit = index <= number, clear[0].abs().numpy() > UNSEEN
        if not lit.any():
            break
        place, source = zip(*(_strips(shown, lit, axis, reach) for axis in (0, 1)), strict=True)
        blurred = blur(torch.cat(_slice(linear[source], index[source], number)), level, DISC)
        own = tuple(slice(to.start - cut.start, to.stop - cut.start) for to, cut in zip(place, source, strict=True))
        color, alpha = blurred[(slice(3), *own)], blurred[(slice(3, 4), *own)]
        within = (slice(None), *place)
        picture[within] += clear[within] * color
        clear[within] *= 1 - alpha
    rest = math.sqrt(max(camera.gamma_px**2 - thin_lens.PIXEL_BOX_VARIANCE, 0.0))
    picture = blur(picture / (1 - clear).clamp_min(1e-3), rest)
    inner = picture[:, margin : margin + height, margin : margin + width]
    return encode_srgb(inner.permute(1, 2, 0).numpy())
