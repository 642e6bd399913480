"""``camind evaluate``: what a model folder scores on pictures that no training saw, through the service's own door.

Every picture goes through the estimator that answers requests, so a figure here is what a user gets. A pixel
without an answer is scored with the median of the picture's answers, and the share of answers is reported.
"""

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from functools import cache, lru_cache, partial
from multiprocessing import get_context
from pathlib import Path
from queue import Queue

import numpy as np
from numpy.typing import NDArray

from model_export.calibrated import calibrated
from model_export.cases import KNOWN_DEPTHS, UNSEEN_K_CAM_PX, Case, Trial
from model_export.devices import one_core
from model_export.metrics import Scores, best_constant, completed, mean_scores, pooled_scores, score
from service.cores import available_cores
from service.inference.artifact import ModelFolder, load_model_folder
from service.inference.cancellation import Cancellation
from service.inference.depth_map import DepthMap, Layers
from service.inference.estimator import Estimator
from service.inference.hypotheses import SIGMA_OF_LAPLACE
from service.inference.known import KnownDepth
from service.inference.pair import GraphPair, RawMaps, Sights
from service.optics import thin_lens
from service.optics.camera import Camera

# an unknown camera is taken for the middle one of those that are scored
UNKNOWN_K_CAM_PX = math.prod(UNSEEN_K_CAM_PX) ** (1 / len(UNSEEN_K_CAM_PX))
SENSOR_TIMES = 6  # as wide as the real lens' pictures


def _misled(factor: float, camera: Camera) -> Camera:
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


MODES: dict[str, Callable[[Camera], Camera]] = {
    "gt": lambda camera: camera,
    "estimated k_cam": calibrated,
    "no k_cam": lambda camera: replace(camera, k_cam_px=UNKNOWN_K_CAM_PX),
    "k_cam -10%": partial(_misled, 0.9),
    "k_cam +10%": partial(_misled, 1.1),
    "focus -10%": partial(_misfocused, 0.9),
    "focus +10%": partial(_misfocused, 1.1),
    "ring from the sensor": _counted_from_lens,
    "registered large": _registered_large,
}
# what no user has: they tell how much of an error is the camera's, and how much the side's
RIGHT_SIDE, ORACLE_K_CAM = "right side", "oracle k_cam"
BLUR_RANGES_PX = (
    *((0.0, 0.5), (0.5, 1.0), (1.0, 2.0), (2.0, 4.0), (4.0, 8.0), (8.0, 16.0), (16.0, math.inf)),
    *((0.6, 1.0), (1.0, 8.0), (0.0, math.inf)),
)
# where sets by other cameras, or focused elsewhere, can be compared: by lambda, and by |x|
EQUAL_BLUR_PX = ((1.0, 2.0), (2.0, 4.0), (4.0, 8.0), (8.0, 16.0))
EQUAL_DEFOCUS = ((0.1, 0.25), (0.25, 0.5), (0.5, 1.0), (1.0, 2.0))
EQUAL = ("equal_blur", "equal_defocus")
LEAST_COMPARED = 300
LEAST_RELIEF = 1e-3
KEPT_SHARES = (1.0, 0.75, 0.5, 0.25, 0.1)
CLEARLY_OUT = 0.25  # |x| from where on the side of focus is asked for
SAMPLED_PIXELS = 3000

