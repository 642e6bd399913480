"""A camera drafted from EXIF: the real focal length or none, and never a number nobody vouches for."""

import math
import random
import re
import struct
from dataclasses import replace
from typing import Any

import pytest

from service.inference.drafting import Draft, draft_camera
from service.inference.exif import Exif, read_exif
from service.inference.headers import read_header
from service.storage.cameras import NAME_PATTERN
from tests.inference.heics import heic
from tests.inference.photographs import (
    ExifValue,
    corners,
    exif_of,
    exif_with_thumbnail,
    jpeg,
    png,
    tiff,
    webp,
    with_exif,
)

MAKE, MODEL = 271, 272
F_NUMBER, FOCAL, SUBJECT, WIDTH, FOCAL_35, ZOOM, LENS = 0x829D, 0x920A, 0x9206, 0xA002, 0xA405, 0xA404, 0xA434
HEIGHT, PLANE_RESOLUTION, PLANE_UNIT, RENDERED = 0xA003, 0xA20E, 0xA210, 0xA401
NIKON = {MAKE: "NIKON CORPORATION", MODEL: "NIKON D200"}
SHOT: dict[int, ExifValue] = {F_NUMBER: (28, 10), FOCAL: (350, 10), FOCAL_35: 52, WIDTH: 3872}
D200 = Exif("NIKON CORPORATION", "NIKON D200", None, 35.0, 52.0, 2.8, None, None, 3872, None, None)


def draft(width_px: int = 3872, height_px: int = 2592, /, **tags: Any) -> Draft:
    return draft_camera(replace(D200, **tags), width_px, height_px)


def said(drafted: Draft, *words: str) -> bool:
    return any(all(word in warning for word in words) for warning in drafted.warnings)


def test_tags_are_read_from_a_jpeg_s_exif() -> None:
    shot = SHOT | {SUBJECT: (2000, 1000), ZOOM: (1, 1), LENS: "35mm f/2", PLANE_RESOLUTION: (4164, 1), PLANE_UNIT: 3}
    found = read_exif(read_header(with_exif(jpeg(corners()), exif_of(NIKON, shot | {HEIGHT: 2592}))).exif)
    assert replace(found, focal_plane_pitch_um=None) == replace(
        D200, lens="35mm f/2", subject_distance_m=2.0, digital_zoom=1.0, height_px=2592
    )
    assert found.focal_plane_pitch_um == pytest.approx(1e4 / 4164)


RENDERINGS = [(0, None), (1, None), (6, "a panorama"), (7, "a portrait mode"), (8, "a portrait mode")]


@pytest.mark.parametrize(("tag", "rendering"), RENDERINGS)
def test_a_phone_s_rendering_is_read_and_said(tag: int, rendering: str | None) -> None:
    found = read_exif(exif_of(NIKON, SHOT | {RENDERED: tag}))
    assert found.rendering == rendering
    assert said(draft_camera(found, 3872, 2592), "its EXIF says", "take one without") == (rendering is not None)


def test_text_is_read_without_control_characters_and_no_more_of_it_than_a_name_has() -> None:
    found = read_exif(exif_of({MAKE: " Ni\x1bkon\n \0left from before", MODEL: "D" * 300}, {LENS: "\x07 "}))
    assert (found.make, found.model, found.lens) == ("Nikon", "D" * 64, None)


@pytest.mark.parametrize("version", [0, 1, 2])
def test_tags_are_read_from_a_heic(version: int) -> None:
    found = read_header(heic(exif=exif_of(NIKON, SHOT), version=version))
    assert read_exif(found.exif) == D200


def test_a_list_of_items_in_a_heic_that_leads_back_to_itself_is_left() -> None:
    endless = heic(exif=exif_of(NIKON, SHOT)).replace(b"infe", b"free")
    for size in range(2):
        stuck = re.sub(rb"....free", struct.pack(">I", size) + b"free", endless, count=1, flags=re.DOTALL)
        assert read_exif(read_header(stuck).exif) == Exif()


