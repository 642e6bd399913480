"""Photographs of a printed grid to a camera's constants: find the circles, measure them, place the sheets, fit."""

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from service.calibration import fit
from service.calibration.edge import PointSpread, find_spread, fit_again
from service.calibration.measure import (
    LEAST_CIRCLES,
    Measured,
    aperture_of,
    ill_exposed,
    measure,
    otherwise_sized,
    too_blurred,
)
from service.calibration.pose import Placement, PoseError, place
from service.calibration.refocus import refocused
from service.calibration.report import PictureReport, Report, Result, Sample
from service.calibration.sharpening import sharpened
from service.calibration.solve import FEW_VIEWS
from service.calibration.target import CircleGrid
from service.calibration.task import Picture, Task, Tell
from service.calibration.tones import otherwise_toned
from service.errors import CamindError
from service.optics.camera import Intrinsics

FITTING_PART = 0.2  # of the progress
BAD_VIEW = 4.0
LEAST_BAD_PX = 1.5
SAME_VIEW_PX = 0.05  # rms, between the centres of two pictures' circles
MOST_ODD = 1 / 3  # of the pictures, that may be left out for being blurred otherwise
CENTRE_TO, CORNER_FROM = 0.4, 0.7
FIELD_DIFFERENCE = 0.1
LEAST_FIELD_CIRCLES = 12


def calibrate(
    task: Task,
    pictures: Sequence[Picture],
    tell: Tell = lambda _progress, _reports: None,
    check: Callable[[], None] = lambda: None,
) -> Report:
    """Calibrate. ``tell(progress in 0..1, reports so far)`` is called circle by circle, and now and then in the fit.

    So is ``check``, which may raise to stop the work; what it raises comes out. What is wrong with the pictures is in
    the report, never raised. Focused ones come first, there too: their partners need them.
    """
    pictures = sorted(pictures, key=lambda picture: picture.role != "focused")
    measured: list[Measured] = []
    reports: list[PictureReport] = []

    def told(progress: float) -> None:
        check()
        tell(progress, tuple(reports))

    for number, picture in enumerate(pictures):

        def at(part: float, number: int = number) -> None:
            told((1 - FITTING_PART) * (number + part) / len(pictures))

        at(0.0)
        one = _measured(task, picture, at, _partner(picture, measured))
        measured.append(one)
        reports.append(one.report)
    try:
        result = _result(task, measured, lambda part: told(1 - FITTING_PART + FITTING_PART * part))
    except (PoseError, fit.FitError) as error:
        return Report(tuple(one.report for one in measured), None, str(error))
    return Report(tuple(one.report for one in measured), result, None)


def _partner(picture: Picture, measured: list[Measured]) -> Measured | None:
    """The focused picture that this defocused one is the pair of, if it came before: each kind is counted alone."""
    if picture.role == "focused":
        return None
    place_ = sum(one.report.role == "defocused" for one in measured)
    focused = [one for one in measured if one.report.role == "focused"]
    return focused[place_] if place_ < len(focused) else None


def _measured(task: Task, picture: Picture, at: Callable[[float], None], partner: Measured | None) -> Measured:
    out = Measured(PictureReport(picture.name, picture.role, found=False))
    try:
        shot = picture.load()
    except CamindError as error:
        out.warn(error.detail)
        return out
    out.f_number = shot.f_number
    measure(out, shot.rgb, task.grid, at, method=task.method, partner=partner)
    return out


@dataclass(frozen=True, slots=True)
class _Fitted:
    """Those pictures that count, where their sheets stood, how they are blurred, and what fits them all best."""

    usable: list[Measured]
    placement: Placement
    spread: PointSpread
    circles: fit.Circles
    constants: fit.Constants


def _result(task: Task, measured: list[Measured], at: Callable[[float], None]) -> Result:
    size_px, usable = _of_one_size(measured)
    found = _fitted(task, _distinct(usable), size_px, at)
    like_others = _like_others(task, found)
    if len(like_others) < len(found.usable):
        found = _fitted(task, like_others, size_px, at)
    usable, placement, circles = found.usable, found.placement, found.circles
    constants = _constants(task, circles, placement, tick=lambda: at(0.8))
    for one, distance, tilt in zip(usable, placement.distance_m, placement.tilt_deg, strict=True):
        blur_px = float(np.median(one.blur_px()))
        one.report = replace(one.report, distance_m=distance, tilt_deg=tilt, blur_px=blur_px)
    samples = tuple(_samples(usable, circles, constants))
    corners = _corner_ratio(samples, placement.intrinsics, size_px)
    f_number, apertures = aperture_of(usable)
    return Result(
        *size_px,
        k_cam_px=constants.k_cam_px,
        gamma_px=constants.gamma_px,
        focus_distance_m=constants.focus_distance_m,
        point_spread=found.spread.shape,
        intrinsics=placement.intrinsics,
        reprojection_rms_px=placement.overall_rms_px,
        samples=samples,
        curve=constants.curve,
        corner_ratio=corners,
        f_number=f_number,
        warnings=(
            *_left_out(measured, usable),
            *ill_exposed(measured),
            *too_blurred(usable),
            *otherwise_sized(usable),
            *placement.warnings,
            *constants.warnings,
            *(_altered(task.grid, found, constants) if task.method == "edge" else ()),
            *_uneven(corners),
            *apertures,
        ),
    )


