"""``camind evaluate``: what a model folder scores on pictures that no training saw, through the service's own door.

Every picture goes through the estimator that answers requests, so a figure here is what a user gets. A pixel
without an answer is scored with the median of the picture's answers, and the share of answers is reported.
"""

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from model_export.config import SceneConfig
from model_export.datasets.photos import Photo, filled, load_photos
from model_export.metrics import Scores, best_constant, completed, mean_scores, score
from model_export.render import encode_srgb, refocus
from model_export.scenes import draw_sample, true_blur_px
from model_export.train import HELD_OUT_SEED
from service.inference.artifact import load_model_folder
from service.inference.estimator import Estimator
from service.inference.pair import Side
from service.optics.camera import Camera, Intrinsics, Lens

REFERENCE = Camera(640, 480, 2.0, 3.81, 0.5, intrinsics=Intrinsics(525.0, 525.0, 319.5, 239.5))
PLANES_M = (0.7, 1.0, 1.5)
NEAR_LIMIT_M = 2.0
D200 = Lens(35.0, 2.8, 6.05, 3872)
D200_LIMIT_M = 5.0
D200_STEP = 0.05
D200_STEP_MARGIN_PX = 25
CELL_PX = 32
CELL_CONTRAST = 0.03
TEXTURED_SHARE = 0.6
BLUR_BINS_PX = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, math.inf)
PROCEDURAL_SCENES = 120
SIDES: dict[int, Side] = {-1: "near", 0: "auto", 1: "far"}

Map = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Case:
    """One picture to answer: truth is NaN where it is not scored."""

    name: str
    image: NDArray[np.uint8]
    truth_m: Map
    camera: Camera
    side: Side


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one picture scored, what the best constant depth would have, and the share of scored pixels answered."""

    name: str
    scores: Scores
    constant: Scores
    answered: float
    median_error: float
    depth_m: Map
    truth_m: Map


@dataclass(frozen=True, slots=True)
class Summary:
    """A set's scores, pooled over pixels and averaged over pictures, beside the best constant of each picture."""

    name: str
    pictures: int
    answered: float
    pooled: Scores
    mean: Scores
    constant: Scores
    median_error: float

    def as_dict(self) -> dict[str, object]:
        parts = {"pooled": self.pooled, "mean": self.mean, "constant": self.constant}
        numbers = {"pictures": self.pictures, "answered": self.answered, "median_error": self.median_error}
        return {**numbers, **{name: scores.as_dict() for name, scores in parts.items()}}


def _to_pixels(picture: Map) -> NDArray[np.uint8]:
    return (picture * 255 + 0.5).astype(np.uint8)


