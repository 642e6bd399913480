"""Procedural scenes: layered surfaces with known depth, photographed by a random camera.

A scene is drawn in the inverse depth ratio q = s1 / z, because a plane is linear in it and blur is too:
sigma = k_cam |q - 1|; q > 1 is nearer than focus, q < 1 beyond.
"""

import math
from dataclasses import dataclass, field, replace
from statistics import NormalDist
from typing import Self

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from model_export.config import SceneConfig
from model_export.frames import Frame, draw_crop, draw_frame
from model_export.render import Layer, PointSpread, blur, render_layers, sliced
from model_export.rooms import Surface, draw_room
from model_export.textures import draw_texture
from service.optics import thin_lens
from service.optics.light import decode_srgb, encode_srgb

BOTH_SIDES_SHARE = 0.55  # something before and something beyond what is in focus, as in most photographs
# what people photograph is a few metres away: the background of a close-up is beyond its focus, and what a distant
# focus shows is mostly nearer
USUAL_DEPTH_M, DEPTH_SPREAD = 2.0, 1.2  # median, and standard deviation of the logarithm
LIKELIEST_SIDE = 0.85
LEVEL_SHARE = 0.5
NEAREST_AT_MOST, FARTHEST_AT_LEAST = 0.5, 2.0
FOCUSED_SHARE = 0.2  # somebody focused on something: sharp is read as blurred by who seldom saw it
K_CAM_LEAN = 0.5  # so that every octave of blur has about its share: what is rare is read as what is common
DISC_SHARE, GAUSSIAN_SHARE = 0.5, 0.2  # lenses have discs, softened where they are soft; fewer come near a bell
ROUND_SHARE = 0.7
CHROMATIC_SHARE = 0.4
CHROMATIC_PX = 0.8
CHROMATIC_PART = 0.15
ACHROMAT_SHARE = 0.75
MOSAIC_SHARE = 0.4
MOSAIC_VARIANCE = 0.35  # what a bilinear demosaic adds to luminance, px^2
SHOT_NOISE, READ_NOISE = (1e-6, 2e-3), (1e-4, 4e-3)
GRAINY_SHARE, GRAIN = 0.25, (3e-4, 3e-3)  # dim light: grain must not pass for sharpness
MOSTLY = 0.98
PLAIN_SHARE = 0.35  # not compressed: the network must not need the noise of JPEG
SHARPENED_SHARE = 0.3
RESCALED_SHARE = 0.15
RESCALES = (1.2, 1.6)
Map = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Material:
    """What scenes are made of: photographs uint8 [h,w,3] to lay on surfaces, and sharp frames with depth."""

    photographs: list[NDArray[np.uint8]] = field(default_factory=list)
    frames: list[Frame] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Shot:
    """The camera and lens of one scene, and how near and far its surfaces may be, as z / s1.

    ``side`` is -1 if all is nearer than focus, +1 if beyond, 0 if both.
    """

    k_cam_px: float
    gamma_px: float
    focus_distance_m: float
    focal_length_px: float
    spread: PointSpread
    side: int
    depth_ratio: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Scene:
    """Surfaces before the lens of a shot: nearest first, with q - 1 of each over the canvas [layers,h,w].

    ``softness`` is the variance (px^2) of the blur that they have themselves.
    """

    shot: Shot
    layers: list[Layer]
    excesses: Map
    softness: float = 0.0


@dataclass(frozen=True, slots=True)
class Sample:
    """One training example: picture uint8 [3,h,w] (sRGB), q - 1 as float16 [h,w], and the shot.

    ``shown`` is the picture that what learns is shown instead, where that is another one.
    """

    image: NDArray[np.uint8]
    excess: NDArray[np.float16]
    shot: Shot
    shown: NDArray[np.uint8] | None = None


