"""The occlusion-aware refocuser: sharp layers with depth to the picture a lens would take.

Works in linear light. Every layer's colour is blurred premultiplied with its alpha, and layers are put
over each other front to back, so a blurred edge of a near object shows what is behind it, a constant
image stays constant, and no depth edge leaves a halo. Blurring is a product in the frequency domain with
the transfer function of the point spread, so discs of any diameter cost the same.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import brentq
from torch import Tensor

from model_export.datasets.photos import filled
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


GAUSSIAN = PointSpread()
DISC = PointSpread(1.0)


@dataclass(frozen=True, slots=True)
class Layer:
    """A sharp surface: premultiplied linear colour [3,h,w], alpha [1,h,w], signed defocus k_cam d [h,w] in px."""

    color: Tensor
    alpha: Tensor
    defocus_px: Tensor


def _sampled(parameter: float) -> tuple[list[float], float]:
    """Weights at 1, 2, ... px, before normalising, of a sampled Gaussian, and the variance that it has."""
    weights = [math.exp(-(x**2) / (2 * parameter)) for x in range(1, SAMPLED_TAPS + 1)]
    return weights, 2 * sum(w * x**2 for x, w in enumerate(weights, 1)) / (1 + 2 * sum(weights))


@lru_cache(maxsize=256)
def _taps(variance: float) -> list[float]:
    """The weights of the sampled Gaussian that has this variance: sampling narrows, so its parameter is another."""
    return _sampled(brentq(lambda p: _sampled(p)[1] - variance, 1e-4, 2 * SAMPLED_BELOW_VARIANCE))[0]


def _gaussian_transfer(frequency: Tensor, variance: float) -> Tensor:
    """Transfer function of a Gaussian along one axis, at cycles per pixel."""
    if variance >= SAMPLED_BELOW_VARIANCE:
        return torch.exp(-2 * math.pi**2 * variance * frequency**2)
    out = torch.ones_like(frequency)
    for x, weight in enumerate(_taps(variance), 1):
        out = out + 2 * weight * torch.cos(2 * math.pi * x * frequency)
    return out / (1 + 2 * sum(_taps(variance)))


def transfer(height: int, width: int, sigma_px: float, spread: PointSpread) -> Tensor:
    """Transfer function [h, w//2+1] of a point spread with standard deviation ``sigma_px`` per axis.

    The Gaussian is a sampled one: positive and of exact variance at any sigma, where a band-limited one of half a
    pixel rings.
    """
    fy = torch.fft.fftfreq(height)[:, None]
    fx = torch.fft.rfftfreq(width)[None, :]
    variance = sigma_px**2
    gauss_variance = max((1 - spread.disc_share) * variance, min(variance, SOFT_EDGE_VARIANCE))
    gauss = _gaussian_transfer(fy, gauss_variance) * _gaussian_transfer(fx, gauss_variance)
    if gauss_variance >= variance:
        return gauss
    longer_px = 2 * math.sqrt((variance - gauss_variance) * 2 / (1 + spread.squeeze**2))
    along = fx * math.cos(spread.angle) + fy * math.sin(spread.angle)
    across = fy * math.cos(spread.angle) - fx * math.sin(spread.angle)
    t = (2 * math.pi * longer_px * torch.sqrt(along**2 + (spread.squeeze * across) ** 2)).clamp_min(1e-4)
    disc: Tensor = 2 * torch.special.bessel_j1(t) / t
    return gauss * disc


def blur(image: Tensor, sigma_px: float, spread: PointSpread = GAUSSIAN) -> Tensor:
    """Blur [..., h, w] by one point spread; the image wraps around, so callers give it a margin."""
    height, width = image.shape[-2:]
    spectrum = torch.fft.rfft2(image) * transfer(height, width, sigma_px, spread)
    out: Tensor = torch.fft.irfft2(spectrum, s=(height, width))
    return out


def blur_levels(low_px: float, high_px: float, ratio: float = LEVEL_RATIO) -> list[float]:
    """Standard deviations from low to high, close enough for a linear mix of two to pass for one between."""
    span = math.log((high_px + LEVEL_OFFSET_PX) / (low_px + LEVEL_OFFSET_PX))
    count = max(1, math.ceil(span / math.log(ratio))) + 1
    if high_px - low_px < 0.02:
        return [(low_px + high_px) / 2]
    base = low_px + LEVEL_OFFSET_PX
    return [base * math.exp(span * i / (count - 1)) - LEVEL_OFFSET_PX for i in range(count)]


def blur_varying(image: Tensor, sigma_px: Tensor, spread: PointSpread, ratio: float = LEVEL_RATIO) -> Tensor:
    """Blur [c,h,w] by a point spread whose sigma [h,w] varies slowly: levels mixed so that variance is exact.

    Levels are ``ratio`` apart. A mix of two discs is no disc: who asks for its width as a disc's finds it 3.5 % too
    wide at the default, 1 % at 1.06.
    """
    levels = blur_levels(float(sigma_px.min()), float(sigma_px.max()), ratio)
    if len(levels) == 1:
        return blur(image, levels[0], spread)
    height, width = image.shape[-2:]
    spectrum = torch.fft.rfft2(image)
    variance = sigma_px * sigma_px
    out = torch.zeros_like(image)
    for i, level in enumerate(levels):
        weight = torch.ones_like(variance)
        if i > 0:
            below = levels[i - 1] ** 2
            weight = torch.minimum(weight, (variance - below) / (level**2 - below))
        if i + 1 < len(levels):
            above = levels[i + 1] ** 2
            weight = torch.minimum(weight, (above - variance) / (above - level**2))
        otf = transfer(height, width, level, spread)
        out += weight.clamp_min(0) * torch.fft.irfft2(spectrum * otf, s=(height, width))
    return out


def composite(layers: Iterable[tuple[Tensor, Tensor]]) -> Tensor:
    """Put blurred (colour premultiplied [3,h,w], alpha [1 or 3,h,w]) over each other, nearest first.

    The last layer must be opaque; what little it lacks is divided out, so a constant stays constant. Alpha is
    not clamped: a band-limited disc rings by a percent, colour and alpha alike, and cutting one alone would show.
    """
    image: Tensor | None = None
    clear: Tensor | None = None
    for color, alpha in layers:
        image = color if image is None or clear is None else image + clear * color
        clear = 1 - alpha if clear is None else clear * (1 - alpha)
    if image is None or clear is None:
        raise ValueError("nothing to render: no layers")
    return image / (1 - clear).clamp_min(1e-3)


def _blurred(layer: Layer, spread: PointSpread) -> tuple[Tensor, Tensor]:
    """Colour [3,h,w] and alpha [1 or 3,h,w]; each colour by its own defocus where the lens is not achromatic."""
    red, blue = spread.chromatic_px
    if red == blue == 0:
        out = blur_varying(torch.cat([layer.color, layer.alpha]), layer.defocus_px.abs(), spread)
        return out[:3], out[3:]
    planes = [
        blur_varying(torch.cat([layer.color[i : i + 1], layer.alpha]), (layer.defocus_px + shift).abs(), spread)
        for i, shift in enumerate((red, 0.0, blue))
    ]
    return torch.stack([p[0] for p in planes]), torch.stack([p[1] for p in planes])


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
    """Number the slices of a signed defocus map [h,w], nearest 0, so many to a step of ``blur_levels``."""
    scaled = np.sign(defocus_px) * np.log1p(np.abs(defocus_px) / LEVEL_OFFSET_PX) / math.log(LEVEL_RATIO) * per_level
    index = np.round(scaled).astype(np.int32)
    return np.unique(index, return_inverse=True)[1].reshape(index.shape).astype(np.int32)


def _filled(image: NDArray[np.float32], known: NDArray[np.bool_]) -> NDArray[np.float32]:
    """The image with every unknown pixel given the colour of the nearest known one."""
    _, labels = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    nearest = np.zeros(int(labels.max()) + 1, np.intp)
    nearest[labels[known]] = np.flatnonzero(known)
    out = image.copy()
    out[~known] = image.reshape(-1, 3)[nearest[labels[~known]]]
    return out


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


def refocus(
    image: NDArray[np.float32], depth_m: NDArray[np.float32], camera: Camera, spread: PointSpread = DISC
) -> NDArray[np.float32]:
    """The picture [h,w,3] in 0..1 (sRGB) that ``camera`` would take of a sharp RGB picture with depth [h,w].

    ``depth_m`` is finite and positive everywhere. Depth is sliced; each slice is continued behind what is
    nearer, with the nearest colour of its own or farther slices, so background shows behind a blurred
    edge. gamma is applied to the whole picture, less the pixel's own box which the input has already.
    """
    signed = thin_lens.signed_defocus(depth_m, camera.focus_distance_m) * camera.k_cam_px
    sigma = thin_lens.defocus_at_depth(depth_m, camera.focus_distance_m, camera.k_cam_px)
    margin = math.ceil(MARGIN_SIGMAS * (float(sigma.max()) + camera.gamma_px)) + 1
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
        reach = max(reach, math.ceil(MARGIN_SIGMAS * (level + math.sqrt(SOFT_EDGE_VARIANCE))))
        shown, lit = index <= number, clear[0].abs().numpy() > UNSEEN
        if not lit.any():
            break
        place, source = zip(*(_strips(shown, lit, axis, reach) for axis in (0, 1)), strict=True)
        blurred = blur(torch.cat(_slice(linear[source], index[source], number)), level, spread)
        own = tuple(slice(to.start - cut.start, to.stop - cut.start) for to, cut in zip(place, source, strict=True))
        color, alpha = blurred[(slice(3), *own)], blurred[(slice(3, 4), *own)]
        within = (slice(None), *place)
        picture[within] += clear[within] * color
        clear[within] *= 1 - alpha
    rest = math.sqrt(max(camera.gamma_px**2 - thin_lens.PIXEL_BOX_VARIANCE, 0.0))
    picture = blur(picture / (1 - clear).clamp_min(1e-3), rest)
    inner = picture[:, margin : margin + height, margin : margin + width]
    return encode_srgb(inner.permute(1, 2, 0).numpy())
