"""Modes in which a scored picture is answered: what of its camera, its side of focus and its depths is told."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

from model_export.calibrated import calibrated
from service.optics import thin_lens
from service.optics.camera import Camera

TRUE_CAMERA = "gt"
ESTIMATED_K_CAM = "estimated k_cam"
NO_K_CAM = "no k_cam"
MISLED = ("k_cam -10%", "k_cam +10%")
MISFOCUSED = ("focus -10%", "focus +10%")
RING_FROM_SENSOR = "ring from the sensor"
REGISTERED_LARGE = "registered large"
KNOWN_DEPTHS = ", known depths"  # after the name of another mode: three depths of each picture are known besides
# what no user has: they tell how much of an error is the camera's, and how much the side's
RIGHT_SIDE, ORACLE_K_CAM = "right side", "oracle k_cam"

UNSEEN_K_CAM_PX = (2.64, 3.81, 6.80, 10.7)
# an unknown camera is taken for the middle one of those that are scored
UNKNOWN_K_CAM_PX = math.prod(UNSEEN_K_CAM_PX) ** (1 / len(UNSEEN_K_CAM_PX))
SENSOR_TIMES = 6  # as wide as the real lens' pictures


def with_k_cam_times(factor: float, camera: Camera) -> Camera:
    """The camera with so many times its k_cam."""
    return replace(camera, k_cam_px=factor * camera.k_cam_px)


def _misfocused(factor: float, camera: Camera) -> Camera:
    """The camera said to be focused so many times as far, its k_cam that of its lens there."""
    return camera.focused_at(factor * camera.focus_distance_m)


def _counted_from_lens(camera: Camera) -> Camera:
    """The camera whose focus distance is a ring's, which counts it from the sensor."""
    return camera.focused_at(thin_lens.focus_from_lens(camera.focus_distance_m, camera.focal_length_m or 0.0))


def _registered_large(camera: Camera) -> Camera:
    """The camera as registered with the size of its sensor, its pictures made a sixth as large by whatever program."""
    width_px, height_px = camera.image_width_px, camera.image_height_px
    large = camera.resized(SENSOR_TIMES * width_px, SENSOR_TIMES * height_px)
    return replace(large, gamma_px=camera.gamma_px).resampled(width_px, height_px)


# the camera that is told, of the true one
MODES: dict[str, Callable[[Camera], Camera]] = {
    TRUE_CAMERA: lambda camera: camera,
    ESTIMATED_K_CAM: calibrated,
    NO_K_CAM: lambda camera: replace(camera, k_cam_px=UNKNOWN_K_CAM_PX),
    MISLED[0]: partial(with_k_cam_times, 0.9),
    MISLED[1]: partial(with_k_cam_times, 1.1),
    MISFOCUSED[0]: partial(_misfocused, 0.9),
    MISFOCUSED[1]: partial(_misfocused, 1.1),
    RING_FROM_SENSOR: _counted_from_lens,
    REGISTERED_LARGE: _registered_large,
}
