"""Rooms: solid things on a floor or a table, before a wall or none, seen in perspective and softly lit.

Rays meet boxes, ellipsoids and cylinders; each of them is a layer of its own, whole where others hide it, for the
renderer to blur. Lengths are in units of the focus distance, so that q = 1 / z. The camera stands at the origin; x
is to the right, y down, z ahead.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from model_export.datasets.photos import filled
from model_export.textures import plain_texture
from service.optics.light import decode_srgb

OVERSAMPLE = 2
WALL_SHARE = 0.5
ROLL = 0.15
PLAIN_SHARE, PLAIN_GROUND_SHARE = 0.25, 0.2
LEANING_SHARE = 0.15
LEAST_WALL_VIEW = 0.3
LEAST_Q = 0.02
LEAST_COVER, LEAST_SEEN = 0.2, 4  # of a pixel, and how many such pixels
MOST_LEVELS = 4
APPARENT = (0.06, 0.55)
POLE_SHARE, POLE_PX = 0.15, (2.0, 10.0)

Map = NDArray[np.float32]
Vector = NDArray[np.float64]
DrawTexture = Callable[[int], Map]


@dataclass(frozen=True, slots=True)
class Surface:
    """One surface over the canvas: linear colour [h,w,3] premultiplied with alpha [h,w], and q - 1 [h,w]."""

    color: Map
    alpha: Map
    excess: Map


@dataclass(frozen=True, slots=True)
class View:
    """A pinhole camera: focal length and principal point in pixels of a canvas [size, size]."""

    size: int
    focal_px: float
    center: tuple[float, float]

    def rays(self, columns: slice, rows: slice) -> Map:
        """Rays [h,w,3] with z = 1 through ``OVERSAMPLE``² points of each pixel."""
        u, v = (
            (np.arange(s.start * OVERSAMPLE, s.stop * OVERSAMPLE) + 0.5) / OVERSAMPLE - 0.5 for s in (columns, rows)
        )
        x, y = np.meshgrid((u - self.center[0]) / self.focal_px, (v - self.center[1]) / self.focal_px)
        return np.stack([x, y, np.ones_like(x)], 2).astype(np.float32)

    def ray(self, u: float, v: float) -> Vector:
        return np.array([(u - self.center[0]) / self.focal_px, (v - self.center[1]) / self.focal_px, 1.0])


@dataclass(frozen=True, slots=True)
class Light:
    """Where light comes from [3], of length 1, and what part of it comes from everywhere."""

    direction: Vector
    ambient: float

    def on(self, normals: Map) -> Map:
        """Brightness [h,w] of surfaces with these normals [h,w,3]."""
        facing = np.clip(normals @ self.direction.astype(np.float32), 0, None)
        return np.asarray(self.ambient + (1 - self.ambient) * facing, np.float32)


@dataclass(frozen=True, slots=True)
class Hits:
    """Where rays meet a surface: z [h,w] (infinite where they do not), normals [h,w,3], coordinates on it [h,w,2]."""

    z: Map
    normals: Map
    places: Map


@dataclass(frozen=True, slots=True)
class Solid:
    """A box, an ellipsoid or a cylinder about ``middle``: half of its extents [3] along its axes, the rows of [3,3]."""

    kind: str
    middle: Vector
    extent: Vector
    axes: Vector

    @property
    def radius(self) -> float:
        return float(np.linalg.norm(self.extent))

    def meet(self, rays: Map) -> Hits:
        """The nearest points before the camera."""
        origin = (self.axes @ -self.middle).astype(np.float32)
        along = rays @ self.axes.T.astype(np.float32)
        extent = self.extent.astype(np.float32)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            z, normals, places = _MEET[self.kind](origin, along, extent)
            z = np.where(np.isfinite(z) & (z > 0), z, np.inf).astype(np.float32)
        return Hits(z, normals @ self.axes.astype(np.float32), places)


Meeting = tuple[Map, Map, Map]


def _meet_box(origin: Map, along: Map, extent: Map) -> Meeting:
    ends = np.stack([(-extent - origin) / along, (extent - origin) / along])
    entries, exits = ends.min(0), ends.max(0)
    axis = entries.argmax(2)
    z = np.where(entries.max(2) < exits.min(2), entries.max(2), np.inf)
    normals = np.zeros_like(along)
    rows, columns = np.indices(axis.shape)
    normals[rows, columns, axis] = -np.sign(along[rows, columns, axis])
    points = origin + np.where(np.isfinite(z), z, 0)[..., None] * along
    others = np.array([[1, 2], [0, 2], [0, 1]])[axis]
    return z, normals, points[rows[..., None], columns[..., None], others]


def _first_root(a: Map, b: Map, c: Map) -> Map:
    """The smaller root of a t² + 2 b t + c."""
    inside = b * b - a * c
    return np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0))) / a, np.inf)


def _meet_ellipsoid(origin: Map, along: Map, extent: Map) -> Meeting:
    o, d = origin / extent, along / extent
    z = _first_root((d * d).sum(2), d @ o, (o * o).sum() - 1)
    unit = o + np.where(np.isfinite(z), z, 0)[..., None] * d
    normals = unit / extent
    normals /= _length(normals)[..., None] + 1e-9
    size = extent.mean()
    places = np.stack([np.arctan2(unit[..., 1], unit[..., 0]), np.arcsin(np.clip(unit[..., 2], -1, 1))], 2) * size
    return z, normals, places


def _meet_cylinder(origin: Map, along: Map, extent: Map) -> Meeting:
    """A round one, upright along its third axis, of radius extent[0]."""
    radius, half = extent[0], extent[2]
    o, d = origin[:2], along[..., :2]
    side = _first_root((d * d).sum(2), d @ o, (o * o).sum() - radius**2)
    side = np.where(np.abs(origin[2] + side * along[..., 2]) <= half, side, np.inf)
    cap = (-np.sign(along[..., 2]) * half - origin[2]) / along[..., 2]
    reach = ((o + cap[..., None] * d) ** 2).sum(2)
    cap = np.where((reach <= radius**2) & (cap > 0), cap, np.inf)
    z = np.minimum(side, cap)
    points = origin + np.where(np.isfinite(z), z, 0)[..., None] * along
    is_cap = (cap < side)[..., None]
    upright = np.concatenate([points[..., :2] / radius, np.zeros_like(points[..., :1])], 2)
    level = np.zeros_like(points)
    level[..., 2] = -np.sign(along[..., 2])
    around = np.stack([np.arctan2(points[..., 1], points[..., 0]) * radius, points[..., 2]], 2)
    return z, np.where(is_cap, level, upright), np.where(is_cap, points[..., :2], around)


_MEET: dict[str, Callable[[Map, Map, Map], Meeting]] = {
    "box": _meet_box,
    "ellipsoid": _meet_ellipsoid,
    "cylinder": _meet_cylinder,
}


def _painted(texture: Map, places: Map, level: Map) -> Map:
    """The sRGB texture [n,n,3] at places [h,w,2] in its pixels, mirrored on and on, each ``level`` octaves reduced."""
    level = np.clip(level, 0, MOST_LEVELS - 1)
    places = places.astype(np.float32)
    out = np.zeros((*level.shape, 3), np.float32)
    for octave in range(int(level.min()), int(np.ceil(level.max())) + 1):
        size = texture.shape[0] >> octave
        reduced = cv2.resize(texture, (size, size), interpolation=cv2.INTER_AREA) if octave else texture
        within = np.abs(np.mod(places / np.float32(2**octave), np.float32(2 * size)) - np.float32(size))
        within = np.clip(within, 0, size - 1)
        seen = cv2.remap(reduced, within[..., 0], within[..., 1], cv2.INTER_LINEAR)
        out += np.clip(1 - np.abs(level - octave), 0, 1)[..., None] * np.asarray(seen, np.float32)
    return out


def _paint(texture: Map, hits: Hits, rays: Map, view: View, nearest_z: float) -> Map:
    """Linear colour [h,w,3] of the points hit: the texture, as sharp as pixels allow where it is nearest."""
    z = np.where(np.isfinite(hits.z), hits.z, nearest_z)
    texel = nearest_z / (view.focal_px * OVERSAMPLE)
    slant = np.abs(np.einsum("hwc,hwc->hw", hits.normals, rays)) / _length(rays)
    level = np.log2(z / nearest_z / np.sqrt(np.clip(slant, 0.05, 1)))
    return decode_srgb(_painted(texture, hits.places / texel, level))


def _plain_or(rng: np.random.Generator, plain_share: float, texture: Map) -> Map:
    """The texture, or its mean colour in soft light."""
    return texture if rng.random() >= plain_share else plain_texture(rng, texture.mean((0, 1)), texture.shape[0])


def _reduced(samples: NDArray[np.floating], size: tuple[int, int]) -> Map:
    return np.asarray(cv2.resize(samples, size, interpolation=cv2.INTER_AREA), np.float32)


def _unit(vector: Vector) -> Vector:
    out: Vector = vector / np.linalg.norm(vector)
    return out


def _length(vectors: Map) -> Map:
    return np.asarray(np.sqrt(np.einsum("hwc,hwc->hw", vectors, vectors)), np.float32)


def _across(up: Vector) -> tuple[Vector, Vector]:
    """Two directions at right angles to this one and each other."""
    helper = np.array([1.0, 0, 0]) if abs(up[0]) < 0.9 else np.array([0, 1.0, 0])
    first = _unit(np.cross(up, helper))
    return first, np.cross(up, first)


def _plane_hits(normal: Vector, rays: Map, level: float) -> Hits:
    """Where rays meet the plane normal · X = level; coordinates along two axes on it."""
    q = np.maximum(rays @ normal.astype(np.float32) / np.float32(level), LEAST_Q)
    points = rays / q[..., None]
    places = np.stack([points @ axis.astype(np.float32) for axis in _across(_unit(normal))], 2)
    toward = -_unit(normal) * np.sign(level)
    return Hits(1 / q, np.broadcast_to(toward.astype(np.float32), rays.shape), places)


def _draw_solid(rng: np.random.Generator, foot: Vector, up: Vector, view: View, nearest_z: float) -> Solid:
    """Something that stands at ``foot``, or leans there, no nearer than ``nearest_z``."""
    pixel = foot[2] / view.focal_px
    kind = rng.choice(["box", "ellipsoid", "cylinder"], p=[0.45, 0.2, 0.35])
    if rng.random() < POLE_SHARE:
        width = np.exp(rng.uniform(*np.log(POLE_PX))) * pixel / 2
        extent = np.array([width, width, width * rng.uniform(10, 60)])
        kind = rng.choice(["box", "cylinder"])
    else:
        width = np.exp(rng.uniform(*np.log(APPARENT))) * view.size * pixel / 2
        extent = width * np.array([1.0, rng.uniform(0.3, 1), np.exp(rng.uniform(np.log(0.12), np.log(2.5)))])
    if kind == "cylinder":
        extent[1] = extent[0]
    extent *= min(1.0, 0.5 * max(foot[2] - nearest_z, 0.1 * foot[2]) / np.linalg.norm(extent))
    if rng.random() < LEANING_SHARE:
        up = _unit(up + rng.normal(0, 0.7, 3))
    first, second = _across(up)
    yaw = rng.uniform(0, 2 * np.pi)
    turned = np.cos(yaw) * first + np.sin(yaw) * second
    return Solid(str(kind), foot + up * extent[2], extent, np.stack([turned, np.cross(up, turned), up]))


def _window(solid: Solid, view: View) -> tuple[slice, slice] | None:
    """Columns and rows of the canvas that the solid can be seen in; None if in none."""
    depth = max(solid.middle[2] - solid.radius, 0.05 * solid.middle[2])
    reach = view.focal_px * solid.radius / depth * 1.5 + 2
    middle = solid.middle[:2] / solid.middle[2] * view.focal_px + view.center
    low = np.clip(np.floor(middle - reach), 0, view.size).astype(int)
    high = np.clip(np.ceil(middle + reach), 0, view.size).astype(int)
    if (high <= low).any():
        return None
    return slice(int(low[0]), int(high[0])), slice(int(low[1]), int(high[1]))


def _solid_surface(
    rng: np.random.Generator, draw: DrawTexture, solid: Solid, view: View, light: Light
) -> Surface | None:
    """The solid as a layer over the whole canvas; None if it is out of sight."""
    window = _window(solid, view)
    if window is None:
        return None
    columns, rows = window
    rays = view.rays(columns, rows)
    hits = solid.meet(rays)
    hit = np.isfinite(hits.z)
    size = (columns.stop - columns.start, rows.stop - rows.start)
    cover = _reduced(hit.astype(np.float32), size)
    if (cover > LEAST_COVER).sum() < LEAST_SEEN:
        return None
    paint = (
        _paint(_plain_or(rng, PLAIN_SHARE, draw(view.size)), hits, rays, view, float(hits.z[hit].min()))
        * light.on(hits.normals)[..., None]
    )
    color = _reduced(paint * hit[..., None], size)
    q = _reduced(np.where(hit, 1 / hits.z, 0).astype(np.float32), size) / np.maximum(cover, 1e-3)
    canvas = (view.size, view.size)
    alpha, excess = np.zeros(canvas, np.float32), np.full(canvas, np.nan, np.float32)
    premultiplied = np.zeros((*canvas, 3), np.float32)
    alpha[rows, columns], premultiplied[rows, columns] = cover, color
    excess[rows, columns] = np.where(cover > LEAST_COVER, q - 1, np.nan)
    return Surface(premultiplied, alpha, filled(excess))


def _shadow(rng: np.random.Generator, points: Map, solids: list[Solid], up: Vector, light: Light) -> Map:
    """How much light [h,w] the solids leave on the ground: soft, long where light comes from low."""
    out = np.ones(points.shape[:2], np.float32)
    away = up * (light.direction @ up) - light.direction
    strength, softness = rng.uniform(0.1, 0.8), rng.uniform(0.1, 1.0)
    for solid in solids:
        width = float(np.sort(solid.extent)[:2].mean())
        foot = solid.middle - up * solid.extent[2]
        reach = 2 * float(solid.extent[2]) / max(float(light.direction @ up), 0.3)
        way = (away * reach).astype(np.float32)
        beside = points - foot.astype(np.float32)
        share = np.clip((beside @ way) / max(float(way @ way), 1e-9), 0, 1)
        distance = _length(beside - share[..., None] * way)
        soft = width * softness * (0.3 + share)
        out *= 1 - np.float32(strength) / (1 + np.exp(np.clip((distance - width) / soft * 4, -30, 30)))
    return out


def _draw_view(rng: np.random.Generator, ends: tuple[float, float], focal_px: float, size: int) -> tuple[View, Vector]:
    """A camera, and the normal [3] of the ground it sees: normal · X = 1 there, so normal · ray is q.

    The canvas is a part of a larger picture: the axis of the lens may lie beside it.
    """
    middle = (size - 1) / 2
    offset = rng.uniform(-0.5, 0.5, 2) * min(focal_px, 2.0 * size)
    roll = rng.normal(0, ROLL)
    slope = (ends[1] - ends[0]) / (size - 1) * np.array([np.sin(roll), np.cos(roll)])
    q_on_axis = 1 + (ends[0] + ends[1]) / 2 + float(slope @ offset)
    view = View(size, focal_px, (float(middle + offset[0]), float(middle + offset[1])))
    return view, np.array([*(slope * focal_px), q_on_axis])


def _draw_wall(
    rng: np.random.Generator, up: Vector, ends: tuple[float, float], view: View
) -> tuple[Vector, float] | None:
    """Normal and level of a wall upright on the ground, behind much of it; None seen from above."""
    ahead = np.array([0, 0, 1.0]) - up * up[2]
    if np.linalg.norm(ahead) < LEAST_WALL_VIEW:
        return None
    turn = rng.normal(0, 0.35)
    facing: Vector = np.cos(turn) * _unit(ahead) + np.sin(turn) * np.cross(up, _unit(ahead))
    q = 1 + ends[0] + rng.uniform(0, 0.6) * (ends[1] - ends[0])
    u, v = rng.uniform(0.2, 0.8, 2) * view.size
    stands = view.ray(u, v) / q
    level = float(facing @ stands)
    return (facing, level) if level > 0.1 * np.linalg.norm(stands) else None


def draw_room(
    rng: np.random.Generator,
    draw: DrawTexture,
    *,
    ends: tuple[float, float],
    bounds: tuple[float, float],
    focal_px: float,
    count: int,
    size: int,
) -> list[Surface]:
    """Up to ``count`` solids on a ground, nearest first and the ground last, over a canvas [size, size].

    The ground's q - 1 goes from ``ends[0]`` at the top to ``ends[1]`` at the bottom; all is held within ``bounds``.
    ``draw`` draws an sRGB texture of a size.
    """
    view, normal = _draw_view(rng, ends, focal_px, size)
    up = -_unit(normal)
    light = Light(_unit(up * rng.uniform(0.3, 1.5) + rng.normal(0, 0.6, 3)), float(rng.uniform(0.25, 0.9)))
    nearest_z = 1 / (1 + bounds[1])

    solids = []
    for _ in range(count):
        u, v = rng.uniform(-0.1, 1.1, 2) * size
        ray = view.ray(u, v)
        q = max(float(np.clip(normal @ ray, 1 + bounds[0], 1 + bounds[1])), LEAST_Q)
        solids.append(_draw_solid(rng, ray / q, up, view, nearest_z))

    rays = view.rays(slice(0, size), slice(0, size))
    ground = _plane_hits(normal, rays, 1.0)
    texture = _plain_or(rng, PLAIN_GROUND_SHARE, draw(OVERSAMPLE * size))
    lit = light.on(ground.normals) * _shadow(rng, rays * ground.z[..., None], solids, up, light)
    color = _paint(texture, ground, rays, view, max(nearest_z, float(ground.z.min()))) * lit[..., None]
    z = ground.z
    stands = _draw_wall(rng, up, ends, view) if rng.random() < WALL_SHARE else None
    if stands is not None:
        wall = _plane_hits(stands[0], rays, stands[1])
        texture = _plain_or(rng, PLAIN_SHARE, draw(OVERSAMPLE * size))
        paint = _paint(texture, wall, rays, view, max(nearest_z, float(wall.z.min())))
        color = np.where((wall.z < z)[..., None], paint * light.on(wall.normals)[..., None], color)
        z = np.minimum(z, wall.z)
    seen = [s for s in (_solid_surface(rng, draw, solid, view, light) for solid in solids) if s is not None]
    seen.sort(key=lambda surface: -float((surface.excess * surface.alpha).sum() / surface.alpha.sum()))
    opaque = np.ones((size, size), np.float32)
    seen.append(Surface(_reduced(color, (size, size)), opaque, _reduced(1 / z, (size, size)) - 1))
    return [replace(surface, excess=np.clip(surface.excess, *bounds).astype(np.float32)) for surface in seen]
