"""Where the pixels of an answer look, by the camera's intrinsics and its lens' distortion."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.inference.depth_map import DepthMap
from service.opencv import cv2
from service.optics.camera import Intrinsics

# towards the corners of a wide lens 20 rounds are too few; a place that no ray meets is left out, and costs all of them
UNDISTORTING = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-6)
LENS_CELL_PX, MOST_OFF_PX = 8, 0.5
RAY_CELL_PX, MOST_BENT_PX = 4, 0.01
UNKNOWN = Intrinsics(math.nan, math.nan, math.nan, math.nan)


def camera_matrix(answer: DepthMap) -> NDArray[np.float64]:
    """K [3, 3] at the maps' size; NaN for the four numbers of unknown intrinsics."""
    return np.array((answer.camera.intrinsics or UNKNOWN).matrix)


def distortion_of(answer: DepthMap) -> NDArray[np.float64]:
    """The lens' distortion in OpenCV's order; empty where there is none."""
    return np.array(answer.camera.intrinsics.distortion if answer.camera.intrinsics else (), np.float64)


def rays(answer: DepthMap, u: NDArray[np.intp], v: NDArray[np.intp]) -> NDArray[np.float64]:
    """Where pixels look: x and y [2, n] at a depth of 1, without the lens' distortion.

    That is looked for on a grid, and between its places linear where that is right to a hundredth of a pixel.
    """
    matrix = camera_matrix(answer)
    if not distortion_of(answer).any() or len(u) == 0:
        return np.stack([(u - matrix[0, 2]) / matrix[0, 0], (v - matrix[1, 2]) / matrix[1, 1]])
    height, width = answer.depth_m.shape
    down, across = (np.arange(0, size + RAY_CELL_PX, RAY_CELL_PX) for size in (height, width))
    corners = _grid_rays(answer, down, across).astype(np.float32)
    to_corners = np.array([[1 / RAY_CELL_PX, 0, 0], [0, 1 / RAY_CELL_PX, 0]])
    linear = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    between_corners = (cv2.warpAffine(values, to_corners, (width, height), flags=linear) for values in corners)
    found = np.array([values[v, u] for values in between_corners], np.float64)
    middles = (corners[:, :-1, :-1] + corners[:, :-1, 1:] + corners[:, 1:, :-1] + corners[:, 1:, 1:]) / 4
    off = _grid_rays(answer, down[:-1] + RAY_CELL_PX / 2, across[:-1] + RAY_CELL_PX / 2) - middles
    is_bent = ~(np.hypot(*off) * matrix[0, 0] <= MOST_BENT_PX)
    alone = is_bent[v // RAY_CELL_PX, u // RAY_CELL_PX]
    if alone.any():
        found[:, alone] = _undistorted(answer, u[alone], v[alone])
    return found


def _grid_rays(answer: DepthMap, down: NDArray[Any], across: NDArray[Any]) -> NDArray[np.float64]:
    """Where the places of a grid look: x and y [2, h, w] at a depth of 1."""
    u, v = (places.ravel() for places in np.meshgrid(across, down))
    return _undistorted(answer, u, v).reshape(2, len(down), len(across))


def _undistorted(answer: DepthMap, u: NDArray[Any], v: NDArray[Any]) -> NDArray[np.float64]:
    """Where places look, each by its own search, which takes long for all of a photograph."""
    places = np.stack([u, v], 1).astype(np.float64)[:, None]
    found = cv2.undistortPoints(places, camera_matrix(answer), distortion_of(answer), criteria=UNDISTORTING)
    return np.asarray(found, np.float64)[:, 0].T


def are_met(answer: DepthMap, u: NDArray[np.intp], v: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Whether rays meet the sensor at pixels, by the corners of cells of ``LENS_CELL_PX`` each way.

    Towards the corners of a wide picture a lens' polynomial may turn back: nothing is distorted to what lies beyond.
    """
    distortion = distortion_of(answer)
    if not distortion.any():
        return np.ones(len(u), np.bool_)
    down, across = (np.arange(0, size + LENS_CELL_PX, LENS_CELL_PX) for size in answer.depth_m.shape)
    corners = np.stack([places.ravel() for places in np.meshgrid(across, down)])
    ahead = np.column_stack([*_undistorted(answer, *corners), np.ones(corners.shape[1])])
    back = cv2.projectPoints(ahead, np.zeros(3), np.zeros(3), camera_matrix(answer), distortion)[0][:, 0]
    met = (np.hypot(*(back.T - corners)) <= MOST_OFF_PX).reshape(len(down), len(across))
    cells = met[:-1, :-1] & met[1:, :-1] & met[:-1, 1:] & met[1:, 1:]
    return np.asarray(cells[v // LENS_CELL_PX, u // LENS_CELL_PX])
