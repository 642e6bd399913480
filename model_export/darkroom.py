"""Pictures of scenes taken on the device that trains: many at a time, each scene again and again, never alike.

To draw a scene, its surfaces and what is on them, is work for processor cores and slow; a picture of it is some Fourier
transforms. So scenes wait as negatives, and every batch has lenses, exposures, noise and compression of its own. The
optics are those of ``render.py`` and ``scenes.py``, which tests hold them to, on [n,...] at a time. Nothing here waits
for the device.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from model_export.config import TrainConfig
from model_export.devices import columns, sent
from model_export.render import GAUSSIAN, Numbers, Spreads, blur_varying, transfers
from model_export.scenes import (
    GRAIN,
    GRAINY_SHARE,
    PLAIN_SHARE,
    READ_NOISE,
    RESCALED_SHARE,
    SHOT_NOISE,
    Negative,
    Sharpening,
    Shot,
    draw_spread,
    log_uniform,
    rest_of_gamma,
    softest_gamma_px,
)
from service.optics import thin_lens
from service.optics.light import encode_srgb

AGAIN = (0.5, 1.25)  # k_cam of another shot of a scene, of the first one's
LEAST_MARGIN_PX = 16
SQUARE, CROSS = ((1, 2, 1), (2, 4, 2), (1, 2, 1)), ((0, 1, 0), (1, 4, 1), (0, 1, 0))  # bilinear, of a colour mosaic
BLOCK = 8
# ITU-T T.81, annex K
LUMINANCE_STEPS = (
    (16, 11, 10, 16, 24, 40, 51, 61),
    (12, 12, 14, 19, 26, 58, 60, 55),
    (14, 13, 16, 24, 40, 57, 69, 56),
    (14, 17, 22, 29, 51, 87, 80, 62),
    (18, 22, 37, 56, 68, 109, 103, 77),
    (24, 35, 55, 64, 81, 104, 113, 92),
    (49, 64, 78, 87, 103, 121, 120, 101),
    (72, 92, 95, 98, 112, 100, 103, 99),
)
COLOUR_STEPS = (
    (17, 18, 24, 47, 99, 99, 99, 99),
    (18, 21, 26, 66, 99, 99, 99, 99),
    (24, 26, 56, 99, 99, 99, 99, 99),
    (47, 66, 99, 99, 99, 99, 99, 99),
    *((99,) * BLOCK,) * 4,
)
TO_YCBCR = ((0.299, 0.587, 0.114), (-0.168736, -0.331264, 0.5), (0.5, -0.418688, -0.081312))
FROM_YCBCR = ((1.0, 0.0, 1.402), (1.0, -0.344136, -0.714136), (1.0, 1.772, 0.0))


@lru_cache
def constant(values: tuple[Any, ...], device: torch.device) -> Tensor:
    """The same, once for all."""
    return torch.tensor(values, dtype=torch.float32).to(device)


def retake(rng: np.random.Generator, negative: Negative, config: TrainConfig) -> Shot:
    """The shot of a negative by another camera: a lens and softness of its own, and about the same k_cam."""
    shot, scenes = negative.shot, config.scenes
    k_cam_px = float(np.clip(shot.k_cam_px * log_uniform(rng, AGAIN), *scenes.k_cam_px))
    gamma_px = max(log_uniform(rng, scenes.gamma_px), softest_gamma_px(negative.softness))
    return replace(shot, k_cam_px=k_cam_px, gamma_px=gamma_px, spread=draw_spread(rng, k_cam_px))


@dataclass(frozen=True, slots=True)
class _Surfaces:
    """All surfaces of some scenes, one after the other: which scene each is of, and the how-manieth of it."""

    maps: Tensor
    ends: Numbers
    scene: NDArray[np.intp]
    rank: NDArray[np.intp]

    @classmethod
    def of(cls, negatives: Sequence[Negative], device: torch.device) -> "_Surfaces":
        maps = torch.cat([negative.surfaces.to(device) for negative in negatives]).float()
        count = np.array([len(negative.surfaces) for negative in negatives])
        scene = np.repeat(np.arange(len(count)), count)
        ends = np.concatenate([negative.ends for negative in negatives], 1).astype(np.float64)
        return cls(maps, ends, scene, np.arange(len(scene)) - np.repeat(np.cumsum(count) - count, count))


def _blurred(surfaces: _Surfaces, shots: Sequence[Shot]) -> tuple[Tensor, Tensor]:
    """Colour and alpha, both [n,3,h,w], of every surface as its scene's lens shows it."""
    maps, device = surfaces.maps, surfaces.maps.device
    spread = [shot.spread for shot in shots]
    spreads = Spreads.of(spread)
    k_cam_px = np.array([shot.k_cam_px for shot in shots])
    shifts = np.array([(s.chromatic_px[0], 0.0, s.chromatic_px[1]) for s in spread])
    coloured = (shifts != 0).any(1)[surfaces.scene]
    color, alpha = (torch.empty(len(maps), 3, *maps.shape[2:], device=device) for _ in range(2))
    for channels, items in (
        ((0, 1, 2), np.flatnonzero(~coloured)),
        *(((c,), np.flatnonzero(coloured)) for c in range(3)),
    ):
        if not items.size:
            continue
        scene, at = surfaces.scene[items], sent(items, device)
        shift = shifts[scene, channels[0]]
        gain, moved = columns(device, -k_cam_px[scene], shift)
        signed = maps[at, 4] * gain + moved
        edges = -k_cam_px[scene] * surfaces.ends[:, items] + shift
        least = np.where(edges[0] * edges[1] <= 0, 0, np.abs(edges).min(0))
        seen = torch.stack([maps[at, channel] for channel in (*channels, 3)], 1)
        blurred = blur_varying(seen, signed.abs(), spreads.at(scene), (least, np.abs(edges).max(0)))
        for i, channel in enumerate(channels):
            color[at, channel], alpha[at, channel] = blurred[:, i], blurred[:, -1]
    return color, alpha


