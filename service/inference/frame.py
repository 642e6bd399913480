"""Whether a photograph is a camera's frame, and the camera as that photograph has it."""

import math
from collections.abc import Iterator
from typing import Literal

from service.errors import ImageSizeMismatch
from service.inference.drafting import draft_camera
from service.inference.exif import FULL_FRAME_DIAGONAL_MM, Exif
from service.inference.images import TURNS, UNTURNS, Photograph, StoredFrame
from service.metres import focus_in_words
from service.optics import thin_lens
from service.optics.camera import AS_INFINITY_M, FOCUS_DISTANCES_M, Camera, Intrinsics, Lens

FocalLengthFrom = Literal["camera", "exif"]

LENS_TOLERANCE = 0.05
FOCUS_TOLERANCE = 0.15
SAME_FOCUS, FROM_SENSOR = 1.01, 1.1  # told as it was noted, and so many times what it then is from the lens
MOST_COARSE = 2.0  # times as far, or as near, as what was measured: what a camera notes is off by no more
SENSOR_WIDTHS_MM = (0.5, 100.0)  # an endoscope's, and more than a digital back's
VIEW_TOLERANCE = 1.05
MOST_OFF_MIDDLE = 1 / 8  # of width or height: a sensor is put into its camera better than that
SAME_VIEW = 1.25  # equivalents are rounded, and count the whole of a sensor that 16:9 or a square is cut out of


def stored_intrinsics(frame: StoredFrame, camera: Camera | None) -> tuple[Intrinsics | None, FocalLengthFrom | None]:
    """Those of the camera at a stored frame's size, if it is its frame, else what the EXIF tells of the lens."""
    height_px, width_px = frame.rgb.shape[:2]
    if camera is not None:
        unturned = camera.turned(*TURNS[UNTURNS[frame.orientation]])
        fitting = _fitting(width_px, height_px, camera, unturned)
        if fitting and fitting.intrinsics:
            return fitting.resized(width_px, height_px).intrinsics, "camera"
    fx_px = draft_camera(frame.exif, width_px, height_px).lens.fx_px(width_px)
    return (None, None) if fx_px is None else (Intrinsics.centred(fx_px, width_px, height_px), "exif")


def _fitting(width_px: int, height_px: int, *cameras: Camera) -> Camera | None:
    """The first whose frame a picture is: one is registered with the size of its files or of its upright pictures."""
    return next((camera for camera in cameras if camera.is_same_frame(width_px, height_px)), None)


def camera_of(photograph: Photograph, camera: Camera) -> tuple[Camera, tuple[str, ...]]:
    """The camera turned and resized like the upright photograph, with warnings.

    Raises ``ImageSizeMismatch`` for a picture that is not the whole frame.
    """
    unlikely = tuple(_all_but_infinite(camera.focus_distance_m))
    width_px, height_px = photograph.width_px, photograph.height_px
    fitting = _fitting(width_px, height_px, camera.turned(*TURNS[photograph.orientation]), camera)
    if fitting is None:
        is_turned = camera.is_same_frame(height_px, width_px)
        advice = (
            "send the original, whose EXIF says how the camera was held, or register a camera of that size"
            if is_turned
            else "send the whole frame, not a crop; a region that the sensor reads out is a camera of its own, of that "
            "size, with k_cam_px as it is (by lens specs, sensor_width_px is the region's)"
        )
        raise ImageSizeMismatch(
            f"The photograph has {width_px}x{height_px} pixels upright, the camera "
            f"{camera.image_width_px}x{camera.image_height_px}: {advice}."
        )
    resized = fitting.resampled(width_px, height_px)
    if resized is fitting:
        return fitting, unlikely
    warning = (
        f"the photograph has {width_px}x{height_px} pixels and the camera "
        f"{fitting.image_width_px}x{fitting.image_height_px}: "
        f"k_cam_px {resized.k_cam_px:.4g} and gamma_px {resized.gamma_px:.4g} were scaled to it, as of "
        "the whole frame resized: a region that the sensor reads out is a camera of its own"
    )
    return resized, (*unlikely, warning)


def _all_but_infinite(focus_distance_m: float) -> Iterator[str]:
    """A warning of a distance that is as good as infinity, and may be one in millimetres or centimetres."""
    farthest_m = FOCUS_DISTANCES_M[1]
    if AS_INFINITY_M <= focus_distance_m < farthest_m:
        yield (
            f"focused at {focus_distance_m:.6g} m, which is all but infinity: it counts in metres, and {farthest_m:g} "
            "stands for infinity"
        )


