"""Ray-traced thin-lens scenes with exact depth, by Blender's Cycles: a check of our renderer, and an evaluation set.

``blender_worker.py`` renders them in Blender's own environment. Cycles' lens has its image plane at the focal length,
so k_cam = f^2 / (k_r N s1 p) there, with s1 where eq. 2 has s1 - f.
"""

import math
import random
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from model_export.datasets.blender_environment import run_workers, shares
from model_export.datasets.photos import Photo, PhotoAndCamera, save_photos
from model_export.render import DISC, blur
from service.optics import thin_lens
from service.optics.light import encode_srgb

WORKER = Path(__file__).with_name("blender_worker.py")
EDGE_ANGLE = math.radians(5)
EDGE_SIZE_PX, EDGE_SAMPLES, ROOM_SAMPLES = 128, 1024, 64
EDGE_SIGMAS_PX = (0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0, 7.0, 10.0)
EDGE_EXCESS = 0.5
EDGE_OVERSAMPLE = 8
EDGE_TOLERANCE = 0.03
GAMMA_PX = 0.5

Map = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Scene:
    """What the worker renders: a slanted ``edge`` at one depth, or a ``room`` with solids drawn from its seed."""

    name: str
    kind: str
    seed: int
    size_px: int
    focus_distance_m: float
    k_cam_px: float
    focal_length_mm: float
    sensor_width_mm: float
    samples: int
    depth_m: float | None = None

    @property
    def fx_px(self) -> float:
        return self.focal_length_mm / self.sensor_width_mm * self.size_px


def edges() -> list[Scene]:
    """Slanted edges of every sigma in ``EDGE_SIGMAS_PX`` before and behind the plane in focus."""
    found = []
    for sigma_px in EDGE_SIGMAS_PX:
        for side, depth_m in (
            ("near", thin_lens.depth_near(EDGE_EXCESS, 2.0)),
            ("far", thin_lens.depth_far(EDGE_EXCESS, 2.0)),
        ):
            k_cam_px = sigma_px / EDGE_EXCESS
            name = f"edge_{side}_{sigma_px:g}"
            found.append(Scene(name, "edge", 1, EDGE_SIZE_PX, 2.0, k_cam_px, 50.0, 36.0, EDGE_SAMPLES, depth_m))
    return found


def rooms(count: int, size_px: int = 256) -> list[Scene]:
    """Rooms by cameras with k_cam 0.8 to 15 px, focused at 0.4 to 4 m."""
    found = []
    for seed in range(count):
        dice = random.Random(seed)
        focus_m, k_cam_px = (math.exp(dice.uniform(math.log(a), math.log(b))) for a, b in ((0.4, 4), (0.8, 15)))
        focal_mm = dice.uniform(25, 70)
        found.append(Scene(f"room_{seed:03d}", "room", seed, size_px, focus_m, k_cam_px, focal_mm, 36.0, ROOM_SAMPLES))
    return found


def render(python: Path, scenes: list[Scene], out: Path, on_progress: Callable[[str], None] = lambda _: None) -> None:
    """Render to ``out``/NAME.npz (``light`` linear [h,w,3], ``depth_m`` [h,w]); what is there is kept.

    Raises ``ChildProcessError`` with the worker's last words if it fails.
    """
    run_workers(python, WORKER, shares([asdict(scene) for scene in scenes]), out, on_progress)


def sharp_edge(size_px: int) -> Map:
    """The worker's edge [h,w] without blur, seen by square pixels: the part of each that is white."""
    fine = (np.arange(size_px * EDGE_OVERSAMPLE) + 0.5) / EDGE_OVERSAMPLE - size_px / 2
    distance = fine[None, :] * math.cos(EDGE_ANGLE) - fine[:, None] * math.sin(EDGE_ANGLE)
    white = np.clip(distance * EDGE_OVERSAMPLE + 0.5, 0, 1).astype(np.float32)
    return np.asarray(cv2.resize(white, (size_px, size_px), interpolation=cv2.INTER_AREA), np.float32)


def edge_sigma(light: Map, expected_px: float) -> float:
    """Standard deviation of the point spread, px, from a picture [h,w] of the worker's edge: whatever its shape.

    The slope of each row is the line spread, widened by the edge's slant; what an edge without blur shows, the pixels'
    own box among it, is taken off. Only where a disc of ``expected_px`` reaches is looked at: beyond, a band-limited
    disc rings.
    """
    reach = 2 * expected_px + 3
    variances = [_row_variance(picture, reach) for picture in (light, sharp_edge(len(light)))]
    return math.sqrt(variances[0] - variances[1]) * math.cos(EDGE_ANGLE)


def _row_variance(picture: Map, reach: float) -> float:
    size = len(picture)
    border = math.ceil(reach + 2)
    rows = np.arange(border, size - border)
    at = np.arange(1, size) - size / 2
    offset = at[None, :] - (rows[:, None] + 0.5 - size / 2) * math.tan(EDGE_ANGLE)
    weight = np.diff(picture[rows].astype(np.float64), axis=1) * (np.abs(offset) <= reach)
    weight /= weight.sum(1, keepdims=True)
    return float((weight * (offset - (weight * offset).sum(1, keepdims=True)) ** 2).sum(1).mean())


@dataclass(frozen=True, slots=True)
class EdgeResult:
    """One slanted edge: sigma by eq. 7, as Cycles rendered it, and as our renderer does."""

    name: str
    expected_px: float
    cycles_px: float
    ours_px: float


def compare_edge(scene: Scene, light: Map) -> EdgeResult:
    """Measure a rendered edge [h,w] and ours by the same means."""
    depth_m = scene.depth_m or math.nan
    expected = thin_lens.defocus_at_depth(depth_m, scene.focus_distance_m, scene.k_cam_px)
    ours = blur(torch.from_numpy(sharp_edge(scene.size_px)), expected, DISC).numpy()
    return EdgeResult(scene.name, expected, edge_sigma(light, expected), edge_sigma(ours, expected))


def compare_edges(rendered: Path, scenes: list[Scene]) -> Iterator[EdgeResult]:
    """All rendered edges below a folder, measured."""
    for scene in scenes:
        yield compare_edge(scene, np.load(rendered / f"{scene.name}.npz")["light"][..., 1])


def develop(rendered: Path, scenes: list[Scene], out: Path) -> None:
    """Rendered rooms as an evaluation set: gamma is brought to 0.5 px, brightness to the 98th percentile."""
    save_photos(out, (_developed(rendered, scene) for scene in scenes))


def _developed(rendered: Path, scene: Scene) -> PhotoAndCamera:
    found = np.load(rendered / f"{scene.name}.npz")
    light = torch.from_numpy(found["light"].transpose(2, 0, 1).copy())
    margin = 8
    padded = torch.nn.functional.pad(light[None], (margin,) * 4, mode="reflect")[0]
    soft = blur(padded, math.sqrt(GAMMA_PX**2 - thin_lens.PIXEL_BOX_VARIANCE))[:, margin:-margin, margin:-margin]
    picture = encode_srgb((soft / soft.quantile(0.98).clamp_min(1e-3)).permute(1, 2, 0).numpy())
    camera = {
        "focus_distance_m": scene.focus_distance_m,
        "k_cam_px": scene.k_cam_px,
        "gamma_px": GAMMA_PX,
        "fx_px": scene.fx_px,
    }
    return Photo(scene.name, np.rint(picture * 255).astype(np.uint8), found["depth_m"]), camera