@dataclass(frozen=True, slots=True)
class Negative:
    """A scene whose picture is still to be taken (``darkroom.py``), by a camera about that of ``shot``.

    ``surfaces`` [layers,5,h,w] in float16 are premultiplied linear colour, alpha and q - 1, nearest first, ``ends``
    [2,layers] the least and greatest q - 1 of each; ``softness`` is the scene's.
    """

    surfaces: torch.Tensor
    ends: Map
    shot: Shot
    softness: float


NOTHING = Material()


def log_uniform(rng: np.random.Generator, bounds: tuple[float, float], lean: float = 1.0) -> float:
    """Between the bounds, uniform in the logarithm; a ``lean`` below 1 leans to the upper one."""
    low, high = math.log(bounds[0]), math.log(bounds[1])
    return math.exp(low + (high - low) * rng.random() ** lean)


def _by_chance(rng: np.random.Generator, share: float) -> bool:
    """True that often. What never happens draws nothing, so a seed's scene stays what it was."""
    return share > 0 and rng.random() < share


def _nearer_share(focus_distance_m: float) -> float:
    """Of what people photograph, how much is nearer than that."""
    nearer = NormalDist(math.log(USUAL_DEPTH_M), DEPTH_SPREAD).cdf(math.log(focus_distance_m))
    return min(max(nearer, 1 - LIKELIEST_SIDE), LIKELIEST_SIDE)


def draw_shot(rng: np.random.Generator, config: SceneConfig) -> Shot:
    """A random camera, focus distance, lens and side of focus within the config's ranges."""
    focus_distance_m = log_uniform(rng, config.focus_distance_m)
    side = 0 if rng.random() < BOTH_SIDES_SHARE else -1 if rng.random() < _nearer_share(focus_distance_m) else 1
    k_cam_px = log_uniform(rng, config.k_cam_px, K_CAM_LEAN)
    return Shot(
        k_cam_px=k_cam_px,
        gamma_px=log_uniform(rng, config.gamma_px),
        focus_distance_m=focus_distance_m,
        focal_length_px=log_uniform(rng, config.focal_length_px),
        spread=draw_spread(rng, k_cam_px),
        side=side,
        depth_ratio=(
            log_uniform(rng, (config.depth_ratio[0], NEAREST_AT_MOST)),
            log_uniform(rng, (FARTHEST_AT_LEAST, config.depth_ratio[1])),
        ),
    )


def draw_spread(rng: np.random.Generator, k_cam_px: float) -> PointSpread:
    """A Gaussian, a disc or between; sometimes squeezed; sometimes red and blue focused elsewhere than green.

    Most lenses are achromats, which focus green nearest to the lens: red and blue are blurrier than green before the
    plane in focus, sharper beyond it.
    """
    shape = rng.random()
    disc_share = 0.0 if shape < GAUSSIAN_SHARE else 1.0 if shape > 1 - DISC_SHARE else rng.uniform(0.3, 1.0)
    squeeze = 1.0 if rng.random() < ROUND_SHARE else rng.uniform(0.7, 1.0)
    shift = min(CHROMATIC_PX, CHROMATIC_PART * k_cam_px) if rng.random() < CHROMATIC_SHARE else 0.0
    most = 0.0 if rng.random() < ACHROMAT_SHARE else shift
    red, blue = rng.uniform(-shift, most, 2).tolist()
    return PointSpread(float(disc_share), float(squeeze), float(rng.uniform(0, math.pi)), (red, blue))


def _excess_bounds(shot: Shot, config: SceneConfig) -> tuple[float, float]:
    """Lowest and highest q - 1 that the depth range and the largest blur allow."""
    limit = config.defocus_px[1] / shot.k_cam_px
    nearest = min(1 / shot.depth_ratio[0] - 1, limit)
    farthest = min(1 - 1 / shot.depth_ratio[1], limit)
    return (0.0 if shot.side < 0 else -farthest), (0.0 if shot.side > 0 else nearest)


