"""One photograph of the sheet measured: its grid found, and the blur of each circle read."""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from service.calibration.edge import EdgeError, EdgeFit, fit_edge, slice_blur
from service.calibration.grid import FoundGrid, GridError, find_grid
from service.calibration.pose import View
from service.calibration.report import Method, PictureReport
from service.calibration.target import CircleGrid
from service.opencv import cv2
from service.optics.camera import F_NUMBERS
from service.optics.light import decode_srgb

LEAST_CIRCLES = 8
CLIPPED_LEVEL = 252
DARK_LEVEL = 80  # of the paper: below, noise is a large part of the circles' contrast
PLATEAU, PLATEAU_CIRCLES, LEAST_PLATEAU = 0.7, 0.5, 160  # of the paper at one level, of the circles so, from where on
CLIPPED_CIRCLES = 0.1  # of a picture's, from where on it is overexposed
FAR_RADII = 0.45  # of blur: what reads as half a radius may be a disc of three quarters
SAME_APERTURE = 1.05  # a third of a stop is 1.12
OTHER_SIZE = 1.1  # paper shrinks and ink spreads less
PAPER_FROM_RADII, PAPER_TO_RADII = 1.3, 1.6
LUMINANCE = (0.2126, 0.7152, 0.0722)


@dataclass(slots=True)
class Measured:
    """What one picture gave: its circles by number, where they are, and how blurred."""

    report: PictureReport
    size_px: tuple[int, int] = (0, 0)
    grid: FoundGrid | None = None
    circles: list[int] = field(default_factory=list)
    centres_px: list[tuple[float, float]] = field(default_factory=list)
    edges: list[EdgeFit] = field(default_factory=list)
    slices_px: list[float] = field(default_factory=list)  # lambda as the paper reads it, if asked for
    paper_levels: list[float] = field(default_factory=list)  # of the white around each circle looked at, 0 to 255
    plateaus: list[int] = field(default_factory=list)  # the level of those around which nearly all white has one
    f_number: float | None = None

    @property
    def is_dark(self) -> bool:
        return bool(self.paper_levels) and float(np.median(self.paper_levels)) < DARK_LEVEL

    @property
    def is_clipped(self) -> bool:
        clipped = sum(level >= CLIPPED_LEVEL for level in self.paper_levels)
        return clipped > CLIPPED_CIRCLES * len(self.paper_levels)

    @property
    def blur_radii(self) -> float:
        """How large the blur is beside the circles; 0 of none."""
        if self.grid is None or not self.edges:
            return 0.0
        return float(np.median([edge.blur_px for edge in self.edges]) / np.median(self.grid.radii_px[self.circles]))

    def view(self) -> View:
        return View(np.array(self.circles, np.int64), np.array(self.centres_px, np.float64))

    def blur_px(self) -> list[float]:
        return self.slices_px or [edge.blur_px for edge in self.edges]

    def warn(self, words: str) -> None:
        self.report = replace(self.report, warnings=(*self.report.warnings, words))


def otherwise_sized(measured: Sequence[Measured]) -> tuple[str, ...]:
    """A warning where circles are larger or smaller, beside what is between them, than the grid was told to have."""
    ratios = [
        edge.radius_px / one.grid.radii_px[circle]
        for one in measured
        if one.grid
        for circle, edge in zip(one.circles, one.edges, strict=True)
    ]
    if not ratios or 1 / OTHER_SIZE <= (ratio := float(np.median(ratios))) <= OTHER_SIZE:
        return ()
    linear = ", or the files hold linear light (gamma 1), where sRGB is expected" if ratio > 1 else ""
    return (
        f"the circles are {ratio:.3g} times as large, beside what is between them, as was told: one of spacing_mm and "
        f"diameter_mm is not the sheet's, and metres follow spacing_mm{linear}",
    )


def aperture_of(measured: Sequence[Measured]) -> tuple[float | None, tuple[str, ...]]:
    """The one that the defocused photographs were taken with, for k_cam is theirs; a warning where it is not one."""
    told = [one.f_number or math.nan for one in measured if one.report.role == "defocused"]
    told = [f_number for f_number in told if F_NUMBERS[0] <= f_number <= F_NUMBERS[1]]
    if not told:
        return None, ()
    least, most = min(told), max(told)
    if most > least * SAME_APERTURE:
        return None, (f"their EXIF says f/{least:.3g} to f/{most:.3g}, and k_cam_px can be that of one aperture alone",)
    return float(np.median(told)), ()


def ill_exposed(measured: Sequence[Measured]) -> tuple[str, ...]:
    """A warning where most photographs that show the sheet are too dark or too bright, beside what is said of each."""
    shown = [one for one in measured if one.paper_levels]
    dark, clipped = sum(one.is_dark for one in shown), sum(one.is_clipped for one in shown)
    told = []
    if 2 * dark > len(shown):
        told.append(f"{dark} of {len(shown)} photographs are underexposed, which falsifies k_cam_px and gamma_px")
    if 2 * clipped > len(shown):
        told.append(
            f"{clipped} of {len(shown)} photographs are overexposed: what is left of their circles looks sharper"
        )
    return tuple(told)


def too_blurred(measured: Sequence[Measured]) -> tuple[str, ...]:
    """A warning where most photographs are too far out of focus, beside what is said of each."""
    shown = [one for one in measured if one.edges]
    far = sum(one.blur_radii > FAR_RADII for one in shown)
    if 2 * far <= len(shown):
        return ()
    return (
        f"{far} of {len(shown)} photographs are too far out of focus for their circles, which falsifies k_cam_px and "
        "focus_distance_m",
    )


