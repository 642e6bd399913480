"""What a model is scored on: pictures with a camera and the truth, made from the development data or drawn."""

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from model_export.config import SceneConfig
from model_export.datasets.photos import CAMERAS, CameraPart, Photo, filled, load_cameras, load_photos, pictures_of
from model_export.modes import (
    ESTIMATED_K_CAM,
    KNOWN_DEPTHS,
    MISFOCUSED,
    MISLED,
    NO_K_CAM,
    REGISTERED_LARGE,
    RIGHT_SIDE,
    RING_FROM_SENSOR,
    TRUE_CAMERA,
    UNSEEN_K_CAM_PX,
)
from model_export.pool import HELD_OUT_SEED
from model_export.render import refocus
from model_export.scenes import draw_sample, draw_shot, true_blur_px
from service.inference.known import KnownDepth
from service.inference.pair import Side
from service.optics import thin_lens
from service.optics.camera import Camera, Intrinsics, Lens

FRAME_FX_PX = 525.0
FAR_K_CAM_PX = (1.0, 20.0, 60.0)
LARGE_K_CAMS_PX = {60.0: 4, 9.0: 3}  # such a k_cam belongs to a photograph of many pixels: so many times a frame's
FOCUS_DISTANCES_M = (0.6, 1.0, 4.0)
PLANES_M = (0.7, 1.0, 1.5)
VIEWS = (0.6, 0.8, 1.5)
NEAR_LIMIT_M = 2.0
LEAST_SCORED = 0.02
D200 = Lens(35.0, 2.8, 6.05, 3872)
D200_LIMIT_M = 5.0
COUNTS = {True: (2, 2, 4, 8), False: (8, 20, 40, 60)}  # quick or not: few, several, many pictures, and scenes
D200_STEP = 0.05
D200_STEP_MARGIN_PX = 25
CELL_PX = 32
CELL_CONTRAST = 0.03
TEXTURED_SHARE = 0.6
SIDES: dict[int, Side] = {-1: "near", 0: "auto", 1: "far"}
FIXED = "fixed"
FOLDERS = ("rgbd", "tabletop", "d200", "blender")  # a set of each, or several
FIXED_SCENES = 6
TAKEN_NAMES = (FIXED, "plane", "procedural", "indoor")  # what names of sets that are no folder begin with
NEEDED: tuple[CameraPart, ...] = ("focus_distance_m", "k_cam_px", "gamma_px")  # to answer a picture
ORACLE_FACTORS = (0.8, 0.9, 1.0, 1.1, 1.25, 1.4)
KNOWN_RANKS = (1 / 6, 3 / 6, 5 / 6)
PROCEDURAL_SIDES = {"near": -1, "far": 1, "mixed": 0}

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


CaseSource = Callable[[], Iterator[Case]]


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


@dataclass(frozen=True, slots=True)
class EvaluationSet:
    """Pictures under one name, and the modes (see ``modes.MODES``) in which its pictures are answered.

    They are also answered with ``factors`` on all k_cam, of which the one that the truth likes best is kept.
    ``sheets_of`` is the camera that is known by photographs of a sheet in one of the modes.
    """

    name: str
    cases: CaseSource
    modes: tuple[str, ...] = (TRUE_CAMERA,)
    factors: tuple[float, ...] = ()
    sheets_of: Camera | None = None

    @property
    def answers(self) -> int:
        """How often each picture is answered."""
        return len(self.modes) + len(self.factors)


def _enough(source: CaseSource) -> Iterator[Case]:
    """The cases of which enough can be scored."""
    return (case for case in source() if np.isfinite(case.truth_m).mean() > LEAST_SCORED)


