"""HEIC, AVIF and raw files: turned and limited as any other, and their decoders can hang, swell or die without harm."""

import json
import struct
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from starlette.testclient import TestClient

from service.errors import Busy, InvalidImage, TooLarge, UnsupportedKind
from service.inference import isolated
from service.inference.headers import read_header
from service.inference.images import TURNS, ImageLimits, read_photograph, read_stored_frame, turned
from tests.inference.heics import box, heic, whole
from tests.inference.photographs import avif, corners, png, tiff
from tests.inference.raws import dng, with_preview

CAMERA = {"name": "bench", "image_width_px": 64, "image_height_px": 48, "focus_distance_m": 2.0, "k_cam_px": 6.0}
PROBLEM = "application/problem+json"
# what a HEIC's turn and mirror amount to
HEIC_TURNS = {1: (None, None), 2: (0, 1), 3: (2, None), 4: (None, 0), 5: (1, 0), 6: (3, None), 7: (1, 1), 8: (1, None)}

STAND_IN = """
import os, runpy, socket, sys, time, types

class Picture:
    size, mode, data = (64, 48), "RGB", bytes(64 * 48 * 3)

def open_heif(data, **options):
    {misdeed}
    return Picture()

codec = types.ModuleType("pi_heif")
codec.open_heif, codec.options = open_heif, types.ModuleType("pi_heif.options")
sys.modules["pi_heif"] = codec
runpy.run_path({program!r}, run_name="__main__")
"""
MACOS = """
import resource, runpy, sys

bound = resource.setrlimit

def setrlimit(kind, bounds):
    if kind == resource.RLIMIT_AS:
        raise ValueError("current limit exceeds maximum limit")
    bound(kind, bounds)

sys.platform, resource.setrlimit = "darwin", setrlimit
runpy.run_path({program!r}, run_name="__main__")
"""
MISDEEDS = {
    "sleeps for ever": "time.sleep(1000)",
    "computes for ever": "while True: pass",
    "takes all memory": "Picture.held = bytearray(3_000_000_000)",
    "segfaults": "os.kill(os.getpid(), 11)",
    "ends": "os._exit(0)",
    "opens a file": "open('/proc/self/status')",
    "opens a socket": "socket.socket()",
    "raises": "raise KeyError",
    "prints": "os.write(1, b'x' * 100_000); raise ValueError",
    "answers too little": "Picture.data = bytes(5)",
    "answers of another size": "Picture.size = (48, 48); Picture.data = bytes(48 * 48 * 3)",
    "answers nothing": "Picture.size = (0, 0); Picture.data = b''",
}


@pytest.fixture
def misbehave(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[str], None]:
    """Puts a decoder in the place of HEIC's; everything around it is the real thing."""

    def put(misdeed: str) -> None:
        program = tmp_path / "stand_in.py"
        program.write_text(STAND_IN.format(misdeed=misdeed, program=str(isolated.PROGRAM)))
        monkeypatch.setattr(isolated, "PROGRAM", program)

    return put


def near(found: object, wanted: object) -> None:
    assert np.abs(np.asarray(found).astype(int) - np.asarray(wanted).astype(int)).max() <= 6


