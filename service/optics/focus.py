"""Where a lens is focused, and how sharp its pictures are there, from the blur of things whose depth is known."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby, pairwise
from typing import NamedTuple

from service.optics import thin_lens
from service.optics.camera import AS_INFINITY_M, Camera

# standard deviations of a logarithm: of the focus distance that was told, as by a ring, of the gamma that was told, as
# no specs do, the least of a blur read, and the most of where focus lies between what was said to be nearer and beyond
TOLD_ERROR = 0.1
INFINITY_ERROR_PER_M = 0.3  # of an inverse distance: what a lens of fixed focus, or a driver, says for want of another
TOLD_GAMMA_ERROR = 0.3
READING_ERROR = 0.1
SIDE_ERROR = 0.05
# Cauchy's loss: what is off by more deviations than this counts ever less, so that one thing mistaken does not decide,
# be it what was told
TAIL = 2.5
FARTHEST_OFF = 2.5
NEAREST_FOR_INFINITY_M = 1.5
# candidates over what was told, that itself first: what is farther off than they are need not be looked at
FOCUS_STEP = math.log(FARTHEST_OFF) / 100
FOCUS_RATIOS = tuple(math.exp(FOCUS_STEP * step) for step in sorted(range(-100, 101), key=abs))
# what is likely is looked at in ever finer steps, until it is so many wide
LEAST_STEPS, FINER_STEPS, MOST_PASSES = 10, 24, 4
FOR_INFINITY_M = tuple(NEAREST_FOR_INFINITY_M * 100 / step for step in range(1, 100))
GAMMA_RATIOS = tuple(FARTHEST_OFF ** (step / 6) for step in sorted(range(-6, 7), key=abs))
LEAST_BLUR_PX = 0.1
# times as likely that nothing of a photograph is in focus as that its sharpest parts are, where these show the gamma
# that was told: one in two has something in focus, and of the other the sharpest is anything up to 20 gammas
NOTHING_IN_FOCUS = TOLD_GAMMA_ERROR * math.sqrt(2 * math.pi) / math.log(20)
CONFIDENCE_95 = 1.92  # half of the 95 % quantile of chi squared with one degree of freedom


@dataclass(frozen=True, slots=True)
class Sighting:
    """A thing at ``depth_m`` whose blur was read as ``blur_px``, with that relative standard deviation."""

    depth_m: float
    blur_px: float
    error: float

    def deviation(self, shown_px: float) -> float:
        """By how many standard deviations of its reading its blur is off what a camera shows, in ln lambda, signed."""
        ratio = max(self.blur_px, LEAST_BLUR_PX) / max(shown_px, LEAST_BLUR_PX)
        return math.log(ratio) / max(self.error, READING_ERROR)


@dataclass(frozen=True, slots=True)
class FocusFit:
    """The focus distance in metres with its 95 % interval, and gamma over what was told of it.

    ``deviations`` say by how many of its own each sighting is off both.
    """

    focus_distance_m: float
    low_m: float
    high_m: float
    gamma_ratio: float
    deviations: tuple[float, ...]


def fit_focus(camera: Camera, sightings: Sequence[Sighting], is_near: bool | None = None) -> FocusFit:
    """The focus distance whose blur (eq. 3 and 5) is near to what was read, and that is near to the camera's own.

    It is the mean of what is likely, gamma the likeliest for it. Blur is in pixels of the camera's pictures. A known
    depth tells its side of focus, so that, other than depth from blur, this has one answer; from a single sighting
    close to focus the interval holds both, unless it is told whether all of the picture ``is_near``, nearer than what
    is in focus, or beyond it. Neither end is farther from the camera's own than 2.5 times; what is said to be at
    infinity is from 1.5 m on. Raises ``ValueError`` without a sighting.
    """
    if not sightings:
        raise ValueError("a focus distance is fitted to one known depth or more")
    search = _Search(camera, sightings, is_near)
    told_m = camera.focus_distance_m
    search.look((told_m, *FOR_INFINITY_M) if told_m >= AS_INFINITY_M else (told_m * ratio for ratio in FOCUS_RATIOS))
    search.look(_suited(camera, sightings))
    search.look_closer()
    found = search.candidate(search.middle_m)
    low_m, high_m = search.likely_m
    fitted = replace(camera.focused_at(found.focus_distance_m), gamma_px=camera.gamma_px * found.gamma_ratio)
    deviations = tuple(abs(seen.deviation(fitted.blur_px(seen.depth_m))) for seen in sightings)
    return FocusFit(found.focus_distance_m, low_m, high_m, found.gamma_ratio, deviations)


class _Candidate(NamedTuple):
    focus_distance_m: float
    gamma_ratio: float
    loss: float


@dataclass(slots=True)
class _Search:
    """The focus distances looked at, each with its likeliest gamma; without end is the loss of what is not likely."""

    camera: Camera
    sightings: Sequence[Sighting]
    is_near: bool | None
    looked: list[_Candidate] = field(default_factory=list)
    most: float = math.inf

    @property
    def likely_m(self) -> tuple[float, float]:
        """The nearest and the farthest focus distance in the 95 % interval."""
        likely_m = [each.focus_distance_m for each in self.looked if each.loss <= self.most]
        return min(likely_m), max(likely_m)

    @property
    def likeliest(self) -> list[_Candidate]:
        """What is in the 95 % interval around the likeliest, without a gap, by distance."""
        by_likely = groupby(sorted(self.looked), lambda each: each.loss <= self.most)
        return min((list(run) for _, run in by_likely), key=lambda run: min(each.loss for each in run))

    @property
    def middle_m(self) -> float:
        """The mean of those, in dioptres, as blur goes: amid both sides of what is seen to be in focus.

        The likeliest where infinity was told: most that say so are there, and their mean could not be.
        """
        run = self.likeliest
        if self.camera.focus_distance_m >= AS_INFINITY_M:
            return min(run, key=lambda each: each.loss).focus_distance_m
        seen = [(1 / each.focus_distance_m, math.exp(run[0].loss - each.loss)) for each in run]
        area = moment = 0.0
        for (low, low_density), (high, high_density) in pairwise(seen):
            area += (high - low) * (low_density + high_density)
            moment += (high - low) * (low_density * low + high_density * high)
        return area / moment if area else run[0].focus_distance_m

    def look(self, distances_m: Iterable[float]) -> None:
        """Look at those focus distances that the lens can have and that are not too far from what was told."""
        told_m = self.camera.focus_distance_m
        low_m, high_m = told_m * FOCUS_RATIOS[-2], told_m * FOCUS_RATIOS[-1]
        if told_m >= AS_INFINITY_M:
            low_m, high_m = NEAREST_FOR_INFINITY_M, told_m
        low_m = max(low_m, self.camera.focal_length_m or 0.0)
        for focus_m in distances_m:
            if low_m < focus_m <= high_m:
                self.looked.append(self.candidate(focus_m, self.most))
                self.most = min(self.most, self.looked[-1].loss + CONFIDENCE_95)

    def look_closer(self) -> None:
        """Look at what is likely in finer steps: where k_cam is large, all of it may lie between two of the first."""
        step = FOCUS_STEP
        for _ in range(MOST_PASSES):
            run = self.likeliest
            low_m, high_m = run[0].focus_distance_m, run[-1].focus_distance_m
            width = math.log(high_m / low_m)
            if width >= LEAST_STEPS * step:
                return
            start, step = math.log(low_m) - step, (width + 2 * step) / FINER_STEPS
            self.look(math.exp(start + number * step) for number in range(1, FINER_STEPS))

    def candidate(self, focus_m: float, most: float = math.inf) -> _Candidate:
        """The camera focused there with the likeliest gamma, if no more than ``most`` is lost."""
        k_cam_px = self.camera.focused_at(focus_m).k_cam_px
        seen = [
            (each.deviation, thin_lens.defocus_at_depth(each.depth_m, focus_m, k_cam_px)) for each in self.sightings
        ]
        lost = self._lost_by_place(focus_m, k_cam_px)
        best = _Candidate(focus_m, 1.0, math.inf)
        for ratio in GAMMA_RATIOS:
            gamma_px, loss = self.camera.gamma_px * ratio, lost + (math.log(ratio) / TOLD_GAMMA_ERROR) ** 2 / 2
            for deviation, sigma_px in seen:
                if loss >= best.loss or loss > most:
                    break
                loss += _loss(deviation(thin_lens.blur_from_defocus(sigma_px, gamma_px)))
            if loss < best.loss and loss <= most:
                best = _Candidate(focus_m, ratio, loss)
        return best

    def _lost_by_place(self, focus_m: float, k_cam_px: float) -> float:
        """What speaks against that focus distance but for blur: what was told, and sides."""
        # what is clearly blurred is seen to be out of focus, however little that is of a large k_cam
        side_error = min(SIDE_ERROR, max(self.camera.gamma_px, LEAST_BLUR_PX) / k_cam_px)
        off_side = (_off_side(each.depth_m, focus_m, self.is_near) / side_error for each in self.sightings)
        told_m = self.camera.focus_distance_m
        off_told = (
            (1 / focus_m - 1 / told_m) / INFINITY_ERROR_PER_M
            if told_m >= AS_INFINITY_M
            else math.log(focus_m / told_m) / TOLD_ERROR
        )
        return _loss(off_told) + sum(map(_loss, off_side))


def likely_gamma(told_px: float, sharpest_px: float) -> float:
    """gamma of a photograph, told for its camera, whose sharpest parts show a blur of ``sharpest_px``; never less.

    Either these are in focus, and what they show is gamma, which is as likely as it is near what was told; or nothing
    is, and gamma is as told: the mean of its logarithm. A photograph is often softer than its camera is where one
    measures that, and what is in it softer than ink on paper.
    """
    softer = math.log(max(sharpest_px, told_px) / told_px) if told_px else 0.0
    in_focus = math.exp(-((softer / TOLD_GAMMA_ERROR) ** 2) / 2)
    return told_px * math.exp(softer * in_focus / (in_focus + NOTHING_IN_FOCUS))


def _suited(camera: Camera, sightings: Sequence[Sighting]) -> Iterator[float]:
    """The focus distances on either side of each thing whose blur there is what was read."""
    focal_m = camera.focal_length_m or 0.0
    k_near = camera.k_cam_px * (camera.focus_distance_m - focal_m)
    for seen in sightings:
        defocus_px = thin_lens.defocus_from_blur(seen.blur_px, camera.gamma_px)
        for sigma_px in (defocus_px, -defocus_px):
            if sigma_px * seen.depth_m < k_near:
                yield seen.depth_m * (k_near - sigma_px * focal_m) / (k_near - sigma_px * seen.depth_m)


def _off_side(depth_m: float, focus_m: float, is_near: bool | None) -> float:
    """How far, as a logarithm, a thing is on the side of focus where nothing was said to be."""
    beyond = math.log(depth_m / focus_m)
    return 0.0 if is_near is None else max(0.0, beyond if is_near else -beyond)


def _loss(deviations: float) -> float:
    return TAIL**2 / 2 * math.log1p((deviations / TAIL) ** 2)