def evaluation_sets(data: Path, quick: bool) -> list[EvaluationSet]:
    """The sets that the data folder can serve; a folder that is missing, or has no pictures, is a missing set.

    Raises ``ValueError`` or ``OSError`` for what is wrong with a set of one's own.
    """
    few, _, many, scenes = COUNTS[quick]
    there = {name: data / name for name in FOLDERS if pictures_of(data / name)}
    indoor = [there[name] for name in ("rgbd", "tabletop") if name in there]
    found = []
    if len(indoor) == 2:
        found += [_set(f"plane {depth_m:g} m", partial(plane_cases, data, depth_m, few)) for depth_m in PLANES_M]
    found.append(_set(FIXED, fixed_cases))
    found += [_set(f"procedural {n}", partial(procedural_cases, scenes, side)) for n, side in PROCEDURAL_SIDES.items()]
    if "blender" in there:
        found.append(_set("blender", partial(photographed_cases, there["blender"], 2 * scenes), RIGHT_SIDE))
    for folder in photographed_folders(data):
        own = partial(photographed_cases, folder, 2 * scenes)
        for _ in own():  # what is wrong with one of them is said before anything is scored
            pass
        found.append(_set(folder.name, own, RIGHT_SIDE))
    for folder in indoor:
        found += _indoor_sets(folder, quick)
    if "d200" in there:
        source = partial(d200_cases, there["d200"], 2 * many)
        told = (RING_FROM_SENSOR, REGISTERED_LARGE, *MISFOCUSED)
        further = (RIGHT_SIDE, *told, TRUE_CAMERA + KNOWN_DEPTHS, MISFOCUSED[1] + KNOWN_DEPTHS)
        found.append(replace(_set("d200", source, *further), factors=ORACLE_FACTORS))
    return found


def photographed_folders(data: Path) -> list[Path]:
    """Those of a data folder that have pictures, or cameras of pictures, and a name of their own.

    Raises ``ValueError`` for the name of another set, and for a folder that is itself a set.
    """
    if (data / "color").is_dir():
        raise ValueError(f"{data} is a set of pictures itself: name the folder that it is in")
    parts = (part for name in ("color", CAMERAS) for part in data.glob(f"*/{name}"))
    folders = sorted({part.parent for part in parts if part.parent.name not in FOLDERS})
    if taken := [folder for folder in folders if folder.name in TAKEN_NAMES or " " in folder.name]:
        raise ValueError(f"{taken[0]} has the name of another set, or a space in it: name it otherwise")
    return folders


def is_own(name: str) -> bool:
    """Whether a set of this name is of a user's own pictures."""
    return name.split()[0] not in (*FOLDERS, *TAKEN_NAMES)


def _set(name: str, source: CaseSource, *further_modes: str) -> EvaluationSet:
    return EvaluationSet(name, partial(_enough, source), (TRUE_CAMERA, *further_modes))


def _indoor_sets(folder: Path, quick: bool) -> list[EvaluationSet]:
    """Sharp frames refocused by several cameras, at other distances of focus and in other fields of view."""
    few, several, many, _ = COUNTS[quick]

    def by(camera: Camera, count: int, side: Side = "near") -> CaseSource:
        return partial(refocused_cases, folder, count, camera, side)

    misfocused = (*MISFOCUSED, MISFOCUSED[1] + KNOWN_DEPTHS)
    found = []
    for k_cam_px in (REFERENCE.k_cam_px,) if quick else UNSEEN_K_CAM_PX:
        camera = replace(REFERENCE, k_cam_px=k_cam_px)
        misled = (*MISLED, *misfocused) if camera == REFERENCE else ()
        # a camera's sheets take as long to photograph as everything else of a set
        further = (NO_K_CAM, *misled) if quick else (ESTIMATED_K_CAM, NO_K_CAM, *misled)
        count = many if camera == REFERENCE else several
        own = _set(f"{folder.name} k_cam {k_cam_px:g}", by(camera, count), *further)
        found.append(replace(own, sheets_of=None if quick else camera))
    found.append(_set(f"{folder.name} in focus", partial(sharp_cases, folder, few)))
    found.append(_set(f"{folder.name} shuffled", partial(shuffled_cases, folder, few)))
    for view in VIEWS:
        found += [_set(f"{folder.name} view {view:g}", partial(viewed_cases, folder, several, view))]
    if quick:
        return found
    for k_cam_px in FAR_K_CAM_PX:
        found += [_set(f"{folder.name} k_cam {k_cam_px:g}", by(replace(REFERENCE, k_cam_px=k_cam_px), few))]
    for k_cam_px, times in LARGE_K_CAMS_PX.items():
        enlarged = partial(enlarged_cases, folder, few, replace(REFERENCE, k_cam_px=k_cam_px / times), times)
        large = f"{REFERENCE.image_width_px * times}x{REFERENCE.image_height_px * times}"
        found += [_set(f"{folder.name} k_cam {k_cam_px:g} of {large}", enlarged)]
    for focus_m in FOCUS_DISTANCES_M:
        camera = replace(REFERENCE, focus_distance_m=focus_m)
        found.append(_set(f"{folder.name} focus {focus_m:g} m", by(camera, few, "auto"), *misfocused))
    return found
