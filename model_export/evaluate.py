"""``camind evaluate``: what a model folder scores on pictures that no training saw, through the service's own door.

Every picture goes through the estimator that answers requests, so a figure here is what a user gets. A pixel
without an answer is scored with the median of the picture's answers, and the share of answers is reported.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache, partial
from multiprocessing import get_context
from pathlib import Path
from queue import Queue

import numpy as np
from numpy.typing import NDArray

from model_export.cases import Case, Map
from model_export.devices import one_core
from model_export.evaluation_sets import EvaluationSet
from model_export.metrics import Scores, best_constant, completed, mean_scores, score
from model_export.modes import (
    KNOWN_DEPTHS,
    MODES,
    ORACLE_K_CAM,
    RIGHT_SIDE,
    TRUE_CAMERA,
    UNSEEN_K_CAM_PX,
    with_k_cam_times,
)
from model_export.summary import Example, Outcome, Pixels, Report, Sides, blur_ranges, summarise
from service.cores import available_cores
from service.inference.artifact import ModelFolder, load_model_folder
from service.inference.cancellation import Cancellation
from service.inference.depth_map import MAX_RELATIVE_ERROR, DepthMap, Layers, stated_error
from service.inference.estimator import Estimator
from service.inference.hypotheses import SIGMA_OF_LAPLACE, in_metres
from service.inference.known import KnownDepth
from service.inference.pair import GraphPair, RawMaps, Sights
from service.inference.resampling import Lines
from service.optics import thin_lens
from service.optics.camera import Camera

CLEARLY_OUT = 0.25  # |x| from where on the side of focus is asked for
SAMPLED_PIXELS = 3000  # of a picture
SAMPLED_CELLS = 2**15
LEAST_COLUMNS = 16
EXAMPLE_PX = 1500  # of a side, or less


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

    def answer(self, case: Case, mode: str = TRUE_CAMERA) -> tuple[Outcome, Example]:
        """Run a case through the estimator, with the camera as the mode tells it, and score the answer."""
        if mode == RIGHT_SIDE:
            return self._scored(case, self._rightly_sided(case))
        known = case.known_depths if mode.endswith(KNOWN_DEPTHS) else ()
        camera = MODES[mode.removesuffix(KNOWN_DEPTHS)](case.camera)
        return self.answer_by(camera, case, known, blur=mode == TRUE_CAMERA)

    def answer_by(
        self, camera: Camera, case: Case, known: Sequence[KnownDepth] = (), *, blur: bool = False
    ) -> tuple[Outcome, Example]:
        """Score the answer to a case that is said to be by some camera, and its lambda where asked to."""
        answered = self._estimator.estimate(case.image, camera, case.side, known=known)
        return self._scored(case, answered, self._blur(case) if blur else None)

    def _rightly_sided(self, case: Case) -> DepthMap:
        """Each pixel answered on the side that its truth is on; where there is none, on the far one."""
        near, far = (self._estimator.estimate(case.image, case.camera, side) for side in ("near", "far"))
        is_near = case.truth_m < case.camera.focus_distance_m

        def layers_at(lines: Lines) -> Layers:
            both = [(getattr(near, name), getattr(far, name)) for name in Layers.__slots__]
            return Layers(*(lines.of(np.where(is_near, *sides)) for sides in both))

        return replace(far, depth_m=np.where(is_near, near.depth_m, far.depth_m), layers_at=layers_at)

    def _scored(self, case: Case, told: DepthMap, blur: Pixels | None = None) -> tuple[Outcome, Example]:
        scored = np.flatnonzero(np.isfinite(case.truth_m))
        truth, depth = case.truth_m.ravel()[scored], completed(told.depth_m).ravel()[scored]
        some = _some(scored, case.truth_m.shape[1], SAMPLED_PIXELS)
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
            warnings=told.warnings,
        )
        every = max(1, max(case.truth_m.shape) // EXAMPLE_PX)
        shown = (slice(None, None, every),) * 2
        return outcome, Example(case.image[shown], case.truth_m[shown], told.depth_m[shown], told.sigma_m[shown])

    def _blur(self, case: Case) -> Pixels | None:
        """Lambda where the case knows it, at the middles of the cells of what a request would read."""
        if case.blur_px is None:
            return None
        read = self._estimator.read(case.image, case.camera, case.side)
        answer = read.maps["blur_px"] * (case.camera.image_width_px / read.camera.image_width_px)
        stated = np.exp(read.maps["blur_log_error"]) * SIGMA_OF_LAPLACE
        return _at_cells(case.blur_px, answer, stated)

    def stated_by_graph(self, case: Case) -> Pixels:
        """The depth graph's hypothesis on the side that is told, and what it states by itself: no answer yet."""
        read = self._estimator.read(case.image, case.camera, case.side)
        answer_m = np.exp(read.maps[f"log_ratio_{case.side}"]) * np.float32(read.camera.focus_distance_m)
        stated = stated_error(read.maps["log_scale"], read.camera, self._pair.manifest)
        no_answer = stated > MAX_RELATIVE_ERROR
        return _at_cells(case.truth_m, answer_m, np.where(no_answer, np.float32(np.inf), in_metres(stated)))


