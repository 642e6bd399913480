"""Whether all photographs had one focus: on a tilted sheet blur changes with depth within each of them, too.

Where the focus follows the sheet or drifts as one goes farther, or another aperture is set half way, one curve fits all
photographs well, with a k_cam that is wrong by a third, say. Within each of them blur then changes otherwise than from
one to the next.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.calibration.fit import SLOPE_ERROR, Circles, Constants, blur_of, errors_of
from service.calibration.numerics import least_squares
from service.optics import thin_lens

Array = NDArray[np.float64]

LEAST_CIRCLES = 8  # of a photograph that tells how its blur changes
USUAL_MOVE = 0.1  # of a focus that moved, relative: a far larger one is not looked for
CLEARLY = 15.0  # less of the cost, twice: of simulated sets with one focus the most was 11
LEAST_SPREAD = 0.05  # of the focus distances, nearest to farthest, that is told
ROBUST_SCALE = 3.0  # standard deviations
REACH = 3.0  # of what is fitted, logarithms


@dataclass(frozen=True, slots=True)
class _Seen:
    """Circles [n], the number of each's photograph, and the relative errors their blur may have."""

    circles: Circles
    number: NDArray[np.int64]
    offset: Array  # of depth within its photograph, in standard deviations
    errors: tuple[float, float, float]  # of a photograph, of how its blur changes, of a circle

    def rest(self, values: Array) -> Array:
        """What is left of the blur, in standard errors, by the logarithms of k_cam, gamma, focus distance, and by how
        much the focus of each photograph is another; none for one focus.
        """
        k_cam, gamma, focus_m = np.exp(values[:3])
        moves = values[3:]
        focus = focus_m * np.exp(moves[self.number]) if moves.size else focus_m
        blur_px = thin_lens.blur_at_depth(self.circles.depth_m, focus, k_cam, gamma)
        return np.append(self._whitened(np.log(blur_px / self.circles.blur_px)), moves / USUAL_MOVE)

    def _whitened(self, off: Array) -> Array:
        count = np.bincount(self.number)
        of_picture, of_slope, of_circle = self.errors
        for error, along in ((of_picture, np.ones_like(off)), (of_slope, self.offset)):
            mean = np.bincount(self.number, off * along) / count
            off = off - (mean * (1 - of_circle / np.sqrt(of_circle**2 + count * error**2)))[self.number] * along
        return np.asarray(off / of_circle)


def refocused(circles: Circles, constants: Constants) -> tuple[str, ...]:
    """A warning where photographs clearly fit better if each may have had a focus of its own, by how far it moved."""
    kept = circles.only(~constants.is_outlier & ~circles.is_focused)
    kept = kept.only(np.bincount(kept.picture)[kept.picture] >= LEAST_CIRCLES)
    pictures, number = np.unique(kept.picture, return_inverse=True)
    if pictures.size < 2:
        return ()
    found = np.array([constants.k_cam_px.value, constants.gamma_px.value, constants.focus_distance_m.value])
    (of_picture, _, of_circle), offset = errors_of(kept, blur_of(found, kept), number)
    seen = _Seen(kept, number, offset, (of_picture, SLOPE_ERROR, max(of_circle, SLOPE_ERROR)))

    def fitted(start: Array) -> tuple[float, Array]:
        bounds = (start - REACH, start + REACH)
        best = least_squares(seen.rest, start, bounds=bounds, loss="soft_l1", f_scale=ROBUST_SCALE, max_nfev=100)
        return 2 * float(best.cost), best.x

    one_cost, one = fitted(np.log(found))
    own_cost, own = fitted(np.append(one, np.zeros(pictures.size)))
    spread = float(np.exp(np.ptp(own[3:])) - 1)
    if one_cost - own_cost < CLEARLY or spread < LEAST_SPREAD:
        return ()
    return (
        f"within photographs blur changes with depth otherwise than from one to the next, as if the focus had moved by "
        f"{spread:.0%} between them: k_cam_px and focus_distance_m may be off by far more than their intervals say; "
        "lock focus, zoom and aperture, switch autofocus off, and HDR and what removes noise or lifts contrast",
    )