def _draw_excess(rng: np.random.Generator, shot: Shot, config: SceneConfig) -> float:
    """q - 1 of one surface on a side of the shot: at times in focus, else uniform or log-uniform in blur."""
    low, high = _excess_bounds(shot, config)
    far = shot.side > 0 or (shot.side == 0 and rng.random() > _nearer_share(shot.focus_distance_m))
    end = -low if far else high
    first = min(config.defocus_px[0] / shot.k_cam_px, end / 2)
    if rng.random() < FOCUSED_SHARE:
        amount = rng.uniform(0, first)
    else:
        amount = rng.uniform(0, end) if rng.random() < 0.5 else log_uniform(rng, (first, end))
    return -amount if far else amount


def _surface(rng: np.random.Generator, middle: float, bounds: tuple[float, float], size: int) -> Map:
    """q - 1 over the canvas: a plane through ``middle``, sometimes steep, sometimes curved."""
    u = np.linspace(-1, 1, size, dtype=np.float32)[None, :]
    v = u.T
    steepness = rng.choice([0.0, 0.1, 0.4, 1.0], p=[0.25, 0.3, 0.3, 0.15]) * (abs(middle) + 0.1)
    angle = rng.uniform(0, 2 * math.pi)
    surface: Map = middle + steepness * rng.uniform(0.3, 1) * (math.cos(angle) * u + math.sin(angle) * v)
    if rng.random() < 0.3:
        waves = rng.uniform(1, 4, 2)
        surface += 0.3 * steepness * np.sin(waves[0] * u + rng.uniform(0, 6)) * np.cos(waves[1] * v)
    return np.asarray(np.clip(surface, *bounds), np.float32)


def _outline(rng: np.random.Generator, size: int) -> Map:
    """A random opaque shape [h,w] in 0..1 with smooth edges: polygon, ellipse, blob, or thin bars."""
    span = 2 * size
    canvas = np.zeros((span, span), np.uint8)
    kind = rng.integers(4)
    center, radius = rng.uniform(0, span, 2), span * rng.uniform(0.08, 0.4)
    if kind == 0:
        angles = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(3, 8))))
        corners = center + radius * np.stack([np.cos(angles), np.sin(angles)], 1)
        cv2.fillPoly(canvas, [corners.astype(np.int32)], 255)
    elif kind == 1:
        axes = (int(radius), int(radius * rng.uniform(0.3, 1)))
        middle = (int(center[0]), int(center[1]))
        cv2.ellipse(canvas, middle, axes, float(rng.uniform(0, 180)), 0, 360, 255, -1)
    elif kind == 2:
        coarse = rng.standard_normal((int(rng.integers(4, 12)),) * 2).astype(np.float32)
        field = cv2.resize(coarse, (span, span), interpolation=cv2.INTER_CUBIC)
        canvas = (np.asarray(field) > rng.uniform(0.2, 1.0)).astype(np.uint8) * 255
    else:
        for _ in range(int(rng.integers(1, 6))):
            ends = rng.integers(-50, span + 50, 4).tolist()
            cv2.line(canvas, (ends[0], ends[1]), (ends[2], ends[3]), 255, int(rng.integers(3, 24)))
    small = cv2.resize(canvas, (size, size), interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.float32) / np.float32(255)


def _apart(rng: np.random.Generator, shot: Shot, config: SceneConfig, count: int, size: int) -> list[tuple[Map, Map]]:
    """Alpha and q - 1 of shapes before a background, nearest first, at depths that say little of where they are."""
    bounds = _excess_bounds(shot, config)
    first, *others = (_draw_excess(rng, shot, config) for _ in range(count))
    # what stands together is often alike in depth
    apart = rng.uniform(0, 1) if rng.random() < config.close_share else 1.0
    middles = sorted((first, *(first + apart * (other - first) for other in others)), reverse=True)
    *shapes, background = [_surface(rng, middle, bounds, size) for middle in middles]
    return [*((_outline(rng, size), shape) for shape in shapes), (np.ones((size, size), np.float32), background)]