def _at_cells(truth: Map, answer: Map, stated: Map) -> Pixels:
    """The truth, where it is known, at the middles of the cells of a copy's maps."""
    rows, columns = (
        ((np.arange(cells) + 0.5) * size / cells).astype(int)
        for cells, size in zip(answer.shape, truth.shape, strict=True)
    )
    truth = truth[np.ix_(rows, columns)]
    known = np.flatnonzero(np.isfinite(truth))
    some = known[_some(known, truth.shape[1], SAMPLED_CELLS)]
    return Pixels(*(maps.ravel()[some] for maps in (truth, answer, stated)))


def _some(places: NDArray[np.intp], width: int, most: int) -> NDArray[np.intp]:
    """Which of some places in a map of that width to take, evenly: no more than twice ``most``.

    Where every so-manieth is in one of a few columns, as in a picture whose width that divides, it is one near by.
    """
    step = max(1, places.size // most)
    taken = np.arange(0, places.size, step)
    if step > 1 and np.unique(places[taken] % width).size < LEAST_COLUMNS:
        taken = np.minimum(taken + np.random.default_rng(0).integers(0, step, taken.size), places.size - 1)
    return taken


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


@dataclass(slots=True)
class _Examined:
    """One model's outcomes of a set by mode, its first picture, and by warning the pictures that have it."""

    name: str
    outcomes: dict[str, list[Outcome]] = field(default_factory=dict)
    searched: dict[float, list[Outcome]] = field(default_factory=dict)
    example: Example | None = None
    warnings: dict[str, list[str]] = field(default_factory=dict)

    def take(self, examiner: Examiner, case: Case, scored_set: EvaluationSet) -> None:
        """Have the model answer one more picture, in all modes of the set."""
        for mode in scored_set.modes:
            outcome, example = examiner.answer(case, mode)
            self.outcomes.setdefault(mode, []).append(outcome)
            self.example = self.example or example
            for warning in outcome.warnings if mode == TRUE_CAMERA else ():
                self.warnings.setdefault(warning, []).append(case.name)
        for factor in scored_set.factors:
            is_known = factor == 1 and TRUE_CAMERA in scored_set.modes
            camera = with_k_cam_times(factor, case.camera)
            outcome = self.outcomes[TRUE_CAMERA][-1] if is_known else examiner.answer_by(camera, case)[0]
            self.searched.setdefault(factor, []).append(outcome)

    def by_mode(self) -> dict[str, list[Outcome]]:
        """All outcomes, of the factors on k_cam the best one's."""
        if not self.searched:
            return self.outcomes
        best = min(self.searched, key=lambda factor: mean_scores([o.scores for o in self.searched[factor]]).abs_rel)
        return self.outcomes | {f"{ORACLE_K_CAM}, x {best:g}": self.searched[best]}


_Scored = dict[str, list[_Examined]]  # of each set, by model
_examiner = cache(Examiner)  # each process that examines loads a model once


def _examined(models: Sequence[Path], said: "Queue[tuple[str, int] | None]", job: Sequence[EvaluationSet]) -> _Scored:
    examiners = [_examiner(model) for model in models]
    done: _Scored = {}
    for scored_set in job:
        found = done[scored_set.name] = [_Examined(scored_set.name) for _ in models]
        for case in scored_set.cases():
            for examiner, examined in zip(examiners, found, strict=True):
                examined.take(examiner, case, scored_set)
            said.put((f"{scored_set.name}: {case.name}", 0))
        said.put((scored_set.name, 1))
    return done


def _jobs(sets: Sequence[EvaluationSet]) -> list[list[EvaluationSet]]:
    """Sets that are scored one after the other, those of one camera known by its sheets together: sheets take long."""
    jobs: dict[object, list[EvaluationSet]] = {}
    # what was named last first, whose pictures are large; then what is answered most often, lest a core wait in the end
    for scored_set in reversed(sets):
        jobs.setdefault(scored_set.sheets_of or scored_set.name, []).append(scored_set)
    return sorted(jobs.values(), key=lambda job: -sum(scored_set.answers for scored_set in job))


def evaluate(
    models: Sequence[Path],
    sets: Sequence[EvaluationSet],
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
            parts = pool.map(partial(_examined, models, said), _jobs(sets))
            done = {name: found for part in parts for name, found in part.items()}
        finally:
            said.put(None)
    by_model = zip(models, zip(*(done[scored_set.name] for scored_set in sets), strict=True), strict=True)
    return [_reported(load_model_folder(model).manifest.name, scored) for model, scored in by_model]


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
        warnings={e.name: e.warnings for e in done},
    )
