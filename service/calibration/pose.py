"""Where the sheet was in every photograph, and the intrinsics that make it so: depth is z along the axis, not a ray."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.calibration.solve import CRITERIA, FEW_VIEWS, FREE_VIEWS, Solved, focal_error, solve, solve_with_sheet
from service.calibration.target import CircleGrid
from service.opencv import cv2
from service.optics.camera import Intrinsics

Array = NDArray[np.float64]

RIM_POINTS = 48
LEAST_VIEWS = 2
LITTLE_TILT_DEG = 8.0
BAD_RMS_PART = 0.008  # of the spacing
CLEARLY = 0.75
TELL_BENT_PART = 0.025  # of the spacing
MOST_FOCAL_ERROR = 0.1
NEAR_M = 0.01  # all sheets nearer than that: their spacing may have been told in metres


class PoseError(Exception):
    """Why the sheets cannot be placed, in words for the user."""


@dataclass(frozen=True, slots=True)
class View:
    """The centres [k, 2] (px) of those circles of the grid, by number, that were measured in one photograph."""

    circles: NDArray[np.int64]
    centres_px: Array


@dataclass(frozen=True, slots=True)
class Placement:
    """The camera, and for each view the circles' depth z [k] in metres, the sheet's tilt, and what is left over in px.

    ``focal_error`` is the relative standard error of the focal length: all depths are wrong together by it.
    """

    intrinsics: Intrinsics
    depth_m: tuple[Array, ...]
    distance_m: tuple[float, ...]
    tilt_deg: tuple[float, ...]
    rms_px: tuple[float, ...]
    overall_rms_px: float
    focal_error: float
    warnings: tuple[str, ...]


def place(grid: CircleGrid, views: Sequence[View], size_px: tuple[int, int]) -> Placement:
    """Intrinsics and poses of the views of one camera with pictures of ``size_px`` (width, height).

    What an imaged circle's middle is off from its centre's image under perspective is taken out. Raises ``PoseError``
    for too few views, or such as no camera would have or as tell no focal length.
    """
    if len(views) < LEAST_VIEWS:
        raise PoseError(
            f"{len(views)} photograph{' shows' if len(views) == 1 else 's show'} the grid well enough; {LEAST_VIEWS} "
            f"are the least from which a focal length, and so a distance, can be had, {FEW_VIEWS} or more are better"
        )
    flat = np.column_stack([grid.points_mm(), np.zeros(grid.rows * grid.columns)])
    seen = _solved(flat, views, [view.centres_px for view in views], size_px)
    centres = [view.centres_px - _bias(flat, grid, view, seen, i) for i, view in enumerate(views)]
    solved = _solved(flat, views, centres, size_px)
    board, solved, error = _freed(flat, grid, views, centres, size_px, solved)
    bent_mm = float(np.linalg.norm(board - flat, axis=1).max())
    turns = [np.asarray(cv2.Rodrigues(turn)[0]) for turn in solved.turns]
    depths = [
        np.asarray((board[view.circles] @ turn.T)[:, 2] + float(shift[2]), np.float64) / 1e3
        for view, turn, shift in zip(views, turns, solved.shifts, strict=True)
    ]
    middle = board.mean(0)
    tilts = [_tilt_deg(turn) for turn in turns]
    distances = [float((turn @ middle)[2] + shift[2]) / 1e3 for turn, shift in zip(turns, solved.shifts, strict=True)]
    fx_px, fy_px, cx_px, cy_px = solved.matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    if error > MOST_FOCAL_ERROR:
        raise PoseError(
            f"the focal length cannot be told from these sheets, tilted by at most {max(tilts):.0f} degrees: tilt the "
            "sheet by 15 to 25 degrees, this way and that"
        )
    return Placement(
        Intrinsics(fx_px, fy_px, cx_px, cy_px, tuple(solved.distortion.tolist())),
        tuple(depths),
        tuple(distances),
        tuple(tilts),
        tuple(solved.errors.tolist()),
        solved.rms,
        error,
        (*_near(distances), *_warnings(grid, views, solved, tilts), *_imperfect(grid, bent_mm)),
    )


def stand(grid: CircleGrid, view: View, intrinsics: Intrinsics) -> tuple[float, float] | tuple[None, None]:
    """How far (m, along the axis) the middle of the sheet stands from a camera that is known, and its tilt in degrees.

    Neither where no pose fits the circles.
    """
    flat = np.column_stack([grid.points_mm(), np.zeros(grid.rows * grid.columns)])
    matrix, distortion = np.array(intrinsics.matrix), np.array(intrinsics.distortion, np.float64)
    try:
        is_placed, turn, shift = cv2.solvePnP(
            flat[view.circles], np.asarray(view.centres_px, np.float64)[:, None], matrix, distortion
        )
    except cv2.error:
        return None, None
    if not is_placed:
        return None, None
    rotation = np.asarray(cv2.Rodrigues(turn)[0], np.float64)
    middle = rotation @ flat.mean(0) + np.asarray(shift, np.float64).ravel()
    return float(middle[2]) / 1e3, _tilt_deg(rotation)


def _tilt_deg(rotation: NDArray[np.generic]) -> float:
    return float(np.degrees(np.arccos(min(abs(rotation[2, 2]), 1.0))))


def _freed(
    flat: Array,
    grid: CircleGrid,
    views: Sequence[View],
    centres: Sequence[Array],
    size_px: tuple[int, int],
    solved: Solved,
) -> tuple[Array, Solved, float]:
    """The sheet as it is, found along with the camera, and the relative standard error of its focal length.

    Paper bends and printers stretch, by a millimetre. The mean size is kept: which of both is wrong cannot be known.
    Where many views show all of it each circle is where it fits best (Strobl and Hirzinger 2011), if that is clearly
    better; few tell how it stretches and bends on the whole.
    """
    whole = [i for i, view in enumerate(views) if view.circles.size == len(flat)]
    if len(whole) < FREE_VIEWS:
        board, solved = solve_with_sheet(flat, [view.circles for view in views], centres, size_px, solved)
        return board, solved, focal_error([board[view.circles] for view in views], solved, size_px, flat)
    found = cv2.calibrateCameraRO(
        [flat[views[i].circles].astype(np.float32) for i in whole],
        [np.asarray(centres[i], np.float32)[:, None] for i in whole],
        size_px,
        grid.columns - 1,
        solved.matrix.copy(),
        solved.distortion.copy(),
        flags=cv2.CALIB_FIX_K3,  # with CALIB_USE_INTRINSIC_GUESS, OpenCV 5.0 fails an assertion of its own
        criteria=CRITERIA,
    )
    board = np.empty_like(flat)
    board[views[whole[0]].circles] = np.asarray(found[5], np.float64).reshape(-1, 3)
    board = _laid_over(board, flat)
    freed = _solved(board, views, centres, size_px, solved)
    board, solved = (board, freed) if freed.rms < CLEARLY * solved.rms else (flat, solved)
    return board, solved, focal_error([board[view.circles] for view in views], solved, size_px)


def _laid_over(board: Array, flat: Array) -> Array:
    """The points [n, 3] turned, moved and sized to lie as near to the flat ones as they can (Umeyama 1991)."""
    from_middle, to_middle = board - board.mean(0), flat - flat.mean(0)
    left, _, right = np.linalg.svd(from_middle.T @ to_middle)
    turn = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    size = np.sqrt((to_middle**2).sum() / (from_middle**2).sum())
    return np.asarray(size * from_middle @ turn + flat.mean(0))


def _solved(
    board: Array,
    views: Sequence[View],
    centres: Sequence[Array],
    size_px: tuple[int, int],
    near: Solved | None = None,
) -> Solved:
    try:
        return solve([board[view.circles] for view in views], centres, size_px, near)
    except cv2.error as error:
        raise PoseError("the sheets cannot be placed: no camera would see the grid like that") from error


def _bias(board: Array, grid: CircleGrid, view: View, solved: Solved, number: int) -> Array:
    """How far [k, 2] the middle of each circle's image is from the image of its centre, in px."""
    angle = np.arange(RIM_POINTS) * (2 * np.pi / RIM_POINTS)
    rim = np.stack([np.cos(angle), np.sin(angle), np.zeros(RIM_POINTS)], 1) * grid.diameter_mm / 2
    centres = board[view.circles]
    points = np.concatenate([centres, (centres[:, None] + rim).reshape(-1, 3)])
    seen, _ = cv2.projectPoints(points, solved.turns[number], solved.shifts[number], solved.matrix, solved.distortion)
    flat = np.asarray(seen, np.float64).reshape(-1, 2)
    outlines = flat[len(centres) :].reshape(-1, RIM_POINTS, 2) - flat[: len(centres), None]
    after = np.roll(outlines, -1, axis=1)
    cross = outlines[..., 0] * after[..., 1] - outlines[..., 1] * after[..., 0]
    # the centroid of the outline's polygon, from the centre's image
    return np.asarray(((outlines + after) * cross[..., None]).sum(1) / (3 * cross.sum(1))[:, None])


