"""The door for photographs: what is let in comes out upright and whole, what is not is refused early."""

import resource
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from service.errors import InvalidImage, TooLarge, UnsupportedKind
from service.inference.exif import Exif, read_exif
from service.inference.headers import MOST_PARTS, MOST_SCANS, read_header
from service.inference.images import TURNS, ImageLimits, photographs_in, read_photograph, read_stored_frame
from service.opencv import cv2
from tests.inference.photographs import (
    ExifValue,
    Order,
    corners,
    encoded,
    exif_block,
    exif_of,
    hostile_png,
    jpeg,
    png,
    png_chunk,
    tiff,
    tiff_with,
    webp,
    with_exif,
)

MAKERS: dict[str, Callable[..., bytes]] = {"jpeg": jpeg, "png": png, "tiff": tiff, "webp": webp}
# corners as they must appear upright: top left, top right, bottom left, bottom right
UPRIGHT = {1: "rgbw", 2: "grwb", 3: "wbgr", 4: "bwrg", 5: "rbgw", 6: "brwg", 7: "wgbr", 8: "gwrb"}
COLOURS = {"r": (255, 0, 0), "g": (0, 255, 0), "b": (0, 0, 255), "w": (255, 255, 255)}
FOCAL, APERTURE = 0x920A, 0x829D

IN_LITTLE_MEMORY = """
import resource, sys
from pathlib import Path
import numpy as np
from service.inference.artifact import load_model_folder
from service.inference.cancellation import Cancellation
from service.inference.images import read_photograph
from service.inference.session import Graph
from tests.inference.photographs import jpeg

folder = load_model_folder(Path(sys.argv[1]))
graph = Graph(folder.blur_graph, folder.manifest.graphs.blur, 1)
data = jpeg(np.zeros((3000, 4000, 3), np.uint8))
feeds = {name: np.zeros((1, 3, 2000, 2000), np.float32) for name in graph.input_names}
size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (size + 2_000_000, resource.RLIM_INFINITY))
for what, work in (("decoding", lambda: read_photograph(data)), ("running", lambda: graph.run(feeds, Cancellation()))):
    try:
        work()
    except MemoryError:
        print(what)
"""


@pytest.mark.parametrize("orientation", TURNS)
@pytest.mark.parametrize("kind", MAKERS)
def test_orientation_is_applied_exactly_once(kind: str, orientation: int) -> None:
    photograph = read_photograph(MAKERS[kind](corners(), orientation))
    turned = orientation >= 5
    assert photograph.rgb.shape == ((64, 48, 3) if turned else (48, 64, 3))
    assert (photograph.kind, photograph.orientation) == (kind, orientation)
    rgb = photograph.rgb.astype(int)
    found = (rgb[4, 4], rgb[4, -5], rgb[-5, 4], rgb[-5, -5])
    for pixel, letter in zip(found, UPRIGHT[orientation], strict=True):
        assert np.abs(pixel - COLOURS[letter]).max() <= 6


@pytest.mark.parametrize("orientation", TURNS)
@pytest.mark.parametrize("kind", MAKERS)
def test_the_stored_frame_is_as_the_sensor_had_it(kind: str, orientation: int) -> None:
    stored = read_stored_frame(MAKERS[kind](corners(), orientation)).rgb
    np.testing.assert_array_equal(stored, read_photograph(MAKERS[kind](corners())).rgb)


def test_the_stored_frame_has_the_same_limits() -> None:
    with pytest.raises(TooLarge, match="64x48"):
        read_stored_frame(png(corners()), ImageLimits(max_pixels=64 * 48 - 1))
    with pytest.raises(InvalidImage, match="empty"):
        read_stored_frame(b"")
    with pytest.raises(UnsupportedKind):
        read_stored_frame(b"hello, world")


@pytest.mark.parametrize("orientation", [0, 9, 65535])
def test_an_orientation_that_exif_does_not_know_is_none(orientation: int) -> None:
    assert read_photograph(jpeg(corners(), orientation)).orientation == 1


@pytest.mark.parametrize("order", ["<", ">"])
def test_both_byte_orders_are_read(order: Order) -> None:
    assert read_header(jpeg(corners(), 6, order)).orientation == 6
    photograph = read_photograph(tiff(corners(), 6, order))
    assert photograph.rgb.shape == (64, 48, 3)
    np.testing.assert_array_equal(photograph.rgb[0, 0], (0, 0, 255))


@pytest.mark.parametrize("kind", MAKERS)
def test_the_header_states_the_decoded_size(kind: str) -> None:
    data = MAKERS[kind](corners(33, 71))
    header = read_header(data)
    assert (header.width_px, header.height_px) == (71, 33)
    assert read_photograph(data).rgb.shape == (33, 71, 3)


