"""Textures for scenes: photographs, dead leaves, plain objects, noise, text, lines, patterns, and clouds.

Most are drawn at twice the size they are wanted and reduced by area, so they are as sharp as pixels allow: what blur a
scene shows is then the renderer's alone. Clouds are soft themselves, as marble, cloth and worn plaster are, and must
not pass for blur.
"""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from model_export.datasets.photos import read_image

OVERSAMPLE = 2
KIND_SHARES = {
    "photo": 0.33,
    "leaves": 0.14,
    "objects": 0.19,
    "noise": 0.05,
    "drawing": 0.08,
    "pattern": 0.1,
    "clouds": 0.11,
}
PATTERNS = ("stripes", "checks", "dots", "bricks", "waves")
PERIOD_PX = (3.0, 60.0)
BENT_SHARE = 0.4
CLOUD_PX = (4.0, 60.0)
FADED_SHARE = 0.45
SHADED_SHARE = 0.5
SOFT_SIGMA_PX = 4.0
LETTERS = "ABCDEFGHJKLMNPRSTUVXYZabcdefghkmnoprstuvxyz0123456789&%#?"

Image = NDArray[np.float32]


def picture_files(folder: Path) -> list[Path]:
    """All JPEG and PNG files below ``folder`` but hidden ones, in a fixed order."""
    files = (p for p in folder.rglob("*") if p.suffix.lower() in {".jpg", ".jpeg", ".png"})
    return sorted(p for p in files if not p.name.startswith("."))


def load_photographs(folder: Path) -> list[NDArray[np.uint8]]:
    """All JPEG and PNG files below ``folder``, RGB, in a fixed order. Raises if there is none, or one is no picture."""
    photographs = [read_image(path) for path in picture_files(folder)]
    if not photographs:
        raise FileNotFoundError(f"no JPEG or PNG pictures below {folder}")
    return photographs


def draw_texture(rng: np.random.Generator, photographs: list[NDArray[np.uint8]], size: int) -> Image:
    """A sharp sRGB texture [size, size, 3] in 0..1 of a random kind."""
    kind = rng.choice(list(KIND_SHARES), p=list(KIND_SHARES.values()))
    if kind == "photo" and photographs:
        texture = _photo(rng, photographs[rng.integers(len(photographs))], size)
    else:
        texture = _DRAWN.get(kind, _noise)(rng, size)
    if rng.random() < FADED_SHARE:
        texture = _faded(rng, texture)
    if rng.random() < SHADED_SHARE:
        texture = _shaded(rng, texture)
    return _recolor(rng, texture)


def plain_texture(rng: np.random.Generator, color: Image, size: int) -> Image:
    """One colour [3] over [size, size, 3], as sharp as the light upon it: soft, sometimes with soft shadows."""
    texture = np.asarray(np.clip(color * _slope(rng, size), 0, 1), np.float32)
    return _shaded(rng, texture) if rng.random() < SHADED_SHARE else texture


def _shrink(image: NDArray[np.uint8], size: int) -> Image:
    """The canvas [span, span(, 3)] at its final size, 0..1."""
    small = cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.float32) / np.float32(255)


