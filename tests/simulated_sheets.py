"""Photographs of a sheet of circles by a camera that is known, from the project's own renderer."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from model_export.photographed_sheets import GridCamera, draw_pose, photograph
from service.calibration.report import Role
from service.calibration.target import CircleGrid
from service.optics.camera import Intrinsics

GRID = CircleGrid("asymmetric_circles", 7, 3, 26.0, 18.0)
CAMERA = GridCamera(800, 600, 4.0, 0.7, 0.5, Intrinsics(900, 900, 400, 300, (-0.05, 0.02, 0, 0, 0)))
DEPTHS_M = (0.34, 0.4, 0.46, 0.6, 0.75, 0.9)
FEW_DEPTHS_M = (0.34, 0.46, 0.6, 0.9)  # enough that nothing is warned of

SheetPhoto = tuple[str, Role, NDArray[np.uint8]]


def sheet_photos(
    camera: GridCamera, depths_m: Sequence[float], role: Role = "defocused", seed: int = 0
) -> list[SheetPhoto]:
    """A photograph (name, role, RGB) at every distance of the sheet."""
    rng = np.random.default_rng(seed)
    taken: list[SheetPhoto] = []
    for z in depths_m:
        pose = draw_pose(rng, camera, GRID, z)
        taken.append((f"{role} at {z} m", role, photograph(rng, camera, pose, GRID, focused=role == "focused")))
    return taken
