"""The sets of pictures that a model is scored on, and how each set's are answered."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from model_export.cases import (
    PROCEDURAL_SIDES,
    REFERENCE,
    Case,
    d200_cases,
    enlarged_cases,
    fixed_cases,
    photographed_cases,
    plane_cases,
    procedural_cases,
    refocused_cases,
    sharp_cases,
    shuffled_cases,
    viewed_cases,
)
from model_export.datasets.photos import CAMERAS, pictures_of
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
from service.inference.pair import Side
from service.optics.camera import Camera

LEAST_SCORED = 0.02
FOLDERS = ("rgbd", "tabletop", "d200", "blender")  # a set of each, or several
FIXED = "fixed"
TAKEN_NAMES = (FIXED, "plane", "procedural", "indoor")  # what names of sets that are no folder begin with
PLANES_M = (0.7, 1.0, 1.5)
VIEWS = (0.6, 0.8, 1.5)
FAR_K_CAM_PX = (1.0, 20.0, 60.0)
LARGE_K_CAMS_PX = {60.0: 4, 9.0: 3}  # such a k_cam belongs to a photograph of many pixels: so many times a frame's
FOCUS_DISTANCES_M = (0.6, 1.0, 4.0)
ORACLE_FACTORS = (0.8, 0.9, 1.0, 1.1, 1.25, 1.4)

CaseSource = Callable[[], Iterator[Case]]


class Counts(NamedTuple):
    """How many pictures of a set: few, several or many; and how many procedural scenes."""

    few: int
    several: int
    many: int
    scenes: int


QUICK, ALL = Counts(2, 2, 4, 8), Counts(8, 20, 40, 60)


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
    counts = QUICK if quick else ALL
    there = {name: data / name for name in FOLDERS if pictures_of(data / name)}
    indoor = [there[name] for name in ("rgbd", "tabletop") if name in there]
    found = []
    if len(indoor) == 2:
        found += [_set(f"plane {depth_m:g} m", partial(plane_cases, data, depth_m, counts.few)) for depth_m in PLANES_M]
    found.append(_set(FIXED, fixed_cases))
    found += [
        _set(f"procedural {n}", partial(procedural_cases, counts.scenes, side)) for n, side in PROCEDURAL_SIDES.items()
    ]
    if "blender" in there:
        found.append(_set("blender", partial(photographed_cases, there["blender"], 2 * counts.scenes), RIGHT_SIDE))
    for folder in photographed_folders(data):
        own = partial(photographed_cases, folder, 2 * counts.scenes)
        for _ in own():  # what is wrong with one of them is said before anything is scored
            pass
        found.append(_set(folder.name, own, RIGHT_SIDE))
    for folder in indoor:
        found += _indoor_sets(folder, quick)
    if "d200" in there:
        source = partial(d200_cases, there["d200"], 2 * counts.many)
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
    counts = QUICK if quick else ALL

    def by(camera: Camera, count: int, side: Side = "near") -> CaseSource:
        return partial(refocused_cases, folder, count, camera, side)

    misfocused = (*MISFOCUSED, MISFOCUSED[1] + KNOWN_DEPTHS)
    found = []
    for k_cam_px in (REFERENCE.k_cam_px,) if quick else UNSEEN_K_CAM_PX:
        camera = replace(REFERENCE, k_cam_px=k_cam_px)
        misled = (*MISLED, *misfocused) if camera == REFERENCE else ()
        # a camera's sheets take as long to photograph as everything else of a set
        further = (NO_K_CAM, *misled) if quick else (ESTIMATED_K_CAM, NO_K_CAM, *misled)
        count = counts.many if camera == REFERENCE else counts.several
        own = _set(f"{folder.name} k_cam {k_cam_px:g}", by(camera, count), *further)
        found.append(replace(own, sheets_of=None if quick else camera))
    found.append(_set(f"{folder.name} in focus", partial(sharp_cases, folder, counts.few)))
    found.append(_set(f"{folder.name} shuffled", partial(shuffled_cases, folder, counts.few)))
    for view in VIEWS:
        found += [_set(f"{folder.name} view {view:g}", partial(viewed_cases, folder, counts.several, view))]
    if quick:
        return found
    for k_cam_px in FAR_K_CAM_PX:
        found += [_set(f"{folder.name} k_cam {k_cam_px:g}", by(replace(REFERENCE, k_cam_px=k_cam_px), counts.few))]
    for k_cam_px, times in LARGE_K_CAMS_PX.items():
        enlarged = partial(enlarged_cases, folder, counts.few, replace(REFERENCE, k_cam_px=k_cam_px / times), times)
        large = f"{REFERENCE.image_width_px * times}x{REFERENCE.image_height_px * times}"
        found += [_set(f"{folder.name} k_cam {k_cam_px:g} of {large}", enlarged)]
    for focus_m in FOCUS_DISTANCES_M:
        camera = replace(REFERENCE, focus_distance_m=focus_m)
        found.append(_set(f"{folder.name} focus {focus_m:g} m", by(camera, counts.few, "auto"), *misfocused))
    return found
