"""What an evaluation found: of pixels, of pictures, of sets of them, and of lambda by its range."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field

import numpy as np
from numpy.typing import NDArray

from model_export.metrics import Scores, mean_scores, pooled_scores
from model_export.modes import TRUE_CAMERA

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
    side was told; ``warnings`` are the answer's.
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
    warnings: tuple[str, ...] = ()


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
        within = [share if math.isfinite(share) else None for share in self.within]  # JSON has no NaN
        shares = {"kept_abs_rel": dict(zip(KEPT_SHARES, self.kept_abs_rel, strict=True)), "within": within}
        parts = {"sides": self.sides, "relief": self.relief}
        told = {name: asdict(part) if part else None for name, part in parts.items()}
        scores = {n: asdict(getattr(self, n)) for n in tables}
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
    """Everything one evaluation found; ``warnings``: of each set, the pictures by what their answers warn of."""

    model: str
    sets: list[Summary]
    blur: list[BlurRange]
    blur_pixels: dict[str, Pixels]
    examples: dict[str, Example]
    warnings: dict[str, dict[str, list[str]]] = field(default_factory=dict)

    def summary(self, name: str, mode: str = TRUE_CAMERA) -> Summary:
        """Raises ``KeyError`` for a set that was not scored."""
        for found in self.sets:
            if (found.name, found.mode) == (name, mode):
                return found
        raise KeyError((name, mode))

    def as_dict(self) -> dict[str, object]:
        ranges = [asdict(b) | {"high_px": b.high_px if math.isfinite(b.high_px) else None} for b in self.blur]
        sets = [s.as_dict() for s in self.sets]
        return {"model": self.model, "sets": sets, "blur": ranges, "warnings": self.warnings}

    def scores(self) -> dict[str, float]:
        """What the manifest keeps, by ``set.score``, in the mode where the camera is known."""
        kept: dict[str, float] = {}
        for s in self.sets:
            if s.mode == TRUE_CAMERA:
                kept[f"{s.name}.abs_rel"] = s.mean.abs_rel
                kept[f"{s.name}.constant_abs_rel"] = s.constant_mean.abs_rel
                kept[f"{s.name}.rmse_m"] = s.pooled.rmse
                kept[f"{s.name}.median_error"] = s.median_error
        return {name: round(value, 4) for name, value in kept.items()}


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
