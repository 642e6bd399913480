"""How right a calibration is: simulated cameras with known constants, and the paper's own protocol for both methods."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from rich.table import Table

from model_export.photographed_sheets import (
    GRID,
    SIZE_PX,
    GridCamera,
    draw_camera,
    draw_pose,
    photograph,
    picture,
    sweep,
)
from model_export.render import DISC
from service.calibration.calibrate import calibrate
from service.calibration.report import Interval, Method, Report
from service.calibration.target import CircleGrid
from service.calibration.task import Task
from service.optics import thin_lens
from service.optics.camera import Intrinsics

PHOTOGRAPHS = (8, 12)
QUANTITIES = (("k_cam", "%"), ("focus distance", "%"), ("gamma", " px"))
# Fig. 4 of the paper: its k_cam counts k_r = 1, and its blur is 0.3 of that
PAPER_NUMBERS = (1.39, 5.61, 8.79, 12.69, 22.67, 35.61)
PAPER_SIGMA = 0.3
PAPER_FOCUS_M = 2.0
PAPER_DEPTHS_M = np.linspace(0.1, 2.0, 200)
PAPER_GRID = CircleGrid("asymmetric_circles", 7, 3, 60.0, 40.0)


@dataclass(frozen=True, slots=True)
class Trial:
    """One camera and what its calibration said; ``report.result`` is None where it said why it could not."""

    camera: GridCamera
    report: Report

    def against_truth(self) -> list[tuple[Interval, float]]:
        """What was found of each of ``QUANTITIES``, and its true value; nothing where nothing was."""
        found, camera = self.report.result, self.camera
        if found is None:
            return []
        return [
            (found.k_cam_px, camera.k_cam_px),
            (found.focus_distance_m, camera.focus_distance_m),
            (found.gamma_px, camera.gamma_px),
        ]


def random_camera(seed: int) -> Trial:
    """A random camera's photographs from both sides of its focus, calibrated with nothing known."""
    rng = np.random.default_rng(seed)
    camera = draw_camera(rng)
    count = int(rng.integers(PHOTOGRAPHS[0], PHOTOGRAPHS[1] + 1))
    return Trial(camera, calibrate(Task(GRID), sweep(rng, camera, GRID, count)))


def paper_pairs(number: float, pairs: int) -> list[tuple[Method, Trial]]:
    """The paper's protocol: focused and defocused pictures of the sheet at half the focus distance, which is given."""
    rng = np.random.default_rng((0, round(100 * number)))
    camera = GridCamera(
        *SIZE_PX,
        PAPER_SIGMA * number,
        0.6,
        PAPER_FOCUS_M,
        Intrinsics(1050.0, 1050.0, 639.5, 479.5, (-0.05, 0.02, 0.0, 0.0, 0.0)),
        DISC,
    )
    taken = []
    for pair in range(pairs):
        pose = draw_pose(rng, camera, PAPER_GRID, PAPER_FOCUS_M / 2 * rng.uniform(0.95, 1.05))
        taken.append(picture(f"focused {pair}", "focused", photograph(rng, camera, pose, PAPER_GRID, focused=True)))
        taken.append(picture(f"defocused {pair}", "defocused", photograph(rng, camera, pose, PAPER_GRID)))
    methods: tuple[Method, ...] = ("edge", "paper")
    return [(method, Trial(camera, calibrate(Task(PAPER_GRID, PAPER_FOCUS_M, method), taken))) for method in methods]


def error_table(trials: Sequence[Trial]) -> Table:
    """The distribution of errors over cameras, by point spread, and how often the intervals hold."""
    table = Table("point spread", "cameras", "answered", "error of", "median", "95th percentile", "worst", "holds")
    discs = [trial for trial in trials if trial.camera.spread == DISC]
    others = [trial for trial in trials if trial.camera.spread != DISC]
    for name, group in (("disc", discs), ("gaussian", others), ("all", trials)):
        answers = [found for trial in group if (found := trial.against_truth())]
        for i, ((what, unit), pairs) in enumerate(zip(QUANTITIES, zip(*answers, strict=True), strict=False)):
            off = [100 * (found.value / truth - 1) if unit == "%" else found.value - truth for found, truth in pairs]
            figures = [f"{v:.2f}{unit}" for v in np.quantile(np.abs(off), (0.5, 0.95, 1))]
            told = [name, str(len(group)), str(len(answers))] if i == 0 else ["", "", ""]
            holds = np.mean([found.low <= truth <= found.high for found, truth in pairs])
            table.add_row(*told, what, *figures, f"{holds:.0%}")
    return table


def paper_row(number: float, method: Method, trial: Trial) -> list[str]:
    """One row of the table of the paper's protocol."""
    found = trial.report.result
    head = [f"{number:g}", f"{trial.camera.k_cam_px:.3f}", method]
    if found is None:
        return [*head, "", "", trial.report.problem or ""]
    ratio = found.k_cam_px.value / trial.camera.k_cam_px
    blurred = [
        s.blur_px / thin_lens.blur_at_depth(s.depth_m, PAPER_FOCUS_M, trial.camera.k_cam_px, trial.camera.gamma_px)
        for s in found.samples
        if s.image.startswith("defocused")
    ]
    figures = (ratio - 1, float(np.median(blurred)) - 1)
    return [*head, f"{found.k_cam_px.value:.3f}", *(f"{v:+.1%}" for v in figures), f"{_depth_off(ratio):.1%}"]


def _depth_off(ratio: float) -> float:
    """Relative rms difference of depths read by a k_cam that is ``ratio`` of the true one, over depths in front."""
    x = thin_lens.relative_defocus(PAPER_DEPTHS_M, PAPER_FOCUS_M)
    read_m = thin_lens.depth_near(x / ratio, PAPER_FOCUS_M)
    return float(np.sqrt(np.mean((read_m / PAPER_DEPTHS_M - 1) ** 2)))


PAPER_HEAD = ("paper's k_cam", "k_cam px", "method", "found px", "error", "lambda reads", "depth off")