def test_a_system_that_bounds_no_memory_decodes_all_the_same(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    program = tmp_path / "macos.py"
    program.write_text(MACOS.format(program=str(isolated.PROGRAM)))
    monkeypatch.setattr(isolated, "PROGRAM", program)
    near(read_photograph(heic()).rgb, corners())


@pytest.mark.parametrize("orientation", TURNS)
def test_a_heic_is_turned_exactly_once(orientation: int) -> None:
    photograph = read_photograph(heic(*HEIC_TURNS[orientation]), "image/heic")
    assert (photograph.kind, photograph.orientation, photograph.warnings) == ("heic", orientation, ())
    near(photograph.rgb, turned(corners(), orientation))


@pytest.mark.parametrize(
    ("number", "curve"), [(16, "HDR by PQ"), (18, "HDR by HLG"), (8, "linear light"), (13, ""), (1, ""), (None, "")]
)
def test_a_heic_of_high_dynamic_range_is_told_of_and_not_measured_by(number: int | None, curve: str) -> None:
    data = heic(colour=b"" if number is None else b"nclx" + struct.pack(">HHHB", 9, number, 9, 0x80))
    assert ([*read_photograph(data).warnings] != []) == bool(curve)
    if curve:
        with pytest.raises(UnsupportedKind, match=curve):
            read_stored_frame(data)


def test_a_heic_s_profile_is_read() -> None:
    linear = bytes(128) + struct.pack(">I4sII", 1, b"rTRC", 144, 12) + b"curv" + bytes(8)
    for kind in (b"prof", b"rICC"):
        assert read_header(heic(colour=kind + linear)).other_curve == "linear light"
    assert read_header(heic(colour=b"prof" + linear[:-1])).other_curve is None


def test_the_stored_frame_of_a_heic_is_the_sensor_s() -> None:
    near(read_stored_frame(heic(3)).rgb, corners())


def test_a_heic_of_another_size_than_stated_is_refused() -> None:
    assert read_photograph(heic(crop=None)).rgb.shape == (64, 64, 3)
    for stated in ((64, 60), (32, 32)):
        with pytest.raises(InvalidImage):
            read_photograph(heic(stated=stated, crop=None))
    with pytest.raises(InvalidImage):
        read_photograph(heic(crop=struct.pack(">8I", 64, 0, 48, 0, 0, 1, 0, 1)))  # 64 noughts wide


def test_a_box_may_end_with_the_file_or_tell_its_size_in_64_bits() -> None:
    data = heic(3)
    content = data[data.index(b"mdat") + 4 :]
    before = data[: -len(content) - 8]
    for head in (struct.pack(">I4s", 0, b"mdat"), struct.pack(">I4sQ", 1, b"mdat", 16 + len(content))):
        assert read_header(before + head + content) == read_header(data)


def test_no_prefix_of_a_heic_gets_past_its_header() -> None:
    data = heic(3)
    for length in range(12, len(data) - 1):
        with pytest.raises(InvalidImage):
            read_header(data[:length])


@pytest.mark.parametrize(("stated", "word"), [((30_000, 30_000), "30000x30000"), ((4_000, 300), "10 to 1")])
def test_a_heic_is_measured_before_a_decoder_starts(
    monkeypatch: pytest.MonkeyPatch, stated: tuple[int, int], word: str
) -> None:
    monkeypatch.setattr(isolated, "PROGRAM", Path("/nowhere"))
    with pytest.raises(TooLarge, match=word):
        read_photograph(heic(stated=stated, crop=None))


def test_boxes_without_end_are_limited_and_cheap() -> None:
    data = heic(3)
    # each list claims more items than there are bytes
    properties = box(b"iprp", whole(b"ipma", b"\xff" * 4, bytes(8)) * 20_000)
    meta = whole(b"meta", whole(b"pitm", struct.pack(">H", 1)), properties)
    with pytest.raises(InvalidImage):
        read_header(data[: data.index(b"meta") - 4] + meta + box(b"mdat", bytes(1_000_000)))
    with pytest.raises(InvalidImage, match="boxes"):
        read_header(data + box(b"free") * 20_000)


@pytest.mark.parametrize("orientation", [1, 5, 6])
def test_an_avif_is_turned_exactly_once(orientation: int) -> None:
    data = avif(corners(), orientation)
    photograph = read_photograph(data, "image/avif")
    assert (photograph.kind, photograph.orientation, photograph.warnings) == ("avif", orientation, ())
    assert photograph.exif.make == "Maker"
    near(photograph.rgb, turned(corners(), orientation))
    if orientation == 6:
        near(read_stored_frame(data).rgb, corners())


def test_an_avif_is_known_by_its_brands_and_its_first_frame_is_read() -> None:
    data = avif(corners())
    named = data.replace(b"ftypavif", b"ftypmif1", 1).replace(b"avifmif1miaf", b"mif1miafavif", 1)
    assert (read_header(named).kind, read_header(heic().replace(b"ftypheic", b"ftypmif1", 1)).kind) == ("avif", "heic")
    photograph = read_photograph(avif(corners(), 1, corners()[::-1]))
    assert photograph.warnings == ("the file has more than one picture: the first was read",)
    near(photograph.rgb, corners())


def test_an_avif_is_measured_before_a_decoder_starts_and_a_damaged_one_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    data = avif(corners())
    with pytest.raises(InvalidImage, match="avif"):
        read_photograph(data[:-30] + bytes(30))
    monkeypatch.setattr(isolated, "PROGRAM", Path("/nowhere"))
    at = data.index(b"ispe") + 8
    with pytest.raises(TooLarge, match="30000x30000"):
        read_photograph(data[:at] + struct.pack(">II", 30_000, 30_000) + data[at + 8 :])
    for length in range(12, len(data) - 1, 3):
        with pytest.raises(InvalidImage, match="avif"):
            read_header(data[:length])


@pytest.mark.parametrize("orientation", [1, 6])
def test_a_raw_file_is_developed_and_turned_once(orientation: int) -> None:
    photograph = read_photograph(dng(orientation), "image/x-adobe-dng")
    assert (photograph.kind, photograph.orientation, photograph.warnings) == ("raw", orientation, ())
    away_from_edges = np.abs(photograph.rgb.astype(int) - turned(corners(), orientation)) <= 6
    assert away_from_edges.mean() > 0.9


def test_raw_and_tiff_are_told_apart_by_their_bytes() -> None:
    assert read_photograph(dng(), "image/tiff").warnings == ("declared image/tiff, read as raw",)
    assert read_photograph(tiff(corners()), "image/x-adobe-dng").kind == "tiff"
    for data in (dng(is_told=False), with_preview()):
        header = read_header(data)
        assert (header.kind, header.width_px, header.height_px) == ("raw", 64, 48)


def test_a_raw_file_without_pixels_to_develop_is_refused() -> None:
    with pytest.raises(InvalidImage, match="cut off"):
        read_photograph(dng()[:-2000])
    with pytest.raises(TooLarge, match="64x48"):
        read_photograph(dng(), limits=ImageLimits(max_pixels=3_000))


@pytest.mark.parametrize(("data", "module", "extra"), [(heic(), "pi_heif", "heic"), (dng(), "rawpy", "raw")])
def test_without_the_extra_it_is_named(
    client: TestClient, monkeypatch: pytest.MonkeyPatch, data: bytes, module: str, extra: str
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(UnsupportedKind, match=f"extra '{extra}'"):
        read_photograph(data)
    client.post("/cameras", json=CAMERA)
    answer = client.post("/depth?camera=bench", content=data, headers={"Content-Type": "application/octet-stream"})
    assert (answer.status_code, answer.headers["content-type"]) == (415, PROBLEM)
    assert f"'{extra}'" in answer.json()["detail"]


def test_a_stand_in_that_behaves_is_believed(misbehave: Callable[[str], None]) -> None:
    misbehave("pass")
    assert read_photograph(heic()).rgb.max() == 0


@pytest.mark.parametrize("misdeed", MISDEEDS.values(), ids=MISDEEDS)
def test_a_decoder_that_misbehaves_is_a_damaged_file(
    misbehave: Callable[[str], None], monkeypatch: pytest.MonkeyPatch, misdeed: str
) -> None:
    monkeypatch.setattr(isolated, "CPU_S", 1)
    monkeypatch.setattr(isolated, "WALL_S", 1.0 if "sleep" in misdeed else 60.0)
    misbehave(misdeed)
    with pytest.raises(InvalidImage, match="heic"):
        read_photograph(heic())


def test_no_room_for_a_process_is_busy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/nowhere")
    with pytest.raises(Busy):
        read_photograph(heic())


def test_the_service_outlives_its_decoders(
    client: TestClient, misbehave: Callable[[str], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    client.post("/cameras", json=CAMERA)
    answer = client.post("/depth?camera=bench&format=json", content=heic(3), headers={"Content-Type": "image/heic"})
    assert answer.status_code == 200, answer.text
    assert (answer.json()["width_px"], answer.json()["height_px"]) == (48, 64)
    monkeypatch.setattr(isolated, "WALL_S", 1.0)
    for misdeed in ("time.sleep(1000)", "os.kill(os.getpid(), 11)", "Picture.held = bytearray(3_000_000_000)"):
        misbehave(misdeed)
        answer = client.post("/depth?camera=bench", content=heic(), headers={"Content-Type": "image/heic"})
        assert (answer.status_code, answer.headers["content-type"]) == (422, PROBLEM)
        assert json.loads(answer.content)["type"] == "urn:camind:problem:invalid-image"
    answer = client.post("/depth?camera=bench", content=png(corners()), headers={"Content-Type": "image/png"})
    assert answer.status_code == 200
