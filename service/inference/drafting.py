"""A camera drafted from a photograph's EXIF: what is sure, what is a guess, and what is missing.

The 35-mm-equivalent focal length never stands for the focal length. With the real one beside it, it tells how large
the sensor is, as a last resort.
"""

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import lensfunpy

from service.inference.exif import FULL_FRAME_DIAGONAL_MM, Exif
from service.optics.camera import AS_INFINITY_M, FOCUS_DISTANCES_M, Lens

SENSOR_WIDTHS_MM = (1.0, 70.0)
# of the long side to the short one; others are cut out of one of these
SENSOR_ASPECTS = (4 / 3, 3 / 2)
ASPECT_TOLERANCE = 0.02
# what is told of one width differs by less, an equivalent's rounding included; of a phone's other lens by more
SAME_WIDTH = 1.1
SAME_CUT_WIDTH = 1.25  # a square cut out of 4:3 is taken for wider by less, a sensor's part by more


@dataclass(frozen=True, slots=True)
class LensGuess:
    """Lens specs; None for what the photograph does not tell. Lengths in the units of their names."""

    focal_length_mm: float | None
    f_number: float | None
    pixel_pitch_um: float | None
    sensor_width_px: int | None

    def fx_px(self, image_width_px: int) -> float | None:
        """Focal length in pixels of pictures so wide; None where it is not known."""
        if self.focal_length_mm is None or self.pixel_pitch_um is None or self.sensor_width_px is None:
            return None
        return Lens(self.focal_length_mm, math.nan, self.pixel_pitch_um, self.sensor_width_px).fx_px(image_width_px)


@dataclass(frozen=True, slots=True)
class Draft:
    """A camera to be; None for what the photograph does not tell."""

    name: str
    description: str | None
    image_width_px: int
    image_height_px: int
    focus_distance_m: float | None
    lens: LensGuess
    warnings: tuple[str, ...]


def draft_camera(exif: Exif, width_px: int, height_px: int) -> Draft:
    """The camera of a photograph of this stored size, from its EXIF."""
    warnings: list[str] = []
    pitch_um, sensor_width_px = _sensor(exif, width_px, width_px / height_px, warnings)
    for value, words in (
        (exif.focal_length_mm, "the focal length is not in its EXIF: lens.focal_length_mm is needed"),
        (exif.f_number, "the aperture is not in its EXIF: lens.f_number is needed"),
        (pitch_um, "nothing tells the size of the sensor: lens.pixel_pitch_um is needed"),
        (sensor_width_px, "nothing tells how many pixels wide the sensor is: lens.sensor_width_px is needed"),
    ):
        if value is None:
            warnings.append(words)
    if exif.is_zoomed:
        warnings.append(
            f"taken with a digital zoom of {exif.zoom:g}: the frame is a part of the sensor's, enlarged, and "
            "lens.pixel_pitch_um that of what it shows"
        )
    if exif.rendering is not None:
        warnings.append(f"its EXIF says {exif.rendering}: take one without, whose blur is the lens'")
    return Draft(
        name=_name(exif),
        description=", ".join(filter(None, (_body(exif), exif.lens))) or None,
        image_width_px=width_px,
        image_height_px=height_px,
        focus_distance_m=_focus_m(exif, warnings),
        lens=LensGuess(exif.focal_length_mm, exif.f_number, pitch_um, sensor_width_px),
        warnings=tuple(warnings),
    )


def _focus_m(exif: Exif, warnings: list[str]) -> float | None:
    distance_m, farthest_m = exif.subject_distance_m, FOCUS_DISTANCES_M[1]
    if distance_m is not None and distance_m >= AS_INFINITY_M:
        at = "infinity" if distance_m == math.inf else f"{distance_m:.10g} m, which is all but infinity,"
        warnings.append(
            f"focused at {at} as the camera reports it, for which {farthest_m:g} m stand: better measure from the "
            "lens to what is sharpest"
        )
        return farthest_m
    if distance_m is None or distance_m < FOCUS_DISTANCES_M[0]:
        warnings.append("its EXIF does not say where the lens was focused: focus_distance_m is needed")
        return None
    warnings.append(
        f"focused at {distance_m:g} m as the camera reports it, which is often coarse{_from_lens(exif, distance_m)}: "
        "better measure from the lens to what is sharpest"
    )
    return distance_m