def render(surfaces: _Surfaces, shots: Sequence[Shot]) -> tuple[Tensor, Tensor]:
    """Linear pictures [n,3,h,w] and q - 1 [n,1,h,w] of what most of each pixel's green light comes from."""
    color, alpha = _blurred(surfaces, shots)
    size = (len(shots), 3, *color.shape[2:])
    picture, clear = torch.zeros(size, device=color.device), torch.ones(size, device=color.device)
    most, excess = (torch.full((len(shots), *color.shape[2:]), -math.inf, device=color.device) for _ in range(2))
    order = np.argsort(surfaces.rank, kind="stable")
    ranks = np.bincount(surfaces.rank).tolist()
    both = sent(np.stack([order, surfaces.scene[order]]), color.device)
    for at, of in (pair.unbind() for pair in torch.split(both, ranks, 1)):
        through = clear[of]
        picture.index_add_(0, of, through * color[at])
        share = through[:, 1] * alpha[at, 1]
        more = share > most[of]
        excess[of] = torch.where(more, surfaces.maps[at, 4], excess[of])
        most[of] = torch.where(more, share, most[of])
        clear[of] = through * (1 - alpha[at])
    return picture / (1 - clear).clamp_min(1e-3), excess[:, None]


def soften(maps: Tensor, sigma_px: Numbers, radius: int) -> Tensor:
    """Each of [n,c,h,w] blurred by a Gaussian of its own; what is beyond the border is mirrored."""
    n, c, h, w = maps.shape
    weights = np.exp(-0.5 * (np.arange(-radius, radius + 1) / np.maximum(sigma_px, 0.05)[:, None]) ** 2)
    weights /= weights.sum(1, keepdims=True)
    taps = sent(weights.astype(np.float32), maps.device).repeat_interleave(c, 0)
    flat = functional.pad(maps.reshape(1, n * c, h, w), (radius,) * 4, mode="reflect")
    flat = functional.conv2d(flat, taps[:, None, :, None], groups=n * c)
    return functional.conv2d(flat, taps[:, None, None, :], groups=n * c).reshape(n, c, h, w)