@pytest.mark.parametrize("prefix", [b"", b"Exif\x00\x00"])
def test_tags_are_read_from_a_webp_of_either_form(prefix: bytes) -> None:
    found = read_exif(read_header(webp(corners(), exif=prefix + exif_of(NIKON, SHOT))).exif)
    assert found == D200


def test_fractions_with_a_sign_are_read() -> None:
    signed = exif_of({}, {F_NUMBER: (28, 10)}).replace(
        struct.pack("<HH", F_NUMBER, 5), struct.pack("<HH", F_NUMBER, 10)
    )
    assert read_exif(signed).f_number == 2.8


def test_a_place_may_be_told_as_a_directory_s() -> None:
    place = exif_of({}, {F_NUMBER: (28, 10)}).replace(struct.pack("<HH", 0x8769, 4), struct.pack("<HH", 0x8769, 13))
    assert read_exif(place).f_number == 2.8


def test_a_body_is_read_where_nothing_is_noted_of_the_shot() -> None:
    assert read_exif(exif_with_thumbnail(b"")) == Exif(make="Maker")


def test_numbers_with_a_floating_point_are_read() -> None:
    found = read_exif(exif_of({}, {F_NUMBER: 1.8, FOCAL: 35.0, SUBJECT: 2.5, ZOOM: 1.0}))
    assert (found.f_number, found.focal_length_mm, found.subject_distance_m, found.digital_zoom) == (1.8, 35, 2.5, 1)


@pytest.mark.parametrize("data", [jpeg(corners()), png(corners()), tiff(corners()), webp(corners()), heic()])
def test_without_exif_there_are_no_tags(data: bytes) -> None:
    found = read_exif(read_header(data).exif)
    assert read_exif(b"x") == Exif()
    assert (found.make, found.focal_length_mm, found.f_number, found.focal_plane_pitch_um) == (None,) * 4


@pytest.mark.parametrize("value", [(0, 1), (0, 0), (5, 0), (2**32 - 1, 1), (2**32 - 1, 1000)])
def test_a_number_that_means_unknown_is_none(value: tuple[int, int]) -> None:
    shot = {F_NUMBER: value, SUBJECT: value, FOCAL: value, PLANE_RESOLUTION: value}
    found = read_exif(exif_of({}, shot))
    assert (found.f_number, found.focal_length_mm, found.focal_plane_pitch_um) == (None, None, None)
    assert found.subject_distance_m == (math.inf if value[0] == 2**32 - 1 else None)


def test_a_list_of_cameras_knows_the_sensor() -> None:
    drafted = draft()
    assert drafted.lens.pixel_pitch_um == pytest.approx(6.05, rel=0.01)
    assert (drafted.name, drafted.description) == ("nikon-d200-35mm-f2.8", "NIKON D200")
    assert (drafted.lens.focal_length_mm, drafted.lens.f_number, drafted.lens.sensor_width_px) == (35.0, 2.8, 3872)
    assert said(drafted, "crop factor")
    assert said(drafted, "focus_distance_m is needed")
    for words in ("digital zoom", "neither 4:3 nor 3:2", "pitch in its EXIF alone"):
        assert not said(drafted, words)


def test_the_pixel_pitch_of_the_exif_comes_first() -> None:
    drafted = draft(focal_plane_pitch_um=6.05)
    assert drafted.lens.pixel_pitch_um == 6.05
    assert not said(drafted, "crop")


def test_a_pitch_that_nothing_else_agrees_with_is_told() -> None:
    alone: dict[str, Any] = {"model": "Canon EOS R50", "focal_length_35mm": None, "focal_plane_pitch_um": 3.72}
    assert said(draft(2048, 1365, **alone, width_px=2048), "7.62 mm wide by the pixel pitch", "check lens.pixel_pitch")
    for known in ({"focal_length_35mm": 52.0}, {"model": "NIKON D200"}):
        assert not said(draft(**alone | {"focal_plane_pitch_um": 6.05} | known), "pitch in its EXIF alone")
    assert not said(draft(focal_length_35mm=None), "pitch in its EXIF alone")


