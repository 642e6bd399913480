"""Every form of the answer is read back to the numbers it was made of."""

import io
import json
from dataclasses import replace
from typing import Any
from zipfile import ZipFile

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from service.errors import BadRequest
from service.inference.depth_map import DepthMap, Layers
from service.inference.encode import (
    ENCODERS,
    MEDIA_TYPES,
    Beside,
    encode_npy,
    encode_npz,
    encode_ply,
    encode_png,
    encode_preview,
    encode_tiff,
)
from service.inference.figures import read_point, spread_of
from service.inference.png import grey_png
from service.inference.preview import render_preview
from service.inference.resampling import Lines
from service.opencv import cv2
from service.optics.camera import Camera, Intrinsics

CAMERA = Camera(40, 30, 2.0, 6.0, intrinsics=Intrinsics(50.0, 52.0, 19.5, 14.5))
RGB = np.random.default_rng(1).integers(0, 255, (30, 40, 3), np.uint8)
BESIDE = Beside(RGB)
COLOURS = ["red", "green", "blue"]


@pytest.fixture
def answer() -> DepthMap:
    depth_m = np.linspace(0.5, 4.0, 1200, dtype=np.float32).reshape(30, 40)
    depth_m[0, 0] = np.nan
    alt_m = np.where(depth_m > 3, np.nan, depth_m * 2).astype(np.float32)
    ones = np.ones_like(depth_m)
    layers = Layers(depth_m, alt_m, ones * np.float32(0.75), depth_m * np.float32(0.1), ones)
    return DepthMap(
        depth_m=depth_m,
        valid=np.isfinite(depth_m),
        layers_at=lambda lines: Layers(*(lines.of(getattr(layers, name)) for name in Layers.__slots__)),
        camera=CAMERA,
        scales=(1.0,),
        warnings=(),
        timings_ms={},
    )


def read_png(body: bytes) -> NDArray[np.uint16]:
    pixels = cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_UNCHANGED)
    assert pixels is not None
    assert pixels.dtype == np.uint16
    return np.asarray(pixels, np.uint16)


def read_ply(body: bytes) -> NDArray[Any]:
    """The points, laid out as the header says."""
    head, _, stored = body.partition(b"end_header\n")
    lines = [line.split() for line in head.decode("ascii").splitlines()]
    kinds = {"float": "<f4", "uchar": "u1"}
    points = np.frombuffer(stored, [(words[2], kinds[words[1]]) for words in lines if words[0] == "property"])
    assert lines[:2] == [["ply"], ["format", "binary_little_endian", "1.0"]]
    assert ["element", "vertex", str(len(points))] in lines
    return points


def test_png_holds_millimetres_and_zero_for_no_answer(answer: DepthMap) -> None:
    encoded = encode_png(answer, BESIDE)
    pixels = read_png(encoded.body)
    assert encoded.depth_scale_m == 0.001
    assert pixels[0, 0] == 0
    np.testing.assert_allclose(pixels[answer.valid] * 0.001, answer.depth_m[answer.valid], atol=0.00051)


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (5, 1), (37, 53)])
def test_another_reader_finds_every_level_in_the_png(size: tuple[int, int]) -> None:
    levels = np.random.default_rng(0).integers(0, 2**16, size, np.uint16)
    np.testing.assert_array_equal(read_png(grey_png(levels)), levels)


def test_png_has_no_answer_beyond_what_it_can_hold_and_says_so(answer: DepthMap) -> None:
    answer.depth_m[5, 5] = 65.535
    answer.depth_m[5, 6] = 70.0
    answer.depth_m[5, 7] = np.inf
    encoded = encode_png(answer, BESIDE)
    np.testing.assert_array_equal(read_png(encoded.body)[5, 5:8], (65535, 0, 0))
    assert "65.535 m" in encoded.warnings[0]


def test_png_says_where_a_millimetre_is_coarse(answer: DepthMap) -> None:
    said = "nine tenths of the depths lie within 8 mm, and a 16-bit PNG holds whole millimetres"
    for nearest_m, relief_m, is_coarse in ((0.06, 0.01, True), (0.06, 0.1, False), (2.0, 0.01, False)):
        answer.depth_m[:] = np.linspace(nearest_m, nearest_m + relief_m, 1200).reshape(30, 40)
        warnings = encode_png(answer, BESIDE).warnings
        assert [warning.startswith(said) for warning in warnings] == [True] * is_coarse
    answer.valid[:] = False
    assert encode_png(answer, BESIDE).warnings == ()