def _through_mosaic(linear: Tensor) -> Tensor:
    """Pictures [n,3,h,w] as a sensor with one colour a pixel has them (red first), interpolated."""
    seen = torch.zeros_like(linear)
    seen[:, 0, ::2, ::2], seen[:, 2, 1::2, 1::2] = linear[:, 0, ::2, ::2], linear[:, 2, 1::2, 1::2]
    seen[:, 1, ::2, 1::2], seen[:, 1, 1::2, ::2] = linear[:, 1, ::2, 1::2], linear[:, 1, 1::2, ::2]
    around = constant((SQUARE, CROSS, SQUARE), linear.device)[:, None] / 4
    return functional.conv2d(functional.pad(seen, (1,) * 4, mode="reflect"), around, groups=3)


@lru_cache
def _cosines(device: torch.device) -> Tensor:
    """The orthonormal cosine transform of a block's side [8,8]."""
    k, x = torch.arange(BLOCK, device=device)[:, None], torch.arange(BLOCK, device=device)[None]
    out = torch.cos((2 * x + 1) * k * math.pi / (2 * BLOCK)) * math.sqrt(2 / BLOCK)
    out[0] /= math.sqrt(2)
    return out


def _quantised(plane: Tensor, steps: tuple[tuple[int, ...], ...], quality: Tensor) -> Tensor:
    """A plane [n,h,w] of -128..127 after a JPEG's blocks of the given quality [n]."""
    n, h, w = plane.shape
    cosines = _cosines(plane.device)
    scale = torch.where(quality < 50, 5000 / quality, 200 - 2 * quality)[:, None, None]
    table = ((constant(steps, plane.device) * scale + 50) / 100).floor().clamp(1, 255)[:, None, None]
    blocks = plane.reshape(n, h // BLOCK, BLOCK, w // BLOCK, BLOCK).transpose(2, 3)
    kept = (cosines @ blocks @ cosines.T / table).round() * table
    return (cosines.T @ kept @ cosines).transpose(2, 3).reshape(n, h, w)


def compressed(pixels: Tensor, quality: Tensor) -> Tensor:
    """Pictures [n,3,h,w] in 0..255, sides multiples of 16, as JPEGs of these qualities [n] show them (4:2:0)."""
    to, back = constant(TO_YCBCR, pixels.device), constant(FROM_YCBCR, pixels.device)
    ycbcr = torch.einsum("ij,njhw->nihw", to, pixels).round()
    light = _quantised(ycbcr[:, 0] - 128, LUMINANCE_STEPS, quality) + 128
    halved = functional.avg_pool2d(ycbcr[:, 1:], 2).round()
    colour = torch.stack([_quantised(halved[:, i], COLOUR_STEPS, quality) for i in (0, 1)], 1).round()
    colour = functional.interpolate(colour, scale_factor=2.0, mode="bilinear", align_corners=False)
    seen = torch.cat([light[:, None].round().clamp(0, 255), colour.round().clamp(-128, 127)], 1)
    return torch.einsum("ij,njhw->nihw", back, seen).round().clamp(0, 255)


def develop(
    rng: np.random.Generator,
    linear: Tensor,
    config: TrainConfig,
    sharpenings: Sequence[Sharpening],
    through_mosaic: NDArray[np.bool_],
    noise: torch.Generator,
) -> Tensor:
    """Light on the sensor [n,3,h,w] to a JPEG's pixels in 0..255, as ``scenes.develop`` does."""
    n, device = len(linear), linear.device
    shot_noise = np.array([log_uniform(rng, GRAIN if rng.random() < GRAINY_SHARE else SHOT_NOISE) for _ in range(n)])
    read_noise = np.array([log_uniform(rng, READ_NOISE) for _ in range(n)])
    spread = rng.uniform(0, 0.9, n)
    filtered = ~through_mosaic & (spread > 0.3)  # filters make noise of neighbours alike
    numbers = columns(
        device,
        rng.uniform(0.5, 1.4, n),
        shot_noise,
        read_noise**2,
        (1 + 1.5 * spread * filtered) * (rng.random(n) >= config.scenes.clean_share),
        ~through_mosaic & (rng.random(n) < config.scenes.grey_share),
        through_mosaic,
        rng.uniform(-0.1, 0.35, n),
        np.array([sharpening.amount for sharpening in sharpenings]),
        rng.random(n) < PLAIN_SHARE,
    )
    exposure, shot, read, grain, grey, mosaic, bend, sharp, plain = (column[:, None] for column in numbers)
    white = torch.quantile(linear[:, :, ::4, ::4].flatten(1), 0.98, dim=1).clamp_min(0.2)[:, None, None, None]
    picture = linear * exposure / white
    grains = torch.randn(linear.shape, generator=noise, device=device)
    grains = soften(torch.where(grey > 0, grains[:, :1], grains), np.where(filtered, spread, 0), 4) * grain
    picture = picture + grains * (shot * picture.clamp_min(0) + read).sqrt()
    picture = torch.where(mosaic > 0, _through_mosaic(picture.clamp(0, 2)), picture)
    picture = picture * sent(rng.uniform(0.85, 1.15, (n, 3, 1, 1)).astype(np.float32), device)
    encoded = encode_srgb(picture)
    encoded = encoded + bend * (encoded**2 * (3 - 2 * encoded) - encoded)
    soft = soften(encoded, np.array([sharpening.spread_px for sharpening in sharpenings]), 6)
    pixels = ((encoded + sharp * (encoded - soft)).clamp(0, 1) * 255).round()
    low, high = config.scenes.jpeg_quality
    quality = sent(rng.integers(low, high + 1, n).astype(np.float32), device)
    return torch.where(plain > 0, pixels, compressed(pixels, quality))


def _areas(from_px: int, to_px: int) -> NDArray[np.float32]:
    """What averaging areas makes of a row of pixels: a matrix [to_px, from_px]."""
    edges = np.arange(to_px + 1) * (from_px / to_px)
    pixels = np.arange(from_px)
    covered = np.minimum(edges[1:, None], pixels + 1) - np.maximum(edges[:-1, None], pixels)
    return np.asarray(np.clip(covered, 0, None) * (to_px / from_px), np.float32)


def photograph(
    rng: np.random.Generator, negatives: Sequence[Negative], config: TrainConfig, device: torch.device
) -> tuple[Tensor, Tensor, list[Shot]]:
    """Pictures [n,3,h,w] in 0..1, q - 1 [n,1,h,w] and the shots as they are told, of new cameras before the scenes.

    At times all are taken larger and made small.
    """
    size = config.scenes.size_px
    taken_px = size
    if rng.random() < RESCALED_SHARE:
        taken_px += 2 * max(0, config.scenes.margin_px - LEAST_MARGIN_PX)
    shots = [retake(rng, negative, config) for negative in negatives]
    surfaces = _Surfaces.of(negatives, device)
    linear, excess = render(surfaces, shots)
    sharpenings = [Sharpening.draw(rng) for _ in shots]
    rests, mosaics, told = [], [], []
    for negative, shot, sharpening in zip(negatives, shots, sharpenings, strict=True):
        before_px = thin_lens.gamma_before_averaging(shot.gamma_px, taken_px, size)
        gamma_px = max(before_px, softest_gamma_px(negative.softness))
        rest_px, through_mosaic = rest_of_gamma(rng, gamma_px, negative.softness, sharpening)
        rests.append(rest_px)
        mosaics.append(through_mosaic)
        told.append(
            replace(
                shot,
                k_cam_px=shot.k_cam_px * size / taken_px,
                gamma_px=thin_lens.gamma_after_averaging(gamma_px, taken_px, size),
                focal_length_px=shot.focal_length_px * size / taken_px,
            )
        )
    whole = linear.shape[-1]
    otf = transfers(whole, whole, np.array(rests), Spreads.of([GAUSSIAN] * len(shots)), device)
    linear = torch.fft.irfft2(torch.fft.rfft2(linear) * otf[:, None], s=(whole, whole))
    first = (whole - taken_px) // 2
    inner = slice(first, first + taken_px)
    noise = torch.Generator(device).manual_seed(int(rng.integers(2**62)))
    pixels = develop(rng, linear[:, :, inner, inner], config, sharpenings, np.array(mosaics), noise)
    excess = excess[:, :, inner, inner]
    if taken_px > size:
        areas = sent(_areas(taken_px, size), device)
        pixels = (areas @ pixels @ areas.T).round()
        at = sent(((np.arange(size) + 0.5) * taken_px / size).astype(np.intp), device)
        excess = excess[:, :, at][:, :, :, at]
    return pixels / 255, excess, told