Map = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Pixels:
    """Some pixels of a set, each map [n]: the error stated (a relative standard deviation) and the one made."""

    truth: Map
    answer: Map
    stated: Map

    @property
    def error(self) -> Map:
        """Relative error, signed."""
        return self.answer / self.truth - 1

    def certain(self, share: float = 0.5) -> NDArray[np.bool_]:
        """The share of the pixels with the least stated error."""
        return np.asarray(self.stated <= np.quantile(self.stated, share, method="lower"))

    @property
    def order(self) -> float:
        """The mean error of the most certain tenth over that of the least certain half; 1: certainty says nothing."""
        error, least_certain = np.abs(self.error), ~self.certain(0.5)
        return float(error[self.certain(0.1)].mean() / error[least_certain].mean()) if least_certain.any() else 1.0

    @property
    def answered(self) -> "Pixels":
        """Those with an answer: the others are filled in and state no error."""
        told = np.isfinite(self.stated)
        return Pixels(self.truth[told], self.answer[told], self.stated[told])

    @property
    def deviations(self) -> Map:
        """How many stated deviations the truth is off, of the pixels with an answer."""
        told = self.answered
        return np.asarray(np.abs(told.truth / told.answer - 1) / told.stated)

    def within(self, deviations: float) -> float:
        """The share of answered pixels whose truth lies within so many stated deviations; NaN for none."""
        off = self.deviations
        return float((off <= deviations).mean()) if off.size else math.nan

    def kept_error(self, share: float) -> float:
        """The mean error of the share of the pixels that is most certain."""
        return float(np.abs(self.error)[self.certain(share)].mean())

    @staticmethod
    def joined(parts: Sequence["Pixels"]) -> "Pixels":
        return Pixels(*(np.concatenate([getattr(p, name) for p in parts]) for name in ("truth", "answer", "stated")))


@dataclass(frozen=True, slots=True)
class Sides:
    """Of pixels visibly out of focus: the share on the right side, and with either hypothesis within two deviations."""

    right: float
    either: float
    pixels: int

    @staticmethod
    def joined(parts: Sequence["Sides"]) -> "Sides | None":
        """All of them together; None for none."""
        pixels = [part.pixels for part in parts]
        if not any(pixels):
            return None
        right, either = np.average([(part.right, part.either) for part in parts], axis=0, weights=pixels).tolist()
        return Sides(right, either, sum(pixels))