def taken_otherwise(exif: Exif, camera: Camera, *, is_refocused: bool, is_found: bool = False) -> Iterator[str]:
    """Warnings where a photograph was zoomed, rendered, or not taken as the camera was, as far as that is known.

    ``is_refocused``: the photograph came with a focus distance of its own. ``is_found``: known depths tell it.
    """
    if exif.is_zoomed:
        said = f"its EXIF says a digital zoom of {exif.zoom:.4g}"
        yield f"{said}: the metres hold for a camera registered at that zoom alone"
    if exif.rendering is not None:
        yield f"its EXIF says {exif.rendering}: its blur may be computed, and no lens'"
    yield from _other_lens(exif, camera)
    if not is_found:
        yield from _other_focus(exif, camera.focus_distance_m, is_refocused=is_refocused)
        yield from _focus_from_sensor(exif, camera.focus_distance_m)


def _other_lens(exif: Exif, camera: Camera) -> Iterator[str]:
    told = (exif.focal_length_mm, exif.f_number)
    known = (camera.focal_length_m and camera.focal_length_m * 1e3, camera.f_number)
    both = ((theirs, ours) for theirs, ours in zip(told, known, strict=True) if theirs and ours)
    if any(abs(theirs / ours - 1) > LENS_TOLERANCE for theirs, ours in both):
        yield f"its EXIF says {_as_engraved(*told)}, the camera is {_as_engraved(*known)}"


def _as_engraved(focal_length_mm: float | None, f_number: float | None) -> str:
    engraved = ((focal_length_mm, "{:g} mm"), (f_number, "f/{:g}"))
    return " ".join(form.format(round(value, 2)) for value, form in engraved if value)


def maybe_of_another_size(camera: Camera) -> Iterator[str]:
    """A warning where intrinsics put the axis far off the middle: what was calibrated at another size is so."""
    known = camera.intrinsics
    if known is None:
        return
    width_px, height_px = camera.image_width_px, camera.image_height_px
    off = max(abs((known.cx_px + 0.5) / width_px - 0.5), abs((known.cy_px + 0.5) / height_px - 0.5))
    if off > MOST_OFF_MIDDLE:
        yield (
            f"intrinsics put the axis at ({known.cx_px:.4g}, {known.cy_px:.4g}) of {width_px}x{height_px} pixels, "
            "far off the middle: were they found at another size, or of too few photographs?"
        )


def maybe_wrong_specs(lens: Lens | None, camera: Camera) -> Iterator[str]:
    """Warnings where specs make no sensor, are a tall picture's height, or have another field of view than intrinsics.

    k_cam hangs on the same specs. That the lens is longer focused close is allowed for.
    """
    if lens is None:
        return
    if not SENSOR_WIDTHS_MM[0] <= lens.sensor_width_mm <= SENSOR_WIDTHS_MM[1]:
        yield (
            f"lens.pixel_pitch_um times lens.sensor_width_px is a sensor {lens.sensor_width_mm:.3g} mm wide, which "
            "hardly can be: k_cam and metres are wrong if it is not"
        )
    if lens.sensor_width_px == camera.image_height_px > camera.image_width_px:
        yield (
            f"lens.sensor_width_px, {lens.sensor_width_px}, is the images' height: of tall ones it is the sensor's "
            "short side, and k_cam and metres are wrong by as much"
        )
    if camera.intrinsics is None:
        return
    specs_px, seen_px = lens.fx_px(camera.image_width_px), camera.intrinsics.fx_px
    longer = thin_lens.image_distance_in_focal_lengths(camera.focus_distance_m, lens.focal_length_m)
    if not 1 / SAME_VIEW <= seen_px / specs_px <= SAME_VIEW * longer:
        yield (
            f"fx_px is {specs_px:.0f} by lens and {seen_px:.0f} by intrinsics: is focal_length_mm the 35-mm "
            "equivalent, or pixel_pitch_um or sensor_width_px wrong? k_cam is off by as much or more if the lens is"
        )