def test_npy_and_tiff_hold_the_very_floats(answer: DepthMap) -> None:
    for pixels in (
        np.load(io.BytesIO(encode_npy(answer, BESIDE).body), allow_pickle=False),
        tifffile.imread(io.BytesIO(encode_tiff(answer, BESIDE).body)),
    ):
        assert pixels.dtype == np.float32
        np.testing.assert_array_equal(pixels, answer.depth_m)


def test_npz_holds_all_maps_and_the_camera_matrix(answer: DepthMap) -> None:
    with np.load(io.BytesIO(encode_npz(answer, BESIDE).body), allow_pickle=False) as stored:
        assert set(stored) == {"depth_m", "depth_alt_m", "p_near", "sigma_m", "blur_px", "valid", "K"}
        np.testing.assert_array_equal(stored["depth_alt_m"], answer.depth_alt_m)
        np.testing.assert_array_equal(stored["valid"], answer.valid)
        np.testing.assert_array_equal(stored["K"], [[50, 0, 19.5], [0, 52, 14.5], [0, 0, 1]])


def test_an_npz_holds_the_maps_that_are_asked_for_and_the_camera_matrix(answer: DepthMap) -> None:
    def never(_: Lines) -> Layers:
        raise AssertionError("nothing of the layers was asked for")

    unread = replace(answer, layers_at=never)
    body = encode_npz(unread, Beside(RGB, ("valid", "depth_m", "depth_m"))).body
    with np.load(io.BytesIO(body)) as stored:
        assert set(stored) == {"depth_m", "valid", "K"}
        np.testing.assert_array_equal(stored["depth_m"], answer.depth_m)


def test_files_say_what_they_were_made_by_and_in_which_unit(answer: DepthMap) -> None:
    origin = {"camera": "bench", "revision": 3, "warnings": ["40 m, \xe9"] * 100}
    beside = Beside(RGB, origin=origin)
    in_metres, in_millimetres = {**origin, "depth_scale_m": 1.0}, {**origin, "depth_scale_m": 0.001}
    text = encode_png(answer, beside).body.partition(b"tEXtDescription\0")[2].decode("latin-1")
    assert json.JSONDecoder().raw_decode(text)[0] == in_millimetres
    with tifffile.TiffFile(io.BytesIO(encode_tiff(answer, beside).body)) as tiff:
        assert json.loads(tiff.pages.first.description) == in_metres
    with ZipFile(io.BytesIO(encode_npz(answer, beside).body)) as archive:
        assert json.loads(archive.comment) == in_metres
    comments = encode_ply(answer, beside).body.partition(b"element")[0].decode("ascii").splitlines()[2:]
    assert {'comment camera: "bench"', "comment revision: 3", "comment depth_scale_m: 1.0"} <= set(comments)
    assert all(line.startswith("comment ") and len(line) < 256 for line in comments)


def test_gdal_is_told_that_nan_is_no_answer_in_a_tiff(answer: DepthMap) -> None:
    with tifffile.TiffFile(io.BytesIO(encode_tiff(answer, BESIDE).body)) as tiff:
        assert tiff.pages.first.tags["GDAL_NODATA"].value == "nan"


def test_unknown_intrinsics_are_nan_in_npz_and_no_point_cloud(answer: DepthMap) -> None:
    blind = replace(answer, camera=replace(CAMERA, intrinsics=None))
    with np.load(io.BytesIO(encode_npz(blind, BESIDE).body)) as stored:
        assert np.isnan(stored["K"]).sum() == 4
    with pytest.raises(BadRequest, match="focal length"):
        encode_ply(blind, BESIDE)


def test_nothing_seen_is_a_cloud_without_points(answer: DepthMap) -> None:
    blank = replace(answer, valid=np.zeros_like(answer.valid))
    cloud = encode_ply(blank, BESIDE)
    assert b"element vertex 0\n" in cloud.body
    assert not cloud.warnings


def test_ply_points_project_back_to_their_pixels(answer: DepthMap) -> None:
    points = read_ply(encode_ply(answer, BESIDE).body)
    assert len(points) == 1199
    v, u = np.nonzero(answer.valid)
    np.testing.assert_allclose(points["x"] / points["z"] * 50 + 19.5, u, atol=1e-3)
    np.testing.assert_allclose(points["y"] / points["z"] * 52 + 14.5, v, atol=1e-3)
    np.testing.assert_array_equal(points[COLOURS].tolist(), RGB[v, u])