def _near(distances: Sequence[float]) -> list[str]:
    if max(distances) >= NEAR_M:
        return []
    return [
        f"by what was told of the sheet it stood at most {1e3 * max(distances):.2g} mm from the lens: give spacing_mm "
        "and diameter_mm in millimetres"
    ]


def _imperfect(grid: CircleGrid, bent_mm: float) -> list[str]:
    if bent_mm < TELL_BENT_PART * grid.spacing_mm:
        return []
    return [
        f"the sheet is bent or unevenly printed: circles are up to {bent_mm:.2g} mm off a flat, even grid; this is "
        "accounted for, but a flat sheet gives better distances"
    ]


def _warnings(grid: CircleGrid, views: Sequence[View], solved: Solved, tilts: list[float]) -> list[str]:
    told = []
    if len(views) < FEW_VIEWS:
        told.append(
            f"{len(views)} usable photographs: the focal length, and with it every distance, is uncertain; take "
            f"{FEW_VIEWS} or more"
        )
    if max(tilts) < LITTLE_TILT_DEG:
        told.append(
            f"the sheet was never tilted by more than {max(tilts):.0f} degrees: focal length and distance cannot be "
            "told apart well; tilt it by 15 to 25 degrees"
        )
    size = np.median([np.ptp(view.centres_px, axis=0).max() for view in views]) / max(grid.rows, grid.columns)
    if solved.rms > BAD_RMS_PART * size:
        told.append(
            f"the circles are {solved.rms:.1f} px off where one camera would see them: check the pattern's numbers, "
            "that the sheet is flat, and that all pictures are from one camera with one zoom"
        )
    return told
