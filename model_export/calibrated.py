"""A camera as our own calibration finds it: simulated photographs of a sheet, and nothing told of the camera."""

from functools import cache

import numpy as np

from model_export.photographed_sheets import GridCamera, sweep
from service.calibration.calibrate import calibrate
from service.calibration.target import CircleGrid
from service.calibration.task import Task
from service.optics.camera import Camera

# of A0: at the two metres that the scored cameras are focused at, a circle of a smaller one is a few pixels
SHEET = CircleGrid("asymmetric_circles", 11, 4, 100.0, 70.0)
PHOTOGRAPHS = 10
SEED = 0


@cache
def calibrated(camera: Camera) -> Camera:
    """The camera that its photographs of a sheet tell: k_cam, gamma, focus distance and intrinsics.

    The sheet is moved through the plane in focus, no farther from it than a third of a circle's radius of blur.
    Raises ``ValueError`` for a camera without intrinsics, or whose sheet tells nothing.
    """
    if camera.intrinsics is None:
        raise ValueError("a camera without intrinsics has no simulated photographs")
    known = GridCamera(
        camera.image_width_px,
        camera.image_height_px,
        camera.k_cam_px,
        camera.gamma_px,
        camera.focus_distance_m,
        camera.intrinsics,
    )
    report = calibrate(Task(SHEET), sweep(np.random.default_rng(SEED), known, SHEET, PHOTOGRAPHS))
    if report.result is None:
        raise ValueError(f"no calibration: {report.problem}")
    return report.result.to_camera()
