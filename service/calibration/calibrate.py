"""Photographs of a printed grid to a camera's constants: find the circles, measure them, place the sheets, fit."""

import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from service.calibration import fit
from service.calibration.edge import EdgeError, EdgeFit, find_spread, fit_again, fit_edge, slice_blur
from service.calibration.grid import FoundGrid, GridError, find_grid
from service.calibration.pose import Placement, PoseError, View, place
from service.calibration.report import Method, PictureReport, Report, Result, Role, Sample
from service.calibration.target import CircleGrid
from service.errors import CamindError
from service.opencv import cv2
from service.optics.light import decode_srgb

Array = NDArray[np.float64]
Tell = Callable[[float, tuple[PictureReport, ...]], None]

TELL_EVERY_S = 1.0
FITTING_PART = 0.2  # of the progress
CLIPPED_LEVEL = 252
CLIPPED_PART = 0.5
PAPER_FROM_RADII, PAPER_TO_RADII = 1.3, 1.6
LUMINANCE = (0.2126, 0.7152, 0.0722)
BAD_VIEW = 4.0
LEAST_BAD_PX = 1.5
LEAST_CIRCLES = 8
CENTRE_TO, CORNER_FROM = 0.4, 0.7
FIELD_DIFFERENCE = 0.1
LEAST_FIELD_CIRCLES = 12


@dataclass(frozen=True, slots=True)
class Picture:
    """One photograph, decoded when it is its turn: ``load`` gives RGB uint8 [h,w,3] as the sensor had it.

    ``load`` may raise ``CamindError`` (the picture is then reported as not readable, with its words).
    """

    name: str
    role: Role
    load: Callable[[], NDArray[np.uint8]]


@dataclass(frozen=True, slots=True)
class Task:
    """What is asked: the printed grid, the focus distance if it is known, and how to read blur."""

    grid: CircleGrid
    focus_distance_m: float | None = None
    method: Method = "edge"


@dataclass(slots=True)
class _Measured:
    """What one picture gave: its circles by number, where they are, and how blurred."""

    report: PictureReport
    size_px: tuple[int, int] = (0, 0)
    grid: FoundGrid | None = None
    circles: list[int] = field(default_factory=list)
    centres_px: list[tuple[float, float]] = field(default_factory=list)
    edges: list[EdgeFit] = field(default_factory=list)
    slices_px: list[float] = field(default_factory=list)  # lambda as the paper reads it, if asked for

    def view(self) -> View:
        return View(np.array(self.circles, np.int64), np.array(self.centres_px, np.float64))

    def blur_px(self) -> list[float]:
        return self.slices_px or [edge.blur_px for edge in self.edges]

    def warn(self, words: str) -> None:
        self.report = replace(self.report, warnings=(*self.report.warnings, words))


class _Teller:
    """Says how far the work is, once a second, and lets it be stopped as often."""

    def __init__(self, tell: Tell | None, check: Callable[[], None] | None) -> None:
        self.tell, self.check = tell, check
        self.told_at = -math.inf
        self.reports: list[PictureReport] = []

    def at(self, progress: float) -> None:
        if self.check is not None:
            self.check()
        if self.tell is not None and time.monotonic() - self.told_at >= TELL_EVERY_S:
            self.tell(progress, tuple(self.reports))
            self.told_at = time.monotonic()


def calibrate(
    task: Task,
    pictures: Sequence[Picture],
    *,
    tell: Tell | None = None,
    check: Callable[[], None] | None = None,
) -> Report:
    """Calibrate. ``tell(progress in 0..1, reports so far)`` is called about every second of work.

    ``check`` is called more often and may raise to stop the work; what it raises comes out. What is wrong with the
    pictures is in the report, never raised.
    """
    teller = _Teller(tell, check)
    measured: list[_Measured] = []
    with threadpool_limits(1, "blas"):  # the sums are small: more threads would wait for each other
        for number, picture in enumerate(pictures):

            def at(part: float, number: int = number) -> None:
                teller.at((1 - FITTING_PART) * (number + part) / len(pictures))

            at(0.0)
            one = _measured(task, picture, at, _partner(picture, measured))
            measured.append(one)
            teller.reports.append(one.report)
        try:
            result = _fitted(task, measured, lambda part: teller.at(1 - FITTING_PART + FITTING_PART * part))
        except (PoseError, fit.FitError) as error:
            return Report(tuple(one.report for one in measured), None, str(error))
    return Report(tuple(one.report for one in measured), result, None)


def _partner(picture: Picture, measured: list[_Measured]) -> _Measured | None:
    """The focused picture that this defocused one is the pair of, if it came before: each kind is counted alone."""
    if picture.role == "focused":
        return None
    place_ = sum(one.report.role == "defocused" for one in measured)
    focused = [one for one in measured if one.report.role == "focused"]
    return focused[place_] if place_ < len(focused) else None