def _sharp_texture(photo: Photo) -> Map:
    """A frame halved, so that its own softness is gone, and mirrored back to its size; sRGB 0..1."""
    height, width = photo.image.shape[:2]
    half = cv2.resize(photo.image, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    tiled = cv2.copyMakeBorder(half, 0, height - height // 2, 0, width - width // 2, cv2.BORDER_REFLECT)
    return np.asarray(tiled, np.float32) / np.float32(255)


def is_textured(texture: Map) -> bool:
    """Whether most cells of 32 px have a contrast (standard deviation of brightness) above 3 %."""
    height, width = (size // CELL_PX * CELL_PX for size in texture.shape[:2])
    grey = texture[:height, :width].mean(2)
    cells = grey.reshape(height // CELL_PX, CELL_PX, width // CELL_PX, CELL_PX).std((1, 3))
    return float((cells > CELL_CONTRAST).mean()) >= TEXTURED_SHARE


def plane_cases(data: Path, depth_m: float, count: int) -> Iterator[Case]:
    """Textured planes at one distance, refocused with the reference camera; a bare wall is no textured plane."""
    for folder in ("rgbd", "tabletop"):
        sharp = [(photo, _sharp_texture(photo)) for photo in load_photos(data / folder)]
        textured = [(photo, texture) for photo, texture in sharp if is_textured(texture)]
        for photo, texture in textured[:: max(1, len(textured) // max(1, count // 2))][: count // 2]:
            plane = np.full(texture.shape[:2], depth_m, np.float32)
            picture = _to_pixels(refocus(texture, plane, REFERENCE))
            yield Case(f"{photo.name} at {depth_m} m", picture, plane, REFERENCE, "near")


def refocused_cases(folder: Path, count: int) -> Iterator[Case]:
    """Sharp frames with depth, refocused with the reference camera; scored to 2 m."""
    for photo in _spread(folder, count):
        depth_m = filled(photo.depth_m)
        encoded = photo.image.astype(np.float32) / np.float32(255)
        picture = _to_pixels(refocus(encoded, depth_m, REFERENCE))
        with np.errstate(invalid="ignore"):
            truth = np.where(photo.depth_m <= NEAR_LIMIT_M, photo.depth_m, np.float32(np.nan))
        if np.isfinite(truth).mean() > 0.05:
            yield Case(photo.name, picture, truth.astype(np.float32), REFERENCE, "near")


def d200_cases(folder: Path, count: int) -> Iterator[Case]:
    """Real photographs of a real lens, known by its specs alone; scored away from depth steps and to 5 m."""
    for photo in _spread(folder, count):
        height, width = photo.image.shape[:2]
        fx = D200.fx_px(width)
        inner = Intrinsics(fx, fx, (width - 1) / 2, (height - 1) / 2)
        camera = Camera(width, height, 2.0, D200.k_cam_px(2.0, width), 0.5, D200.focal_length_m, inner)
        truth = photo.depth_m.copy()
        truth[_near_steps(filled(truth)) | (filled(truth) > D200_LIMIT_M)] = np.nan
        if np.isfinite(truth).mean() > 0.02:
            yield Case(photo.name, photo.image, truth, camera, "auto")


def _near_steps(depth_m: Map) -> NDArray[np.bool_]:
    """Pixels within the margin of a step of more than 5 % between neighbours."""
    kernel = np.ones((3, 3), np.uint8)
    ratio = cv2.dilate(depth_m, kernel) / cv2.erode(depth_m, kernel)
    step = (np.asarray(ratio) > 1 + D200_STEP).astype(np.uint8)
    size = 2 * D200_STEP_MARGIN_PX + 1
    return np.asarray(cv2.dilate(step, np.ones((size, size), np.uint8))) > 0


def _spread(folder: Path, count: int) -> Iterator[Photo]:
    """About ``count`` of a folder's photos, spread over it."""
    total = len(list((folder / "color").glob("*")))
    return load_photos(folder, max(1, math.ceil(total / count)))


def answer(estimator: Estimator, case: Case) -> Outcome:
    """Run a case through the estimator and score it."""
    depth_m = estimator.estimate(case.image, case.camera, case.side).depth_m
    scored = np.isfinite(case.truth_m)
    truth = case.truth_m[scored]
    depth = completed(depth_m)[scored]
    return Outcome(
        name=case.name,
        scores=score(depth, truth),
        constant=score(np.full_like(truth, best_constant(truth)), truth),
        answered=float(np.isfinite(depth_m[scored]).mean()),
        median_error=float(abs(np.median(depth / truth) - 1)),
        depth_m=depth_m,
        truth_m=case.truth_m,
    )


def summarise(name: str, outcomes: list[Outcome]) -> Summary:
    """A set's figures; raises ``ValueError`` for an empty set."""
    if not outcomes:
        raise ValueError(f"{name}: no picture to score")
    kept = [np.isfinite(o.truth_m) for o in outcomes]
    depth = np.concatenate([completed(o.depth_m)[k] for o, k in zip(outcomes, kept, strict=True)])
    truth = np.concatenate([o.truth_m[k] for o, k in zip(outcomes, kept, strict=True)])
    return Summary(
        name=name,
        pictures=len(outcomes),
        answered=float(np.mean([o.answered for o in outcomes])),
        pooled=score(depth, truth),
        mean=mean_scores([o.scores for o in outcomes]),
        constant=mean_scores([o.constant for o in outcomes]),
        median_error=float(np.median([o.median_error for o in outcomes])),
    )


@dataclass(frozen=True, slots=True)
class BlurBin:
    """How blur is read where lambda lies in a range: median relative error, and its 90th percentile."""

    low_px: float
    high_px: float
    pixels: int
    median: float
    p90: float


def procedural_blur(estimator: Estimator, count: int) -> list[BlurBin]:
    """Error of lambda by range of lambda on procedural scenes of seeds and textures that no training drew."""
    errors: list[Map] = []
    truths: list[Map] = []
    for number in range(count):
        sample = draw_sample(HELD_OUT_SEED + number, SceneConfig(), [])
        shot = sample.shot
        height, width = sample.excess.shape
        camera = Camera(width, height, shot.focus_distance_m, shot.k_cam_px, shot.gamma_px)
        image = np.ascontiguousarray(sample.image.transpose(1, 2, 0))
        blur_px = estimator.estimate(image, camera, SIDES[shot.side]).blur_px
        truth = true_blur_px(sample)
        errors.append((np.abs(blur_px - truth) / truth).ravel())
        truths.append(truth.ravel())
    return _bins(np.concatenate(errors), np.concatenate(truths))


def _bins(error: Map, truth: Map) -> list[BlurBin]:
    bins = []
    for low, high in itertools.pairwise(BLUR_BINS_PX):
        part = error[(truth >= low) & (truth < high)]
        if part.size:
            bins.append(BlurBin(low, high, part.size, float(np.median(part)), float(np.quantile(part, 0.9))))
    return bins


@dataclass(frozen=True, slots=True)
class Report:
    """Everything one evaluation found."""

    model: str
    sets: list[Summary]
    blur: list[BlurBin]
    samples: dict[str, Outcome]

    def as_dict(self) -> dict[str, object]:
        bins = [
            {
                "low_px": b.low_px,
                "high_px": b.high_px if math.isfinite(b.high_px) else None,
                "pixels": b.pixels,
                "median": b.median,
                "p90": b.p90,
            }
            for b in self.blur
        ]
        return {"model": self.model, "sets": {s.name: s.as_dict() for s in self.sets}, "blur": bins}

    def tables(self) -> dict[str, tuple[list[str], list[list[str]]]]:
        """Title to head and rows, as text."""
        depth_head = ["set", "pictures", "answered", "AbsRel", "best constant", "RMSE m", "delta1", "median error"]
        depth_rows = [
            [
                s.name,
                str(s.pictures),
                f"{s.answered:.0%}",
                f"{s.mean.abs_rel:.3f}",
                f"{s.constant.abs_rel:.3f}",
                f"{s.mean.rmse:.3f}",
                f"{s.mean.delta1:.3f}",
                f"{s.median_error:.1%}",
            ]
            for s in self.sets
        ]
        blur_head = ["lambda px", "pixels", "median error", "90th percentile"]
        blur_rows = [
            [f"{b.low_px:g}-{b.high_px:g}", f"{b.pixels:,}", f"{b.median:.1%}", f"{b.p90:.1%}"] for b in self.blur
        ]
        return {
            "Depth, mean over pictures": (depth_head, depth_rows),
            "Blur on procedural scenes": (blur_head, blur_rows),
        }

    def markdown(self) -> dict[str, str]:
        """The same tables in Markdown, by title."""
        return {title: _markdown([head, ["---"] * len(head), *rows]) for title, (head, rows) in self.tables().items()}

    def write_samples(self, folder: Path) -> None:
        """One picture a set: the truth beside the answer."""
        for name, outcome in self.samples.items():
            pair = np.hstack([preview(outcome.truth_m), preview(outcome.depth_m)])
            cv2.imwrite(str(folder / f"{name}.png"), pair)

    def scores(self) -> dict[str, float]:
        """What the manifest keeps: AbsRel of every set, of its best constants, and the planes' median error."""
        kept = {f"{s.name}.abs_rel": s.mean.abs_rel for s in self.sets}
        kept |= {f"{s.name}.constant_abs_rel": s.constant.abs_rel for s in self.sets}
        kept |= {f"{s.name}.median_error": s.median_error for s in self.sets if s.name.startswith("plane")}
        return {name: round(value, 4) for name, value in kept.items()}


def _markdown(rows: list[list[str]]) -> str:
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def case_sets(data: Path, quick: bool) -> dict[str, Callable[[], Iterator[Case]]]:
    """The sets that the data folder can serve, by name; a missing folder is a missing set, and said."""
    few, many = (2, 4) if quick else (8, 40)
    sets: dict[str, Callable[[], Iterator[Case]]] = {}
    if (data / "rgbd").is_dir() and (data / "tabletop").is_dir():
        for distance in PLANES_M:
            sets[f"plane_{distance:g}m"] = partial(plane_cases, data, distance, few)
    for name in ("rgbd", "tabletop"):
        if (data / name).is_dir():
            sets[name] = partial(refocused_cases, data / name, many)
    if (data / "d200").is_dir():
        sets["d200"] = partial(d200_cases, data / "d200", 2 * many)
    return sets


def evaluate(
    model: Path, data: Path, *, quick: bool = False, on_progress: Callable[[str], None] = lambda _: None
) -> Report:
    """Score a model folder on everything below ``data`` and on procedural scenes."""
    folder = load_model_folder(model)
    estimator = Estimator.from_folder(folder, intra_op_threads=2)
    summaries, samples = [], {}
    for name, cases in case_sets(data, quick).items():
        outcomes = []
        for case in cases():
            outcomes.append(answer(estimator, case))
            on_progress(f"{name}: {case.name}")
        summaries.append(summarise(name, outcomes))
        samples[name] = outcomes[0]
    on_progress("procedural scenes")
    blur = procedural_blur(estimator, PROCEDURAL_SCENES // (6 if quick else 1))
    return Report(folder.manifest.name, summaries, blur, samples)


def preview(depth_m: Map) -> NDArray[np.uint8]:
    """A depth map for the eye: near bright, 0.3 to 5 m by inverse depth, NaN black."""
    bright = np.clip((1 / np.nan_to_num(depth_m, nan=np.inf) - 0.2) / (1 / 0.3 - 0.2), 0, 1)
    return _to_pixels(encode_srgb(bright.astype(np.float32)))