def _other_focus(exif: Exif, focus_distance_m: float, *, is_refocused: bool) -> Iterator[str]:
    """What cameras note is coarse, and counts from the sensor in most, at 1:1 a few focal lengths more."""
    noted_m = exif.subject_distance_m
    if noted_m is None or min(noted_m, focus_distance_m) >= AS_INFINITY_M or (is_refocused and noted_m == math.inf):
        return
    low, high = 1 / (1 + FOCUS_TOLERANCE), 1 / (1 - FOCUS_TOLERANCE)
    if is_refocused:
        low, high = 1 / MOST_COARSE, MOST_COARSE
    nearest_m = exif.focus_from_lens_m or min(noted_m, (exif.focal_length_mm or math.inf) / 1e3)
    if not nearest_m * low <= focus_distance_m <= noted_m * high:
        noted, told = focus_in_words(noted_m), focus_in_words(focus_distance_m)
        ours, advice = (
            (f"focus_distance_m is {told}", "it counts in metres, of dioptres the reciprocal")
            if is_refocused
            else (f"the camera at {told}", "send this shot's focus_distance_m")
        )
        yield f"its EXIF says that it was focused at {noted}, {ours}: {advice}"


def _focus_from_sensor(exif: Exif, focus_distance_m: float) -> Iterator[str]:
    """A warning where what the camera noted was told as it is, close up, where that is much more than from the lens."""
    noted_m, focal_length_m = exif.subject_distance_m, (exif.focal_length_mm or math.inf) / 1e3
    if noted_m is None or not 1 / SAME_FOCUS <= focus_distance_m / noted_m <= SAME_FOCUS:
        return
    from_lens_m = exif.focus_from_lens_m or 2 * focal_length_m
    if from_lens_m * FROM_SENSOR < noted_m:
        yield (
            f"focus_distance_m is {focus_in_words(focus_distance_m)}, as its EXIF notes, which most cameras count from "
            f"the sensor: from the lens, as it is to be, that is about {focus_in_words(from_lens_m)}"
        )


def maybe_another_part(exif: Exif, camera: Camera) -> Iterator[str]:
    """A warning where the EXIF tells, by no zoom but by its 35-mm equivalent, of another field of view.

    Of a camera whose lens is not known a pixel's size tells it too, which a program that resizes may leave as it was.
    ``camera`` has the photograph's size. That a lens focused close may see less is allowed for, and of another focal
    length than the lens' ``taken_otherwise`` tells.
    """
    by_pitch_mm = exif.equivalent_by_pitch_mm if camera.focal_length_m is None else None
    equivalent_mm, focal_length_m = exif.focal_length_35mm or by_pitch_mm, (exif.focal_length_mm or math.inf) / 1e3
    if equivalent_mm is None or camera.intrinsics is None or exif.is_zoomed:
        return
    is_other_lens = abs(focal_length_m / (camera.focal_length_m or focal_length_m) - 1) > LENS_TOLERANCE
    if is_other_lens or focal_length_m >= camera.focus_distance_m:
        return
    diagonal_px = math.hypot(camera.image_width_px, camera.image_height_px)
    camera_mm = camera.intrinsics.fx_px / diagonal_px * FULL_FRAME_DIAGONAL_MM
    longer = thin_lens.image_distance_in_focal_lengths(camera.focus_distance_m, focal_length_m)
    if not 1 / SAME_VIEW <= camera_mm / equivalent_mm <= SAME_VIEW * longer:
        yield (
            f"its EXIF says it shows what {equivalent_mm:.3g} mm show on 35-mm film, the camera what {camera_mm:.3g} "
            "do: another lens, zoom or part of the sensor (a phone's 2x, a crop mode) is another camera, drafted from "
            "its picture"
        )


def maybe_seen_otherwise(camera: Camera, known_at_m: float | None) -> Iterator[str]:
    """A warning for what ``fx_px`` measures, where the lens is focused much nearer or farther than where it is known.

    ``known_at_m`` is the focus that intrinsics were given for; None where lens specs tell them, of infinity.
    """
    if camera.focal_length_m is None:
        return
    longer = thin_lens.image_distance_in_focal_lengths(camera.focus_distance_m, camera.focal_length_m)
    where = "far away"
    if known_at_m is not None:
        longer /= thin_lens.image_distance_in_focal_lengths(known_at_m, camera.focal_length_m)
        where = f"at {known_at_m:.4g} m"
    if not 1 / VIEW_TOLERANCE <= longer <= VIEW_TOLERANCE:
        moved = "nearer to" if longer > 1 else "farther from"
        yield (
            f"fx_px is that of the lens focused {where}: in one that moves as a whole it is {longer:.3g} times that, "
            f"and points lie as much {moved} the axis: calibrate, or give intrinsics, for this focus"
        )