@pytest.mark.parametrize(
    ("tags", "width_mm"),
    [
        ({"focal_plane_pitch_um": 1.01}, 23.6),
        ({"make": "Nobody", "focal_plane_pitch_um": 15.0}, 23.6),
        ({"focal_plane_pitch_um": 4.0, "focal_length_35mm": None}, 23.6),
        ({"focal_length_35mm": 105.0}, 12.0),
    ],
    ids=["a copy's pitch", "a wrong pitch", "none but pitch and list", "another lens of a phone"],
)
def test_what_the_lens_says_of_the_sensor_is_believed_against_one_other(tags: dict[str, Any], width_mm: float) -> None:
    drafted = draft(**tags)
    assert drafted.lens.pixel_pitch_um == pytest.approx(width_mm * 1e3 / 3872, rel=0.05)
    assert said(drafted, "check lens.pixel_pitch_um")
    assert not said(draft(focal_plane_pitch_um=6.05), "check lens.pixel_pitch_um")


def test_a_picture_whose_pixels_were_turned_is_as_wide_as_it_was_high() -> None:
    turned = draft(2592, 3872, height_px=2592, focal_plane_pitch_um=6.05)
    assert (turned.lens.pixel_pitch_um, turned.lens.sensor_width_px) == (6.05, 2592)
    assert not said(turned, "resized")
    assert not said(turned, "neither 4:3 nor 3:2")
    copy = draft(645, 966, height_px=2592, focal_plane_pitch_um=6.05)
    assert (copy.lens.pixel_pitch_um, copy.lens.sensor_width_px) == (6.05, 2592)


def test_a_square_is_cut_out_of_a_sensor_that_its_lens_is_made_for() -> None:
    square: dict[str, Any] = {"make": "Nobody", "model": None, "width_px": 3024, "height_px": 3024}
    drafted = draft(3024, 3024, **square, focal_length_mm=4.25, focal_length_35mm=26.0, focal_plane_pitch_um=1.4)
    assert (drafted.lens.pixel_pitch_um, said(drafted, "also says")) == (1.4, False)


def test_a_pitch_that_cannot_be_is_not_believed() -> None:
    drafted = draft(focal_plane_pitch_um=300.0)
    assert drafted.lens.pixel_pitch_um == pytest.approx(6.05, rel=0.01)
    assert said(drafted, "cannot be")
    unbelievable = draft(make="Nobody", focal_length_35mm=3500.0)
    assert unbelievable.lens.pixel_pitch_um is None


def test_the_equivalent_tells_the_sensor_but_is_no_focal_length() -> None:
    drafted = draft(make="Nobody", model="Nothing 1")
    assert drafted.lens.pixel_pitch_um == pytest.approx(6.05, rel=0.05)
    assert drafted.lens.focal_length_mm == 35.0
    assert said(drafted, "35-mm equivalent", "rounded")
    alone = draft(make="Nobody", model="Nothing 1", focal_length_mm=None)
    assert (alone.lens.focal_length_mm, alone.lens.pixel_pitch_um) == (None, None)
    assert said(alone, "lens.focal_length_mm is needed")
    assert said(alone, "lens.pixel_pitch_um is needed")


def test_a_list_that_has_another_lens_of_a_phone_does_not_outweigh_its_exif() -> None:
    # the list's crop factor of 6 is no sensor of this phone's main lens, whose pixels are 1.8 um wide
    drafted = draft(
        *(4000, 3000),
        make="samsung",
        model="SM-G991B",
        focal_length_mm=5.4,
        focal_length_35mm=26.0,
        width_px=4000,
        height_px=3000,
    )
    assert drafted.lens.pixel_pitch_um == pytest.approx(1.8, rel=0.01)
    assert said(drafted, "list of cameras also says 5.77")
    assert (drafted.name, drafted.description) == ("samsung-sm-g991b-5.4mm-f2.8", "samsung SM-G991B")