def _measured(task: Task, picture: Picture, at: Callable[[float], None], partner: _Measured | None = None) -> _Measured:
    out = _Measured(PictureReport(picture.name, picture.role, found=False))
    try:
        rgb = picture.load()
    except CamindError as error:
        out.warn(error.detail)
        return out
    out.size_px = (rgb.shape[1], rgb.shape[0])
    grey = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8)
    at(0.05)
    try:
        out.grid = find_grid(grey, task.grid)
    except GridError as error:
        out.warn(str(error))
        if partner is None or partner.grid is None or partner.size_px != out.size_px:
            return out
        out.grid = partner.grid
        out.warn("looked for the circles where its focused partner has them")
    else:
        out.report = replace(out.report, found=True)
    at(0.1)
    _measure_circles(task, rgb, out.grid, out, at)
    out.report = replace(
        out.report,
        found=out.report.found or bool(out.circles),
        circles=len(out.circles),
        blur_px=float(np.median(out.blur_px())) if out.edges else None,
    )
    return out


def _measure_circles(
    task: Task, rgb: NDArray[np.uint8], grid: FoundGrid, out: _Measured, at: Callable[[float], None]
) -> None:
    reasons: Counter[str] = Counter()
    like: EdgeFit | None = None
    left, top, light, peak = _light_about(rgb, grid)
    for number, ((x, y), radius) in enumerate(zip(grid.centres_px.tolist(), grid.radii_px.tolist(), strict=True)):
        at(0.1 + 0.9 * number / len(grid.radii_px))
        try:
            if _is_clipped(peak, x - left, y - top, radius):
                raise EdgeError("the paper around it is overexposed: expose so that white stays grey")
            edge = fit_edge(light, x - left, y - top, radius, like)
            if task.method == "paper":
                out.slices_px.append(slice_blur(light, edge.x_px, edge.y_px, edge.radius_px))
        except EdgeError as error:
            reasons[str(error)] += 1
            continue
        like = edge
        out.circles.append(number)
        out.centres_px.append((edge.x_px + left, edge.y_px + top))
        out.edges.append(edge)
    for reason, count in reasons.most_common(3):
        out.warn(f"{count} of {len(grid.radii_px)} circles not measured: {reason}")
    if 0 < len(out.circles) < LEAST_CIRCLES:
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


def _is_clipped(peak: NDArray[np.uint8], x: float, y: float, radius: float) -> bool:
    angle = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    ring = np.concatenate([np.stack([np.cos(angle), np.sin(angle)], 1) * r for r in (PAPER_FROM_RADII, PAPER_TO_RADII)])
    places = np.rint(ring * radius + (x, y)).astype(int)
    inside = (places >= 0).all(1) & (places < peak.shape[::-1]).all(1)
    levels = peak[places[inside, 1], places[inside, 0]]
    return levels.size > 0 and float((levels >= CLIPPED_LEVEL).mean()) > CLIPPED_PART


def _fitted(task: Task, measured: list[_Measured], at: Callable[[float], None]) -> Result:
    size_px, usable = _of_one_size(measured)
    placement, usable = _placed(task.grid, usable, size_px)
    for one, distance, tilt in zip(usable, placement.distance_m, placement.tilt_deg, strict=True):
        one.report = replace(one.report, distance_m=distance, tilt_deg=tilt)
    circles = _circles(usable, placement)
    at(0.0)
    constants = _constants(task, circles, placement, resamples=0 if task.method == "edge" else fit.RESAMPLES)
    spread = find_spread([edge for one in usable for edge in one.edges], constants.gamma_px.value, lambda: at(0.1))
    if task.method == "edge":
        for number, one in enumerate(usable):
            at(0.1 + 0.6 * number / len(usable))
            one.edges = [fit_again(edge, spread) for edge in one.edges]
        circles = _circles(usable, placement)
        constants = _constants(task, circles, placement, tick=lambda: at(0.8))
    for one in usable:
        one.report = replace(one.report, blur_px=float(np.median(one.blur_px())))
    samples = tuple(_samples(usable, circles, constants))
    corners = _corner_ratio(samples, placement, size_px)
    return Result(
        *size_px,
        k_cam_px=constants.k_cam_px,
        gamma_px=constants.gamma_px,
        focus_distance_m=constants.focus_distance_m,
        point_spread=spread.shape,
        intrinsics=placement.intrinsics,
        reprojection_rms_px=placement.overall_rms_px,
        samples=samples,
        curve=constants.curve,
        corner_ratio=corners,
        warnings=(
            *_left_out(measured, usable),
            *placement.warnings,
            *constants.warnings,
            *_uneven(corners),
        ),
    )