def test_lossy_webp_is_read() -> None:
    assert read_photograph(encoded(".webp", corners(), 64, 80)).rgb.shape == (48, 64, 3)


@pytest.mark.parametrize("kind", [".png", ".tiff"])
def test_sixteen_bits_are_scaled_and_not_cut(kind: str) -> None:
    deep = np.random.default_rng(0).integers(0, 65535, (50, 60, 3), np.uint16, endpoint=True)
    deep[0, 0] = (65535, 32896, 0)
    rgb = read_photograph(encoded(kind, deep)).rgb
    np.testing.assert_array_equal(rgb[0, 0], (255, 128, 0))
    assert np.abs(rgb - deep / 257).max() <= 0.5


@pytest.mark.parametrize(("kind", "bits"), [(".png", 14), (".png", 12), (".tiff", 12), (".png", 10)])
def test_ten_to_fourteen_bits_in_a_file_of_sixteen_are_no_dark_picture(kind: str, bits: int) -> None:
    most = 2**bits - 1
    ramp = np.linspace(0, most, 48 * 64).round().astype(np.uint16).reshape(48, 64)
    for pixels in (ramp, np.dstack([ramp] * 3)):
        photograph = read_photograph(encoded(kind, pixels))
        assert np.abs(photograph.rgb[..., 0] - ramp / most * 255).max() <= 0.51
        assert [*photograph.warnings] == [f"nothing in its 16 bits is above {most}: read as {bits} bits, and as sRGB"]
        np.testing.assert_array_equal(read_stored_frame(encoded(kind, pixels)).rgb, photograph.rgb)
    brighter = ramp.copy()
    brighter[0, 0] = 16384
    for pixels, brightest in ((brighter, 64), (np.zeros_like(ramp), 0)):
        photograph = read_photograph(encoded(kind, pixels))
        assert (photograph.rgb.max(), photograph.warnings) == (brightest, ())
    assert read_photograph(encoded(kind, np.full_like(ramp, 255))).rgb.max() == 16  # a lens cap's


def test_grey_becomes_rgb() -> None:
    grey = np.full((10, 12), 77, np.uint8)
    np.testing.assert_array_equal(read_photograph(encoded(".png", grey)).rgb[3, 3], (77, 77, 77))