@pytest.mark.parametrize(
    ("size_px", "focal_length_mm", "is_told"),
    [((4000, 3000), 26.0, True), ((3000, 4000), 26.0, True), ((2592, 3872), 26.0, False), ((4000, 3000), 6.8, False)],
    ids=["phone", "held upright", "full frame, upright", "real"],
)
def test_an_equivalent_that_stands_for_the_focal_length_is_told(
    size_px: tuple[int, int], focal_length_mm: float, *, is_told: bool
) -> None:
    exif = Exif(focal_length_mm=focal_length_mm, focal_length_35mm=26.0, f_number=1.8)
    assert said(draft_camera(exif, *size_px), "focal length and equivalent are the same") == is_told


def test_a_digital_zoom_is_taken_out_of_the_equivalent_and_told() -> None:
    zoomed = draft(make="Nobody", model="Nothing 1", focal_length_35mm=104.0, digital_zoom=2.0)
    assert zoomed.lens.pixel_pitch_um == pytest.approx(6.05 / 2, rel=0.05)
    assert said(zoomed, "digital zoom")
    assert said(zoomed, "taken to count the digital zoom of 2", "lens.pixel_pitch_um is to be divided by the zoom")
    assert not said(draft(digital_zoom=2.0, focal_plane_pitch_um=6.05), "taken to count")
    assert not said(draft(make="Nobody", model="Nothing 1"), "taken to count")


@pytest.mark.parametrize("tags", [{}, {"focal_plane_pitch_um": 6.05}, {"focal_plane_pitch_um": 6.05, "width_px": None}])
def test_a_zoomed_picture_s_pixels_are_so_much_smaller_ones_of_the_sensor(tags: dict[str, Any]) -> None:
    whole, zoomed = draft(**tags).lens, draft(digital_zoom=2.0, **tags).lens
    assert zoomed.sensor_width_px == whole.sensor_width_px == 3872
    assert whole.pixel_pitch_um is not None
    assert zoomed.pixel_pitch_um == pytest.approx(whole.pixel_pitch_um / 2, rel=1e-3)
    assert draft(digital_zoom=0.5, **tags).lens == whole  # nothing is zoomed by less than 1


@pytest.mark.parametrize("width_px", [None, 400])
def test_a_sensor_as_wide_as_its_picture_is_drafted_only_where_something_says_so(width_px: int | None) -> None:
    unknown = draft(645, 432, make=None, model=None, focal_length_35mm=None, width_px=width_px)
    assert (unknown.lens.pixel_pitch_um, unknown.lens.sensor_width_px) == (None, None)
    assert said(unknown, "lens.sensor_width_px is needed")
    assert draft(3872, 2592, make=None, model=None, focal_length_35mm=None).lens.sensor_width_px == 3872
    listed = draft(645, 432, width_px=width_px)
    assert listed.lens.pixel_pitch_um == pytest.approx(6.05 * 3872 / 645, rel=0.01)
    assert (listed.lens.sensor_width_px, said(listed, "sensor_width_px is needed")) == (645, False)
    bare: dict[str, Any] = {"make": None, "model": None, "focal_length_35mm": None, "width_px": width_px}
    pitched = draft(645, 432, **bare, focal_plane_pitch_um=6.0)
    assert (pitched.lens.pixel_pitch_um, pitched.lens.sensor_width_px) == (6.0, 645)
    assert said(pitched, "not how many there are: taken as the 645 of the file")


def test_a_file_made_small_belongs_to_the_whole_sensor() -> None:
    for tags in ({}, {"height_px": 2592}, {"focal_plane_pitch_um": 6.05}):
        drafted = draft(645, 432, **tags)
        assert (drafted.image_width_px, drafted.lens.sensor_width_px) == (645, 3872)
        assert drafted.lens.pixel_pitch_um == pytest.approx(6.05, rel=0.01)
        assert said(drafted, "resized")
    assert draft(645, 432, width_px=None, height_px=2592).lens.sensor_width_px == 645


def test_a_part_of_the_frame_is_told_by_its_shape_and_not_taken_for_a_small_copy() -> None:
    stated: dict[str, Any] = {"make": "Apple", "model": None, "width_px": 4032, "height_px": 3024}
    for width_px, height_px in ((2566, 3313), (2000, 3000), (4032, 2268)):
        cut = draft(width_px, height_px, **stated)
        assert said(cut, "4032x3024", "draft from the whole frame")
        assert not said(cut, "resized")
    for width_px, height_px in ((4032, 3024), (3024, 4032), (2016, 1512), (768, 1024), (1000, 751)):
        assert not said(draft(width_px, height_px, **stated), "whole frame")