def _drawn_scene(
    rng: np.random.Generator, shot: Shot, config: SceneConfig, photographs: list[NDArray[np.uint8]]
) -> Scene:
    """A wall, a room, or shapes before each other."""
    size = config.size_px + 2 * config.margin_px

    def draw(texture_size: int) -> Map:
        return draw_texture(rng, photographs, texture_size)

    kind = rng.random()
    if kind < config.wall_share:  # what people photograph first, and what rooms seldom hold
        alpha = np.ones((size, size), np.float32)
        middle = _draw_excess(rng, shot, config)
        level = rng.random() < LEVEL_SHARE
        excess = alpha * np.float32(middle) if level else _surface(rng, middle, _excess_bounds(shot, config), size)
        surfaces = [Surface(decode_srgb(draw(size)), alpha, excess)]
    elif kind < config.wall_share + config.room_share:
        far, near = sorted(_draw_excess(rng, shot, config) for _ in range(2))
        surfaces = draw_room(
            rng,
            draw,
            ends=(far, near),
            bounds=_excess_bounds(shot, config),
            focal_px=shot.focal_length_px,
            count=int(rng.integers(1, config.max_layers + 3)),
            size=size,
        )
    else:
        count = int(rng.integers(1, config.max_layers + 1)) if rng.random() < config.layered_share else 1
        surfaces = [
            Surface(decode_srgb(draw(size)) * alpha[..., None], alpha, excess)
            for alpha, excess in _apart(rng, shot, config, count, size)
        ]
    layers = [
        Layer(
            torch.from_numpy(surface.color.transpose(2, 0, 1).copy()),
            torch.from_numpy(surface.alpha)[None],
            torch.from_numpy(-surface.excess * np.float32(shot.k_cam_px)),
        )
        for surface in surfaces
    ]
    return Scene(shot, layers, np.stack([surface.excess for surface in surfaces]))


def _through_mosaic(linear: Map) -> Map:
    """The picture [h,w,3] as a sensor with one colour a pixel has it, interpolated."""
    levels = (np.clip(linear, 0, 2) * 32767.5).astype(np.uint16)
    mosaic = levels[..., 1].copy()
    mosaic[::2, ::2], mosaic[1::2, 1::2] = levels[::2, ::2, 0], levels[1::2, 1::2, 2]
    # OpenCV names a mosaic by the pixels of its second row: this one begins red, green
    return np.asarray(cv2.demosaicing(mosaic, cv2.COLOR_BayerBG2RGB), np.float32) / np.float32(32767.5)


@dataclass(frozen=True, slots=True)
class Sharpening:
    """An unsharp mask: how much is added of what a Gaussian of this spread takes away; mostly nothing."""

    amount: float = 0.0
    spread_px: float = 1.0

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Self:
        amount, spread_px = rng.uniform(0.1, 0.5), rng.uniform(0.7, 1.5)
        return cls(amount, spread_px) if rng.random() < SHARPENED_SHARE else cls()


def softest_gamma_px(softness: float) -> float:
    """gamma of surfaces as they are, ``softness`` (px^2) beside their pixels' box: no picture of them is sharper."""
    return math.sqrt(thin_lens.PIXEL_BOX_VARIANCE + softness)


def rest_of_gamma(
    rng: np.random.Generator, gamma_px: float, softness: float, sharpening: Sharpening
) -> tuple[float, bool]:
    """What a lens adds to gamma, a standard deviation in px, and whether the sensor has a mosaic.

    gamma is what the picture shows in the end: what the surfaces have of it (``softness``, a variance in px^2), a
    mosaic adds and a sharpening takes away is made up for.
    """
    before_px = thin_lens.blur_before_sharpening(gamma_px, sharpening.amount, sharpening.spread_px)
    variance = before_px**2 - thin_lens.PIXEL_BOX_VARIANCE - softness
    through_mosaic = variance > MOSAIC_VARIANCE and rng.random() < MOSAIC_SHARE
    return math.sqrt(max(variance - through_mosaic * MOSAIC_VARIANCE, 0.0)), through_mosaic


