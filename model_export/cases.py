"""Pictures to answer, with a camera and the truth: made from the development data, or drawn."""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from model_export.config import SceneConfig
from model_export.datasets.photos import CameraPart, Photo, filled, load_cameras, load_photos, pictures_of
from model_export.pool import HELD_OUT_SEED
from model_export.render import refocus
from model_export.scenes import draw_sample, draw_shot, true_blur_px
from service.inference.known import KnownDepth
from service.inference.pair import Side
from service.optics import thin_lens
from service.optics.camera import Camera, Intrinsics, Lens

FRAME_FX_PX = 525.0
NEAR_LIMIT_M = 2.0
CELL_PX = 32
CELL_CONTRAST = 0.03
TEXTURED_SHARE = 0.6
D200 = Lens(35.0, 2.8, 6.05, 3872)
D200_LIMIT_M = 5.0
D200_STEP = 0.05
D200_STEP_MARGIN_PX = 25
SIDES: dict[int, Side] = {-1: "near", 0: "auto", 1: "far"}
PROCEDURAL_SIDES = {"near": -1, "far": 1, "mixed": 0}
FIXED_SCENES = 6
NEEDED: tuple[CameraPart, ...] = ("focus_distance_m", "k_cam_px", "gamma_px")  # to answer a picture
KNOWN_RANKS = (1 / 6, 3 / 6, 5 / 6)

Map = NDArray[np.float32]

REFERENCE = Camera(640, 480, 2.0, 3.81, 0.5, intrinsics=Intrinsics.centred(FRAME_FX_PX, 640, 480))


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """One picture to answer: ``truth_m`` is NaN where it is not scored, ``blur_px`` None where lambda is not known.

    Cases are compared by identity, so that what was found of one can be cached by it.
    """

    name: str
    image: NDArray[np.uint8]
    truth_m: Map
    camera: Camera
    side: Side
    blur_px: Map | None = None

    @property
    def known_depths(self) -> list[KnownDepth]:
        """What a user with a tape would tell: the depth of a near, a middle and a far pixel."""
        rows, columns = np.nonzero(np.isfinite(self.truth_m))
        depth_m = self.truth_m[rows, columns]
        chosen = np.argsort(depth_m, kind="stable")[[int(rank * depth_m.size) for rank in KNOWN_RANKS]]
        return [KnownDepth(columns[place], rows[place], float(depth_m[place])) for place in chosen]


def to_pixels(picture: Map) -> NDArray[np.uint8]:
    """A picture in 0..1 as eight bits."""
    return (picture * 255 + 0.5).astype(np.uint8)


def _encoded(photo: Photo) -> Map:
    return photo.image.astype(np.float32) / np.float32(255)