@dataclass(frozen=True, slots=True)
class Relief:
    """What answers make of the depth differences within a picture, in ln z about its mean over the picture.

    ``true`` is the differences' standard deviation, ``slope`` the part of them that is answered (1: all, 0: one depth
    for everything), ``correlation`` that of the differences answered with the true ones.
    """

    true: float
    slope: float
    correlation: float

    @staticmethod
    def of(pictures: Sequence[Pixels]) -> "Relief | None":
        """Over pixels of several pictures; None where nothing stands out from anything."""
        logs = [(np.log(p.truth), np.log(p.answer)) for p in pictures]
        truth, answer = (np.concatenate([a - a.mean() for a in several]) for several in zip(*logs, strict=True))
        deviation = float(truth.std())
        if deviation < LEAST_RELIEF:
            return None
        joint = float((truth * answer).mean())
        return Relief(deviation, joint / deviation**2, joint / (deviation * max(float(answer.std()), LEAST_RELIEF)))


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one picture scored, what the best constant depth would have, and the share of scored pixels answered.

    ``depth_blur_px`` and ``depth_defocus`` are lambda and |x| of the pixels of ``depth``. ``sides`` is None where the
    side was told.
    """

    scores: Scores
    constant: Scores
    scored_pixels: int
    answered: float
    median_error: float
    depth: Pixels
    depth_blur_px: Map
    depth_defocus: Map
    blur: Pixels | None
    sides: Sides | None


@dataclass(frozen=True, slots=True)
class Summary:
    """A set's scores in one mode, beside the best constant depth of each picture.

    ``certain_abs_rel`` is that of the half of the pixels with the least stated error; ``order`` is the mean error
    of the most certain tenth over that of the least certain half; ``kept_abs_rel`` has the errors of the most certain
    shares ``KEPT_SHARES``, and ``within`` the shares of truths within one and two stated deviations. ``equal_blur`` and
    ``equal_defocus`` are the AbsRel by range, None where few pixels are; ``relief`` is None for pictures of one depth.
    """

    name: str
    mode: str
    pictures: int
    answered: float
    pooled: Scores
    mean: Scores
    constant_pooled: Scores
    constant_mean: Scores
    median_error: float
    order: float
    kept_abs_rel: tuple[float, ...]
    within: tuple[float, float]
    equal_blur: dict[str, float | None]
    equal_defocus: dict[str, float | None]
    sides: Sides | None
    relief: Relief | None
    depth: Pixels

    @property
    def certain_abs_rel(self) -> float:
        return self.kept_abs_rel[KEPT_SHARES.index(0.5)]

    def as_dict(self) -> dict[str, object]:
        plain = ("name", "mode", "pictures", "answered", "median_error", "certain_abs_rel", "order", *EQUAL)
        tables = ("pooled", "mean", "constant_pooled", "constant_mean")
        shares = {"kept_abs_rel": dict(zip(KEPT_SHARES, self.kept_abs_rel, strict=True)), "within": self.within}
        parts = {"sides": self.sides, "relief": self.relief}
        told = {name: asdict(part) if part else None for name, part in parts.items()}
        scores = {n: getattr(self, n).as_dict() for n in tables}
        return {n: getattr(self, n) for n in plain} | scores | shares | told


@dataclass(frozen=True, slots=True)
class BlurRange:
    """How lambda is read where the truth lies in a range: medians of the relative error, and its sign's.

    ``order`` is the mean error of the most certain tenth over that of the least certain half.
    """

    name: str
    low_px: float
    high_px: float
    pixels: int
    median: float
    certain_median: float
    p90: float
    bias: float
    order: float


@dataclass(frozen=True, slots=True)
class Example:
    """One picture of a set for the eye."""

    image: NDArray[np.uint8]
    truth_m: Map
    depth_m: Map
    sigma_m: Map


@dataclass(frozen=True, slots=True)
class Report:
    """Everything one evaluation found."""

    model: str
    sets: list[Summary]
    blur: list[BlurRange]
    blur_pixels: dict[str, Pixels]
    examples: dict[str, Example]

    def summary(self, name: str, mode: str = "gt") -> Summary:
        """Raises ``KeyError`` for a set that was not scored."""
        for found in self.sets:
            if (found.name, found.mode) == (name, mode):
                return found
        raise KeyError((name, mode))

    def as_dict(self) -> dict[str, object]:
        ranges = [asdict(b) | {"high_px": b.high_px if math.isfinite(b.high_px) else None} for b in self.blur]
        return {"model": self.model, "sets": [s.as_dict() for s in self.sets], "blur": ranges}

    def scores(self) -> dict[str, float]:
        """What the manifest keeps, by ``set.score``, in the mode where the camera is known."""
        kept: dict[str, float] = {}
        for s in self.sets:
            if s.mode == "gt":
                kept[f"{s.name}.abs_rel"] = s.mean.abs_rel
                kept[f"{s.name}.constant_abs_rel"] = s.constant_mean.abs_rel
                kept[f"{s.name}.rmse_m"] = s.pooled.rmse
                kept[f"{s.name}.median_error"] = s.median_error
        return {name: round(value, 4) for name, value in kept.items()}


class _RememberingPair(GraphPair):
    """A pair that sees a picture once for all the cameras it is answered for in a row."""

    def __init__(self, folder: ModelFolder, intra_op_threads: int) -> None:
        super().__init__(folder, intra_op_threads)
        self._sights = Sights()

    def see(self, rgb: NDArray[np.uint8], cancellation: Cancellation) -> RawMaps:
        return self._sights.of(rgb, lambda: super(_RememberingPair, self).see(rgb, cancellation))


class Examiner:
    """A loaded model under examination."""

    def __init__(self, model: Path) -> None:
        folder = load_model_folder(model)
        self._pair = _RememberingPair(folder, intra_op_threads=1)
        self._estimator = Estimator(self._pair)

    def answer(self, case: Case, mode: str = "gt") -> tuple[Outcome, Example]:
        """Run a case through the estimator, with the camera as the mode tells it, and score the answer."""
        if mode == RIGHT_SIDE:
            return self._scored(case, self._rightly_sided(case))
        known = case.known_depths if mode.endswith(KNOWN_DEPTHS) else ()
        return self.told(case, MODES[mode.removesuffix(KNOWN_DEPTHS)](case.camera), known, blur=mode == "gt")

    def told(
        self, case: Case, camera: Camera, known: Sequence[KnownDepth] = (), *, blur: bool = False
    ) -> tuple[Outcome, Example]:
        """Score the answer to a case that is said to be by some camera, and its lambda where asked to."""
        answered = self._estimator.estimate(case.image, camera, case.side, known=known)
        return self._scored(case, answered, self._blur(case) if blur else None)

    def _rightly_sided(self, case: Case) -> DepthMap:
        """Each pixel answered on the side that its truth is on; where there is none, on the far one."""
        near, far = (self._estimator.estimate(case.image, case.camera, side) for side in ("near", "far"))
        is_near = case.truth_m < case.camera.focus_distance_m

        def layers() -> Layers:
            both = [(getattr(near, name), getattr(far, name)) for name in Layers.__slots__]
            return Layers(*(np.where(is_near, *sides) for sides in both))

        return replace(far, depth_m=np.where(is_near, near.depth_m, far.depth_m), layers=layers)

    def _scored(self, case: Case, told: DepthMap, blur: Pixels | None = None) -> tuple[Outcome, Example]:
        scored = np.flatnonzero(np.isfinite(case.truth_m))
        truth, depth = case.truth_m.ravel()[scored], completed(told.depth_m).ravel()[scored]
        some = slice(None, None, max(1, truth.size // SAMPLED_PIXELS))
        sigma_m, answer_m = (values.ravel()[scored[some]] for values in (told.sigma_m, told.depth_m))
        defocus = thin_lens.relative_defocus(truth[some], case.camera.focus_distance_m)
        outcome = Outcome(
            scores=score(depth, truth),
            constant=_constant_scores(case),
            scored_pixels=truth.size,
            answered=float(np.isfinite(told.depth_m.ravel()[scored]).mean()),
            median_error=float(abs(np.median(depth / truth) - 1)),
            depth=Pixels(truth[some], depth[some], np.nan_to_num(sigma_m / answer_m, nan=np.inf)),
            depth_blur_px=thin_lens.blur_from_defocus(defocus * case.camera.k_cam_px, case.camera.gamma_px),
            depth_defocus=defocus,
            blur=blur,
            sides=_sides(case, told) if case.side == "auto" else None,
        )
        return outcome, Example(case.image, case.truth_m, told.depth_m, told.sigma_m)

    def _blur(self, case: Case) -> Pixels | None:
        """Lambda where the case knows it, at the middles of the cells of what a request would read."""
        if case.blur_px is None:
            return None
        read = self._estimator.read(case.image, case.camera, case.side)
        answer = read.maps["blur_px"] * (case.camera.image_width_px / read.camera.image_width_px)
        rows, columns = (
            ((np.arange(cells) + 0.5) * size / cells).astype(int)
            for cells, size in zip(answer.shape, case.blur_px.shape, strict=True)
        )
        truth = case.blur_px[np.ix_(rows, columns)]
        known = np.isfinite(truth)
        stated = np.exp(read.maps["blur_log_error"]) * SIGMA_OF_LAPLACE
        return Pixels(truth[known], answer[known], stated[known])


@lru_cache(1)
def _constant_scores(case: Case) -> Scores:
    """What the best constant depth scores, found once for all answers to a picture in a row."""
    truth = case.truth_m[np.isfinite(case.truth_m)]
    return score(np.full_like(truth, best_constant(truth)), truth)


def _sides(case: Case, told: DepthMap) -> Sides:
    focus_m = case.camera.focus_distance_m
    with np.errstate(invalid="ignore"):
        out = np.abs(focus_m / case.truth_m - 1) > CLEARLY_OUT
        truth, depth, alt = case.truth_m[out], told.depth_m[out], told.depth_alt_m[out]
        reach = 2 * told.sigma_m[out] / depth
        either = (np.abs(truth / depth - 1) <= reach) | (np.abs(truth / alt - 1) <= reach)
    if not out.any():
        return Sides(0.0, 0.0, 0)
    # what has no answer is on no side
    right = ((depth < focus_m) == (truth < focus_m)) & np.isfinite(depth)
    return Sides(float(right.mean()), float(either.mean()), int(out.sum()))


def summarise(name: str, mode: str, outcomes: Sequence[Outcome]) -> Summary:
    """A set's figures; raises ``ValueError`` for an empty set."""
    if not outcomes:
        raise ValueError(f"{name}: no picture to score")
    depth = Pixels.joined([o.depth for o in outcomes])
    error = np.abs(depth.error)
    weights = [o.scored_pixels for o in outcomes]
    return Summary(
        name=name,
        mode=mode,
        pictures=len(outcomes),
        answered=float(np.mean([o.answered for o in outcomes])),
        pooled=pooled_scores([o.scores for o in outcomes], weights),
        mean=mean_scores([o.scores for o in outcomes]),
        constant_pooled=pooled_scores([o.constant for o in outcomes], weights),
        constant_mean=mean_scores([o.constant for o in outcomes]),
        median_error=float(np.median([o.median_error for o in outcomes])),
        order=depth.order,
        kept_abs_rel=tuple(depth.kept_error(share) for share in KEPT_SHARES),
        within=(depth.within(1), depth.within(2)),
        equal_blur=_by_range(error, np.concatenate([o.depth_blur_px for o in outcomes]), EQUAL_BLUR_PX),
        equal_defocus=_by_range(error, np.concatenate([o.depth_defocus for o in outcomes]), EQUAL_DEFOCUS),
        sides=Sides.joined([o.sides for o in outcomes if o.sides is not None]),
        relief=Relief.of([o.depth for o in outcomes]),
        depth=depth,
    )


