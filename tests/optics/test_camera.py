"""The camera: bounds, resizing, refocusing."""

import itertools
import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from service.opencv import cv2
from service.optics import thin_lens
from service.optics.camera import Camera, Intrinsics, Lens

D200 = Lens(focal_length_mm=35, f_number=2.8, pixel_pitch_um=6.05, sensor_width_px=3872)


def camera(**changes: float) -> Camera:
    values: dict[str, Any] = {"image_width_px": 640, "image_height_px": 480, "focus_distance_m": 2.0, "k_cam_px": 3.81}
    return Camera(**(values | changes))


def test_lens_specs_give_k_cam_at_the_images_width() -> None:
    assert D200.k_cam_px(2.0, 645) == pytest.approx(1.5324, rel=1e-3)
    assert D200.k_cam_px(2.0, 3872) == pytest.approx(D200.k_cam_px(2.0, 645) * 3872 / 645)


def test_lens_specs_give_the_field_of_view() -> None:
    assert D200.sensor_width_mm == pytest.approx(23.43, abs=0.01)
    assert D200.fx_px(3872) == pytest.approx(35 / 23.43 * 3872, rel=1e-3)
    assert D200.fx_px(645) == pytest.approx(35 / 23.43 * 645, rel=1e-3)


@pytest.mark.parametrize("name", ["image_width_px", "image_height_px", "focus_distance_m", "k_cam_px"])
@pytest.mark.parametrize("value", [0, -1, math.nan, math.inf])
def test_out_of_bounds_is_refused_by_name(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        camera(**{name: value})


@pytest.mark.parametrize("gamma", [-0.1, math.nan, math.inf])
def test_gamma_is_zero_or_more(gamma: float) -> None:
    with pytest.raises(ValueError, match="gamma_px"):
        camera(gamma_px=gamma)


@pytest.mark.parametrize("focal_length_m", [2.0, 0.0, -0.05])
def test_focal_length_is_positive_and_shorter_than_focus(focal_length_m: float) -> None:
    with pytest.raises(ValueError, match="focal_length_m"):
        camera(focal_length_m=focal_length_m)


def test_resizing_scales_blur_and_leaves_depth() -> None:
    half = camera().resized(320, 240)
    assert half.k_cam_px == pytest.approx(3.81 / 2)
    assert half.gamma_px == pytest.approx(0.25)
    assert half.blur_px(1.0) == pytest.approx(camera().blur_px(1.0) / 2)


def test_resizing_there_and_back_is_nothing() -> None:
    there = Camera(640, 480, 2.0, 3.81, intrinsics=Intrinsics(500, 510, 319.5, 239.5, (0.1, -0.2)))
    back = there.resized(320, 240).resized(640, 480)
    assert back.k_cam_px == pytest.approx(there.k_cam_px)
    assert back.intrinsics is not None
    assert back.intrinsics.cx_px == pytest.approx(319.5)
    assert back.intrinsics.distortion == (0.1, -0.2)


@pytest.mark.parametrize("times", [2, 5])
def test_averaging_areas_leaves_the_rest_of_gamma_and_a_box(times: int) -> None:
    taps, per_pixel = np.array([0.1, 0.2, 0.4, 0.2, 0.1]), 20
    rest = float((taps * np.arange(-2, 3) ** 2).sum())
    points = (np.arange(times * per_pixel) + 0.5) / per_pixel + 5 * times  # all over one pixel of the copy
    squares = np.zeros(len(points))
    for offset, tap in zip(range(-2, 3), taps, strict=True):
        copied = np.floor((np.floor(points) + offset) / times)
        squares += tap * ((copied + 0.5) - points / times) ** 2
    large = camera(gamma_px=math.sqrt(rest + thin_lens.PIXEL_BOX_VARIANCE))
    small = large.averaged(640 // times, 480 // times)
    assert small.gamma_px**2 == pytest.approx(squares.mean(), rel=1e-3)
    assert small.k_cam_px == pytest.approx(3.81 / times)
    assert large.averaged(640, 480) is large


def test_an_axis_in_the_middle_is_between_the_middle_pixels() -> None:
    centred = Intrinsics.centred(500.0, 4, 3)
    assert (centred.cx_px, centred.cy_px) == (1.5, 1.0)


def test_the_centre_of_the_image_stays_its_centre() -> None:
    scaled = Intrinsics(500, 500, 319.5, 239.5).scaled(0.25, 0.25)
    assert (scaled.cx_px, scaled.cy_px) == pytest.approx((79.5, 59.5))


def test_the_same_frame_is_told_from_a_crop() -> None:
    assert camera().is_same_frame(320, 240)
    assert camera().is_same_frame(161, 121)
    assert not camera().is_same_frame(640, 427)
    assert not camera().is_same_frame(480, 640)


def test_one_percent_is_the_most_unless_a_copy_is_so_small_that_it_is_rounded_by_more() -> None:
    frame = Camera(645, 432, 2.0, 1.53)
    assert frame.is_same_frame(645, 436)
    assert not frame.is_same_frame(645, 437)
    assert frame.is_same_frame(30, 20)
    assert not frame.is_same_frame(30, 21)


def test_refocusing_follows_the_lens() -> None:
    known = Camera(645, 432, 2.0, D200.k_cam_px(2.0, 645), focal_length_m=0.035)
    assert known.focused_at(1.0).k_cam_px == pytest.approx(D200.k_cam_px(1.0, 645))
    with pytest.raises(ValueError, match="focal length"):
        known.focused_at(0.03)


def test_refocusing_without_a_focal_length_takes_it_as_short() -> None:
    assert camera().focused_at(1.0).k_cam_px == pytest.approx(2 * 3.81)


@pytest.mark.parametrize("focus_m", [0.0, -1.0, math.nan, math.inf])
def test_no_lens_is_refocused_to_nowhere(focus_m: float) -> None:
    with pytest.raises(ValueError, match="focus"):
        camera().focused_at(focus_m)


def test_range_ends_where_a_quarter_pixel_is_ten_percent() -> None:
    near, far = camera().range_m
    assert near == 0
    assert far == pytest.approx(0.1 * 2.0 * 3.81 / 0.25)


def test_a_lens_that_tilts_tilts_as_its_picture_is_turned() -> None:
    terms = tuple(0.01 * (number + 1) for number in range(14))
    inner = Intrinsics(500, 500, 320, 240, terms)
    assert inner.turned(False, False, False, (640, 480)).distortion == terms
    turned = inner.turned(False, True, True, (640, 480)).distortion
    assert (turned[2:4], turned[12:]) == ((-terms[2], -terms[3]), (-terms[12], -terms[13]))
    assert inner.turned(True, False, False, (480, 640)).distortion[12:] == (-terms[13], -terms[12])


@pytest.mark.parametrize("tilts", [(0.02, 0.0), (0.0, 0.03)])
@pytest.mark.parametrize("turn", [*itertools.product((False, True), repeat=3)])
def test_what_is_seen_is_at_its_place_in_the_turned_picture(
    turn: tuple[bool, bool, bool], tilts: tuple[float, float]
) -> None:
    rational, prism = (-0.2, 0.05, 3e-3, -2e-3, 0.01, 0.02, -0.01, 5e-3), (4e-3, -1e-3, 2e-3, 3e-3)
    upright = Camera(640, 480, 2.0, 3.81, intrinsics=Intrinsics(500, 510, 300, 230, (*rational, *prism, *tilts)))
    points = np.random.default_rng(0).uniform((-0.5, -0.4, 1), (0.5, 0.4, 1), (20, 3))

    def seen(by: Camera) -> NDArray[np.float64]:
        assert by.intrinsics is not None
        matrix, distortion = np.array(by.intrinsics.matrix), np.array(by.intrinsics.distortion)
        shown, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, distortion)
        return np.asarray(shown, np.float64).reshape(-1, 2)

    places, turned, size_px = seen(upright), upright.turned(*turn), np.array((640, 480))
    if turn[0]:
        places, points, size_px = places[:, ::-1], points[:, [1, 0, 2]], size_px[::-1]
    assert (turned.image_width_px, turned.image_height_px, turned.k_cam_px) == (*size_px, 3.81)
    places = np.where(turn[1:], size_px - 1 - places, places)
    points *= (*np.where(turn[1:], -1, 1), 1)
    np.testing.assert_allclose(seen(turned), places, atol=1e-6)


def test_both_axes_follow_their_own_ratio() -> None:
    scaled = Intrinsics(500, 510, 319.5, 239.5).scaled(0.5, 0.25)
    assert (scaled.fx_px, scaled.fy_px) == (250, 127.5)
    assert (scaled.cx_px, scaled.cy_px) == (159.5, 59.5)
    assert (
        Camera(640, 480, 2.0, 3.81, intrinsics=Intrinsics(500, 510, 319.5, 239.5)).resized(320, 120).intrinsics
        == scaled
    )


def test_a_part_of_a_picture_is_seen_where_it_was() -> None:
    part = Camera(640, 480, 2.0, 3.81, intrinsics=Intrinsics(500, 510, 300, 200)).cropped(100, 50, 320, 240)
    assert part == Camera(320, 240, 2.0, 3.81, intrinsics=Intrinsics(500, 510, 200, 150))


def test_a_range_never_begins_beyond_its_end() -> None:
    near, far = Camera(640, 480, 2.0, 0.05, focal_length_m=0.05).range_m
    assert near == far == pytest.approx(0.1 * 2.0 * 0.05 / 0.25)


def test_a_curve_is_drawn_around_focus_beyond_the_range_too_unless_that_is_infinity() -> None:
    assert camera(k_cam_px=0.5).middle_m == 2.0 > camera(k_cam_px=0.5).range_m[1]
    assert camera(k_cam_px=7e-5, focus_distance_m=100_000.0).middle_m == pytest.approx(2.8)


def test_a_thumbnail_is_of_the_same_frame() -> None:
    frame = Camera(645, 432, 2.0, 1.53)
    assert frame.is_same_frame(16, 11)
    assert frame.is_same_frame(20, 13)
