"""One camera and the poses of its sheets from where their circles are seen, and how well the focal length is told."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from service.opencv import cv2

Array = NDArray[np.float64]

FEW_VIEWS = 4
CRITERIA = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 200, 1e-10)
# what is fitted of the camera: log aspect, principal point (of the longer side), k1, k2, p1, p2, log focal length
# (of the longer side); how far from a square pixel, the middle, no distortion and a usual view cameras are
USUAL_SPREAD = (0.005, 0.02, 0.02, 0.2, 0.2, 0.002, 0.002, 1.0)
CAMERA = len(USUAL_SPREAD)
ROUNDS = 2  # the first is held by too little: its scatter is that of a camera with its axis in the middle
LEAST_SCATTER_PX = 1e-3
LOG_FOCAL_BOUND = 5.0


@dataclass(frozen=True, slots=True)
class Solved:
    """The camera, the turn and shift of every sheet, and what is left over: over all, and of each view, rms in px."""

    rms: float
    matrix: Array
    distortion: Array
    turns: tuple[Array, ...]
    shifts: tuple[Array, ...]
    errors: Array


def solve(
    points: Sequence[Array], centres: Sequence[Array], size_px: tuple[int, int], near: Solved | None = None
) -> Solved:
    """The camera and poses that show points [k, 3] of the sheets at their centres [k, 2] best.

    Few views do not tell the whole camera: what they leave open is held near to what cameras are. Raises
    ``cv2.error`` where no camera would show them so.
    """
    is_few = len(points) < FEW_VIEWS
    flags = cv2.CALIB_FIX_K3
    if is_few:
        flags |= cv2.CALIB_FIX_K2 | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_ASPECT_RATIO
        flags |= cv2.CALIB_FIX_PRINCIPAL_POINT
    start = np.array([[max(size_px), 0, (size_px[0] - 1) / 2], [0, max(size_px), (size_px[1] - 1) / 2], [0, 0, 1]])
    if is_few or near is not None:
        flags |= cv2.CALIB_USE_INTRINSIC_GUESS
    rms, matrix, distortion, turns, shifts, _, _, errors = cv2.calibrateCameraExtended(
        [of_view.astype(np.float32) for of_view in points],
        [np.asarray(places, np.float32)[:, None] for places in centres],
        size_px,
        start.astype(np.float64) if near is None else near.matrix.copy(),
        np.zeros(5) if near is None else near.distortion.copy(),
        flags=flags,
        criteria=CRITERIA,
    )
    solved = Solved(
        float(rms),
        np.asarray(matrix, np.float64),
        np.asarray(distortion, np.float64).ravel(),
        tuple(np.asarray(turn, np.float64).ravel() for turn in turns),
        tuple(np.asarray(shift, np.float64).ravel() for shift in shifts),
        np.asarray(errors, np.float64).ravel(),
    )
    return _held(points, centres, size_px, solved) if is_few else solved


def focal_error(points: Sequence[Array], solved: Solved, size_px: tuple[int, int]) -> float:
    """The relative standard error of the focal length, all else that was fitted being free too.

    OpenCV's own drops what the circles hardly tell, which of sheets that were never tilted is the focal length.
    """
    seen = _Seen(points, size_px)
    slopes = seen.slopes(seen.values(solved))
    freedom = len(slopes) - slopes.shape[1]
    if freedom <= 0:
        return math.inf
    scatter_px = max(solved.rms * math.sqrt(len(slopes) / 2 / freedom), LEAST_SCATTER_PX)
    held = [seen.held] if len(points) < FEW_VIEWS else []  # as it was fitted
    told = np.concatenate([slopes / scatter_px, *held])
    lengths = np.linalg.norm(told, axis=0)
    triangle = np.asarray(np.linalg.qr(told / lengths, mode="r"))
    least = float(abs(triangle[-1, -1]) * lengths[-1])
    return 1 / least if least > 0 else math.inf


def _held(points: Sequence[Array], centres: Sequence[Array], size_px: tuple[int, int], at: Solved) -> Solved:
    """All of the camera fitted, and held near to what cameras are.

    With the axis held in the very middle, focal lengths of two views were 4 % off, with what is stated a tenth of it.
    """
    seen = _Seen(points, size_px)
    wanted = np.concatenate([places.ravel() for places in centres])
    for _ in range(ROUNDS):
        scatter_px = max(at.rms / math.sqrt(2), LEAST_SCATTER_PX)

        def rest(values: Array, scatter_px: float = scatter_px) -> Array:
            off = (seen.places(values) - wanted) / scatter_px
            return np.append(off, (values[-CAMERA:] - seen.usual) / seen.spread)

        def slopes(values: Array, scatter_px: float = scatter_px) -> Array:
            return np.concatenate([seen.slopes(values) / scatter_px, seen.held])

        found = least_squares(rest, seen.values(at), jac=slopes, method="lm", x_scale="jac")
        at = seen.solved(found.x, wanted)
    return at


@dataclass(frozen=True, slots=True)
class _Seen:
    """Where a camera shows points, by the values that are fitted: turn and shift of each view, and the camera."""

    points: Sequence[Array]
    size_px: tuple[int, int]

    @property
    def usual(self) -> Array:
        middle = (np.array(self.size_px) - 1) / 2
        return np.array([0.0, *middle, 0.0, 0.0, 0.0, 0.0, math.log(max(self.size_px))])

    @property
    def spread(self) -> Array:
        longer = max(self.size_px)
        return np.array(USUAL_SPREAD) * [1, longer, longer, 1, 1, 1, 1, 1]

    @property
    def held(self) -> Array:
        """The slopes [8, n] of what the camera is off from usual, in standard deviations."""
        return np.pad(np.diag(1 / self.spread), ((0, 0), (6 * len(self.points), 0)))

    def values(self, solved: Solved) -> Array:
        fx, fy, cx, cy = solved.matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
        poses = np.concatenate([*zip(solved.turns, solved.shifts, strict=True)], axis=None)
        return np.array([*poses, math.log(fx / fy), cx, cy, *solved.distortion[:4], math.log(fy)])

    def solved(self, values: Array, wanted: Array) -> Solved:
        matrix, distortion = self._camera(values)
        square = np.square(self.places(values) - wanted)
        ends = np.cumsum([2 * len(of_view) for of_view in self.points])[:-1]
        errors = [math.sqrt(2 * float(part.mean())) for part in np.split(square, ends)]
        poses = values[:-CAMERA].reshape(-1, 2, 3)
        rms = math.sqrt(2 * float(square.mean()))
        return Solved(rms, matrix, distortion, tuple(poses[:, 0]), tuple(poses[:, 1]), np.array(errors))

    def places(self, values: Array) -> Array:
        return np.concatenate([places.ravel() for places, _ in self._projected(values)])

    def slopes(self, values: Array) -> Array:
        """Of places, [2 points, values]."""
        matrix, _ = self._camera(values)
        rows = []
        for number, (_, slopes) in enumerate(self._projected(values)):
            row = np.zeros((len(slopes), values.size))
            row[:, 6 * number : 6 * number + 6] = slopes[:, :6]
            row[:, -CAMERA] = slopes[:, 6] * matrix[0, 0]
            row[:, 1 - CAMERA : -1] = slopes[:, 8:14]
            row[:, -1] = slopes[:, 6] * matrix[0, 0] + slopes[:, 7] * matrix[1, 1]
            rows.append(row)
        return np.concatenate(rows)

    def _projected(self, values: Array) -> list[tuple[Array, Array]]:
        matrix, distortion = self._camera(values)
        seen = [
            cv2.projectPoints(of_view, turn, shift, matrix, distortion)
            for of_view, (turn, shift) in zip(self.points, values[:-CAMERA].reshape(-1, 2, 3), strict=True)
        ]
        return [(np.asarray(places, np.float64), np.asarray(slopes, np.float64)) for places, slopes in seen]

    def _camera(self, values: Array) -> tuple[Array, Array]:
        log_aspect, cx, cy, *distortion, log_f = values[-CAMERA:].tolist()
        fy = math.exp(min(log_f, self.usual[-1] + LOG_FOCAL_BOUND))
        matrix = np.array([[fy * math.exp(max(min(log_aspect, 1.0), -1.0)), 0, cx], [0, fy, cy], [0, 0, 1]])
        return matrix, np.array([*distortion, 0.0])