def _by_range(error: Map, value: Map, ranges: Sequence[tuple[float, float]]) -> dict[str, float | None]:
    """The mean error where the value lies in each range, None where few pixels do."""
    found: dict[str, float | None] = {}
    for low, high in ranges:
        part = error[(value >= low) & (value < high)]
        found[f"{low:g}-{high:g}"] = float(part.mean()) if part.size >= LEAST_COMPARED else None
    return found


def blur_ranges(name: str, pixels: Pixels) -> list[BlurRange]:
    """Errors of lambda by range of the true lambda; ranges that no pixel shows are left out."""
    found = []
    for low, high in BLUR_RANGES_PX:
        inside = (pixels.truth >= low) & (pixels.truth < high)
        if not inside.any():
            continue
        part = Pixels(pixels.truth[inside], pixels.answer[inside], pixels.stated[inside])
        error = np.abs(part.error)
        found.append(
            BlurRange(
                name=name,
                low_px=low,
                high_px=high,
                pixels=error.size,
                median=float(np.median(error)),
                certain_median=float(np.median(error[part.certain()])),
                p90=float(np.quantile(error, 0.9)),
                bias=float(np.median(part.error)),
                order=part.order,
            )
        )
    return found


@dataclass(slots=True)
class _Examined:
    """One model's outcomes of a trial by mode, and its first picture."""

    name: str
    outcomes: dict[str, list[Outcome]] = field(default_factory=dict)
    searched: dict[float, list[Outcome]] = field(default_factory=dict)
    example: Example | None = None

    def take(self, examiner: Examiner, case: Case, trial: Trial) -> None:
        """Have the model answer one more picture, in all modes of the trial."""
        for mode in trial.modes:
            outcome, example = examiner.answer(case, mode)
            self.outcomes.setdefault(mode, []).append(outcome)
            self.example = self.example or example
        for factor in trial.factors:
            is_known = factor == 1 and "gt" in trial.modes
            told = self.outcomes["gt"][-1] if is_known else examiner.told(case, _misled(factor, case.camera))[0]
            self.searched.setdefault(factor, []).append(told)

    def by_mode(self) -> dict[str, list[Outcome]]:
        """All outcomes, of the factors on k_cam the best one's."""
        if not self.searched:
            return self.outcomes
        best = min(self.searched, key=lambda factor: mean_scores([o.scores for o in self.searched[factor]]).abs_rel)
        return self.outcomes | {f"{ORACLE_K_CAM}, x {best:g}": self.searched[best]}