def test_points_of_a_smaller_map_look_where_the_photograph_s_pixels_do_and_have_their_colours(answer: DepthMap) -> None:
    points = read_ply(encode_ply(answer.shrunk(16), BESIDE).body)
    assert len(points) == 16 * 12
    # a pixel of it is two and a half of the photograph's
    v, u = (lines.ravel() * 2.5 + 0.75 for lines in np.indices((12, 16)))
    np.testing.assert_allclose(points["x"] / points["z"] * 50 + 19.5, u, atol=1e-3)
    np.testing.assert_allclose(points["y"] / points["z"] * 52 + 14.5, v, atol=1e-3)
    row, column = (np.floor(place + 0.5).astype(int) for place in (v, u))
    np.testing.assert_array_equal(points["z"], answer.depth_m[row, column])
    np.testing.assert_array_equal(points[COLOURS].tolist(), RGB[row, column])


def test_points_leave_the_lens_distortion_out(answer: DepthMap) -> None:
    distortion = (-0.2, 0.05, 1e-3, -2e-3, 0.01)
    bent = replace(answer, camera=replace(CAMERA, intrinsics=Intrinsics(50.0, 52.0, 19.5, 14.5, distortion)))
    points = read_ply(encode_ply(bent, BESIDE).body)
    matrix = np.array([[50.0, 0, 19.5], [0, 52.0, 14.5], [0, 0, 1]])
    places, _ = cv2.projectPoints(
        np.stack([points[axis] for axis in "xyz"], 1).astype(np.float64),
        np.zeros(3),
        np.zeros(3),
        matrix,
        np.array(distortion),
    )
    v, u = np.nonzero(bent.valid)
    np.testing.assert_allclose(np.asarray(places)[:, 0], np.stack([u, v], 1), atol=0.01)
    with np.load(io.BytesIO(encode_npz(bent, BESIDE).body)) as stored:
        np.testing.assert_array_equal(stored["distortion"], distortion)