def _photo(rng: np.random.Generator, photograph: NDArray[np.uint8], size: int) -> Image:
    """A photograph turned, stretched and mirrored over the canvas, made smaller than it was."""
    height, width = photograph.shape[:2]
    canvas = size * OVERSAMPLE
    zoom = OVERSAMPLE * rng.uniform(0.22, 0.8)
    if zoom < 0.75:
        photograph = np.asarray(cv2.resize(photograph, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_AREA), np.uint8)
        height, width = photograph.shape[:2]
        zoom = 1.0
    angle, stretch = rng.uniform(0, 360), rng.uniform(0.7, 1.0)
    turn = cv2.getRotationMatrix2D((canvas / 2, canvas / 2), angle, zoom)
    place = np.diag([1.0, stretch, 1.0])
    place[:2, 2] = rng.uniform(-1, 1, 2) * (width, height)
    matrix = (np.vstack([turn, [0, 0, 1]]) @ place)[:2]
    warped = cv2.warpAffine(photograph, matrix, (canvas, canvas), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    return _shrink(np.asarray(warped, np.uint8), size)


def _shade(rng: np.random.Generator) -> tuple[int, int, int]:
    red, green, blue = rng.integers(0, 256, 3).tolist()
    return red, green, blue


def _leaves(rng: np.random.Generator, size: int) -> Image:
    """Opaque shapes with sizes after a power law, dropped on each other: edges of all sizes, flat areas too."""
    canvas = np.full((size * OVERSAMPLE, size * OVERSAMPLE, 3), _shade(rng), np.uint8)
    smallest = rng.uniform(3, 20)
    largest = rng.uniform(40, 250)
    for _ in range(int(rng.integers(60, 400))):
        u = rng.random()
        radius = (smallest**-1.5 + u * (largest**-1.5 - smallest**-1.5)) ** (-1 / 1.5)
        center = rng.uniform(0, size * OVERSAMPLE, 2)
        count = int(rng.integers(3, 9))
        angles = np.sort(rng.uniform(0, 2 * np.pi, count)) if rng.random() < 0.6 else np.linspace(0, 6, 14)
        corners = center + radius * np.stack([np.cos(angles), np.sin(angles)], 1)
        cv2.fillPoly(canvas, [corners.astype(np.int32)], _shade(rng))
    return _shrink(canvas, size)


def _paint(rng: np.random.Generator) -> Image:
    """A colour [3] as rooms have them: any brightness, mostly little saturation."""
    grey, saturation = rng.uniform(0.03, 1), rng.beta(0.7, 2)
    return np.asarray(grey * (1 + saturation * (rng.uniform(0, 1, 3) - 0.7)), np.float32)


def _slope(rng: np.random.Generator, size: int) -> Image:
    """Soft light over a surface [size, size, 1], from even to strongly curved."""
    strength = np.float32(rng.choice([0.0, 0.1, 0.3, 0.6]))
    return np.asarray(1 + strength * _smooth_field(rng, size)[..., None] / 2, np.float32)


def _shape(rng: np.random.Generator, span: int) -> NDArray[np.uint8]:
    """The mask [span, span] of a box, a rounded or a tapered thing, small to most of the canvas."""
    mask = np.zeros((span, span), np.uint8)
    center, turn = rng.uniform(0, span, 2), rng.uniform(0, 180)
    longer = span * np.exp(rng.uniform(np.log(0.02), np.log(0.6)))
    shorter = longer * rng.uniform(0.15, 1)
    middle = (float(center[0]), float(center[1]))
    kind = rng.integers(3)
    if kind == 0:
        cv2.ellipse(mask, (middle, (float(shorter), float(longer)), turn), 255, -1)
        return mask
    corners = cv2.boxPoints((middle, (float(shorter), float(longer)), turn))
    if kind == 2:
        corners = corners + rng.normal(0, 0.15 * shorter, corners.shape)
    cv2.fillConvexPoly(mask, cv2.convexHull(np.asarray(corners, np.int32)), 255)
    return mask


def _objects(rng: np.random.Generator, size: int) -> Image:
    """Plain things on a plain ground, softly lit, with soft shadows: sharp edges far between, as in a room."""
    out = _paint(rng) * _slope(rng, size)
    for _ in range(int(np.exp(rng.uniform(np.log(2), np.log(40))))):
        mask = _shape(rng, size * OVERSAMPLE)
        cover = _shrink(mask, size)
        if rng.random() < 0.5:
            shift = rng.normal(0, 6, 2)
            softness = float(np.exp(rng.uniform(np.log(1.5), np.log(20))))
            moved = np.array([[1, 0, shift[0]], [0, 1, shift[1]]])
            shadow = cv2.GaussianBlur(cv2.warpAffine(cover, moved, (size, size)), (0, 0), softness)
            out = out * (1 - np.float32(rng.uniform(0.1, 0.7)) * np.asarray(shadow)[..., None])
        out = out + cover[..., None] * (_paint(rng) * _slope(rng, size) - out)
    if rng.random() < 0.5:
        grain = cv2.GaussianBlur(rng.standard_normal((size, size)).astype(np.float32), (0, 0), rng.uniform(0.5, 2))
        out = out * (1 + np.float32(rng.uniform(0, 0.12)) * np.asarray(grain)[..., None])
    return np.asarray(np.clip(out, 0, 1), np.float32)


def _noise(rng: np.random.Generator, size: int) -> Image:
    """Noise whose amplitude falls as frequency to a random power, per channel partly the same."""
    frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None, :])
    amplitude = np.maximum(frequency, 1 / size) ** -rng.uniform(0.3, 1.2)
    shared = rng.uniform(0.3, 1.0)
    white = rng.standard_normal((4, size, size))
    white[:3] = shared * white[3] + (1 - shared) * white[:3]
    fields = np.fft.irfft2(np.fft.rfft2(white[:3]) * amplitude, s=(size, size))
    fields /= fields.std() + 1e-6
    if rng.random() < 0.3:
        fields = np.tanh(fields * rng.uniform(1, 8))
    contrast = rng.uniform(0.05, 0.3)
    return np.clip(0.5 + contrast * fields, 0, 1).transpose(1, 2, 0).astype(np.float32)