def _altered(grid: CircleGrid, found: _Fitted, constants: fit.Constants) -> tuple[str, ...]:
    """What tells that blur is not that of one lens alone, locked."""
    edges = [edge for one in found.usable for edge in one.edges]
    toned, ringed = otherwise_toned(grid, found.usable), sharpened(edges, found.spread)
    return (*toned, *ringed, *refocused(found.circles, constants))


def _fitted(task: Task, usable: list[Measured], size_px: tuple[int, int], at: Callable[[float], None]) -> _Fitted:
    """The fit without its intervals, every circle read under the point spread that suits them all."""
    placement, usable = _placed(task.grid, usable, size_px)
    circles = _circles(usable, placement)
    at(0.0)
    constants = _constants(task, circles, placement, resamples=0)
    spread = find_spread([edge for one in usable for edge in one.edges], constants.gamma_px.value, lambda: at(0.1))
    if task.method == "edge":
        for number, one in enumerate(usable):
            at(0.1 + 0.6 * number / len(usable))
            one.edges = [fit_again(edge, spread) for edge in one.edges]
        circles = _circles(usable, placement)
        constants = _constants(task, circles, placement, resamples=0)
    return _Fitted(usable, placement, spread, circles, constants)


def _like_others(task: Task, found: _Fitted) -> list[Measured]:
    """The pictures without those few that are blurred as no camera of the others would, which are told so.

    All of them where these are many, for then nobody knows which are right, or where hardly any would be left.
    """
    usable, odd = found.usable, fit.odd_pictures(found.circles, found.constants)
    left = len(usable) - len(odd)
    if task.method != "edge" or len(odd) > MOST_ODD * len(usable) or left < FEW_VIEWS:
        return usable
    for number in odd:
        usable[number].warn(
            "left out: its circles are blurred otherwise than those of the others: did it move, or was it refocused?"
        )
    return [one for number, one in enumerate(usable) if number not in odd]


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


def _of_one_size(measured: list[Measured]) -> tuple[tuple[int, int], list[Measured]]:
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


def _distinct(measured: list[Measured]) -> list[Measured]:
    """Those that show the sheet in one place once: the same photograph again tells nothing new."""
    kept: list[Measured] = []
    for one in measured:
        same = next((other for other in kept if _is_same_view(one, other)), None)
        if same is None:
            kept.append(one)
        else:
            one.warn(f"left out: the same photograph as {same.report.name}, or another of the very same view")
    return kept


def _is_same_view(one: Measured, other: Measured) -> bool:
    _, here, there = np.intersect1d(one.circles, other.circles, return_indices=True)
    if one.report.role != other.report.role or len(here) < LEAST_CIRCLES:
        return False
    apart_px = np.array(one.centres_px)[here] - np.array(other.centres_px)[there]
    return float(np.sqrt((apart_px**2).sum(1).mean())) < SAME_VIEW_PX


def _placed(grid: CircleGrid, measured: list[Measured], size_px: tuple[int, int]) -> tuple[Placement, list[Measured]]:
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


def _circles(measured: list[Measured], placement: Placement) -> fit.Circles:
    counts = [len(one.circles) for one in measured]
    return fit.Circles(
        np.concatenate(placement.depth_m),
        np.concatenate([one.blur_px() for one in measured]),
        np.concatenate([[edge.blur_error_px for edge in one.edges] for one in measured]),
        np.repeat(np.arange(len(measured)), counts),
        np.repeat([one.report.role == "focused" for one in measured], counts),
    )


def _samples(measured: list[Measured], circles: fit.Circles, constants: fit.Constants) -> Iterator[Sample]:
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


def _left_out(measured: list[Measured], usable: list[Measured]) -> Iterator[str]:
    if len(usable) < len(measured):
        yield f"{len(measured) - len(usable)} of {len(measured)} photographs were of no use: see what each of them says"


def _corner_ratio(samples: tuple[Sample, ...], intrinsics: Intrinsics, size_px: tuple[int, int]) -> float | None:
    """k_cam in the corners over that in the middle; None where too few circles were."""
    middle, reach = (intrinsics.cx_px, intrinsics.cy_px), math.hypot(*size_px) / 2
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