def _from_lens(exif: Exif, distance_m: float) -> str:
    """What the distance would be from the lens; about that where a lens of its focal length could not be so near."""
    focal_length_m = (exif.focal_length_mm or math.inf) / 1e3
    if focus_m := exif.focus_from_lens_m:
        return f" and counted from the sensor, {focus_m:.4g} m from the lens"
    if distance_m > focal_length_m:
        return (
            f" and counted from the sensor, much less from the lens (at 1:1, {2 * focal_length_m:.4g} m with "
            f"{exif.focal_length_mm:g} mm, or less where the lens shortens it)"
        )
    return ""


def _sensor(exif: Exif, width_px: int, aspect: float, warnings: list[str]) -> tuple[float | None, int | None]:
    """Pitch in µm and width in pixels of the sensor, as if the picture were all of it.

    A picture that says nothing of its width in the camera may be a small copy: then its own width is no sensor's, but
    where it says how wide a pixel is. Where the sensor's width in mm is known any such pair is as good.
    """
    stated_px = _stated_width_px(exif, aspect)
    sensor_width_px = stated_px if stated_px and stated_px >= width_px else None
    if _is_cut(exif, aspect):
        warnings.append(
            f"EXIF says {exif.width_px}x{exif.height_px} pixels, of which this is a part by its shape: k_cam of a part "
            "is wrong, draft from the whole frame"
        )
    elif sensor_width_px not in (None, width_px):
        warnings.append(
            f"EXIF says {sensor_width_px} pixels wide and the file has {width_px}: taken as resized; a crop would "
            "make k_cam wrong"
        )
    if sensor_width_px is None and exif.focal_plane_pitch_um:
        sensor_width_px = width_px
        warnings.append(f"EXIF says how wide a pixel is, not how many there are: taken as the {width_px} of the file")
    width_mm = _sensor_width_mm(exif, sensor_width_px, aspect, warnings)
    if width_mm is None:
        return None, sensor_width_px
    sensor_width_px = sensor_width_px or width_px
    # a zoom enlarges a part of the sensor to as many pixels
    return round(1e3 * width_mm / sensor_width_px / exif.zoom, 4) or None, sensor_width_px


def _is_cut(exif: Exif, aspect: float) -> bool:
    """Whether the picture has another shape than it had in the camera, however it was held."""
    if not exif.width_px or not exif.height_px:
        return False
    stated = exif.width_px / exif.height_px
    return not any(math.isclose(shape, aspect, rel_tol=ASPECT_TOLERANCE) for shape in (stated, 1 / stated))


def _stated_width_px(exif: Exif, aspect: float) -> int | None:
    """The width the picture had in the camera; who turns pixels upright may leave its EXIF as it was."""
    width_px, height_px = exif.width_px, exif.height_px
    if not width_px or not height_px:
        return width_px
    is_turned = math.isclose(height_px / width_px, aspect, rel_tol=ASPECT_TOLERANCE)
    return height_px if is_turned else width_px


def _sensor_width_mm(exif: Exif, sensor_width_px: int | None, aspect: float, warnings: list[str]) -> float | None:
    """The surest width that the roughest agrees with, which follows the lens where a copy's or a list's may not.

    Of a zoomed picture the surest: some equivalents count the zoom, and some do not.
    """
    found = list(_sensor_widths_mm(exif, sensor_width_px, aspect, warnings))
    if not found:
        return None
    roughest_mm = found[0 if exif.is_zoomed else -1][0]
    most = SAME_WIDTH if _is_whole(aspect) else SAME_CUT_WIDTH
    width_mm, told = next(one for one in found if _is_within(most, one[0], roughest_mm))
    if others := ", ".join(f"{other_mm:.3g}" for other_mm, _ in found if not _is_within(most, other_mm, width_mm)):
        warnings.append(
            f"the sensor is taken as {width_mm:.3g} mm wide, where the EXIF or a list of cameras also says {others}: "
            "check lens.pixel_pitch_um"
        )
    if len(found) == 1 and not told:
        warnings.append(
            f"the sensor is taken as {width_mm:.3g} mm wide by the pixel pitch in its EXIF alone, which stays as it "
            "was where a program made the picture smaller: check lens.pixel_pitch_um"
        )
    warnings.extend(told)
    return width_mm


