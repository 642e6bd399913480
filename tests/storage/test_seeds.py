"""The seeds are the paper's Table 1, with k_r = 4 and real focal lengths."""

import math

import pytest

from service.config import Settings
from service.storage.cameras import Cameras
from service.storage.seeds import seed, seed_drafts

TABLE_1_K_CAM = (
    15.54,
    105.58,
    406.16,
    172.35,
    240.40,
    15.76,
    9.85,
    149.98,
    93.73,
    8.92,
    43.13,
    1.62,
    250.94,
    2196.48,
    31.93,
)
PAPER_K_R = 1 / math.sqrt(2)


def test_the_cameras_of_the_table_have_its_k_cam_with_a_disc_s_own_k_r() -> None:
    for draft, paper in zip(seed_drafts(), TABLE_1_K_CAM, strict=False):
        assert draft.k_r == 4
        assert draft.camera.k_cam_px * 4 / PAPER_K_R == pytest.approx(paper, rel=3e-3), draft.name


def test_each_takes_its_own_photographs_without_any_setting() -> None:
    limit = Settings.model_fields["max_image_pixels"].default
    for draft in seed_drafts():
        assert draft.camera.image_width_px * draft.camera.image_height_px <= limit, draft.name


def test_each_is_a_whole_sensor_s_and_knows_its_aperture() -> None:
    for draft in seed_drafts():
        shape = draft.camera.image_width_px / draft.camera.image_height_px
        assert shape == pytest.approx(4 / 3 if draft.name.startswith("pixel") else 3 / 2, rel=0.01)
        assert draft.name.endswith(f"-f{draft.camera.f_number:g}")


def test_phones_have_the_k_cam_of_their_real_lenses() -> None:
    wide, telephoto = seed_drafts()[-2:]
    assert wide.lens is not None
    assert telephoto.lens is not None
    assert wide.lens.focal_length_mm < 10
    assert telephoto.lens.focal_length_mm < 30
    assert wide.camera.k_cam_px * 4 / PAPER_K_R < 50.39 / 3
    assert telephoto.camera.k_cam_px * 4 / PAPER_K_R < 1577.82 / 10


def test_seeding_twice_adds_once(cameras: Cameras) -> None:
    assert len(seed(cameras)) == 17
    changed = cameras.get("nikon-d7500-50mm-f1.8")
    cameras.replace(changed.draft)
    assert seed(cameras) == []
    cameras.delete("nikon-d7500-55mm-f5.6")
    assert seed(cameras) == ["nikon-d7500-55mm-f5.6"]
    assert cameras.get("nikon-d7500-50mm-f1.8").revision == 2