_Scored = dict[str, list[_Examined]]  # of each set, by model
_examiner = cache(Examiner)  # each process that examines loads a model once


def _examined(models: Sequence[Path], said: "Queue[tuple[str, int] | None]", job: Sequence[Trial]) -> _Scored:
    examiners = [_examiner(model) for model in models]
    done: _Scored = {}
    for trial in job:
        found = done[trial.name] = [_Examined(trial.name) for _ in models]
        for case in trial.cases():
            for examiner, examined in zip(examiners, found, strict=True):
                examined.take(examiner, case, trial)
            said.put((f"{trial.name}: {case.name}", 0))
        said.put((trial.name, 1))
    return done


def _jobs(trials: Sequence[Trial]) -> list[list[Trial]]:
    """Sets that are scored one after the other, those of one camera known by its sheets together: sheets take long."""
    jobs: dict[object, list[Trial]] = {}
    # what was named last first, whose pictures are large; then what is answered most often, lest a core wait in the end
    for trial in reversed(trials):
        jobs.setdefault(trial.sheets_of or trial.name, []).append(trial)
    return sorted(jobs.values(), key=lambda job: -sum(trial.answers for trial in job))


def evaluate(
    models: Sequence[Path],
    trials: Sequence[Trial],
    on_progress: Callable[[str, int], None] = lambda _said, _finished: None,
) -> list[Report]:
    """Score model folders on the same sets of pictures, a process on each core; a report of each.

    ``on_progress`` hears, from another thread, of every picture, and how many sets that finishes. What sets are made by
    must be what processes can be told (no lambda).
    """
    context = get_context("forkserver")
    with (
        context.Manager() as manager,
        ThreadPoolExecutor(1) as listener,
        ProcessPoolExecutor(available_cores(), context, initializer=one_core) as pool,
    ):
        said = manager.Queue()

        def listen() -> None:
            for heard in iter(said.get, None):
                on_progress(*heard)

        listener.submit(listen)
        try:
            parts = pool.map(partial(_examined, models, said), _jobs(trials))
            done = {name: found for part in parts for name, found in part.items()}
        finally:
            said.put(None)
    by_model = zip(models, zip(*(done[trial.name] for trial in trials), strict=True), strict=True)
    return [_reported(load_model_folder(model).manifest.name, sets) for model, sets in by_model]


def _reported(model: str, done: Sequence[_Examined]) -> Report:
    outcomes = {(e.name, mode): scored for e in done for mode, scored in e.by_mode().items()}
    examples = {e.name: e.example for e in done if e.example is not None}
    for k_cam_px in UNSEEN_K_CAM_PX:
        for mode in dict.fromkeys(mode for _, mode in outcomes):
            both = [outcomes.get((f"{folder} k_cam {k_cam_px:g}", mode), []) for folder in ("rgbd", "tabletop")]
            if all(both):
                outcomes[f"indoor k_cam {k_cam_px:g}", mode] = [*both[0], *both[1]]
    blur: dict[str, list[Pixels]] = {}
    for (name, _), found in outcomes.items():
        blur.setdefault(name.split()[0], []).extend(o.blur for o in found if o.blur is not None)
    blur_pixels = {name: Pixels.joined(parts) for name, parts in blur.items() if parts}
    return Report(
        model=model,
        sets=[summarise(name, mode, found) for (name, mode), found in outcomes.items()],
        blur=[row for name, pixels in blur_pixels.items() for row in blur_ranges(name, pixels)],
        blur_pixels=blur_pixels,
        examples=examples,
    )