def develop(
    rng: np.random.Generator, linear: Map, config: SceneConfig, sharpening: Sharpening, *, through_mosaic: bool
) -> NDArray[np.uint8]:
    """Light on the sensor [h,w,3] to a JPEG's pixels: exposure, noise, demosaic, white balance, tone, sharpening."""
    picture = linear * rng.uniform(0.5, 1.4) / max(float(np.quantile(linear, 0.98)), 0.2)
    shot_noise = log_uniform(rng, GRAIN if rng.random() < GRAINY_SHARE else SHOT_NOISE)
    read_noise = log_uniform(rng, READ_NOISE)
    noise = rng.standard_normal(picture.shape).astype(np.float32)
    if not through_mosaic and _by_chance(rng, config.grey_share):  # as denoisers leave it, and ray tracing makes it
        noise[:] = noise[..., :1]
    if _by_chance(rng, config.clean_share):  # what is smooth then ends in steps of one grey level
        noise[:] = 0
    spread = rng.uniform(0, 0.9)
    if spread > 0.3 and not through_mosaic:  # filters make noise of neighbours alike
        noise = np.asarray(cv2.GaussianBlur(noise, (0, 0), spread)) * np.float32(1 + 1.5 * spread)
    picture = picture + noise * np.sqrt(shot_noise * np.maximum(picture, 0) + read_noise**2)
    if through_mosaic:
        picture = _through_mosaic(picture)
    picture = picture * rng.uniform(0.85, 1.15, 3)
    encoded = encode_srgb(picture.astype(np.float32))
    bend = rng.uniform(-0.1, 0.35)
    encoded = encoded + bend * (encoded**2 * (3 - 2 * encoded) - encoded)
    if sharpening.amount > 0:
        soft = cv2.GaussianBlur(encoded, (0, 0), sharpening.spread_px)
        encoded = encoded + sharpening.amount * (encoded - soft)
    pixels = (np.clip(encoded, 0, 1) * 255 + 0.5).astype(np.uint8)
    if rng.random() < PLAIN_SHARE:
        return pixels
    quality = int(rng.integers(config.jpeg_quality[0], config.jpeg_quality[1] + 1))
    packed = cv2.imencode(".jpg", pixels[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return np.asarray(cv2.imdecode(packed, cv2.IMREAD_COLOR), np.uint8)[:, :, ::-1]


def _framed_scene(rng: np.random.Generator, shot: Shot, config: SceneConfig, frame: Frame) -> Scene:
    """A frame before the shot's lens, which is focused so that one of its pixels is as far out of focus as may be.

    Distances stay as they are. Where the blur would be more than the config allows, so is the shot's k_cam.
    """
    size = config.size_px + 2 * config.margin_px
    crop = draw_crop(rng, frame, size)
    anchor_m = float(crop.depth_m[tuple(rng.integers(config.margin_px, size - config.margin_px, 2))])
    focus_m = float(np.clip(anchor_m * (1 + _draw_excess(rng, shot, config)), *config.focus_distance_m))
    excess = np.float32(focus_m) / crop.depth_m - 1
    most = float(np.quantile(np.abs(excess), MOSTLY))
    k_cam_px = max(config.k_cam_px[0], min(shot.k_cam_px, config.defocus_px[1] / max(most, 1e-6)))
    layers, _ = sliced(crop.light, -excess * np.float32(k_cam_px))
    shot = replace(
        shot,
        k_cam_px=k_cam_px,
        gamma_px=max(shot.gamma_px, softest_gamma_px(crop.softness)),
        focus_distance_m=focus_m,
        focal_length_px=crop.focal_length_px,
        side=0,
    )
    found = (torch.stack([layer.defocus_px for layer in layers]).numpy() / -k_cam_px).astype(np.float32)
    return Scene(shot, layers, found, crop.softness)


def draw_sample(seed: int, config: SceneConfig, material: Material = NOTHING) -> Sample:
    """The scene of this seed: the same seed, config and material give the same sample."""
    rng = np.random.default_rng(seed)
    shot = draw_shot(rng, config)
    if material.frames and rng.random() < config.frame_share:
        return _photograph(rng, _framed_scene(rng, shot, config, draw_frame(rng, material.frames)), config)
    if rng.random() < RESCALED_SHARE:
        return _taken_larger(rng, shot, config, material.photographs)
    return _photograph(rng, _drawn_scene(rng, shot, config, material.photographs), config)


def _taken_larger(
    rng: np.random.Generator, shot: Shot, config: SceneConfig, photographs: list[NDArray[np.uint8]]
) -> Sample:
    """A shot whose picture was larger, and made small: gamma, which that makes less, is what is left of it."""
    size = config.size_px
    larger_px = round(size * rng.uniform(*RESCALES))
    ratio = larger_px / size
    larger = replace(
        config,
        size_px=larger_px,
        margin_px=round(config.margin_px * ratio),
        defocus_px=(config.defocus_px[0] * ratio, config.defocus_px[1] * ratio),
    )
    # a pixel of the small picture averages those of the large one: its box is there before it is made small
    taken = replace(
        shot,
        k_cam_px=shot.k_cam_px * ratio,
        gamma_px=thin_lens.gamma_before_averaging(shot.gamma_px, larger_px, size),
        focal_length_px=shot.focal_length_px * ratio,
    )
    sample = _photograph(rng, _drawn_scene(rng, taken, larger, photographs), larger)
    small = cv2.resize(sample.image.transpose(1, 2, 0), (size, size), interpolation=cv2.INTER_AREA)
    told = cv2.resize(sample.excess.astype(np.float32), (size, size), interpolation=cv2.INTER_NEAREST_EXACT)
    pixels = np.ascontiguousarray(np.asarray(small, np.uint8).transpose(2, 0, 1))
    gamma_px = thin_lens.gamma_after_averaging(taken.gamma_px, larger_px, size)
    return Sample(pixels, np.asarray(told, np.float16), replace(shot, gamma_px=gamma_px))


def draw_negative(seed: int, config: SceneConfig, material: Material = NOTHING) -> Negative:
    """The surfaces of this seed, before any lens; the same seed, config and material give the same."""
    rng = np.random.default_rng(seed)
    shot = draw_shot(rng, config)
    if material.frames and rng.random() < config.frame_share:
        scene = _framed_scene(rng, shot, config, draw_frame(rng, material.frames))
    else:
        scene = _drawn_scene(rng, shot, config, material.photographs)
    parts = zip(scene.layers, torch.from_numpy(scene.excesses), strict=True)
    surfaces = torch.stack([torch.cat([layer.color, layer.alpha, excess[None]]) for layer, excess in parts])
    ends = np.stack([scene.excesses.min((1, 2)), scene.excesses.max((1, 2))])
    return Negative(surfaces.half(), ends, scene.shot, scene.softness)


def _photograph(rng: np.random.Generator, scene: Scene, config: SceneConfig) -> Sample:
    """The scene's picture, and what most of each of its pixels' light comes from."""
    linear, front = render_layers(scene.layers, scene.shot.spread)
    seen = np.take_along_axis(scene.excesses, front.numpy()[None], 0)[0]
    sharpening = Sharpening.draw(rng)
    rest_px, through_mosaic = rest_of_gamma(rng, scene.shot.gamma_px, scene.softness, sharpening)
    inner = slice(config.margin_px, config.margin_px + config.size_px)
    light = np.ascontiguousarray(blur(linear, rest_px)[:, inner, inner].permute(1, 2, 0).numpy())
    pixels = develop(rng, light, config, sharpening, through_mosaic=through_mosaic)
    image = np.ascontiguousarray(pixels.transpose(2, 0, 1))
    return Sample(image, seen[inner, inner].astype(np.float16), scene.shot)


def true_blur_px(sample: Sample) -> Map:
    """lambda [h,w] that the sample shows."""
    defocus = np.abs(sample.excess.astype(np.float32)) * np.float32(sample.shot.k_cam_px)
    return thin_lens.blur_from_defocus(defocus, sample.shot.gamma_px)