def _sharp_texture(photo: Photo) -> Map:
    """A frame halved, so that its own softness is gone, and mirrored back to its size; sRGB 0..1."""
    height, width = photo.image.shape[:2]
    half = cv2.resize(photo.image, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    tiled = cv2.copyMakeBorder(half, 0, height - height // 2, 0, width - width // 2, cv2.BORDER_REFLECT)
    return np.asarray(tiled, np.float32) / np.float32(255)


def is_textured(texture: Map) -> bool:
    """Whether most cells of 32 px have a contrast (standard deviation of brightness) above 3 %."""
    height, width = (size // CELL_PX * CELL_PX for size in texture.shape[:2])
    grey = texture[:height, :width].mean(2)
    cells = grey.reshape(height // CELL_PX, CELL_PX, width // CELL_PX, CELL_PX).std((1, 3))
    return float((cells > CELL_CONTRAST).mean()) >= TEXTURED_SHARE


def plane_cases(data: Path, depth_m: float, count: int) -> Iterator[Case]:
    """Textured planes at one distance, refocused with the reference camera; a bare wall is no textured plane."""
    for folder in ("rgbd", "tabletop"):
        sharp = [(photo, _sharp_texture(photo)) for photo in load_photos(data / folder)]
        textured = [(photo, texture) for photo, texture in sharp if is_textured(texture)]
        for photo, texture in textured[:: max(1, len(textured) // max(1, count // 2))][: count // 2]:
            plane = np.full(texture.shape[:2], depth_m, np.float32)
            picture = to_pixels(refocus(texture, plane, REFERENCE))
            yield Case(f"{photo.name} at {depth_m} m", picture, plane, REFERENCE, "near")


def _to_limit(depth_m: Map) -> Map:
    with np.errstate(invalid="ignore"):
        return np.where(depth_m <= NEAR_LIMIT_M, depth_m, np.float32(np.nan)).astype(np.float32)


def refocused_cases(folder: Path, count: int, camera: Camera = REFERENCE, side: Side = "near") -> Iterator[Case]:
    """Sharp frames with depth, refocused with a camera; scored to 2 m."""
    for photo in _spread(folder, count):
        picture = to_pixels(refocus(_encoded(photo), filled(photo.depth_m), camera))
        yield Case(photo.name, picture, _to_limit(photo.depth_m), camera, side)


def sharp_cases(folder: Path, count: int) -> Iterator[Case]:
    """A control: frames as they are, said to be by the reference camera, which would have all of them in focus.

    What is answered well all the same was read from what things look like.
    """
    for photo in _spread(folder, count):
        yield Case(photo.name, photo.image, _to_limit(photo.depth_m), REFERENCE, "near")


def shuffled_cases(folder: Path, count: int) -> Iterator[Case]:
    """A control: each frame blurred by the depth of one half a set away, scored on its own. Nothing can be right here.

    What is answered well all the same was not read from blur. Half a set, because neighbours look alike.
    """
    photos = list(_spread(folder, count))
    half = (len(photos) + 1) // 2
    for photo, other in zip(photos, (*photos[half:], *photos[:half]), strict=True):
        if other.depth_m.shape == photo.depth_m.shape:
            picture = to_pixels(refocus(_encoded(photo), filled(other.depth_m), REFERENCE))
            yield Case(photo.name, picture, _to_limit(photo.depth_m), REFERENCE, "near")


def viewed_cases(folder: Path, count: int, view: float) -> Iterator[Case]:
    """Frames of another field of view with the same k_cam: their middle enlarged, or the whole made smaller."""
    for photo in _spread(folder, count):
        height, width = photo.image.shape[:2]
        top, left = (max(0, round(size * (1 - view) / 2)) for size in (height, width))
        cut = (slice(top, height - top), slice(left, width - left))
        shrink = max(1.0, view)
        size = (round(width / shrink), round(height / shrink))
        how = cv2.INTER_CUBIC if view < 1 else cv2.INTER_AREA
        picture = cv2.resize(_encoded(photo)[cut], size, interpolation=how)
        depth = np.asarray(cv2.resize(photo.depth_m[cut], size, interpolation=cv2.INTER_NEAREST_EXACT), np.float32)
        camera = replace(REFERENCE, image_width_px=size[0], image_height_px=size[1])
        camera = replace(camera, intrinsics=Intrinsics.centred(FRAME_FX_PX / view, *size))
        blurred = refocus(np.clip(np.asarray(picture, np.float32), 0, 1), filled(depth), camera)
        yield Case(photo.name, to_pixels(blurred), _to_limit(depth), camera, "near")


def enlarged_cases(folder: Path, count: int, camera: Camera, times: int) -> Iterator[Case]:
    """Refocused frames so many times their size, with the k_cam, gamma and intrinsics that they have there."""
    for case in refocused_cases(folder, count, camera):
        height, width = (size * times for size in case.truth_m.shape)
        picture = cv2.resize(case.image, (width, height), interpolation=cv2.INTER_CUBIC)
        truth = cv2.resize(case.truth_m, (width, height), interpolation=cv2.INTER_NEAREST)
        yield replace(
            case,
            image=np.asarray(picture, np.uint8),
            truth_m=np.asarray(truth, np.float32),
            camera=camera.resized(width, height),
        )


def d200_cases(folder: Path, count: int) -> Iterator[Case]:
    """Real photographs of a real lens, known by its specs alone; scored away from depth steps and to 5 m."""
    for photo in _spread(folder, count):
        height, width = photo.image.shape[:2]
        camera = Camera(width, height, 2.0, D200.k_cam_px(2.0, width), 0.5, D200.focal_length_m).seen_through(D200)
        truth = photo.depth_m.copy()
        truth[_near_steps(filled(truth)) | (filled(truth) > D200_LIMIT_M)] = np.nan
        yield Case(photo.name, photo.image, truth, camera, "auto")


def _near_steps(depth_m: Map) -> NDArray[np.bool_]:
    """Pixels within the margin of a step of more than 5 % between neighbours."""
    kernel = np.ones((3, 3), np.uint8)
    ratio = cv2.dilate(depth_m, kernel) / cv2.erode(depth_m, kernel)
    step = (np.asarray(ratio) > 1 + D200_STEP).astype(np.uint8)
    size = 2 * D200_STEP_MARGIN_PX + 1
    return np.asarray(cv2.dilate(step, np.ones((size, size), np.uint8))) > 0


def procedural_cases(count: int, side: int, first: int = 0) -> Iterator[Case]:
    """Procedural scenes of seeds and textures that no training drew: all nearer (-1), farther (1), or both (0)."""
    config = SceneConfig()
    seeds = (HELD_OUT_SEED + number for number in itertools.count(first))
    # a scene's shot comes first: those of other sides need not be drawn
    fitting = (seed for seed in seeds if draw_shot(np.random.default_rng(seed), config).side == side)
    for sample in (draw_sample(seed, config) for seed in itertools.islice(fitting, count)):
        shot = sample.shot
        height, width = sample.excess.shape
        inner = Intrinsics.centred(shot.focal_length_px, width, height)
        camera = Camera(width, height, shot.focus_distance_m, shot.k_cam_px, shot.gamma_px, intrinsics=inner)
        truth = np.float32(shot.focus_distance_m) / (1 + sample.excess.astype(np.float32))
        image = np.ascontiguousarray(sample.image.transpose(1, 2, 0))
        yield Case("procedural", image, truth, camera, SIDES[side], true_blur_px(sample))


def fixed_cases() -> Iterator[Case]:
    """A few procedural scenes of every side: needs no data, so tests can hold a model to what its card says."""
    for side in PROCEDURAL_SIDES.values():
        yield from procedural_cases(FIXED_SCENES, side)


def photographed_cases(folder: Path, count: int) -> Iterator[Case]:
    """Pictures out of focus, each with a camera in ``cameras.json``, as of ``camind blender``; the side is not told."""
    cameras = load_cameras(folder, NEEDED)
    for photo in _spread(folder, count):
        height, width = photo.image.shape[:2]
        told = cameras[photo.name]
        inner = Intrinsics.centred(told["fx_px"], width, height) if "fx_px" in told else None
        camera = Camera(width, height, told["focus_distance_m"], told["k_cam_px"], told["gamma_px"], intrinsics=inner)
        blur_px = thin_lens.blur_at_depth(photo.depth_m, camera.focus_distance_m, camera.k_cam_px, camera.gamma_px)
        yield Case(photo.name, photo.image, photo.depth_m, camera, "auto", blur_px)


def _spread(folder: Path, count: int) -> Iterator[Photo]:
    """About ``count`` of a folder's photos, spread over it, of those whose depth is known anywhere."""
    photos = load_photos(folder, max(1, math.ceil(len(pictures_of(folder)) / count)))
    return (photo for photo in photos if np.isfinite(photo.depth_m).any())
