"""One camera and the poses of its sheets from where their circles are seen, and how well the focal length is told."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.calibration.numerics import least_squares
from service.opencv import cv2

Array = NDArray[np.float64]

FEW_VIEWS = 4
FREE_VIEWS = 6  # that tell all of a camera, and where each circle of the sheet is
CRITERIA = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 200, 1e-10)
# what is fitted of the camera: log aspect, principal point (of the longer side), k1, k2, p1, p2, log focal length
# (of the longer side); how far from a square pixel, the middle, no distortion and a usual view cameras are
USUAL_SPREAD = (0.005, 0.02, 0.02, 0.2, 0.2, 0.002, 0.002, 1.0)
CAMERA = len(USUAL_SPREAD)
ROUNDS = 2  # the first is held by too little: its scatter is that of a camera with its axis in the middle
LEAST_SCATTER_PX = 1e-3
LOG_FOCAL_BOUND = 5.0
# what is fitted of the sheet: one side stretched and the other shrunk, and how high it bends lengthwise, twisted and
# across, over half its length; how far from an even, flat one sheets are
SHEET_SPREAD = (0.003, 0.005, 0.005, 0.005)
SHEET = len(SHEET_SPREAD)


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

    Few views do not tell the whole camera: what they leave open is as cameras usually are, see ``solve_with_sheet``.
    Raises ``cv2.error`` where no camera would show them so.
    """
    is_few = len(points) < FREE_VIEWS
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
    if not (matrix.diagonal().min() > 0 and math.isfinite(rms)):
        raise cv2.error("no camera shows the points so")
    return Solved(
        float(rms),
        np.asarray(matrix, np.float64),
        np.asarray(distortion, np.float64).ravel(),
        tuple(np.asarray(turn, np.float64).ravel() for turn in turns),
        tuple(np.asarray(shift, np.float64).ravel() for shift in shifts),
        np.asarray(errors, np.float64).ravel(),
    )


def focal_error(points: Sequence[Array], solved: Solved, size_px: tuple[int, int], sheet: Array | None = None) -> float:
    """The relative standard error of the focal length, all else that was fitted being free too.

    That is the ``sheet`` [n, 3] too where it was found by ``solve_with_sheet``, of which each view shows ``points``.
    OpenCV's own drops what the circles hardly tell, which of sheets that were never tilted is the focal length.
    """
    seen = _Seen(points, size_px, () if sheet is None else tuple(_bends(sheet, of_view) for of_view in points))
    slopes = seen.slopes(seen.values(solved))
    freedom = len(slopes) - slopes.shape[1]
    if freedom <= 0:
        return math.inf
    scatter_px = max(solved.rms * math.sqrt(len(slopes) / 2 / freedom), LEAST_SCATTER_PX)
    held = [] if sheet is None else [seen.held]  # as it was fitted
    told = np.concatenate([slopes / scatter_px, *held])
    lengths = np.linalg.norm(told, axis=0)
    triangle = np.asarray(np.linalg.qr(told / lengths, mode="r"))
    least = float(abs(triangle[-1, -1]) * lengths[-1])
    return 1 / least if least > 0 else math.inf


def solve_with_sheet(
    sheet: Array, circles: Sequence[NDArray[np.int64]], centres: Sequence[Array], size_px: tuple[int, int], at: Solved
) -> tuple[Array, Solved]:
    """The sheet [n, 3] as it bends and stretches, and all of the camera, held near to what sheets and cameras are.

    ``circles`` are those that each view shows. With the axis held in the very middle, focal lengths of two views were
    4 % off, with what is stated a tenth of it; with a sheet held flat that bends by 1 mm, those of three.
    """
    bends = _bends(sheet, sheet)
    seen = _Seen([sheet[of_view] for of_view in circles], size_px, tuple(bends[of_view] for of_view in circles))
    wanted = np.concatenate([places.ravel() for places in centres])
    values = seen.values(at)
    for _ in range(ROUNDS):
        scatter_px = max(at.rms / math.sqrt(2), LEAST_SCATTER_PX)

        def rest(values: Array, scatter_px: float = scatter_px) -> Array:
            off = (seen.places(values) - wanted) / scatter_px
            return np.append(off, (values[seen.sheet_from :] - seen.usual) / seen.spread)

        def slopes(values: Array, scatter_px: float = scatter_px) -> Array:
            return np.concatenate([seen.slopes(values) / scatter_px, seen.held])

        values = least_squares(rest, values, jac=slopes, method="lm", x_scale="jac").x
        at = seen.solved(values, wanted)
    return sheet + bends @ values[seen.sheet_from : -CAMERA], at