def _constants(
    task: Task,
    circles: fit.Circles,
    placement: Placement,
    *,
    resamples: int = fit.RESAMPLES,
    tick: Callable[[], None] = lambda: None,
) -> fit.Constants:
    error = placement.focal_error
    if task.method == "edge":
        return fit.fit_constants(circles, task.focus_distance_m, depth_error=error, resamples=resamples, tick=tick)
    if task.focus_distance_m is None:
        raise fit.FitError("the paper's method needs the focus distance: give focus_distance_m")
    return fit.fit_as_paper(circles, task.focus_distance_m, depth_error=error, resamples=resamples)


def _of_one_size(measured: list[_Measured]) -> tuple[tuple[int, int], list[_Measured]]:
    """Most pictures' size and those that have it, upright ones among them turned to lie as the others do."""
    with_circles = [one for one in measured if len(one.circles) >= LEAST_CIRCLES]
    if not with_circles:
        raise PoseError("the circles could be measured in none of the photographs: see what each of them says")
    size_px = Counter(one.size_px for one in with_circles).most_common(1)[0][0]
    usable = []
    for one in with_circles:
        if one.size_px == size_px:
            usable.append(one)
        elif one.size_px == size_px[::-1]:
            one.centres_px = [(y, size_px[1] - 1 - x) for x, y in one.centres_px]
            usable.append(one)
        else:
            one.warn(f"left out: {one.size_px[0]}x{one.size_px[1]} px, while most are {size_px[0]}x{size_px[1]}")
    return size_px, usable


def _placed(grid: CircleGrid, measured: list[_Measured], size_px: tuple[int, int]) -> tuple[Placement, list[_Measured]]:
    """The placement without pictures that fit it far worse than the others, which are told so."""
    placement = place(grid, [one.view() for one in measured], size_px)
    limit = max(BAD_VIEW * float(np.median(placement.rms_px)), LEAST_BAD_PX)
    kept = [one for one, rms in zip(measured, placement.rms_px, strict=True) if rms <= limit]
    if len(kept) == len(measured):
        return placement, measured
    for one, rms in zip(measured, placement.rms_px, strict=True):
        if rms > limit:
            one.warn(f"left out: its circles are {rms:.1f} px off where the camera of the others would see them")
    return place(grid, [one.view() for one in kept], size_px), kept


def _circles(measured: list[_Measured], placement: Placement) -> fit.Circles:
    counts = [len(one.circles) for one in measured]
    return fit.Circles(
        np.concatenate(placement.depth_m),
        np.concatenate([one.blur_px() for one in measured]),
        np.concatenate([[edge.blur_error_px for edge in one.edges] for one in measured]),
        np.repeat(np.arange(len(measured)), counts),
        np.repeat([one.report.role == "focused" for one in measured], counts),
    )


def _samples(measured: list[_Measured], circles: fit.Circles, constants: fit.Constants) -> Iterator[Sample]:
    k_cam = fit.per_circle_k_cam(circles, constants.gamma_px.value, constants.focus_distance_m.value)
    index = 0
    for one in measured:
        for number, centre in zip(one.circles, one.centres_px, strict=True):
            yield Sample(
                circle=number,
                image=one.report.name,
                u_px=centre[0],
                v_px=centre[1],
                depth_m=float(circles.depth_m[index]),
                blur_px=float(circles.blur_px[index]),
                blur_error_px=float(circles.blur_error_px[index]),
                k_cam_px=float(k_cam[index]) if math.isfinite(k_cam[index]) else None,
                used=not constants.is_outlier[index],
            )
            index += 1


def _left_out(measured: list[_Measured], usable: list[_Measured]) -> Iterator[str]:
    if len(usable) < len(measured):
        yield f"{len(measured) - len(usable)} of {len(measured)} photographs were of no use: see what each of them says"


def _corner_ratio(samples: tuple[Sample, ...], placement: Placement, size_px: tuple[int, int]) -> float | None:
    """k_cam in the corners over that in the middle; None where too few circles were."""
    middle, reach = (placement.intrinsics.cx_px, placement.intrinsics.cy_px), math.hypot(*size_px) / 2
    told = [
        (math.dist((sample.u_px, sample.v_px), middle) / reach, sample.k_cam_px)
        for sample in samples
        if sample.used and sample.k_cam_px is not None
    ]
    centre = [k_cam for away, k_cam in told if away < CENTRE_TO]
    corner = [k_cam for away, k_cam in told if away > CORNER_FROM]
    enough = min(len(centre), len(corner)) >= LEAST_FIELD_CIRCLES
    return float(np.median(corner) / np.median(centre)) if enough else None


def _uneven(corner_ratio: float | None) -> Iterator[str]:
    if corner_ratio is not None and abs(corner_ratio - 1) > FIELD_DIFFERENCE:
        yield f"k_cam_px in the corners is {corner_ratio:.2f} times that in the middle: the lens blurs unevenly"
