"""Photographs with depth, written and read."""

import json
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from model_export.datasets.photos import Photo, filled, load_photos, read_image, save_photos, write_image

PICTURE = np.random.default_rng(1).integers(0, 256, (48, 64, 3), np.uint8)


def test_what_is_written_is_read_to_half_a_millimetre(tmp_path: Path) -> None:
    depth_m = np.random.default_rng(2).uniform(0.1, 60, (48, 64)).astype(np.float32)
    depth_m[:, :3], depth_m[:, 60:] = np.nan, 70
    assert save_photos(tmp_path, [(Photo("a", PICTURE, depth_m), {"fx_px": 500.0})]) == 1
    (photo,) = load_photos(tmp_path)
    np.testing.assert_array_equal(photo.image, PICTURE)
    assert np.isnan(photo.depth_m[:, [0, 1, 2, 60, 63]]).all()
    assert photo.depth_m[:, 3:60] == pytest.approx(depth_m[:, 3:60], abs=5.1e-4)


def test_a_set_keeps_the_cameras_of_the_pictures_that_it_has(tmp_path: Path) -> None:
    for name, fx_px in (("a", 500.0), ("b", 600.0)):
        save_photos(tmp_path, [(Photo(name, PICTURE, np.ones((48, 64), np.float32)), {"fx_px": fx_px})])
    assert json.loads((tmp_path / "cameras.json").read_text()) == {"a": {"fx_px": 500.0}, "b": {"fx_px": 600.0}}


def test_what_is_unknown_is_as_far_as_the_nearest_that_is_known() -> None:
    depth_m = np.full((5, 12), np.nan, np.float32)
    depth_m[:, 2], depth_m[:, 3], depth_m[:, 10] = 1.0, 2.0, 3.0
    np.testing.assert_array_equal(filled(depth_m), np.tile(np.repeat([1, 2, 3], (3, 4, 5)), (5, 1)).astype(np.float32))


def test_depth_of_another_size_is_refused(tmp_path: Path) -> None:
    save_photos(tmp_path, [(Photo("a", PICTURE, np.ones((24, 32), np.float32)), {})])
    with pytest.raises(ValueError, match=r"32x24 pixels, its picture 64x48"):
        list(load_photos(tmp_path))


def test_a_picture_that_is_too_large_to_read_is_named(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", PICTURE)
    told = bytearray((tmp_path / "a.png").read_bytes())
    told[16:24] = struct.pack(">II", 40_000, 30_000)
    told[29:33] = struct.pack(">I", zlib.crc32(told[12:29]))
    (tmp_path / "a.png").write_bytes(told)
    with pytest.raises(ValueError, match=r"a\.png is no picture that can be read here"):
        read_image(tmp_path / "a.png")


def test_a_full_disk_is_told_of(tmp_path: Path) -> None:
    (tmp_path / "a.png").symlink_to("/dev/full")
    with pytest.raises(OSError, match="No space left"):
        write_image(tmp_path / "a.png", PICTURE)