def test_a_frame_of_another_shape_is_told() -> None:
    assert said(draft(3872, 2178), "neither 4:3 nor 3:2")


def test_where_it_was_focused_is_taken_with_care() -> None:
    drafted = draft(subject_distance_m=1.5)
    assert drafted.focus_distance_m == 1.5
    assert said(drafted, "1.5 m", "coarse")
    assert draft(subject_distance_m=1e-4).focus_distance_m is None
    for far_m, words in ((65.535, "65.535 m, which is all but infinity"), (65535.0, "65535 m"), (1e9, "1000000000 m")):
        far = draft(subject_distance_m=far_m)
        assert far.focus_distance_m == 100_000
        assert said(far, words, "100000 m stand")
    assert draft(subject_distance_m=49.0).focus_distance_m == 49.0
    infinite = draft(subject_distance_m=math.inf)
    assert infinite.focus_distance_m == 100_000
    assert said(infinite, "focused at infinity", "100000 m stand")
    assert not said(infinite, "is needed")


def test_a_ring_counts_from_the_sensor_and_the_draft_says_what_that_is_from_the_lens() -> None:
    assert said(draft(focal_length_mm=35.0, subject_distance_m=2.0), "from the sensor", "1.964 m from the lens")
    assert said(draft(focal_length_mm=100.0, subject_distance_m=0.5), "0.3618 m from the lens")
    macro = draft(focal_length_mm=100.0, subject_distance_m=0.3)
    assert said(macro, "from the sensor, much less from the lens", "at 1:1, 0.2 m with 100 mm")
    for unknown in (draft(focal_length_mm=None, subject_distance_m=2.0), draft(subject_distance_m=0.01)):
        assert not said(unknown, "from the sensor")


def test_without_exif_everything_is_missing_and_named() -> None:
    drafted = draft_camera(Exif(), 640, 480)
    assert (drafted.name, drafted.description) == ("camera", None)
    assert (drafted.image_width_px, drafted.image_height_px, drafted.lens.sensor_width_px) == (640, 480, None)
    needed = ("focal_length_mm", "f_number", "pixel_pitch_um", "sensor_width_px")
    for field in ("focus_distance_m", *(f"lens.{name}" for name in needed)):
        assert said(drafted, f"{field} is needed")


@pytest.mark.parametrize("model", ["🎞", "../../x", "a" * 200, "\x00\x1b[31m", "-.-"])
def test_any_model_makes_a_name(model: str) -> None:
    assert re.fullmatch(NAME_PATTERN, draft_camera(Exif(model=model, f_number=1.8), 4, 3).name)


def test_damaged_exif_harms_nobody() -> None:
    whole = exif_of(NIKON, SHOT)
    draw = random.Random(7)
    for _ in range(300):
        damaged = bytearray(whole)
        for _ in range(draw.randint(1, 12)):
            damaged[draw.randrange(len(whole))] = draw.randrange(256)
        draft_camera(read_exif(bytes(damaged[: draw.randint(1, len(whole))])), 8, 8)


@pytest.mark.parametrize(("unit", "pixels"), [(None, 4198), (2, 4198), (3, 1653), (4, 165), (5, 0.1653)])
def test_a_pixel_is_as_wide_in_every_unit(unit: int | None, pixels: float) -> None:
    tags: dict[int, ExifValue] = {PLANE_RESOLUTION: (round(1e4 * pixels), 10_000)}
    found = read_exif(exif_of({}, tags if unit is None else tags | {PLANE_UNIT: unit}))
    assert found.focal_plane_pitch_um == pytest.approx(6.05, rel=2e-3)


def test_of_no_unit_a_pixel_has_no_width() -> None:
    assert read_exif(exif_of({}, {PLANE_RESOLUTION: (4198, 1), PLANE_UNIT: 1})).focal_plane_pitch_um is None
