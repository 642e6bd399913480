"""What an evaluation found, as tables for the terminal, the model card and the page of a report."""

import math
from dataclasses import asdict

import numpy as np

from model_export.evaluation_sets import is_own
from model_export.modes import TRUE_CAMERA
from model_export.summary import EQUAL_BLUR_PX, EQUAL_DEFOCUS, KEPT_SHARES, BlurRange, Report, Summary

Table = tuple[list[str], list[list[str]]]

DEPTH_HEAD = [
    *("set", "camera", "pictures", "answered", "AbsRel", "constant", "certain half", "order"),
    *("pooled RMSE", "constant", "median depth off by"),
]
CERTAINTY_HEAD = [
    *("set", "camera", "within sigma", "within 2 sigma", *(f"surest {share:.0%}" for share in KEPT_SHARES)),
    *("right side", "either"),
]
EQUAL_HEAD = [
    *("set", "camera"),
    *(f"lambda {low:g}-{high:g} px" for low, high in EQUAL_BLUR_PX),
    *(f"x {low:g}-{high:g}" for low, high in EQUAL_DEFOCUS),
]
RELIEF_HEAD = ["set", "camera", "true spread of ln z", "of it answered", "correlation"]
SCORES_HEAD = ["set", "camera", "over", "AbsRel", "MSE", "RMSE", "log10", "delta1", "delta2", "delta3"]
BESIDE_HEAD = ["set", "AbsRel", "of the other", "times", "pooled RMSE", "of the other", "times"]
BLUR_HEAD = ["scenes", "lambda px", "pixels", "median error", "certain half", "90th percentile", "bias", "order"]
WARNINGS_HEAD = ["set", "pictures", "such as", "warning"]


def _camera(s: Summary) -> list[str]:
    return [s.name, "known" if s.mode == TRUE_CAMERA else s.mode]


def _depth_row(s: Summary) -> list[str]:
    return [
        *(*_camera(s), str(s.pictures), f"{s.answered:.0%}"),
        *(f"{v:.3f}" for v in (s.mean.abs_rel, s.constant_mean.abs_rel, s.certain_abs_rel)),
        *(f"{s.order:.2f}", f"{s.pooled.rmse:.3f}", f"{s.constant_pooled.rmse:.3f}", f"{s.median_error:.1%}"),
    ]


def _certainty_row(s: Summary) -> list[str]:
    sides = (f"{s.sides.right:.1%}", f"{s.sides.either:.1%}") if s.sides else ("", "")
    return [*_camera(s), *(f"{v:.1%}" for v in s.within), *(f"{v:.3f}" for v in s.kept_abs_rel), *sides]


def _equal_row(s: Summary) -> list[str]:
    found = (*s.equal_blur.values(), *s.equal_defocus.values())
    return [*_camera(s), *("" if v is None else f"{v:.3f}" for v in found)]


def _relief_rows(s: Summary) -> list[list[str]]:
    return [[*_camera(s), *(f"{v:.2f}" for v in asdict(s.relief).values())]] if s.relief else []


def _score_rows(s: Summary) -> list[list[str]]:
    ways = {"pixels": s.pooled, "pictures": s.mean}
    return [[*_camera(s), way, *(f"{v:.3f}" for v in asdict(scores).values())] for way, scores in ways.items()]


def _blur_row(b: BlurRange) -> list[str]:
    span = f"{b.low_px:g}-{b.high_px:g}" if math.isfinite(b.high_px) else f"{b.low_px:g} and more"
    shares = (b.median, b.certain_median, b.p90)
    return [b.name, span, f"{b.pixels:,}", *(f"{v:.1%}" for v in shares), f"{b.bias:+.1%}", f"{b.order:.2f}"]


def _warning_rows(report: Report) -> list[list[str]]:
    """What the answers to a user's own pictures warn of."""
    own = {name: warnings for name, warnings in report.warnings.items() if is_own(name)}
    return [[name, str(len(of)), of[0], said] for name, warnings in own.items() for said, of in warnings.items()]


def tables(report: Report) -> dict[str, Table]:
    """Title to head and rows, as text."""
    warnings = _warning_rows(report)
    return {
        "Depth": (DEPTH_HEAD, [_depth_row(s) for s in report.sets]),
        "Certainty": (CERTAINTY_HEAD, [_certainty_row(s) for s in report.sets if s.mode == TRUE_CAMERA]),
        "AbsRel at equal blur and defocus": (EQUAL_HEAD, [_equal_row(s) for s in report.sets if s.mode == TRUE_CAMERA]),
        "Depth differences within a picture": (RELIEF_HEAD, [row for s in report.sets for row in _relief_rows(s)]),
        "All scores of depth": (SCORES_HEAD, [row for s in report.sets for row in _score_rows(s)]),
        "Blur": (BLUR_HEAD, [_blur_row(b) for b in report.blur]),
        **({"Warnings": (WARNINGS_HEAD, warnings)} if warnings else {}),
    }


def beside(report: Report, other: Report) -> Table:
    """How another model answers the same pictures by known cameras: head and rows, the last of the worst ratios."""
    rows, ratios = [], []
    for s in report.sets:
        if s.mode == TRUE_CAMERA:
            t = other.summary(s.name)
            pairs = (s.mean.abs_rel, t.mean.abs_rel), (s.pooled.rmse, t.pooled.rmse)
            ratios.append([its / own if own else math.nan for own, its in pairs])
            texts = (
                (f"{own:.3f}", f"{its:.3f}", f"{ratio:.3f}")
                for (own, its), ratio in zip(pairs, ratios[-1], strict=True)
            )
            rows.append([s.name, *(text for pair in texts for text in pair)])
    worst = [f"{ratio:.3f}" for ratio in np.nanmax(ratios, axis=0)]
    return BESIDE_HEAD, [*rows, ["worst", "", "", worst[0], "", "", worst[1]]]


def markdown(report: Report) -> dict[str, str]:
    """The same tables in Markdown, by title."""
    lines = {title: [head, ["---"] * len(head), *rows] for title, (head, rows) in tables(report).items()}
    return {title: "\n".join(f"| {' | '.join(row)} |" for row in rows) for title, rows in lines.items()}
