"""Pictures that were cut out of larger ones or computed, and all those that were not."""

from io import BytesIO
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from service.inference.images import read_photograph
from service.opencv import cv2
from tests.inference.heics import heic
from tests.inference.photographs import encoded, exif_with_thumbnail, jpeg, with_exif

Picture = NDArray[np.uint8]


@pytest.fixture(scope="module")
def whole() -> Picture:
    noise = np.random.default_rng(0).integers(0, 255, (30, 45, 3), np.uint8)
    return np.asarray(cv2.resize(noise, (960, 640), interpolation=cv2.INTER_CUBIC), np.uint8)


def with_thumbnail(picture: Picture, of: Picture, width_px: int = 160, bar_px: int = 0) -> bytes:
    """A JPEG whose thumbnail shows another picture, maybe with bars above and below, as cameras write them."""
    small = cv2.resize(of, (width_px, round(width_px * of.shape[0] / of.shape[1])), interpolation=cv2.INTER_AREA)
    small = cv2.copyMakeBorder(small, bar_px, bar_px, 0, 0, cv2.BORDER_CONSTANT)
    thumbnail = encoded(".jpg", np.asarray(small), cv2.IMWRITE_JPEG_QUALITY, 60)
    return with_exif(jpeg(np.ascontiguousarray(picture)), exif_with_thumbnail(thumbnail))


@pytest.mark.parametrize(("width_px", "bar_px"), [(160, 7), (160, 0), (512, 0)])
def test_a_picture_of_which_the_thumbnail_shows_more_was_cut(whole: Picture, width_px: int, bar_px: int) -> None:
    for part in (whole[80:560, 120:840], whole[:320, :480], cv2.resize(whole[:480, :720], (960, 640))):
        (warning,) = read_photograph(with_thumbnail(np.asarray(part), whole, width_px, bar_px)).warnings
        assert "thumbnail" in warning
        assert "send the whole frame" in warning


def test_a_picture_of_which_it_shows_no_more_is_not_doubted(whole: Picture) -> None:
    darker = (255 * (whole / 255) ** 1.4).astype(np.uint8)
    grey = np.full_like(whole, 128)
    for picture, shown, bar_px in (
        (whole, whole, 0),
        (whole, whole, 7),
        (whole, darker, 7),
        (whole[::2, ::2], whole, 0),
        (whole.swapaxes(0, 1), whole, 0),  # turned upright, the thumbnail as it was
        (whole, whole[:320, :480], 0),
        (whole, grey, 0),
        (grey, grey, 0),
        (grey, whole, 0),
    ):
        assert read_photograph(with_thumbnail(picture, shown, bar_px=bar_px)).warnings == ()


@pytest.mark.parametrize("first", [(0, 0), (0, 1), (1, 0), (1, 1)])
def test_a_mosaic_that_was_never_developed_is_told_of(whole: Picture, first: tuple[int, int]) -> None:
    mosaic = whole[..., 1].copy()
    for row, column, channel in ((0, 0, 0), (1, 1, 2)):
        place = np.s_[(row + first[0]) % 2 :: 2, (column + first[1]) % 2 :: 2]
        mosaic[place] = whole[place][..., channel] * 0.8
    for picture in (mosaic, mosaic[:-1, :-1]):
        (warning,) = read_photograph(encoded(".png", np.ascontiguousarray(picture))).warnings
        assert "demosaic it first" in warning


def test_what_is_grey_or_no_more_than_noisy_is_no_mosaic(whole: Picture) -> None:
    grey, noise = whole[..., 1].copy(), np.random.default_rng(0).integers(0, 255, (48, 64), np.uint8)
    striped = grey.copy()
    striped[::2] //= 2  # as fields of different light are
    coloured = whole.copy()
    coloured[::2, ::2] //= 2
    for picture in (grey, noise, striped, grey[:1, :9], grey[:9, :1], coloured):
        assert read_photograph(encoded(".png", np.ascontiguousarray(picture))).warnings == ()


@pytest.mark.parametrize("data", [b"", b"no jpeg", b"\xff\xd8\xff" + bytes(50), jpeg(np.zeros((1200, 8, 3), np.uint8))])
def test_what_is_no_thumbnail_is_passed_over(whole: Picture, data: bytes) -> None:
    assert read_photograph(with_exif(jpeg(whole), exif_with_thumbnail(data))).warnings == ()
    cut_off = exif_with_thumbnail(jpeg(whole[::8, ::8]))[:-40]
    assert read_photograph(with_exif(jpeg(whole), cut_off)).warnings == ()


@pytest.mark.parametrize(
    ("said", "word"),
    [
        (b'crs:HasCrop="True" crs:AlreadyApplied="True"', "cropped"),
        (b"<crs:HasCrop>True</crs:HasCrop><crs:AlreadyApplied>True</crs:AlreadyApplied>", "cropped"),
        (b'crs:HasCrop="True" crs:AlreadyApplied="False"', ""),
        (b'crs:HasCrop="False" crs:AlreadyApplied="True"', ""),
        (b'GPano:ProjectionType="cylindrical"', "panorama"),
        (b"<rdf:li>com.google.android.apps.camera.gallery.specialtype.SpecialType-PORTRAIT</rdf:li>", "portrait"),
        (b"", ""),
    ],
)
def test_what_an_editor_or_a_phone_notes_is_told(whole: Picture, said: bytes, word: str) -> None:
    xmp = b"<rdf:Description " + said + b"/>"
    for kind in ("JPEG", "PNG", "TIFF", "WEBP"):
        warnings = read_photograph(with_xmp(whole[:64, :64], kind, xmp)).warnings
        assert bool(warnings) == bool(word)
        assert all(warning.startswith("its XMP says") and word in warning for warning in warnings)


def with_xmp(picture: Picture, kind: str, xmp: bytes) -> bytes:
    """A file of a kind with this XMP, and in a PNG a comment before it."""
    out, texts = BytesIO(), PngInfo()
    options: dict[str, Any] = {"xmp": xmp}
    if kind == "PNG":
        texts.add_itxt("Comment", "of no use")
        texts.add_itxt("XML:com.adobe.xmp", xmp.decode())
        options = {"pnginfo": texts}
    elif kind == "TIFF":
        options = {"tiffinfo": {700: xmp}}
    Image.fromarray(np.ascontiguousarray(picture)).save(out, kind, **options)
    return out.getvalue()


@pytest.mark.parametrize("name", [b"DualShot_DepthMap_1", b"SingeShot_DepthMap_1", b"MotionPhoto_Data", b""])
def test_a_samsung_s_portrait_is_known_by_the_depth_map_behind_it(whole: Picture, name: bytes) -> None:
    block = b"\0\0\xb1\x0a" + len(name).to_bytes(4, "little") + name + bytes(40)
    for data in (jpeg(whole), heic()):
        warnings = read_photograph(data + len(block).to_bytes(4, "big") + b"sefd" + block[8:]).warnings
        assert [*warnings] == ["it holds the depth map of a portrait mode: its blur may be computed, and no lens'"] * (
            b"DepthMap" in name
        )
