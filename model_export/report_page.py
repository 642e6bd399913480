"""An evaluation as a folder to look at: a page with tables, plots and example pictures, and all of it as JSON."""

import html
import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from model_export.datasets.photos import write_image
from model_export.evaluation_sets import FIXED, VIEWS
from model_export.modes import MODES, TRUE_CAMERA, UNSEEN_K_CAM_PX
from model_export.summary import Pixels, Report, Summary
from model_export.tables import tables
from service.inference.preview import render_preview

Map = NDArray[np.float32]

NOMINAL = np.linspace(0.05, 0.95, 19)
BINS = 16
LEAST_IN_BIN = 50


def write(report: Report, folder: Path) -> None:
    """``report.json``, ``report.html`` and the pictures it shows."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "report.json").write_text(json.dumps(report.as_dict(), indent=2) + "\n")
    pictures = [name for name, draw in PLOTS.items() if _plot(folder / f"{name}.svg", draw, report)]
    (folder / "report.html").write_text(_page(report, pictures, _write_examples(report, folder)))


def _page(report: Report, plots: Sequence[str], examples: dict[str, str]) -> str:
    def table(title: str, head: list[str], rows: list[list[str]]) -> str:
        cells = "".join(f"<tr>{''.join(f'<td>{html.escape(c)}</td>' for c in row)}</tr>" for row in rows)
        return f"<h2>{title}</h2><table><tr>{''.join(f'<th>{h}</th>' for h in head)}</tr>{cells}</table>"

    parts = [table(title, head, rows) for title, (head, rows) in tables(report).items()]
    parts.append("<h2>Plots</h2>" + "".join(f'<img src="{name}.svg" alt="{name}">' for name in plots))
    parts.append(
        "<h2>Examples</h2><p>Picture, truth, answer, and the stated error from 0 (black) to half the depth.</p>"
    )
    parts += [f'<h3>{name}</h3><img src="{file}" alt="{name}">' for name, file in examples.items()]
    style = "body{font:15px sans-serif;margin:2em}td,th{padding:.2em .6em;text-align:right}img{max-width:100%}"
    title = html.escape(report.model)
    head = f'<meta charset="utf-8"><title>{title}</title><style>{style}</style>'
    return f'<!doctype html><html lang="en"><head>{head}</head><body><h1>{title}</h1>{"".join(parts)}</body></html>\n'


def _write_examples(report: Report, folder: Path) -> dict[str, str]:
    """One picture a set: photograph, truth, answer, stated error. Set name to file name."""
    files = {}
    for name, example in report.examples.items():
        relative = np.nan_to_num(example.sigma_m / example.depth_m, nan=1)
        stated = (np.clip(2 * relative, 0, 1) * 255).astype(np.uint8)
        grey = np.repeat(stated[..., None], 3, axis=2)
        depths = render_preview(np.hstack([example.truth_m, example.depth_m]))
        row = np.hstack([example.image, depths, grey])
        files[name] = f"{name.replace(' ', '_')}.png"
        write_image(folder / files[name], row)
    return files


def _plot(file: Path, draw: Callable[[Axes, Report], None], report: Report) -> bool:
    """Write a plot; whether there was anything to draw."""
    with mpl.rc_context({"svg.hashsalt": "camind", "font.size": 9}):
        figure = Figure(figsize=(5.2, 3.6), layout="constrained")
        axes = figure.add_subplot()
        draw(axes, report)
        if not axes.has_data():
            return False
        axes.grid(alpha=0.3)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize=7)
        figure.savefig(file, metadata={"Date": None})
    return True


def _curve(axes: Axes, at: Map, pixels: Pixels, label: str, *, logarithmic: bool) -> None:
    """Median relative error of pixels against a quantity, in bins that hold enough of them."""
    low, high = np.quantile(at, [0.01, 0.99])
    edges = np.geomspace(low, high, BINS + 1) if logarithmic else np.linspace(low, high, BINS + 1)
    inside = np.searchsorted(edges[1:-1], at)  # what is beyond the ends is in the first and the last
    rows = [
        (np.median(at[inside == i]), np.median(np.abs(pixels.error[inside == i])))
        for i in range(BINS)
        if (inside == i).sum() >= LEAST_IN_BIN
    ]
    if rows:
        axes.plot(*np.transpose(rows), marker=".", label=label)


def _of_depth(report: Report) -> list[Summary]:
    """The sets that the plots of depth show, users' own among them: the camera is known, blur belongs to the picture.

    Frames and table tops are shown together, as indoor ones.
    """
    left_out = ("plane", FIXED, "rgbd", "tabletop")
    return [s for s in report.sets if s.mode == TRUE_CAMERA and s.name.split()[0] not in left_out]


def _against_distance(axes: Axes, report: Report) -> None:
    for s in _of_depth(report):
        if not s.name.startswith("procedural"):
            _curve(axes, s.depth.truth, s.depth, s.name, logarithmic=False)
    axes.set(xlabel="true depth, m", ylabel="median relative error of depth", ylim=(0, None))


def _against_blur(axes: Axes, report: Report) -> None:
    for name, pixels in report.blur_pixels.items():
        sure = pixels.certain()
        half = Pixels(pixels.truth[sure], pixels.answer[sure], pixels.stated[sure])
        _curve(axes, pixels.truth, pixels, name, logarithmic=True)
        _curve(axes, half.truth, half, f"{name}, certain half", logarithmic=True)
    axes.set(xlabel="true lambda, px", ylabel="median relative error of lambda", xscale="log", ylim=(0, None))


def _against_view(axes: Axes, report: Report) -> None:
    known = {(s.name, s.mode): s.mean.abs_rel for s in report.sets}
    for folder in ("rgbd", "tabletop"):
        names = {1.0: f"{folder} k_cam {UNSEEN_K_CAM_PX[1]:g}"} | {v: f"{folder} view {v:g}" for v in VIEWS}
        points = sorted(
            (view, known[name, TRUE_CAMERA]) for view, name in names.items() if (name, TRUE_CAMERA) in known
        )
        if points:
            axes.plot(*zip(*points, strict=True), marker="o", label=folder)
    axes.set(xlabel="field of view, as a part of the whole", ylabel="AbsRel", ylim=(0, None))


def _against_k_cam(axes: Axes, report: Report) -> None:
    known = {(s.name, s.mode): s.pooled.rmse for s in report.sets}
    for mode in MODES:
        points = [(k, known[n, mode]) for k in UNSEEN_K_CAM_PX if (n := f"indoor k_cam {k:g}", mode) in known]
        if points:
            axes.plot(*zip(*points, strict=True), marker="o", label="known" if mode == TRUE_CAMERA else mode)
    axes.set(xlabel="k_cam, px", ylabel="pooled RMSE, m", ylim=(0, None))


def _calibration(axes: Axes, report: Report) -> None:
    """How many errors lie within the interval that should hold a given share of them (Laplace)."""
    for s in _of_depth(report):
        told = s.depth.answered
        if not told.stated.size:
            continue
        scale = np.maximum(told.stated, 1e-6) / math.sqrt(2)
        error = np.abs(np.log(told.answer / told.truth))
        axes.plot(NOMINAL, [(error <= -scale * math.log(1 - p)).mean() for p in NOMINAL], label=s.name)
    if report.sets:
        axes.plot([0, 1], [0, 1], color="black", linewidth=0.8)
    axes.set(xlabel="share that should lie within", ylabel="share that lies within", xlim=(0, 1), ylim=(0, 1))


def _by_certainty(axes: Axes, report: Report) -> None:
    for s in _of_depth(report):
        order = np.argsort(s.depth.stated)
        parts = np.array_split(np.abs(s.depth.error[order]), 10)
        axes.plot(np.arange(10) * 10 + 5, [part.mean() for part in parts if part.size], marker=".", label=s.name)
    axes.set(xlabel="pixels by stated error, percentile", ylabel="mean relative error of depth", ylim=(0, None))


PLOTS: dict[str, Callable[[Axes, Report], None]] = {
    "error_against_distance": _against_distance,
    "error_against_blur": _against_blur,
    "error_against_view": _against_view,
    "error_against_k_cam": _against_k_cam,
    "calibration": _calibration,
    "error_by_certainty": _by_certainty,
}