def measure(
    out: Measured,
    rgb: NDArray[np.uint8],
    grid: CircleGrid,
    at: Callable[[float], None],
    *,
    method: Method = "edge",
    partner: Measured | None = None,
    every: int = 1,
) -> None:
    """Find the grid in a picture, or take it where the partner has it, and measure its circles, or every so many.

    ``at(part in 0..1)`` is called circle by circle and may raise to stop the work. What is wrong with the picture is
    among its warnings.
    """
    out.size_px = (rgb.shape[1], rgb.shape[0])
    grey = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8)
    at(0.05)
    try:
        out.grid = find_grid(grey, grid, lambda: at(0.05))
    except GridError as error:
        out.warn(str(error))
        if partner is None or partner.grid is None or partner.size_px != out.size_px:
            return
        out.grid = partner.grid
        out.warn("looked for the circles where its focused partner has them")
    else:
        out.report = replace(out.report, found=True)
    at(0.1)
    _measure_circles(method, rgb, out.grid, out, at, every)
    out.report = replace(
        out.report,
        found=out.report.found or bool(out.circles),
        circles=len(out.circles),
        blur_px=float(np.median(out.blur_px())) if out.edges else None,
    )


def _measure_circles(
    method: Method, rgb: NDArray[np.uint8], grid: FoundGrid, out: Measured, at: Callable[[float], None], every: int
) -> None:
    reasons: Counter[str] = Counter()
    like: EdgeFit | None = None
    left, top, light, peak = _light_about(rgb, grid)
    chosen = range(0, len(grid.radii_px), every)
    for number in chosen:
        (x, y), radius = grid.centres_px[number].tolist(), float(grid.radii_px[number])
        at(0.1 + 0.9 * number / len(grid.radii_px))
        paper = _paper_about(peak, x - left, y - top, radius)
        out.paper_levels.append(float(np.median(paper)))
        level, share = _commonest(paper)
        if share >= PLATEAU:
            out.plateaus.append(level)
        try:
            if out.paper_levels[-1] >= CLIPPED_LEVEL:
                raise EdgeError("the paper around it is overexposed: expose so that white stays grey")
            edge = fit_edge(light, x - left, y - top, radius, like)
            if method == "paper":
                out.slices_px.append(slice_blur(light, edge.x_px, edge.y_px, edge.radius_px))
        except EdgeError as error:
            reasons[str(error)] += 1
            continue
        like = edge
        out.circles.append(number)
        out.centres_px.append((edge.x_px + left, edge.y_px + top))
        out.edges.append(edge)
    _warn_of_plateau(out)
    _warn_of_dark(out)
    if out.blur_radii > FAR_RADII:
        out.warn(
            f"its circles are blurred by {out.blur_radii:.2f} of their radius, where blur is misread: go no farther "
            "from focus than where it is a third, or take a sheet of larger circles"
        )
    for reason, count in reasons.most_common(3):
        out.warn(f"{count} of {len(chosen)} circles not measured: {reason}")
    if every == 1 and 0 < len(out.circles) < LEAST_CIRCLES:
        out.warn(f"left out: {len(out.circles)} circles do not place the sheet, {LEAST_CIRCLES} are needed")


def _light_about(rgb: NDArray[np.uint8], grid: FoundGrid) -> tuple[int, int, NDArray[np.float32], NDArray[np.uint8]]:
    """The part of the picture with the grid: its corner (x, y), luminance in linear light, the brightest channel."""
    reach = 3 * grid.radii_px[:, None]
    low = np.maximum(np.floor((grid.centres_px - reach).min(0)).astype(int), 0)
    high = np.ceil((grid.centres_px + reach).max(0)).astype(int) + 1
    part = rgb[low[1] : high[1], low[0] : high[0]]
    curve = decode_srgb(np.arange(256, dtype=np.float32) / np.float32(255))
    weighted = [weight * curve[part[..., i]] for i, weight in enumerate(LUMINANCE)]
    return int(low[0]), int(low[1]), np.asarray(sum(weighted), np.float32), part.max(axis=2)


def _warn_of_plateau(out: Measured) -> None:
    """White that is one level nearly all over was cut off there, by light or by what made the file."""
    level, share = _commonest(np.array(out.plateaus, np.int64))
    if (
        level < LEAST_PLATEAU
        or level >= CLIPPED_LEVEL
        or share * len(out.plateaus) < PLATEAU_CIRCLES * len(out.paper_levels)
    ):
        return
    out.warn(
        f"the paper is at level {level} nearly everywhere, as if white were cut off there, which makes blur look "
        "smaller: expose less, and send the file as the camera wrote it"
    )


def _warn_of_dark(out: Measured) -> None:
    """In the dark noise is as large as what tells blur, and cut off at black."""
    if out.is_dark:
        level = float(np.median(out.paper_levels))
        out.warn(
            f"underexposed: the paper is at level {level:.0f} of 255, where noise falsifies blur: expose more, so that "
            "white is light grey"
        )


def _commonest(levels: NDArray[np.integer]) -> tuple[int, float]:
    """The level that most have, and what part of them does; 0 of none."""
    if levels.size == 0:
        return 0, 0.0
    counts = np.bincount(levels)
    return int(counts.argmax()), float(counts.max() / levels.size)


def _paper_about(peak: NDArray[np.uint8], x: float, y: float, radius: float) -> NDArray[np.uint8]:
    """Levels, 0 to 255, of the paper around a circle; one of 0 where none is in the picture."""
    angle = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    ring = np.concatenate([np.stack([np.cos(angle), np.sin(angle)], 1) * r for r in (PAPER_FROM_RADII, PAPER_TO_RADII)])
    places = np.rint(ring * radius + (x, y)).astype(int)
    inside = (places >= 0).all(1) & (places < peak.shape[::-1]).all(1)
    return peak[places[inside, 1], places[inside, 0]] if inside.any() else np.zeros(1, np.uint8)
