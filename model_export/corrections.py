"""Two numbers for the manifest, found on scenes that were not trained on: blur right on the whole, errors honest."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from model_export.cases import PROCEDURAL_SIDES, Case, procedural_cases
from model_export.evaluate import Examiner
from model_export.summary import Pixels
from service.inference.artifact import Manifest, load_model_folder, write_manifest

SCENES = 600  # of each side: the temperature's standard error is 0.02
ALL_SCENES = SCENES * len(PROCEDURAL_SIDES)
FIRST = 2**20  # far from the scenes that evaluation draws
WELL_READ_PX = (1.0, 8.0)
HELD = ((1, 0.68), (2, 0.95))  # what intervals of so many deviations should hold
DECIMALS = 3


def blur_gain(pixels: Pixels) -> float:
    """What lambda must be multiplied with to be right in the median, where it is from 1 to 8 px."""
    low, high = WELL_READ_PX
    inside = (pixels.truth >= low) & (pixels.truth < high)
    return float(np.median(pixels.truth[inside] / pixels.answer[inside]))


def temperature(pixels: Pixels) -> float:
    """What stated errors must be multiplied with to hold 68 and 95 %: the geometric mean where these differ."""
    needed = [np.quantile(pixels.deviations, share) / reach for reach, share in HELD]
    return float(math.prod(needed) ** (1 / len(needed)))


def unseen_cases() -> Iterator[Case]:
    """Scenes on either side of focus and on both, to be drawn once for every model folder."""
    for side in PROCEDURAL_SIDES.values():
        yield from procedural_cases(SCENES, side, FIRST)


def record_corrections(model: Path, cases: Sequence[Case]) -> tuple[float, float]:
    """Find both for a model folder and write them into its manifest: ``blur_gain`` and ``temperature``.

    Blur is that of scenes on either side of focus and on both. Errors are those that the depth graph states by itself
    where the side is told: being on the wrong side of focus is what the other hypothesis is for. Raises ``ValueError``
    for a model that no gain or no temperature in bounds makes right.
    """
    examiner = Examiner(model)
    seen = [examiner.answer(case)[0].blur for case in cases]
    gain = _corrected(model, "blur_gain", blur_gain(Pixels.joined([blur for blur in seen if blur is not None])))
    examiner = Examiner(model)
    told = [examiner.stated_by_graph(case) for case in cases if case.side != "auto"]
    found = temperature(Pixels.joined(told))
    return gain, _corrected(model, "temperature", found)


def _corrected(model: Path, name: str, factor: float) -> float:
    """Multiply a number of a folder's manifest, which answers were made with, by what they lack; what it is now."""
    before = load_model_folder(model).manifest
    now = round(float(getattr(before, name)) * factor, DECIMALS)
    write_manifest(model, Manifest.model_validate(before.model_dump() | {name: now}))
    return now