def _is_within(most: float, width_mm: float, other_mm: float) -> bool:
    return max(width_mm, other_mm) <= most * min(width_mm, other_mm)


def _is_whole(aspect: float) -> bool:
    longer = max(aspect, 1 / aspect)
    return any(math.isclose(longer, known, rel_tol=ASPECT_TOLERANCE) for known in SENSOR_ASPECTS)


def _sensor_widths_mm(
    exif: Exif, sensor_width_px: int | None, aspect: float, warnings: list[str]
) -> Iterator[tuple[float, tuple[str, ...]]]:
    """From the pixel pitch, the camera's known crop factor, the two focal lengths, each with what to know of it."""
    if exif.focal_plane_pitch_um and sensor_width_px:
        width_mm = exif.focal_plane_pitch_um * sensor_width_px / 1e3
        if SENSOR_WIDTHS_MM[0] <= width_mm <= SENSOR_WIDTHS_MM[1]:
            yield width_mm, ()
        else:
            warnings.append(f"its EXIF makes the sensor {width_mm:.3g} mm wide, which cannot be, and was not believed")
    longer = max(aspect, 1 / aspect)
    shape = (
        ()
        if _is_whole(aspect)
        else ("the picture is neither 4:3 nor 3:2: the sensor may be larger than the frame it took",)
    )
    crops: list[tuple[float | None, str]] = [
        (
            _known_crop(exif.make or "", exif.model or ""),
            "the sensor's size is that of a crop factor of {:.4g}, from a list of cameras",
        )
    ]
    if exif.focal_length_35mm and exif.focal_length_mm:
        words = (
            f"the sensor's size follows from the 35-mm equivalent, {exif.focal_length_35mm:g} mm for "
            f"{exif.focal_length_mm:g}, which is rounded: k_cam may be off by some percent"
        )
        if exif.focal_length_35mm == exif.focal_length_mm and not math.isclose(longer, 3 / 2, rel_tol=ASPECT_TOLERANCE):
            words += "; focal length and equivalent are the same: a phone's real focal length is a few millimetres"
        if exif.is_zoomed:
            words += (
                f"; it is taken to count the digital zoom of {exif.zoom:g}: where it is that of the whole sensor, "
                "lens.pixel_pitch_um is to be divided by the zoom"
            )
        crops.append((exif.focal_length_35mm / exif.focal_length_mm / exif.zoom, words))
    for crop, words in crops:
        width_mm = FULL_FRAME_DIAGONAL_MM / (crop or math.inf) * aspect / math.hypot(aspect, 1)
        if SENSOR_WIDTHS_MM[0] <= width_mm <= SENSOR_WIDTHS_MM[1]:
            yield width_mm, (words.format(crop), *shape)


@lru_cache(maxsize=256)
def _known_crop(make: str, model: str) -> float | None:
    """The crop factor of a camera in lensfun's list, by its exact names."""
    found = _lensfun().find_cameras(make, model) if make and model else []
    return float(found[0].crop_factor) if found else None


@lru_cache(maxsize=1)
def _lensfun() -> lensfunpy.Database:
    return lensfunpy.Database()


def _body(exif: Exif) -> str:
    """Make and model, the make once: Nikon writes it into both."""
    make, model = exif.make or "", exif.model or ""
    return model if model.lower().startswith(make.lower().partition(" ")[0]) else f"{make} {model}".strip()


def _name(exif: Exif) -> str:
    numbers = ((exif.focal_length_mm, "{:g}mm"), (exif.f_number, "f{:g}"))
    words = [_body(exif) or "camera", *(form.format(round(value, 2)) for value, form in numbers if value)]
    return re.sub(r"[^a-z0-9.]+", "-", " ".join(words).lower()).strip("-.")[:64] or "camera"