def _bends(sheet: Array, points: Array) -> Array:
    """How each of ``points`` [k, 3] moves with what is fitted of the sheet [k, 3, SHEET], in the sheet's unit."""
    reach = float(np.ptp(sheet, axis=0).max()) / 2
    u, v = ((points - sheet.mean(0)) / reach).T[:2]
    none = np.zeros_like(u)
    moves = np.array([[u, none, none, none], [-v, none, none, none], [none, u**2, u * v, v**2]])
    return reach * moves.transpose(2, 0, 1)


@dataclass(frozen=True, slots=True)
class _Seen:
    """Where a camera shows points, by the values that are fitted: turn and shift of each view, sheet and camera.

    ``bends`` [k, 3, SHEET] is how each view's points move with what is fitted of the sheet; none of one that is known.
    """

    points: Sequence[Array]
    size_px: tuple[int, int]
    bends: tuple[Array, ...] = ()

    @property
    def sheet_from(self) -> int:
        """The place of the first value that all views have in common."""
        return 6 * len(self.points)

    @property
    def usual(self) -> Array:
        middle = (np.array(self.size_px) - 1) / 2
        sheet = [0.0] * (SHEET if self.bends else 0)
        return np.array([*sheet, 0.0, *middle, 0.0, 0.0, 0.0, 0.0, math.log(max(self.size_px))])

    @property
    def spread(self) -> Array:
        longer = max(self.size_px)
        camera = np.array(USUAL_SPREAD) * [1, longer, longer, 1, 1, 1, 1, 1]
        return np.array([*(SHEET_SPREAD if self.bends else ()), *camera])

    @property
    def held(self) -> Array:
        """The slopes of what sheet and camera are off from usual, in standard deviations."""
        return np.pad(np.diag(1 / self.spread), ((0, 0), (self.sheet_from, 0)))

    def values(self, solved: Solved) -> Array:
        fx, fy, cx, cy = solved.matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
        poses = np.concatenate([*zip(solved.turns, solved.shifts, strict=True)], axis=None)
        sheet = [0.0] * (SHEET if self.bends else 0)
        return np.array([*poses, *sheet, math.log(fx / fy), cx, cy, *solved.distortion[:4], math.log(fy)])

    def solved(self, values: Array, wanted: Array) -> Solved:
        matrix, distortion = self._camera(values)
        square = np.square(self.places(values) - wanted)
        ends = np.cumsum([2 * len(of_view) for of_view in self.points])[:-1]
        errors = [math.sqrt(2 * float(part.mean())) for part in np.split(square, ends)]
        poses = values[: self.sheet_from].reshape(-1, 2, 3)
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
            if self.bends:
                turn = np.asarray(cv2.Rodrigues(values[6 * number : 6 * number + 3])[0])
                moved = slopes[:, 3:6].reshape(-1, 2, 3) @ turn @ self.bends[number]
                row[:, self.sheet_from : -CAMERA] = moved.reshape(-1, SHEET)
            row[:, -CAMERA] = slopes[:, 6] * matrix[0, 0]
            row[:, 1 - CAMERA : -1] = slopes[:, 8:14]
            row[:, -1] = slopes[:, 6] * matrix[0, 0] + slopes[:, 7] * matrix[1, 1]
            rows.append(row)
        return np.concatenate(rows)

    def _projected(self, values: Array) -> list[tuple[Array, Array]]:
        matrix, distortion = self._camera(values)
        seen = []
        for number, (turn, shift) in enumerate(values[: self.sheet_from].reshape(-1, 2, 3)):
            points = self.points[number]
            if self.bends:
                points = points + self.bends[number] @ values[self.sheet_from : -CAMERA]
            seen.append(cv2.projectPoints(points, turn, shift, matrix, distortion))
        return [(np.asarray(places, np.float64), np.asarray(slopes, np.float64)) for places, slopes in seen]

    def _camera(self, values: Array) -> tuple[Array, Array]:
        log_aspect, cx, cy, *distortion, log_f = values[-CAMERA:].tolist()
        fy = math.exp(min(log_f, self.usual[-1] + LOG_FOCAL_BOUND))
        matrix = np.array([[fy * math.exp(max(min(log_aspect, 1.0), -1.0)), 0, cx], [0, fy, cy], [0, 0, 1]])
        return matrix, np.array([*distortion, 0.0])
