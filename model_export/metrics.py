"""Scores of depth maps: the paper's, pooled over pixels and averaged over images, with unanswered pixels counted."""

from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace

import numpy as np
from numpy.typing import NDArray

Map = NDArray[np.float32]
DELTA = 1.25


@dataclass(frozen=True, slots=True)
class Scores:
    """Errors of depth against truth; distances in metres, shares in 0..1."""

    abs_rel: float
    mse: float
    rmse: float
    log10: float
    delta1: float
    delta2: float
    delta3: float


def score(depth_m: Map, truth_m: Map) -> Scores:
    """Scores over all given pixels, any shape; everything is finite and positive."""
    depth, truth = depth_m.astype(np.float64), truth_m.astype(np.float64)
    error = depth - truth
    ratio = np.maximum(depth / truth, truth / depth)
    mse = float((error**2).mean())
    return Scores(
        abs_rel=float((np.abs(error) / truth).mean()),
        mse=mse,
        rmse=mse**0.5,
        log10=float(np.abs(np.log10(depth / truth)).mean()),
        delta1=float((ratio < DELTA).mean()),
        delta2=float((ratio < DELTA**2).mean()),
        delta3=float((ratio < DELTA**3).mean()),
    )


def mean_scores(scores: Sequence[Scores]) -> Scores:
    """The average over images."""
    return Scores(*np.mean([astuple(s) for s in scores], axis=0).tolist())


def pooled_scores(scores: Sequence[Scores], pixels: Sequence[int]) -> Scores:
    """The scores of all images' pixels together, from each image's scores and its number of pixels."""
    pooled = Scores(*np.average([astuple(s) for s in scores], axis=0, weights=pixels).tolist())
    return replace(pooled, rmse=pooled.mse**0.5)


def best_constant(truth_m: Map) -> float:
    """The one depth with the least AbsRel for these pixels: the median weighted by 1/z. What guessing can do."""
    ordered = np.sort(truth_m.astype(np.float64), axis=None)
    weight = np.cumsum(1 / ordered)
    return float(ordered[np.searchsorted(weight, weight[-1] / 2)])


def completed(depth_m: Map) -> Map:
    """The map with every unanswered pixel (NaN) given the median of the answered: no pixel escapes the score.

    A map without any answer is completed with 1 m.
    """
    answered = np.isfinite(depth_m)
    if answered.all():
        return depth_m
    filler = np.median(depth_m[answered]) if answered.any() else 1.0
    return np.where(answered, depth_m, np.float32(filler)).astype(np.float32)