def half_transparent(kind: str, dtype: type[np.uint8 | np.uint16]) -> bytes:
    """``corners()`` whose upper half is two thirds transparent."""
    most = int(np.iinfo(dtype).max)
    alpha = np.full((48, 64, 1), most, np.dtype(dtype))
    alpha[:24] = most // 3
    rgba = np.dstack([corners().astype(dtype) * (most // 255), alpha])
    if kind == ".avif":
        body = BytesIO()
        Image.fromarray(rgba).save(body, "AVIF", quality=95, subsampling="4:4:4", speed=10)
        return body.getvalue()
    lossless = (cv2.IMWRITE_WEBP_QUALITY, 101) if kind == ".webp" else ()
    data = encoded(kind, rgba, *lossless)
    return tiff_with(data, {338: (3, 1, 2)}) if kind == ".tiff" else data


@pytest.mark.parametrize(
    ("kind", "dtype"),
    [(".png", np.uint8), (".png", np.uint16), (".webp", np.uint8), (".tiff", np.uint16), (".avif", np.uint8)],
)
def test_what_is_transparent_is_hidden(kind: str, dtype: type[np.uint8 | np.uint16]) -> None:
    photograph = read_photograph(half_transparent(kind, dtype))
    assert photograph.hidden is not None
    assert photograph.hidden[:24].all()
    assert not photograph.hidden[24:].any()
    assert np.abs(photograph.rgb.astype(int) - corners()).max() < (20 if kind == ".avif" else 1)


def test_what_is_transparent_in_a_lossy_webp_or_a_tiff_of_planes_is_hidden() -> None:
    rgba = np.dstack([corners(), np.full((48, 64), 255, np.uint8)])
    rgba[:24, :, 3] = 0
    planes = BytesIO()
    form: dict[str, Any] = {"photometric": "rgb", "planarconfig": "separate", "extrasamples": ["unassalpha"]}
    tifffile.imwrite(planes, np.moveaxis(rgba, 2, 0), metadata=None, **form)
    for data in (encoded(".webp", rgba, cv2.IMWRITE_WEBP_QUALITY, 90), planes.getvalue()):
        hidden = read_photograph(data).hidden
        assert hidden is not None
        np.testing.assert_array_equal(hidden, rgba[..., 3] == 0)


def test_alpha_that_hides_nothing_or_all_of_it_says_nothing() -> None:
    for rgba in (np.dstack([corners(), np.full((48, 64), alpha, np.uint8)]) for alpha in (0, 200, 255)):
        photograph = read_photograph(encoded(".png", rgba))
        assert photograph.hidden is None
        np.testing.assert_array_equal(photograph.rgb, corners())


def test_too_little_memory_is_no_damage_to_a_file_or_a_graph(tiny_model_dir: Path) -> None:
    done = subprocess.run([sys.executable, "-c", IN_LITTLE_MEMORY, tiny_model_dir], check=False, capture_output=True)
    assert done.stdout.split() == [b"decoding", b"running"], done.stderr


def test_what_is_transparent_is_turned_along_and_not_overexposed() -> None:
    rgba = np.dstack([np.full((48, 64, 3), 255, np.uint8), np.zeros((48, 64), np.uint8)])
    rgba[:, :16] = (90, 90, 90, 255)
    photograph = read_photograph(png(rgba, orientation=6))
    assert photograph.hidden is not None
    assert not photograph.hidden[:16].any()
    assert photograph.hidden[16:].all()
    assert photograph.warnings == ()


@pytest.mark.parametrize(("transparency", "is_hidden"), [(3, True), (bytes([255]), False)])
def test_a_palette_s_transparent_colours_are_hidden(transparency: int | bytes, *, is_hidden: bool) -> None:
    out = BytesIO()
    picture = Image.fromarray(corners()).quantize(4)
    picture.save(out, "PNG", transparency=transparency)
    hidden = read_photograph(out.getvalue()).hidden
    assert (hidden is not None) == is_hidden
    assert hidden is None or hidden.sum() == (np.asarray(picture) == 3).sum()


@pytest.mark.parametrize("kept", [0.05, 0.5, 0.9, 0.99])
@pytest.mark.parametrize("kind", MAKERS)
def test_a_file_that_is_cut_off_is_refused(kind: str, kept: float) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8)
    data = MAKERS[kind](noise)
    with pytest.raises(InvalidImage, match=kind):
        read_photograph(data[: int(len(data) * kept)])


@pytest.mark.parametrize("layout", [{"rowsperstrip": 16}, {"tile": (16, 16)}])
def test_a_tiff_whose_directory_comes_first_is_refused_where_its_last_part_is_cut_off(layout: dict[str, Any]) -> None:
    out = BytesIO()
    tifffile.imwrite(out, corners(), photometric="rgb", compression="zlib", metadata=None, **layout)
    data = out.getvalue()
    assert read_photograph(data).width_px == 64
    with pytest.raises(InvalidImage, match="ends before the picture"):
        read_photograph(data[:-1])


@pytest.mark.parametrize("kind", MAKERS)
def test_no_prefix_of_a_file_gets_past_the_door(kind: str) -> None:
    data = MAKERS[kind](corners(16, 16), 6)
    for length in range(4, len(data) - 5):
        with pytest.raises((InvalidImage, UnsupportedKind)):
            read_photograph(data[:length])


def test_a_file_that_ends_in_zeros_is_refused() -> None:
    data = jpeg(corners())
    with pytest.raises(InvalidImage):
        read_photograph(data[: len(data) // 2] + bytes(len(data) // 2))


@pytest.mark.parametrize(("width", "height"), [(0, 48), (64, 0)])
def test_a_picture_without_pixels_is_no_picture(width: int, height: int) -> None:
    data = png(corners())
    header = png_chunk(b"IHDR", struct.pack(">II", width, height) + data[24:29])
    with pytest.raises(InvalidImage, match=f"{width}x{height}"):
        read_photograph(data[:8] + header + data[33:])


def test_a_damaged_png_is_refused() -> None:
    data = bytearray(png(corners()))
    data[60] ^= 1
    with pytest.raises(InvalidImage, match="checksum"):
        read_photograph(bytes(data))


@pytest.mark.parametrize(("level", "share", "is_told"), [(255, 0.3, True), (255, 0.2, False), (250, 0.4, False)])
def test_a_picture_much_of_which_is_white_is_told(level: int, share: float, *, is_told: bool) -> None:
    picture = np.full((400, 40, 3), 90, np.uint8)
    picture[: round(400 * share)] = level
    picture[200:] = (255, 255, 0)  # a colour is none
    warnings = read_photograph(png(picture)).warnings
    assert [f"{100 * share:.0f} % of it is overexposed" in words for words in warnings] == [True] * is_told


@pytest.mark.parametrize(("quality", "is_told"), [(98, False), (75, False), (74, True), (60, True), (30, True)])
def test_a_jpeg_too_coarse_for_metres_is_told(quality: int, *, is_told: bool) -> None:
    data = jpeg(corners(), quality=quality)
    assert read_header(data).quality == pytest.approx(quality, abs=0.3)
    told = [words for words in read_photograph(data).warnings if f"a jpeg of quality {quality}, below the 75" in words]
    assert len(told) == is_told
    assert len(read_photograph(data).warnings) == is_told


@pytest.mark.parametrize(("quality", "is_told"), [(100, False), (90, False), (80, False), (75, True), (30, True)])
def test_a_webp_too_coarse_for_metres_is_told(quality: int, *, is_told: bool) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (96, 128, 3), np.uint8)
    data = encoded(".webp", cv2.GaussianBlur(noise, (0, 0), 2), cv2.IMWRITE_WEBP_QUALITY, quality)
    found = read_header(data).quality
    assert found is not None
    assert quality - 15 < found < quality + 1
    warnings = [f"a webp of quality {found:.0f}, below the 76 that metres need: send what the camera stored"] * is_told
    assert [*read_photograph(data).warnings] == warnings
    assert read_header(webp(corners())).quality is None


def test_the_quality_of_a_jpeg_with_steps_of_16_bits_is_that_of_its_luminance() -> None:
    data = jpeg(corners(), quality=40)
    at = data.index(b"\xff\xdb")
    steps = data[at + 5 : at + 69]
    wide = b"\xff\xdb" + struct.pack(">HB64H", 131, 0x10, *steps)
    assert read_header(data[:at] + wide + data[at:]).quality == pytest.approx(40, abs=0.3)


def test_exif_and_xmp_of_a_jpeg_are_told_apart_in_either_order() -> None:
    data, xmp = jpeg(corners(), 6), b"http://ns.adobe.com/xap/1.0/\0<x:xmpmeta/>"
    segment = b"\xff\xe1" + struct.pack(">H", len(xmp) + 2) + xmp
    for at in (2, data.index(b"\xff\xdb")):
        header = read_header(data[:at] + segment + data[at:])
        assert (header.orientation, header.xmp) == (6, xmp)


def test_the_parts_of_a_jpeg_may_have_another_order_and_markers_nothing_behind_them() -> None:
    data = jpeg(corners())
    start = data.index(b"\xff\xc0")
    frame = data[start : start + 2 + int.from_bytes(data[start + 2 : start + 4], "big")]
    ordered = data.replace(frame, b"", 1).replace(b"\xff\xda", b"\xff\x01" + frame + b"\xff\xda", 1)
    np.testing.assert_array_equal(read_photograph(ordered).rgb, read_photograph(data).rgb)
    with pytest.raises(InvalidImage, match="no marker"):
        read_photograph(data[:start] + b"x" + data[start:])


def test_what_stands_behind_the_end_of_a_jpeg_does_no_harm() -> None:
    assert read_photograph(jpeg(corners()) + b"a maker's trailer").rgb.shape == (48, 64, 3)


@pytest.mark.parametrize("data", [b"hello, world", b"%PDF-1.7", b"GIF89a" + bytes(50), b"\x00" * 100, b"RIFF"])
def test_bytes_that_are_no_listed_kind_are_refused(data: bytes) -> None:
    with pytest.raises(UnsupportedKind, match="This is not a JPEG"):
        read_photograph(data, "image/jpeg")


@pytest.mark.parametrize(
    "data",
    [b"FUJIFILMCCD-RAW 0201", b"IIRO\x08\0\0\0", b"MMOR\0\0\0\x08", b"IIU\0\x18\0\0\0", b"\0\0\0\x18ftypcrx \0\0\0\1"],
)
def test_a_raw_file_of_a_kind_that_is_not_read_is_told_what_to_become(data: bytes) -> None:
    with pytest.raises(UnsupportedKind, match="convert it to DNG"):
        read_photograph(data)


def test_an_empty_body_is_refused() -> None:
    with pytest.raises(InvalidImage, match="empty"):
        read_photograph(b"", "image/jpeg")


def test_a_raw_file_is_known_by_its_maker_s_mark_or_version_where_its_values_are_not_named() -> None:
    size, version = struct.pack("<HHIIHHII", 256, 4, 1, 64, 257, 4, 1, 48), struct.pack("<HHII", 50706, 1, 4, 0x401)
    for mark, entries in ((b"CR\x02\x00", size), (bytes(4), size + version)):
        data = b"II*\x00\x0c\x00\x00\x00" + mark + struct.pack("<H", len(entries) // 12) + entries + bytes(4)
        header = read_header(data)
        assert (header.kind, header.width_px, header.height_px) == ("raw", 64, 48)


@pytest.mark.parametrize("declared", ["text/plain", "application/json", "image/gif", "image/svg+xml"])
def test_a_declared_type_that_is_not_listed_is_refused(declared: str) -> None:
    with pytest.raises(UnsupportedKind, match="image/jpeg"):
        read_photograph(jpeg(corners()), declared)


def test_the_bytes_decide_and_a_wrong_declaration_is_told() -> None:
    photograph = read_photograph(png(corners()), "image/jpeg; charset=binary")
    assert photograph.kind == "png"
    assert len(photograph.warnings) == 1
    for declared in (None, "image/png", "application/octet-stream", "IMAGE/PNG"):
        assert read_photograph(png(corners()), declared).warnings == ()


def test_a_tiff_of_floating_point_numbers_is_refused() -> None:
    with pytest.raises(UnsupportedKind, match="floating"):
        read_photograph(encoded(".tiff", np.ones((8, 8, 3), np.float32)))


@pytest.mark.parametrize(
    ("form", "said"),
    [
        ({"photometric": "rgb", "planarconfig": "separate"}, "one colour after the other"),
        ({"photometric": "miniswhite"}, "0 is white"),
    ],
)
def test_a_tiff_of_16_bits_that_the_decoder_takes_for_another_is_refused(form: dict[str, Any], said: str) -> None:
    colours = np.linspace(0, 65535, 24 * 32 * 3).astype(np.uint16).reshape(24, 32, 3)
    pixels = np.moveaxis(colours, 2, 0) if "planarconfig" in form else colours[..., 0]
    out = BytesIO()
    tifffile.imwrite(out, pixels, metadata=None, **form)
    with pytest.raises(UnsupportedKind, match=said):
        read_photograph(out.getvalue())
    interleaved, one_by_one = (struct.pack("<HHIH", 284, 3, 1, order) for order in (1, 2))
    grey = encoded(".tiff", colours[..., 0])
    assert interleaved in grey
    assert read_photograph(grey.replace(interleaved, one_by_one)).width_px == 32  # of one colour that means nothing


def test_bytes_and_pixels_are_limited_before_decoding() -> None:
    with pytest.raises(TooLarge, match="bytes"):
        read_photograph(png(corners()), limits=ImageLimits(max_bytes=50))
    with pytest.raises(TooLarge, match="64x48"):
        read_photograph(png(corners()), limits=ImageLimits(max_pixels=64 * 48 - 1))
    assert read_photograph(png(corners()), limits=ImageLimits(max_pixels=64 * 48)).width_px == 64


@pytest.mark.parametrize("kind", MAKERS)
def test_a_picture_that_is_a_line_is_refused(kind: str) -> None:
    for height, width in ((2, 21), (21, 2)):
        with pytest.raises(TooLarge, match="10 to 1"):
            read_photograph(MAKERS[kind](corners(height, width)))
    assert read_photograph(MAKERS[kind](corners(2, 20))).width_px == 20
    assert read_photograph(MAKERS[kind](corners(2, 21)), limits=ImageLimits(max_aspect=10.5)).width_px == 21


def test_scans_that_cost_a_pass_each_are_limited() -> None:
    data = encoded(".jpg", corners(), cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
    last = data[data.rindex(b"\xff\xda") : -2]
    assert read_photograph(data).width_px == 64
    with pytest.raises(InvalidImage, match="scans"):
        read_photograph(data[:-2] + last * MOST_SCANS + data[-2:])


def test_parts_without_end_are_limited_and_cheap() -> None:
    empty = {"jpeg": b"\xff\xe5\x00\x02", "png": png_chunk(b"teXt", b""), "webp": b"none" + bytes(4)}
    webp_chunks = b"WEBP" + empty["webp"] * 2_000_000
    files = {
        "jpeg": b"\xff\xd8" + empty["jpeg"] * 4_000_000,
        "png": png(corners())[:33] + empty["png"] * 1_500_000,
        "webp": b"RIFF" + len(webp_chunks).to_bytes(4, "little") + webp_chunks,
    }
    for kind, data in files.items():
        with pytest.raises(InvalidImage, match=f"{kind} file has more than {MOST_PARTS} parts"):
            read_photograph(data)
    assert read_photograph(jpeg(corners()).replace(b"\xff\xda", b"\xff" * 1_000_000 + b"\xda", 1)).width_px == 64


def test_a_tile_far_larger_than_its_picture_is_refused() -> None:
    out = BytesIO()
    tifffile.imwrite(out, corners(), photometric="rgb", tile=(16, 16), compression="zlib", metadata=None)
    data = out.getvalue()
    assert read_photograph(data).width_px == 64
    entry, larger = (struct.pack("<HHII", 323, 4, 1, rows) for rows in (16, 8_000_000))
    assert entry in data
    with pytest.raises(InvalidImage, match="16x8000000"):
        read_photograph(data.replace(entry, larger))


def test_entries_and_values_of_a_tiff_without_end_are_refused() -> None:
    data = tiff(corners())
    entries = data[: int.from_bytes(data[4:8], "little")] + b"\xff\xff" + bytes(12 * 65_535 + 4)
    values = tiff_with(data + bytes(200_000), {330: (1, 200_000, 8)})
    for hostile, said in ((entries, "65535 entries"), (values, "200000 values")):
        with pytest.raises(InvalidImage, match=said):
            read_photograph(hostile)
    long = struct.pack("<H", 4_096) + bytes(12 * 4_096)
    often = data + long + struct.pack("<I", len(data)) * 20_000
    started_s = time.process_time()
    assert read_photograph(tiff_with(often, {330: (4, 20_000, len(data + long))})).width_px == 64
    assert time.process_time() - started_s < 1


def test_bytes_that_many_parts_of_a_tiff_share_are_decoded_for_none() -> None:
    data = tiff(np.zeros((1000, 1000, 3), np.uint8)) + bytes(2000)
    own, shared = (7, 1000, 8), (7, len(data) - 8, 8)  # decoders keep a copy of a tag that they do not know
    assert read_photograph(tiff_with(data, {60_000: own, 60_001: own})).width_px == 1000
    before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InvalidImage, match="larger than the file"):
        read_photograph(tiff_with(data, dict.fromkeys(range(60_000, 60_200), shared)))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kb < 100_000


def test_strips_of_a_tiff_share_no_bytes() -> None:
    out = BytesIO()
    tifffile.imwrite(out, corners(), photometric="rgb", rowsperstrip=1, metadata=None)
    data = out.getvalue()
    assert read_photograph(data).width_px == 64
    first, *others = tifffile.TiffFile(BytesIO(data)).pages[0].dataoffsets
    shared = data.replace(struct.pack("<48I", first, *others), struct.pack("<48I", *[first] * 48))
    larger = shared.replace(struct.pack("<48H", *[64 * 3] * 48), struct.pack("<48H", *[64 * 3 * 48] * 48))
    assert data != shared != larger
    with pytest.raises(InvalidImage, match="larger than the file"):
        read_photograph(larger)


def test_of_a_tag_that_comes_twice_the_first_counts_as_it_does_to_the_decoder() -> None:
    twice = tiff_with(tiff(corners()), {256: (4, 1, 9_000), 257: (4, 1, 9_000)})
    assert read_photograph(twice).rgb.shape == (48, 64, 3)


def test_a_png_is_decoded_without_what_is_no_part_of_its_picture(capfd: pytest.CaptureFixture[str]) -> None:
    plain = png(corners())
    forged = png_chunk(b"iCCP", b"x\nFORGED\0\0" + zlib.compress(np.random.default_rng(0).bytes(500)))
    unpacked = png_chunk(b"zTXt", b"x\0\0" + zlib.compress(bytes(7_000_000), 9)) * 1_000
    started_s = time.process_time()
    photograph = read_photograph(plain[:33] + forged + unpacked + plain[33:])
    assert time.process_time() - started_s < 1
    np.testing.assert_array_equal(photograph.rgb, read_photograph(plain).rgb)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("mode", ["P", "L", "RGB", "RGBA", "1"])
def test_a_png_looks_the_same_without_what_is_no_part_of_its_picture(mode: str) -> None:
    out = BytesIO()
    told = {"transparency": 0} if mode in ("P", "L") else {}
    gamma = PngInfo()
    gamma.add(b"gAMA", struct.pack(">I", 100_000))
    Image.fromarray(corners()).convert(mode).save(out, "PNG", pnginfo=gamma, **told)
    seen = cv2.imdecode(np.frombuffer(out.getvalue(), np.uint8), cv2.IMREAD_COLOR_RGB)
    np.testing.assert_array_equal(read_photograph(out.getvalue()).rgb, seen)


def test_a_small_file_of_a_huge_picture_costs_no_memory() -> None:
    data = hostile_png()
    assert len(data) < 300_000
    before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(TooLarge, match="20000x20000"):
        read_photograph(data, "image/png")
    grown_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kb
    assert grown_kb < 20_000


@pytest.mark.parametrize("value", [(358, 10), 35.8])
def test_what_the_lens_was_set_to_is_read_from_every_kind_of_file(value: ExifValue) -> None:
    exif = exif_of({}, {FOCAL: value, APERTURE: (28, 10)})
    chunked = png(corners())[:33] + png_chunk(b"eXIf", exif) + png(corners())[33:]
    for data in (with_exif(jpeg(corners()), exif), webp(corners(), exif=exif), chunked):
        assert read_photograph(data).exif == Exif(focal_length_mm=35.8, f_number=2.8)
    assert read_photograph(jpeg(corners())).exif == Exif()


@pytest.mark.parametrize("value", [(0, 1), (0, 0), (5, 0), -1.0, float("nan"), float("inf"), "35"])
def test_a_setting_that_is_no_number_is_not_told(value: ExifValue) -> None:
    data = with_exif(jpeg(corners()), exif_of({}, {FOCAL: value, APERTURE: value}))
    assert read_photograph(data).exif == Exif()


def test_what_the_lens_was_set_to_is_read_at_once_and_no_damage_stops_it() -> None:
    exif = exif_of({271: "x" * 40, 272: "y" * 40}, {FOCAL: 35.0, APERTURE: 2.8})
    started = time.perf_counter()
    for _ in range(100):
        assert read_exif(exif) == Exif("x" * 40, "y" * 40, focal_length_mm=35.0, f_number=2.8)
    assert time.perf_counter() - started < 0.1
    picture = jpeg(corners())
    for length in range(len(exif)):
        read_exif(exif[:length])
        assert read_header(with_exif(picture, exif[:length])).orientation == 1


def icc_profile(**tags: bytes) -> bytes:
    """An ICC profile of these tags, its head empty."""
    listed, held = b"", b""
    for name, content in tags.items():
        listed += struct.pack(">4sII", name.encode(), 132 + 12 * len(tags) + len(held), len(content))
        held += content
    return bytes(128) + struct.pack(">I", len(tags)) + listed + held


P3 = icc_profile(rXYZ=bytes(20), rTRC=b"para" + bytes(4) + b"\x00\x03\x00\x00\x00\x02\x66\x66" + bytes(16))
ADOBE_RGB = icc_profile(rTRC=b"curv" + bytes(4) + b"\x00\x00\x00\x01\x02\x33")
PROFILES = {
    "linear light": [
        icc_profile(rXYZ=bytes(20), rTRC=b"curv" + bytes(8)),
        icc_profile(rTRC=b"curv" + bytes(4) + b"\x00\x00\x00\x01\x01\x00"),
        icc_profile(rTRC=b"para" + bytes(8) + b"\x00\x01\x00\x00"),
        icc_profile(kTRC=b"curv" + bytes(8)),
        icc_profile(kTRC=b"curv" + bytes(8)) + bytes(100_000),  # of several parts in a jpeg
        icc_profile(rTRC=b"curv" + bytes(4) + b"\x00\x00\x00\x02\x00\x00\xff\xff"),
    ],
    "HDR by PQ": [
        icc_profile(rTRC=b"curv" + bytes(4) + b"\x00\x00\x04\x00", cicp=b"cicp" + bytes(4) + b"\x09\x10\0\1")
    ],
    "HDR by HLG": [icc_profile(cicp=b"cicp" + bytes(4) + b"\x09\x12\0\1")],
    "": [P3, ADOBE_RGB, P3[:140], P3[:100], icc_profile(cicp=b"cicp"), b"x"],
}


@pytest.mark.parametrize("kind", ["jpeg", "png", "tiff", "webp"])
@pytest.mark.parametrize(("curve", "profile"), [(curve, each) for curve, some in PROFILES.items() for each in some])
def test_a_profile_far_from_srgb_is_told_of_and_not_measured_by(kind: str, curve: str, profile: bytes) -> None:
    out = BytesIO()
    Image.fromarray(corners()).save(out, kind, icc_profile=profile)
    said = [words for words in read_photograph(out.getvalue()).warnings if f"{curve}, and it was read as sRGB" in words]
    assert len(said) == bool(curve)
    if curve:
        with pytest.raises(UnsupportedKind, match=curve):
            read_stored_frame(out.getvalue())
    else:
        assert read_stored_frame(out.getvalue()).rgb.shape == (48, 64, 3)


def test_a_png_s_number_of_its_curve_counts_before_its_profile() -> None:
    for number, curve in ((16, "HDR by PQ"), (18, "HDR by HLG"), (13, None)):
        coded = png_chunk(b"cICP", bytes([9, number, 0, 1]))
        profile = png_chunk(b"iCCP", b"x\0\0" + zlib.compress(PROFILES["linear light"][0]))
        data = png(corners())
        assert read_header(data[:33] + coded + profile + data[33:]).other_curve == curve
    for damaged in (b"", b"x", b"x\0\0", b"x\0\0abc"):
        assert read_header(data[:33] + png_chunk(b"iCCP", damaged) + data[33:]).other_curve is None


def test_a_png_s_gamma_counts_where_nothing_else_tells_its_curve() -> None:
    data, linear = png(corners()), png_chunk(b"gAMA", (100_000).to_bytes(4, "big"))
    usual, srgb = png_chunk(b"gAMA", (45_455).to_bytes(4, "big")), png_chunk(b"sRGB", b"\0")
    profile = png_chunk(b"iCCP", b"x\0\0" + zlib.compress(P3))
    for parts, curve in ((linear, "linear light"), (usual, None), (srgb + linear, None), (profile + linear, None)):
        assert read_header(data[:33] + parts + data[33:]).other_curve == curve


@pytest.mark.parametrize("kind", ["png", "tiff"])
@pytest.mark.parametrize(("mode", "is_told"), [("P", True), ("1", True), ("L", False), ("RGB", False)])
def test_a_palette_s_few_colours_are_told(kind: str, mode: str, *, is_told: bool) -> None:
    out = BytesIO()
    Image.fromarray(corners()).convert(mode).save(out, kind)
    if (kind, mode) == ("tiff", "1"):
        with pytest.raises(UnsupportedKind, match="8 or 16 bits"):
            read_photograph(out.getvalue())
    else:
        assert any("palette" in words for words in read_photograph(out.getvalue()).warnings) == is_told


def test_of_two_exif_blocks_the_first_counts_as_it_does_to_viewers() -> None:
    assert read_header(with_exif(jpeg(corners(), 3), exif_block(6))).orientation == 6


def test_a_bigtiff_is_told_what_to_become() -> None:
    for order in ("<", ">"):
        out = BytesIO()
        tifffile.imwrite(out, corners(), bigtiff=True, byteorder=order, photometric="rgb")
        with pytest.raises(UnsupportedKind, match="BigTIFF"):
            read_photograph(out.getvalue())


def test_photographs_of_a_folder_are_known_by_how_cameras_name_them(tmp_path: Path) -> None:
    for name in ("b.HIF", "a.JPG", "c.heic", "d.NEF", "e.txt", "f.mov", "g.jfif", "h.MPO", "._a.JPG"):
        (tmp_path / name).touch()
    assert [path.name for path in photographs_in(tmp_path)] == ["a.JPG", "b.HIF", "c.heic", "d.NEF", "g.jfif", "h.MPO"]


ENDS_ANYWHERE = tiff(corners())[:-4] + b"\xff" * 4  # the next page would be far outside
KIND_OF_PAGE, OTHER_TAG = (struct.pack("<HHI", tag, 4, 1) for tag in (254, 253))


def pages(*subfiles: int) -> bytes:
    """A tiff of the corners and more pages, each of a kind (1: a smaller copy)."""
    out = BytesIO()
    with tifffile.TiffWriter(out) as writer:
        for kind in (0, *subfiles):
            writer.write(corners(), photometric="rgb", subfiletype=kind, metadata=None)
    return out.getvalue()


def animated(kind: str, frames: int) -> bytes:
    """So many frames, the first of the corners."""
    animation = cv2.Animation()
    animation.frames = [np.ascontiguousarray(corners()[..., ::-1]), *([np.zeros((48, 64, 3), np.uint8)] * (frames - 1))]
    animation.durations = [100] * frames
    is_written, body = cv2.imencodeanimation(kind, animation)
    assert is_written
    return body.tobytes()


@pytest.mark.parametrize(
    "data",
    [pages(0), pages(1, 0), pages(0).replace(KIND_OF_PAGE, OTHER_TAG), animated(".webp", 3), animated(".png", 2)],
    ids=["tiff", "tiff with a copy", "tiff that tells no kinds", "webp", "png"],
)
def test_of_several_pictures_the_first_is_read_and_that_is_told(data: bytes) -> None:
    photograph = read_photograph(data)
    assert photograph.warnings == ("the file has more than one picture: the first was read",)
    assert photograph.rgb[4, 4].argmax() == 0
    assert photograph.rgb[4, -5].argmax() == 1


def test_a_small_copy_in_front_is_not_taken_for_the_picture() -> None:
    for below in (None, 1):
        out = BytesIO()
        with tifffile.TiffWriter(out) as writer:
            writer.write(corners(24, 32), photometric="rgb", subfiletype=1, metadata=None, subifds=below)
            writer.write(corners(), photometric="rgb", metadata=None)
        with pytest.raises(UnsupportedKind, match="a small copy of another"):
            read_photograph(out.getvalue())


@pytest.mark.parametrize("data", [pages(), pages(1), ENDS_ANYWHERE, png(corners()), webp(corners())])
def test_of_one_picture_nothing_is_told(data: bytes) -> None:
    assert read_photograph(data).warnings == ()
