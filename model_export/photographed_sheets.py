"""Simulated photographs of a printed grid by a camera that is known: what a calibration is measured against."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import ndtr

from model_export.render import DISC, GAUSSIAN, PointSpread, Spreads, blur_varying
from service.calibration.report import Role
from service.calibration.target import CircleGrid
from service.calibration.task import Picture, Shot
from service.optics import thin_lens
from service.optics.camera import Intrinsics
from service.optics.light import encode_srgb

GRID = CircleGrid("asymmetric_circles", 11, 4, 20.0, 14.0)
SIZE_PX = (1280, 960)  # of cameras that are drawn
MOST_TILT_DEG = 25.0  # as a photographer is told
NEAREST, FARTHEST = 0.6, 1.8  # of the focus distance
MOST_BLUR = 1 / 3  # of a circle's radius
INK, PAPER, TABLE = 0.04, 0.75, 0.25
SHEET_MARGIN_MM = 15.0
MARGIN_PX = 48
LEVEL_RATIO = 1.04
JPEG_QUALITY = 92

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class GridCamera:
    """A camera to calibrate: blur constants, intrinsics and picture size, and its flaws.

    ``vignetting`` is the light lost in the corners, ``noise`` the standard deviation of a pixel as a part of the white.
    """

    width_px: int
    height_px: int
    k_cam_px: float
    gamma_px: float
    focus_distance_m: float
    intrinsics: Intrinsics
    spread: PointSpread = DISC
    vignetting: float = 0.2
    noise: float = 0.015


@dataclass(frozen=True, slots=True)
class GridPose:
    """Turn [3,3] and shift [3] (metres) of the sheet, and how much brighter the light is on its one end."""

    turn: Array
    shift_m: Array
    gradient: tuple[float, float]


def draw_camera(rng: np.random.Generator) -> GridCamera:
    """A random camera whose blur can be measured on a sheet of paper."""
    width_px, height_px = SIZE_PX
    view = rng.uniform(0.9, 1.6)
    fx = width_px * view
    distortion = (rng.uniform(-0.15, 0.1), rng.uniform(-0.05, 0.05), *rng.uniform(-1e-3, 1e-3, 2).tolist(), 0.0)
    middle = np.array([(width_px - 1) / 2, (height_px - 1) / 2]) + rng.uniform(-0.02, 0.02, 2) * width_px
    return GridCamera(
        width_px,
        height_px,
        k_cam_px=math.exp(rng.uniform(math.log(2.0), math.log(12.0))),
        gamma_px=rng.uniform(0.4, 1.2),
        focus_distance_m=view * rng.uniform(0.5, 0.8),  # the sheet fills the picture at about half of it
        intrinsics=Intrinsics(fx, fx * rng.uniform(0.998, 1.002), float(middle[0]), float(middle[1]), distortion),
        spread=DISC if rng.random() < 0.5 else GAUSSIAN,
        vignetting=rng.uniform(0, 0.4),
        noise=rng.uniform(0.01, 0.02),
    )


def draw_pose(rng: np.random.Generator, camera: GridCamera, grid: CircleGrid, depth_m: float) -> GridPose:
    """The sheet with its middle about ``depth_m`` away, tilted by up to 25 degrees, turned, and wholly in view.

    Raises ``ValueError`` where it does not fit into the picture.
    """
    middle = np.append(grid.points_mm().mean(0), 0.0) / 1e3
    is_tall = grid.size_mm[1] > grid.size_mm[0]
    lengthwise = math.pi / 2 if is_tall == (camera.width_px > camera.height_px) else 0.0
    for attempt in range(200):
        tilt, axis = math.radians(rng.uniform(0.2, 1) * MOST_TILT_DEG), rng.uniform(0, 2 * math.pi)
        roll = lengthwise + rng.uniform(-0.4, 0.4)
        lean = cv2.Rodrigues(np.array([math.cos(axis), math.sin(axis), 0]) * tilt)[0]
        turn = np.asarray(lean @ cv2.Rodrigues(np.array([0, 0, roll]))[0], np.float64)
        room = 0.3 * (1 - attempt / 200)
        aside = rng.uniform(-room, room, 2) * depth_m * camera.width_px / camera.intrinsics.fx_px
        shift = np.array([*aside, depth_m]) - turn @ middle
        pose = GridPose(turn, shift, (rng.uniform(-0.3, 0.3), rng.uniform(-0.3, 0.3)))
        seen = project(camera, pose, grid)
        edge = 1.6 * grid.diameter_mm / 1e3 / depth_m * camera.intrinsics.fx_px
        if (seen > edge).all() and (seen < np.array([camera.width_px, camera.height_px]) - edge).all():
            return pose
    raise ValueError(f"the sheet does not fit into the picture at {depth_m:.2f} m")


def project(camera: GridCamera, pose: GridPose, grid: CircleGrid) -> Array:
    """The circles' centres [n, 2] in the picture, px."""
    board = np.column_stack([grid.points_mm(), np.zeros(grid.rows * grid.columns)]) / 1e3
    matrix, distortion = np.array(camera.intrinsics.matrix), np.array(camera.intrinsics.distortion)
    seen = cv2.projectPoints(board, pose.turn, pose.shift_m, matrix, distortion)[0]
    return np.asarray(seen, np.float64).reshape(-1, 2)