def test_points_of_a_large_picture_leave_distortion_out_without_a_search_for_each(
    answer: DepthMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    size, terms = (240, 320), (-0.2, 0.05, 1e-3, -1e-3, 0)
    lens = Intrinsics(400.0, 405.0, 170.0, 110.0, terms)
    valid = np.ones(size, np.bool_)
    valid[::7] = False
    large = replace(
        answer,
        depth_m=np.linspace(0.5, 3, valid.size, dtype=np.float32).reshape(size),
        valid=valid,
        camera=Camera(320, 240, 1.0, 6.0, intrinsics=lens),
    )
    sought: list[int] = []
    undistort = cv2.undistortPoints

    def counting(places: Any, *others: Any, **options: Any) -> Any:
        sought.append(len(places))
        return undistort(places, *others, **options)

    monkeypatch.setattr(cv2, "undistortPoints", counting)
    points = read_ply(encode_ply(large, Beside(np.zeros((*size, 3), np.uint8))).body)
    assert sum(sought) < valid.size / 4
    ahead = np.stack([points[axis] for axis in "xyz"], 1).astype(np.float64)
    places = cv2.projectPoints(ahead, np.zeros(3), np.zeros(3), np.array(lens.matrix), np.array(terms))[0][:, 0]
    off = np.hypot(*(places - np.stack(np.nonzero(valid)[::-1], 1)).T)
    assert off.max() <= 0.012


@pytest.mark.parametrize(("cx_px", "cy_px"), [(-10.0, 14.5), (49.0, 14.5), (5.0, -15.0), (34.0, 44.0)])
def test_what_no_ray_is_distorted_to_is_no_point(answer: DepthMap, cx_px: float, cy_px: float) -> None:
    # this lens' polynomial turns back at 1.05 of a focal length from the middle: 27 px of its picture
    lens = Intrinsics(38.0, 38.0, cx_px, cy_px, (-0.3, 0, 0, 0, 0))
    folding = replace(answer, camera=replace(CAMERA, intrinsics=lens))
    told = encode_ply(folding, BESIDE)
    points = read_ply(told.body)
    ahead = np.stack([points[axis] / points["z"] for axis in "xyz"], 1).astype(np.float64)
    matrix = np.array([[38.0, 0, cx_px], [0, 38.0, cy_px], [0, 0, 1]])
    places = cv2.projectPoints(ahead, np.zeros(3), np.zeros(3), matrix, np.array(lens.distortion))[0][:, 0]
    is_point = np.zeros(answer.valid.shape, np.bool_)
    is_point[tuple(np.rint(places.T[::-1]).astype(int))] = True
    np.testing.assert_allclose(places, np.rint(places), atol=0.2)
    v, u = np.indices(is_point.shape)
    from_middle = np.hypot(u - cx_px, v - cy_px)
    assert not is_point[from_middle > 27].any()
    assert is_point[(from_middle < 15) & answer.valid].all()
    left_out = 1 - len(points) / np.count_nonzero(answer.valid)
    assert told.warnings == (
        f"{left_out:.1%} of the points are left out: by the camera's distortion no ray meets the sensor there",
    )


def test_all_that_a_wide_lens_sees_is_a_point(answer: DepthMap) -> None:
    # its polynomial never turns back, and the middle of the picture is far from its corners
    wide = replace(
        answer, camera=replace(CAMERA, intrinsics=Intrinsics(20.0, 20.0, 19.5, 14.5, (-0.29, 0.08, 0, 0, 0)))
    )
    told = encode_ply(wide, BESIDE)
    assert told.warnings == ()
    assert f"element vertex {np.count_nonzero(answer.valid)}\n".encode() in told.body


def test_points_in_the_middle_alone_are_found_though_a_lens_bends_much_beside_them(answer: DepthMap) -> None:
    in_the_middle = np.zeros_like(answer.valid)
    in_the_middle[12:16, 16:20] = True
    bent = replace(CAMERA, intrinsics=Intrinsics(38.0, 38.0, 19.5, 14.5, (-0.3, 0, 0, 0, 0)))
    told = encode_ply(replace(answer, valid=in_the_middle, camera=bent), BESIDE)
    assert b"element vertex 16\n" in told.body


def test_preview_is_near_red_far_blue_and_grey_without_an_answer(answer: DepthMap) -> None:
    answer.depth_m[:8, :8] = np.nan
    pixels = cv2.imdecode(np.frombuffer(encode_preview(answer, BESIDE).body, np.uint8), cv2.IMREAD_COLOR_RGB)
    assert pixels is not None
    assert pixels.shape == (30, 40, 3)
    nothing, near, far = (pixels[v, u].astype(int) for v, u in ((3, 3), (3, 30), (27, 20)))
    assert np.ptp(nothing) < 16
    assert near[0] > near[2]
    assert far[2] > far[0]


def test_a_preview_s_legend_has_the_near_end_at_the_left_and_each_label_at_its_end() -> None:
    parts = np.linspace(-0.05, 1.05, 400 * 600, dtype=np.float32).clip(0, 1).reshape(400, 600)
    # of the same colours: all that differs is the far end's label
    pixels, farther = (render_preview((far_m**parts).astype(np.float32)).astype(int) for far_m in (2.0, 8.0))
    bar = pixels[400 - 8 - 3, 8 : 8 + 200]
    assert bar[4, 0] > bar[4, 2]
    assert bar[-5, 2] > bar[-5, 0]
    rows, columns = np.nonzero(np.abs(farther - pixels).max(2) > 40)
    assert 380 > rows.min() > 360
    assert 8 + 200 >= columns.max() > columns.min() > 8 + 100


@pytest.mark.parametrize("level", [np.nan, 1.5])
def test_preview_of_nothing_or_of_one_depth_is_a_picture_too(answer: DepthMap, level: float) -> None:
    flat = replace(answer, depth_m=np.full((200, 220), level, np.float32))
    assert encode_preview(flat, BESIDE).body.startswith(b"\xff\xd8\xff")


def test_every_format_states_its_media_type(answer: DepthMap) -> None:
    assert {name: encode(answer, BESIDE).media_type for name, encode in ENCODERS.items()} == MEDIA_TYPES


def test_spread_is_that_of_the_pixels_with_an_answer(answer: DepthMap) -> None:
    spread = spread_of(answer)
    known = answer.depth_m[answer.valid]
    assert spread.min == pytest.approx(known.min())
    assert spread.median == pytest.approx(np.median(known))
    assert spread.max == pytest.approx(4.0)
    nothing = spread_of(replace(answer, valid=np.zeros((30, 40), np.bool_)))
    assert (nothing.min, nothing.p5, nothing.median, nothing.p95, nothing.max) == (None,) * 5


def test_a_point_is_read_at_the_pixel_whose_area_holds_it(answer: DepthMap) -> None:
    for u, v in ((12, 7), (11.5, 6.5), (12.49, 7.49)):
        assert read_point(answer, u, v).depth_m == pytest.approx(float(answer.depth_m[7, 12]))
    assert read_point(answer, 12, 7).sigma_m == pytest.approx(float(answer.sigma_m[7, 12]))
    assert read_point(answer, 0, 0).depth_m is None
    assert read_point(answer, 39, 29).depth_alt_m is None


@pytest.mark.parametrize(("u", "v"), [(40, 0), (0, 30), (-1, 0), (39.5, 0), (-0.51, 0)])
def test_a_point_outside_is_refused(answer: DepthMap, u: float, v: float) -> None:
    with pytest.raises(BadRequest, match=r"\(0, 0\) to \(40, 30\)"):
        read_point(answer, u, v)
