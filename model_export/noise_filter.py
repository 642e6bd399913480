"""What cameras do about noise: filters that keep outlines but take faint texture, and sharpening after them.

So treated a picture looks more blurred than its lens made it, wherever texture was faint. Networks learn what is true
of it all the same (``filtered_share``). The filters are of the families that cameras have: means weighed by likeness of
pixels (bilateral) or of patches (non-local), and coring of fine bands, as filters of wavelets do.
"""

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from model_export.darkroom import TO_YCBCR, compressed, constant, soften
from model_export.devices import sent

NOISE = (0.6, 7.0)  # grey levels, there before the filter
STRENGTH = (0.7, 3.0)  # in deviations of that noise
PATCHES, REACHES = (1, 3, 5), (2, 3, 4, 5)
CORED_SHARE = 0.3
BANDS = ((0.7, 1.0), (1.4, 0.5), (2.8, 0.25))  # what is finer than so many pixels; noise there, of its own
MOST_LEFT = 0.35  # of what a filter takes
COLOUR_SHARE, COLOUR_PX = 0.5, (0.7, 3.0)  # colour is blurred
SHARPENED_SHARE, AMOUNT, SPREAD_PX = 0.6, (0.2, 1.2), (0.6, 1.6)
COMPRESSED_SHARE, QUALITY = 0.7, (75, 98)
REACH_PX = 8


def _brightness(pictures: Tensor) -> Tensor:
    return (pictures * constant(TO_YCBCR, pictures.device)[0, :, None, None]).sum(1, keepdim=True)


def _means(pictures: Tensor, noise: Tensor, strength: Tensor, patch: int, reach: int) -> Tensor:
    """Means [n,3,h,w] over what is around, weighed by how alike the patches about two pixels are."""
    light, (h, w) = _brightness(pictures), pictures.shape[2:]
    lights, colours = (functional.pad(maps, (reach,) * 4, mode="reflect") for maps in (light, pictures))
    total, weights = pictures.clone(), torch.ones_like(light)
    by_noise = 2 * noise**2 / 3  # what noise alone makes of a squared difference
    for down in range(2 * reach + 1):
        for across in range(2 * reach + 1):
            if down == across == reach:
                continue
            at = (..., slice(down, down + h), slice(across, across + w))
            unlike = functional.avg_pool2d((lights[at] - light) ** 2, patch, 1, patch // 2, count_include_pad=False)
            weight = torch.exp(-(unlike - by_noise).clamp_min(0) / (strength * noise) ** 2)
            total += weight * colours[at]
            weights += weight
    return total / weights


def _cored(pictures: Tensor, least: Tensor) -> Tensor:
    """Pictures [n,3,h,w] whose fine bands lost what is below the least [n,1,1,1], and as much of the rest."""
    coarse, kept = pictures, torch.zeros_like(pictures)
    for sigma_px, part in BANDS:
        soft = soften(coarse, np.full(len(pictures), sigma_px), REACH_PX)
        kept = kept + functional.softshrink((coarse - soft) / (least * part), 1.0) * least * part
        coarse = soft
    return coarse + kept


def filtered(rng: np.random.Generator, pictures: Tensor) -> Tensor:
    """Pictures [n,3,h,w] in 0..1, sides multiples of 16, as cameras with noise filters save them: grey levels / 255."""
    n, device = len(pictures), pictures.device

    def some(low: float, high: float, share: float = 1.0) -> Tensor:
        values = np.where(rng.random(n) < share, rng.uniform(low, high, n), 0)
        return sent(values.astype(np.float32), device)[:, None, None, None]

    noise, strength = torch.exp(some(*np.log(NOISE))) / 255, torch.exp(some(*np.log(STRENGTH)))
    source = torch.Generator(device).manual_seed(int(rng.integers(2**62)))
    grainy = pictures + noise * torch.randn(pictures.shape, generator=source, device=device)
    if rng.random() < CORED_SHARE:
        smooth = _cored(grainy, strength * noise)
    else:
        smooth = _means(grainy, noise, strength, int(rng.choice(PATCHES)), int(rng.choice(REACHES)))
    smooth = smooth + some(0, MOST_LEFT) * (grainy - smooth)
    if rng.random() < COLOUR_SHARE:
        light = _brightness(smooth)
        smooth = light + soften(smooth - light, rng.uniform(*COLOUR_PX, n), REACH_PX)
    softer = soften(smooth, rng.uniform(*SPREAD_PX, n), REACH_PX)
    pixels = ((smooth + some(*AMOUNT, SHARPENED_SHARE) * (smooth - softer)).clamp(0, 1) * 255).round()
    quality = sent(rng.integers(QUALITY[0], QUALITY[1] + 1, n).astype(np.float32), device)
    return torch.where(some(1, 1, COMPRESSED_SHARE) > 0, compressed(pixels, quality), pixels) / 255
