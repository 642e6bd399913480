"""The camera follows its photograph: turned, resized, or refused."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from service.errors import ImageSizeMismatch
from service.inference.exif import Exif
from service.inference.frame import (
    camera_of,
    maybe_another_part,
    maybe_of_another_size,
    maybe_seen_otherwise,
    maybe_wrong_specs,
    taken_otherwise,
)
from service.inference.images import TURNS, Photograph, turned
from service.opencv import cv2
from service.optics import thin_lens
from service.optics.camera import Camera, Intrinsics, Lens

DISTORTION = (-0.1, 0.02, 0.003, -0.005, 0.001, 0.01, 0.002, 0.001, 0.004, -0.003, 0.002, 0.005, 0.09, 0.0)
INTRINSICS = Intrinsics(500.0, 520.0, 300.0, 210.0, DISTORTION)
CAMERA = Camera(640, 480, 2.0, 6.0, 0.5, intrinsics=INTRINSICS)


def photograph(width: int, height: int, orientation: int = 1) -> Photograph:
    """Stored width x height, turned upright."""
    rgb = np.zeros((height, width, 3), np.uint8)
    return Photograph(turned(rgb, orientation), "jpeg", orientation)


def projected(intrinsics: Intrinsics, points: NDArray[np.float64]) -> NDArray[np.float64]:
    matrix = np.array([[intrinsics.fx_px, 0, intrinsics.cx_px], [0, intrinsics.fy_px, intrinsics.cy_px], [0, 0, 1]])
    still = np.zeros(3)
    pixels, _ = cv2.projectPoints(points, still, still, matrix, np.array(intrinsics.distortion))
    return np.asarray(pixels, np.float64)[:, 0]


@pytest.mark.parametrize("orientation", TURNS)
def test_turned_intrinsics_project_the_turned_world_to_the_turned_picture(orientation: int) -> None:
    transposed, flip_u, flip_v = TURNS[orientation]
    points = np.random.default_rng(0).uniform(-1, 1, (40, 3)) + np.array([0, 0, 3])
    pixels = projected(INTRINSICS, points)
    camera, warnings = camera_of(photograph(640, 480, orientation), CAMERA)
    assert warnings == ()
    assert camera.k_cam_px == CAMERA.k_cam_px
    assert camera.intrinsics is not None
    if transposed:
        pixels, points = pixels[:, ::-1].copy(), points[:, [1, 0, 2]]
    if flip_u:
        pixels[:, 0] = camera.image_width_px - 1 - pixels[:, 0]
        points = points * (-1, 1, 1)
    if flip_v:
        pixels[:, 1] = camera.image_height_px - 1 - pixels[:, 1]
        points = points * (1, -1, 1)
    np.testing.assert_allclose(projected(camera.intrinsics, points), pixels, atol=1e-9)


def test_a_landscape_camera_takes_a_phone_held_upright() -> None:
    camera, warnings = camera_of(photograph(4080, 3072, 6), Camera(4080, 3072, 2.0, 1.31, 0.6))
    assert (camera.image_width_px, camera.image_height_px) == (3072, 4080)
    assert camera.k_cam_px == 1.31
    assert warnings == ()


def test_a_camera_registered_by_its_upright_size_takes_it_too() -> None:
    camera, _ = camera_of(photograph(4080, 3072, 6), Camera(3072, 4080, 2.0, 1.31, 0.6))
    assert (camera.image_width_px, camera.image_height_px) == (3072, 4080)


@pytest.mark.parametrize("orientation", [1, 6])
def test_a_resized_frame_scales_the_blur_constants_and_says_so(orientation: int) -> None:
    camera, warnings = camera_of(photograph(320, 240, orientation), CAMERA)
    assert camera.k_cam_px == pytest.approx(3.0)
    assert camera.gamma_px == pytest.approx(thin_lens.gamma_after_shrinking(0.5, 0.5))
    assert camera.gamma_px**2 > thin_lens.PIXEL_BOX_VARIANCE > 0.25**2
    assert "k_cam_px 3" in warnings[0]
    assert f"gamma_px {camera.gamma_px:.4g}" in warnings[0]
    assert "a region that the sensor reads out is a camera of its own" in warnings[0]
    assert "; " not in warnings[0]  # which stands between warnings in the header


def test_a_frame_made_larger_scales_gamma_alike() -> None:
    camera, _ = camera_of(photograph(1280, 960), CAMERA)
    assert (camera.k_cam_px, camera.gamma_px) == pytest.approx((12.0, 1.0))


@pytest.mark.parametrize(
    ("exif", "words"),
    [
        (Exif(focal_length_mm=35.0, f_number=2.8), "its EXIF says 35 mm f/2.8, the camera is 50 mm f/1.2"),
        (Exif(focal_length_mm=50.0, f_number=1.8), "its EXIF says 50 mm f/1.8, the camera is 50 mm f/1.2"),
        (Exif(f_number=1.8), "its EXIF says f/1.8, the camera is 50 mm f/1.2"),
        (Exif(focal_length_mm=53.0), "its EXIF says 53 mm, the camera is 50 mm f/1.2"),
        (Exif(focal_length_mm=35.0), "its EXIF says 35 mm, the camera is 50 mm f/1.2"),
        (Exif(focal_length_mm=52.0, f_number=1.25), ""),
        (Exif(), ""),
    ],
)
def test_a_lens_that_is_not_the_camera_s_is_told(exif: Exif, words: str) -> None:
    fifty = replace(CAMERA, focal_length_m=0.05, f_number=1.2)
    assert " ".join(taken_otherwise(exif, fifty, is_refocused=False)) == words


def test_another_aperture_than_k_cam_holds_at_is_told_where_no_lens_is_known() -> None:
    stopped_down = Exif(focal_length_mm=50.0, f_number=5.6)
    (warning,) = taken_otherwise(stopped_down, replace(CAMERA, f_number=2.0), is_refocused=True)
    assert warning == "its EXIF says 50 mm f/5.6, the camera is f/2"
    for same in (replace(CAMERA, f_number=5.59), CAMERA):
        assert not [*taken_otherwise(stopped_down, same, is_refocused=True)]


def test_a_digital_zoom_is_told_of_whatever_the_camera_was_made_from() -> None:
    for zoom in (1.05, 2.0):
        (warning,) = taken_otherwise(Exif(digital_zoom=zoom), CAMERA, is_refocused=True)
        assert f"digital zoom of {zoom:g}" in warning
    assert not [*taken_otherwise(Exif(digital_zoom=1.0), CAMERA, is_refocused=True)]


@pytest.mark.parametrize(
    ("size_px", "equivalent_mm", "tags", "is_another"),
    [
        ((5712, 4284), 24, {}, False),
        ((5712, 3213), 24, {}, False),
        ((4284, 4284), 24, {}, False),
        ((5712, 4284), 48, {}, True),
        ((5712, 4284), 12, {}, True),
        ((5712, 4284), 48, {"digital_zoom": 2.0}, False),
        ((5712, 4284), 120, {"focal_length_mm": 15.7}, False),
        ((5712, 4284), 13, {"focal_length_mm": 2.2}, False),
        ((5712, 4284), 24, {"focal_length_mm": None}, False),
        ((5712, 4284), None, {}, False),
    ],
    ids=[
        "whole",
        "16:9",
        "square",
        "2x",
        "whole, by a 2x",
        "zoom that is told",
        "longer lens",
        "wider lens",
        "no lens",
        "no word",
    ],
)
def test_a_part_of_the_sensor_that_no_zoom_tells_of_is_known_by_its_field_of_view(
    size_px: tuple[int, int], equivalent_mm: float | None, tags: dict[str, Any], *, is_another: bool
) -> None:
    seen = Intrinsics.centred(3961.0, *size_px)
    camera = Camera(*size_px, 0.5, 3.8, focal_length_m=0.006765, intrinsics=seen)
    exif = replace(Exif(focal_length_mm=6.765, focal_length_35mm=equivalent_mm), **tags)
    for one in (camera, camera.resized(size_px[0] // 2, size_px[1] // 2)):
        assert len([*maybe_another_part(exif, one)]) == is_another
    assert not [*maybe_another_part(exif, replace(camera, intrinsics=None))]


@pytest.mark.parametrize(("focal_length_mm", "is_another"), [(50.0, False), (24.0, True), (70.0, True), (None, False)])
def test_a_zoom_of_a_calibrated_camera_is_known_by_what_a_pixel_measures(
    focal_length_mm: float | None, *, is_another: bool
) -> None:
    calibrated = Camera(6000, 4000, 2.0, 30.0, intrinsics=Intrinsics.centred(8360.0, 6000, 4000))
    exif = Exif(focal_length_mm=focal_length_mm, width_px=6000, height_px=4000, focal_plane_pitch_um=5.98)
    for camera in (calibrated, calibrated.resized(1500, 1000)):
        assert len([*maybe_another_part(exif, camera)]) == is_another
    for unknown in ({"width_px": None}, {"height_px": None}, {"focal_plane_pitch_um": None}):
        assert not [*maybe_another_part(replace(exif, **unknown), calibrated)]
    resized = replace(exif, focal_length_mm=50.0, focal_plane_pitch_um=1.5)  # by a program that left the pitch
    assert not [*maybe_another_part(resized, replace(calibrated, focal_length_m=0.05))]
    assert not [*maybe_another_part(resized, replace(calibrated, focus_distance_m=0.05))]  # no 50 mm lens is so near


def test_a_lens_focused_close_may_see_less_than_its_equivalent_tells() -> None:
    macro = Exif(focal_length_mm=100.0, focal_length_35mm=100.0)
    at_half_size = Camera(6000, 4000, 0.3, 300.0, intrinsics=Intrinsics.centred(25_000.0, 6000, 4000))
    assert not [*maybe_another_part(macro, at_half_size)]
    assert [*maybe_another_part(macro, replace(at_half_size, focus_distance_m=5.0))]


def test_a_portrait_mode_is_told_of() -> None:
    (warning,) = taken_otherwise(Exif(rendering="a portrait mode"), CAMERA, is_refocused=True)
    assert "portrait mode" in warning


@pytest.mark.parametrize(
    ("noted_m", "focal_length_mm", "is_other"),
    [
        (0.5, 35.0, True),
        (1.8, 35.0, False),
        (2.2, None, False),
        (2.4, None, True),
        (None, 35.0, False),
        (0.6, 100.0, True),
        (2.35, 100.0, False),  # 2.24 m from the lens
        (65535.0, 35.0, True),
        (math.inf, 35.0, True),
        (math.inf, None, True),
    ],
)
def test_another_focus_than_the_camera_s_is_told_of_unless_it_came_with_the_photograph(
    noted_m: float | None, focal_length_mm: float | None, *, is_other: bool
) -> None:
    exif = Exif(focal_length_mm=focal_length_mm, subject_distance_m=noted_m)
    said = [*taken_otherwise(exif, CAMERA, is_refocused=False)]
    assert len(said) == is_other
    noted = "infinity" if noted_m == math.inf else f"{noted_m:.5g} m" if noted_m else ""
    assert all(f"focused at {noted}, the camera at 2 m" in words for words in said)
    assert not [*taken_otherwise(exif, CAMERA, is_refocused=False, is_found=True)]


@pytest.mark.parametrize(
    ("noted_m", "is_other"), [(0.5, True), (0.95, True), (1.1, False), (3.9, False), (4.1, True), (math.inf, False)]
)
def test_a_focus_that_came_with_the_photograph_need_only_be_about_what_it_notes(
    noted_m: float, *, is_other: bool
) -> None:
    said = [*taken_otherwise(Exif(focal_length_mm=4.0, subject_distance_m=noted_m), CAMERA, is_refocused=True)]
    assert len(said) == is_other
    assert all("focus_distance_m is 2 m: it counts in metres, of dioptres the reciprocal" in words for words in said)


def test_infinity_agrees_with_any_focus_that_no_ring_has_a_figure_for() -> None:
    infinite = Exif(focal_length_mm=50.0, subject_distance_m=math.inf)
    for focus_m, is_other in ((30.0, True), (50.0, False), (1e5, False)):
        for noted in (infinite, replace(infinite, subject_distance_m=65.535)):
            assert len([*taken_otherwise(noted, CAMERA.focused_at(focus_m), is_refocused=False)]) == is_other
    assert [*taken_otherwise(Exif(subject_distance_m=2.0), CAMERA.focused_at(1e5), is_refocused=False)]


@pytest.mark.parametrize(
    ("noted_m", "from_lens_m", "is_other"),
    [(0.31, 0.2, False), (0.31, 0.15, False), (0.31, 0.4, True), (0.5, 0.42, False), (0.5, 0.3, True)],
)
def test_a_macro_lens_may_be_as_much_nearer_than_its_sensor_as_it_is_long(
    noted_m: float, from_lens_m: float, *, is_other: bool
) -> None:
    macro = Exif(focal_length_mm=105.0, subject_distance_m=noted_m)
    assert len([*taken_otherwise(macro, CAMERA.focused_at(from_lens_m), is_refocused=False)]) == is_other


@pytest.mark.parametrize("is_refocused", [False, True])
@pytest.mark.parametrize(
    ("noted_m", "focal_length_mm", "told_m", "from_lens"),
    [
        (0.45, 50.0, 0.45, "0.3927 m"),
        (0.45, 50.0, 0.393, None),
        (0.7, 50.0, 0.7, None),  # 0.65 m from the lens
        (2.0, 35.0, 2.0, None),
        (0.31, 105.0, 0.31, "0.21 m"),  # of 1:1: a thin lens forms no image of what is so near to the sensor
        (0.31, 105.0, 0.2, None),
        (0.1, 6.81, 0.1, None),
        (0.45, None, 0.45, None),
        (math.inf, 50.0, 1e5, None),
    ],
)
def test_a_focus_told_as_the_camera_noted_it_close_up_counts_from_the_sensor(
    noted_m: float, focal_length_mm: float | None, told_m: float, from_lens: str | None, *, is_refocused: bool
) -> None:
    exif = Exif(focal_length_mm=focal_length_mm, subject_distance_m=noted_m)
    said = [*taken_otherwise(exif, CAMERA.focused_at(told_m), is_refocused=is_refocused)]
    assert [words.endswith(f"from the lens, as it is to be, that is about {from_lens}") for words in said] == (
        [True] if from_lens else []
    )
    assert not [*taken_otherwise(exif, CAMERA.focused_at(told_m), is_refocused=is_refocused, is_found=True)]


@pytest.mark.parametrize(
    ("focus_distance_m", "focal_length_m", "known_at_m", "words"),
    [
        (0.2, 0.05, None, "1.33 times"),
        (0.06, 0.025, None, "1.71 times"),
        (0.8, 0.05, None, "1.07 times"),
        (1.2, 0.05, None, ""),
        (0.2, None, None, ""),
        (0.2, 0.05, 0.2, ""),
        (0.2, 0.05, 2.0, "at 2 m: in one that moves as a whole it is 1.3 times that, and points lie as much near"),
        (2.0, 0.05, 0.2, "at 0.2 m: in one that moves as a whole it is 0.769 times that, and points lie as much far"),
        (2.0, 0.05, 0.6, "0.94 times"),
        (2.0, 0.05, 0.8, ""),
    ],
)
def test_a_focal_length_that_focus_elsewhere_changes_is_told_of(
    focus_distance_m: float, focal_length_m: float | None, known_at_m: float | None, words: str
) -> None:
    camera = Camera(640, 480, focus_distance_m, 40.0, focal_length_m=focal_length_m)
    said = [*maybe_seen_otherwise(camera, known_at_m)]
    assert len(said) == bool(words)
    assert all(words in warning for warning in said)


@pytest.mark.parametrize(
    ("width", "height", "advice"),
    [
        (640, 400, "not a crop.*region that the sensor reads out"),
        (480, 640, "the original"),
        (240, 320, "the original"),
        (641, 300, "not a crop"),
    ],
)
def test_another_frame_is_refused_with_both_sizes(width: int, height: int, advice: str) -> None:
    with pytest.raises(ImageSizeMismatch, match=rf"{width}x{height}.*640x480.*{advice}"):
        camera_of(photograph(width, height), CAMERA)


@pytest.mark.parametrize(
    ("focus_m", "is_told"), [(2.0, False), (30.0, False), (130.0, True), (1300.0, True), (1e5, False)]
)
def test_a_focus_distance_that_may_be_in_millimetres_is_told(focus_m: float, *, is_told: bool) -> None:
    _, warnings = camera_of(photograph(640, 480), CAMERA.focused_at(focus_m))
    assert [f"focused at {focus_m:g} m" in words for words in warnings] == [True] * is_told
    _, warnings = camera_of(photograph(320, 240), CAMERA.focused_at(focus_m))
    assert any(f"focused at {focus_m:g} m" in words for words in warnings) == is_told


@pytest.mark.parametrize(
    ("pitch_um", "width_px", "is_told"),
    [
        (6.0, 6000, False),
        (5.3, 8256, False),
        (1.0, 600, False),
        (6.0, 36, True),
        (6.0, 36_000, True),
        (0.06, 6000, True),
    ],
    ids=["full frame", "medium format", "endoscope", "width in mm", "width in um", "pitch of another unit"],
)
def test_specs_that_make_no_sensor_are_told(pitch_um: float, width_px: int, *, is_told: bool) -> None:
    said = [*maybe_wrong_specs(Lens(35.0, 1.4, pitch_um, width_px), replace(CAMERA, intrinsics=None))]
    assert ["which hardly can be" in words for words in said] == [True] * is_told


@pytest.mark.parametrize(
    ("lens", "focus_m", "fx_px", "is_told"),
    [
        (Lens(6.81, 1.85, 2.4, 4080), 0.5, 2860.0, False),
        (Lens(25.0, 1.85, 2.4, 4080), 0.5, 2860.0, True),
        (Lens(6.81, 1.85, 1.2, 4080), 0.5, 2860.0, True),
        (Lens(6.81, 1.85, 2.4, 3072), 0.5, 2860.0, True),
        (Lens(100.0, 2.8, 6.0, 6000), 0.2, 23_000.0, False),
        (Lens(100.0, 2.8, 6.0, 6000), 5.0, 23_000.0, True),
    ],
    ids=["its lens", "equivalent", "unbinned pitch", "short side", "macro at 1:1", "far away"],
)
def test_a_lens_and_intrinsics_of_two_fields_of_view_are_told(
    lens: Lens, focus_m: float, fx_px: float, *, is_told: bool
) -> None:
    size_px = (lens.sensor_width_px, 3000) if lens.focal_length_mm > 50 else (4080, 3072)
    camera = Camera(*size_px, focus_m, 3.8, intrinsics=Intrinsics.centred(fx_px, *size_px))
    said = [*maybe_wrong_specs(lens, camera)]
    assert [f"{fx_px:.0f} by intrinsics" in words for words in said] == [True] * is_told
    assert not [*maybe_wrong_specs(lens, replace(camera, intrinsics=None))]
    assert not [*maybe_wrong_specs(None, camera)]


@pytest.mark.parametrize(("ratio", "is_told"), [(1.0, False), (1.06, False), (0.7, True), (1.5, True), (6.0, True)])
def test_intrinsics_of_another_size_are_told_by_where_their_axis_is(ratio: float, *, is_told: bool) -> None:
    calibrated = Intrinsics.centred(900.0, 1280, 960).scaled(ratio, ratio)
    said = [*maybe_of_another_size(Camera(1280, 960, 2.0, 3.8, intrinsics=calibrated))]
    assert [f"({calibrated.cx_px:.4g}, " in words and "of 1280x960" in words for words in said] == [True] * is_told
    assert not [*maybe_of_another_size(CAMERA)]
    assert not [*maybe_of_another_size(replace(CAMERA, intrinsics=None))]


@pytest.mark.parametrize("off_px", [(170, 0), (-170, 0), (0, 130), (0, -130)])
def test_an_axis_an_eighth_off_the_middle_one_way_is_told(off_px: tuple[int, int]) -> None:
    camera = Camera(1280, 960, 2.0, 3.8, intrinsics=Intrinsics.centred(900.0, 1280, 960))
    for part, is_told in ((0.85, False), (1.0, True)):
        left, top = (round(part * px) for px in off_px)
        cropped = camera.cropped(left, top, 1280, 960)
        assert len([*maybe_of_another_size(cropped)]) == is_told


@pytest.mark.parametrize(
    ("size_px", "sensor_width_px", "is_told"),
    [((3072, 4080), 4080, True), ((3072, 4080), 3072, False), ((4080, 3072), 4080, False), ((3000, 3000), 3000, False)],
)
def test_a_sensor_s_long_side_as_the_width_of_tall_images_is_told(
    size_px: tuple[int, int], sensor_width_px: int, *, is_told: bool
) -> None:
    said = [*maybe_wrong_specs(Lens(6.81, 1.85, 2.4, sensor_width_px), Camera(*size_px, 0.5, 3.8))]
    assert ["short side" in words for words in said] == [True] * is_told
