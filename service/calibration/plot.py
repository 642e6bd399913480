"""A calibration as a picture: blur against distance, k_cam picture by picture, and what of the frame was covered."""

import io
from concurrent.futures import ThreadPoolExecutor

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from service.calibration.report import Result
from service.metres import in_words

INCHES = (13.0, 4.6)
BLUE, ORANGE, GREY = "#1f5fa8", "#d9730d", "#8a8a8a"
LONGEST_NAME = 14
# one thread draws for all: matplotlib keeps its fonts open for each, and its settings are everybody's
ARTIST = ThreadPoolExecutor(1, "plot")


def as_svg(result: Result) -> bytes:
    """Three plots as one SVG; the same result gives the same bytes."""
    return ARTIST.submit(_drawn, result).result()


def _drawn(result: Result) -> bytes:
    figure = Figure(INCHES, layout="constrained")
    blur, spread, frame = figure.subplots(1, 3)
    _blur(blur, result)
    _spread(spread, result)
    _frame(frame, result)
    file = io.BytesIO()
    with mpl.rc_context({"svg.hashsalt": "camind", "svg.fonttype": "none"}):
        figure.savefig(file, format="svg", metadata={"Date": None})
    return file.getvalue()


def _blur(axes: Axes, result: Result) -> None:
    """Lambda against 1/z: the measured circles, outliers as crosses, the fitted curve and its interval."""
    used = [s for s in result.samples if s.used]
    outliers = [s for s in result.samples if not s.used]
    nearness = [1 / point.depth_m for point in result.curve]
    axes.fill_between(
        nearness, [p.low_px for p in result.curve], [p.high_px for p in result.curve], color=ORANGE, alpha=0.25, lw=0
    )
    axes.plot(nearness, [p.blur_px for p in result.curve], color=ORANGE, label="fit, 95 %")
    axes.scatter([1 / s.depth_m for s in used], [s.blur_px for s in used], s=6, color=BLUE, label="circles", zorder=3)
    if outliers:
        axes.scatter(
            [1 / s.depth_m for s in outliers],
            [s.blur_px for s in outliers],
            s=18,
            marker="x",
            color=GREY,
            label="outliers",
        )
    axes.axvline(1 / result.focus_distance_m.value, color=GREY, lw=0.8, ls="--", label="focus")
    axes.set(xlabel="1 / distance (1/m)", ylabel="blur (px)", ylim=(0, None))
    k_cam, gamma, focus = result.k_cam_px, result.gamma_px, result.focus_distance_m
    axes.set_title(
        f"k_cam {k_cam.value:.3g} px [{k_cam.low:.3g}, {k_cam.high:.3g}], gamma {gamma.value:.2f} px, "
        f"focus {in_words(focus.value)} m",
        fontsize=9,
    )
    axes.legend(fontsize=8)


def _spread(axes: Axes, result: Result) -> None:
    """What each picture's circles say of k_cam, as a box plot (Fig. 4 of the paper)."""
    by_image: dict[str, list[float]] = {}
    for sample in result.samples:
        if sample.used and sample.k_cam_px is not None:
            by_image.setdefault(sample.image, []).append(sample.k_cam_px)
    if by_image:
        names = [name if len(name) <= LONGEST_NAME else f"…{name[1 - LONGEST_NAME :]}" for name in by_image]
        plain = [name.replace("$", r"\$") for name in names]  # no formula, whatever a file is called
        axes.boxplot(list(by_image.values()), tick_labels=plain, flierprops={"markersize": 3})
        axes.tick_params(axis="x", labelrotation=90, labelsize=7)
        middle = np.concatenate([np.asarray(values) for values in by_image.values()])
        low, high = np.quantile(middle, [0.02, 0.98])
        room = max(high - low, 0.1 * result.k_cam_px.value)
        axes.set_ylim(max(low - room, 0), high + room)
    axes.axhspan(result.k_cam_px.low, result.k_cam_px.high, color=ORANGE, alpha=0.25, lw=0)
    axes.axhline(result.k_cam_px.value, color=ORANGE)
    axes.set(ylabel="k_cam of single circles (px)")
    axes.set_title("k_cam picture by picture", fontsize=9)


def _frame(axes: Axes, result: Result) -> None:
    """Where in the frame circles were measured."""
    axes.scatter([s.u_px for s in result.samples], [s.v_px for s in result.samples], s=4, color=BLUE, alpha=0.6)
    axes.set(xlim=(0, result.image_width_px), ylim=(result.image_height_px, 0), xlabel="u (px)", ylabel="v (px)")
    axes.set_aspect("equal")
    axes.set_title("coverage of the frame", fontsize=9)