def photograph(
    rng: np.random.Generator, camera: GridCamera, pose: GridPose, grid: CircleGrid, *, focused: bool = False
) -> NDArray[np.uint8]:
    """RGB uint8 [h,w,3] as a JPEG holds it; with ``focused`` the lens is focused on every point of the sheet."""
    margin = MARGIN_PX
    height, width = camera.height_px + 2 * margin, camera.width_px + 2 * margin
    sight = _sight(camera, (np.indices((height, width))[::-1].reshape(2, -1).T - margin).astype(np.float64))
    reached = _reached(sight, pose)
    on_sheet = (reached - pose.shift_m) @ pose.turn
    depth_m = reached[:, 2].reshape(height, width)
    places_mm = on_sheet[:, :2].reshape(height, width, 2) * 1e3
    light = torch.from_numpy(_printed(pose, grid, places_mm, camera.gamma_px)[None])
    if not focused:
        defocus_px = thin_lens.defocus_at_depth(depth_m, camera.focus_distance_m, camera.k_cam_px)
        sigma_px = torch.from_numpy(defocus_px.astype(np.float32))
        light = blur_varying(light[None], sigma_px[None], Spreads.of([camera.spread]), ratio=LEVEL_RATIO)[0]
    inner = light[0].numpy()[margin : margin + camera.height_px, margin : margin + camera.width_px]
    v, u = np.indices(inner.shape)
    away = (
        np.hypot(u - camera.width_px / 2, v - camera.height_px / 2) / math.hypot(camera.width_px, camera.height_px) * 2
    )
    falling = np.maximum(inner, 0) * (1 - camera.vignetting * away**2)  # a convolution by FFT can leave -1e-8
    picture = np.repeat(falling[..., None], 3, axis=2)
    noisy = picture + camera.noise * np.sqrt(PAPER * picture) * rng.standard_normal(picture.shape)
    pixels = (encode_srgb(noisy.astype(np.float32)) * 255 + 0.5).astype(np.uint8)
    packed = cv2.imencode(".jpg", pixels[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
    return np.asarray(cv2.imdecode(packed, cv2.IMREAD_COLOR), np.uint8)[:, :, ::-1].copy()


def picture(name: str, role: Role, rgb: NDArray[np.uint8]) -> Picture:
    """A photograph as a calibration takes it."""
    return Picture(name, role, lambda: Shot(rgb))


def sweep(rng: np.random.Generator, camera: GridCamera, grid: CircleGrid, count: int) -> list[Picture]:
    """So many photographs from before the plane in focus to behind it, as a photographer is told to take them.

    No farther from focus than where blur is a third of a circle's radius.
    """
    focus_m = camera.focus_distance_m
    reach_m = MOST_BLUR * grid.diameter_mm / 2e3 * camera.intrinsics.fx_px / camera.k_cam_px
    nearest_m, farthest_m = max(NEAREST * focus_m, focus_m - reach_m), min(FARTHEST * focus_m, focus_m + reach_m)
    taken = []
    for depth_m in np.geomspace(nearest_m, farthest_m, count):
        pose = draw_pose(rng, camera, grid, float(depth_m))
        taken.append(picture(f"{depth_m:.2f} m", "defocused", photograph(rng, camera, pose, grid)))
    return taken


def _sight(camera: GridCamera, pixels: Array) -> Array:
    """Directions [n, 3] with z = 1 of pixels [n, 2]."""
    matrix, distortion = np.array(camera.intrinsics.matrix), np.array(camera.intrinsics.distortion)
    flat = cv2.undistortPoints(pixels[:, None], matrix, distortion)
    return np.column_stack([np.asarray(flat).reshape(-1, 2), np.ones(len(pixels))])


def _reached(sight: Array, pose: GridPose) -> Array:
    """Where lines of sight meet the sheet's plane [n, 3], metres."""
    normal = pose.turn[:, 2]
    return sight * ((normal @ pose.shift_m) / (sight @ normal))[:, None]


def _printed(pose: GridPose, grid: CircleGrid, places_mm: Array, gamma_px: float) -> NDArray[np.float32]:
    """Light [h,w] of the sheet in focus, each pixel the mean over its square; ``places_mm`` are pixel centres on it.

    Gamma is exact at the circles' edges, where a filter of pixels could not show so small a blur.
    """
    right, down = np.gradient(places_mm, axis=1), np.gradient(places_mm, axis=0)
    points = grid.points_mm()
    margin = SHEET_MARGIN_MM + grid.diameter_mm / 2
    low, high = points.min(0) - margin, points.max(0) + margin
    from_circle = _from_circle(grid, places_mm)
    pixel_mm = np.sqrt(np.abs(right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0]))
    along = _along(from_circle, pixel_mm)
    inwards = gamma_px**2 * along / grid.diameter_mm  # the middle of a round edge, by a Gaussian
    inked = _edge(from_circle / along + inwards, gamma_px)
    paper = ((places_mm > low) & (places_mm < high)).all(-1)
    slope = (places_mm - points.mean(0)) @ np.array(pose.gradient) / (high - low).max()
    return np.asarray((np.where(paper, PAPER, TABLE) * (1 - inked) + INK * inked) * (1 + slope), np.float32)


def _edge(away_px: Array, gamma_px: float) -> Array:
    """How much of a pixel [...] at a signed distance from a straight edge is inside, after a Gaussian blur."""
    sigma = math.sqrt(max(gamma_px**2 - thin_lens.PIXEL_BOX_VARIANCE, 1e-4))

    def total(to: Array) -> Array:
        t = to / sigma
        return np.asarray(sigma * (t * ndtr(t) + np.exp(-0.5 * t**2) / math.sqrt(2 * math.pi)))

    return total(0.5 - away_px) - total(-0.5 - away_px)


def _along(distance: Array, pixel_mm: Array) -> Array:
    """How much a signed distance [h,w] changes from pixel to pixel across its edge, mm."""
    return np.maximum(np.hypot(*np.gradient(distance)), 0.1 * pixel_mm)


def _from_circle(grid: CircleGrid, at_mm: Array) -> Array:
    """Signed distance [...] of places [..., 2] from the edge of the nearest printed circle, mm."""
    nearest = np.full(at_mm.shape[:-1], np.inf)
    spacing, is_asymmetric = grid.spacing_mm, grid.kind == "asymmetric_circles"
    rows = np.rint(at_mm[..., 1] / spacing)
    for step in (-1, 0, 1):
        row = np.clip(rows + step, 0, grid.rows - 1)
        shift = (row % 2) * spacing if is_asymmetric else 0.0
        pitch = 2 * spacing if is_asymmetric else spacing
        column = np.clip(np.rint((at_mm[..., 0] - shift) / pitch), 0, grid.columns - 1)
        away = np.hypot(at_mm[..., 0] - column * pitch - shift, at_mm[..., 1] - row * spacing)
        nearest = np.minimum(nearest, away)
    return nearest - grid.diameter_mm / 2