def _drawing(rng: np.random.Generator, size: int) -> Image:
    """Text and lines on a plain ground, or a checkerboard: sharp, sparse, much of it flat."""
    span = size * OVERSAMPLE
    canvas = np.full((span, span, 3), _shade(rng), np.uint8)
    if rng.random() < 0.2:
        cell = int(rng.integers(8, 64))
        odd = (np.indices((span, span)) // cell).sum(0) % 2 == 1
        canvas[odd] = _shade(rng)
        return _shrink(canvas, size)
    for _ in range(int(rng.integers(10, 60))):
        x, y = rng.integers(-40, span, 2).tolist()
        if rng.random() < 0.7:
            text = "".join(rng.choice(list(LETTERS), int(rng.integers(2, 12))))
            scale, thickness = float(rng.uniform(0.5, 3.5)), int(rng.integers(1, 7))
            cv2.putText(canvas, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, scale, _shade(rng), thickness)
        else:
            end = rng.integers(-40, span + 40, 2).tolist()
            cv2.line(canvas, (x, y), (end[0], end[1]), _shade(rng), int(rng.integers(1, 9)))
    return _shrink(canvas, size)


def _pattern(rng: np.random.Generator, size: int) -> Image:
    """What is woven, tiled, ruled or ribbed: one motif over and over in two colours, its rows sometimes bent."""
    span = size * OVERSAMPLE
    period = OVERSAMPLE * np.exp(rng.uniform(*np.log(PERIOD_PX)))
    turn, stretch = rng.uniform(0, 2 * np.pi), np.float32(rng.uniform(0.3, 1.0))
    at = np.arange(span, dtype=np.float32) / np.float32(period)
    across = np.float32(np.cos(turn)) * at[None, :] + np.float32(np.sin(turn)) * at[:, None]
    along = (np.float32(np.cos(turn)) * at[:, None] - np.float32(np.sin(turn)) * at[None, :]) * stretch
    if rng.random() < BENT_SHARE:
        across += np.float32(rng.uniform(0, 2)) * _smooth_field(rng, span)
    cover = _motif(rng, str(rng.choice(PATTERNS)), across, along, stretch)
    ground, motif = _paint(rng), _paint(rng)
    seen = np.asarray(cv2.resize(cover, (size, size), interpolation=cv2.INTER_AREA), np.float32)
    return np.asarray(np.clip(ground + seen[..., None] * (motif - ground), 0, 1), np.float32)


def _motif(rng: np.random.Generator, kind: str, across: Image, along: Image, stretch: np.float32) -> Image:
    """How much of each place [n, n] a pattern's motif covers: one in each unit of ``across`` and ``along``."""
    part = np.float32(rng.uniform(0.1, 0.6))
    if kind == "bricks":
        along = np.asarray(along + np.floor(across) % 2 / 2, np.float32)
    u, v = across % 1, along % 1
    if kind == "stripes":
        return np.asarray(u < part, np.float32)
    if kind == "checks":
        return np.asarray((u < 0.5) == (v < 0.5), np.float32)
    if kind == "dots":
        return np.asarray(np.hypot(u - 0.5, v - 0.5) < part / 1.2, np.float32)
    if kind == "bricks":
        shades = rng.uniform(0.7, 1, (16, 16)).astype(np.float32)
        stones = shades[np.floor(across).astype(int) % 16, np.floor(along).astype(int) % 16]
        return np.asarray(stones * ((u > part / 4) & (v > part / 4 * stretch)), np.float32)
    return np.asarray(0.5 + 0.5 * np.sin(2 * np.pi * across), np.float32) ** np.float32(rng.uniform(0.5, 4))


def _clouds(rng: np.random.Generator, size: int) -> Image:
    """Two colours that run into each other in spots of one size, with or without finer ones among them."""
    spot_px = float(np.exp(rng.uniform(*np.log(CLOUD_PX))))
    finer = rng.uniform(0, 0.6) if rng.random() < 0.6 else 0.0
    height = np.zeros((size, size), np.float32)
    strength = 1.0
    while spot_px >= CLOUD_PX[0] and strength > 0.03:
        cells = np.maximum(2, np.round(size / spot_px * np.array([1.0, rng.uniform(0.3, 1.0)]))).astype(int)
        field = rng.standard_normal(cells.tolist()).astype(np.float32)
        height += np.float32(strength) * np.asarray(cv2.resize(field, (size, size), interpolation=cv2.INTER_CUBIC))
        spot_px, strength = spot_px / 2, strength * finer
    ground, other = _paint(rng), _paint(rng)
    share = 0.5 + 0.5 * np.tanh(height * np.float32(rng.uniform(0.3, 1.5)))
    return np.asarray(np.clip(ground + share[..., None] * (other - ground), 0, 1), np.float32)


_DRAWN = {
    "leaves": _leaves,
    "objects": _objects,
    "drawing": _drawing,
    "pattern": _pattern,
    "noise": _noise,
    "clouds": _clouds,
}


def _smooth_field(rng: np.random.Generator, size: int) -> NDArray[np.float32]:
    """A random map [size, size] in about -2..2 that varies over a third of the canvas or more."""
    coarse = rng.standard_normal((int(rng.integers(2, 6)),) * 2).astype(np.float32)
    return np.asarray(cv2.resize(coarse, (size, size), interpolation=cv2.INTER_CUBIC), np.float32)


def _faded(rng: np.random.Generator, texture: Image) -> Image:
    """The texture gone faint, everywhere or in parts: walls and table tops are flat at any blur."""
    size = texture.shape[0]
    faint = rng.uniform(0, 0.2)
    if rng.random() < 0.25:
        strength = np.full((size, size, 1), faint + 0.02, np.float32)
    else:
        edge = (_smooth_field(rng, size) + rng.uniform(-0.8, 0.8)) * np.float32(rng.uniform(2, 8))
        strength = (faint + (1 - faint) / (1 + np.exp(-edge)))[..., None].astype(np.float32)
    ground = texture.mean((0, 1)) * (1 + 0.1 * _smooth_field(rng, size)[..., None])
    return np.asarray(np.clip(ground + (texture - ground) * strength, 0, 1), np.float32)


def _shaded(rng: np.random.Generator, texture: Image) -> Image:
    """The texture under soft shadows and lights: what is soft in a sharp picture, and must not pass for blur."""
    size = texture.shape[0]
    light = np.ones((size, size), np.float32)
    for _ in range(int(rng.integers(1, 5))):
        corners = rng.uniform(-0.3, 1.3, (4, 1, 2)) * size
        mask = np.zeros((size, size), np.uint8)
        cv2.fillConvexPoly(mask, cv2.convexHull(corners.astype(np.int32)), 255)
        softness = float(np.exp(rng.uniform(np.log(3), np.log(40))))
        soft = _softened(mask, softness)
        light *= 1 - np.float32(rng.uniform(-0.4, 0.6)) * soft
    return np.asarray(np.clip(texture * light[..., None], 0, 1), np.float32)


def _softened(mask: NDArray[np.uint8], sigma: float) -> Image:
    """The mask [n, n] as 0..1 with edges of this softness, which is worked out on a copy as small as it allows."""
    size = mask.shape[0]
    small = max(8, min(size, round(size * SOFT_SIGMA_PX / sigma)))
    reduced = cv2.resize(mask, (small, small), interpolation=cv2.INTER_AREA)
    soft = cv2.GaussianBlur(np.asarray(reduced, np.float32), (0, 0), sigma * small / size)
    return np.asarray(cv2.resize(soft, (size, size), interpolation=cv2.INTER_CUBIC), np.float32) / np.float32(255)


def _recolor(rng: np.random.Generator, texture: Image) -> Image:
    """Channels swapped, contrast and brightness moved: the same pattern under other paint and light."""
    out = texture[:, :, rng.permutation(3)]
    if rng.random() < 0.15:
        out = np.repeat(out.mean(2, keepdims=True), 3, axis=2)
    gain, offset = rng.uniform(0.4, 1.1), rng.uniform(0, 0.2)
    return np.asarray(np.clip(out * gain + offset, 0, 1), np.float32)
