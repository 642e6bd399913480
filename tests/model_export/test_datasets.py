"""Datasets of the literature, from tiny files of their layouts."""

import json
from pathlib import Path

import cv2
import h5py
import numpy as np
import OpenEXR
import pytest
from typer.testing import CliRunner

from model_export.cases import REFERENCE, photographed_cases, refocused_cases
from model_export.cli import commands
from model_export.datasets.photos import Photo, load_photos, save_photos
from model_export.evaluation_sets import evaluation_sets
from service.optics import thin_lens

PICTURE = np.random.default_rng(1).integers(0, 256, (48, 64, 3), np.uint8)
OWN_CAMERA = {"focus_distance_m": 2.0, "k_cam_px": 3.0, "gamma_px": 0.5}


def converted(layout: str, source: Path, out: Path) -> str:
    found = CliRunner().invoke(commands, ["data", layout, str(source), "--out", str(out)])
    return found.output


def defocusnet(folder: Path) -> Path:
    depth_m = np.full((48, 64), 0.75, np.float16)
    depth_m[:4] = np.inf
    channels = {"R": depth_m, "G": depth_m, "B": depth_m}
    OpenEXR.File({"type": OpenEXR.scanlineimage}, channels).write(str(folder / "000001Dpt.exr"))
    for number in range(5):
        cv2.imwrite(str(folder / f"000001_{number:02d}All.tif"), PICTURE[:, :, ::-1])
    return folder


def test_defocusnet_becomes_a_set_that_is_scored(tmp_path: Path) -> None:
    (tmp_path / "raw").mkdir()
    assert "5 pictures" in converted("defocusnet", defocusnet(tmp_path / "raw"), tmp_path / "data" / "defocusnet")
    assert "defocusnet" in {each.name for each in evaluation_sets(tmp_path / "data", quick=True)}
    found = list(photographed_cases(tmp_path / "data" / "defocusnet", 5))
    assert [case.camera.focus_distance_m for case in found] == [0.1, 0.15, 0.3, 0.7, 1.5]
    first = found[0]
    np.testing.assert_array_equal(first.image, PICTURE)
    assert np.isnan(first.truth_m[:4]).all()
    assert first.truth_m[4:] == pytest.approx(0.75)
    # the disc of an f/1 lens of 2.9 mm, on pixels of 3.1 mm / 64, a quarter of it the standard deviation
    assert first.camera.k_cam_px == pytest.approx(2.9e-3**2 / 0.1 / (3.1e-3 / 64) / 4, rel=1e-3)


def test_a_light_fields_stack_is_known_by_its_disparities(tmp_path: Path) -> None:
    disparity = np.full((1, 48, 64), 0.28247, np.float32)
    disparity[:, :3] = 0
    with h5py.File(tmp_path / "ddff.h5", "w") as file:
        file["stack_val"] = np.broadcast_to(PICTURE, (1, 10, *PICTURE.shape))
        file["disp_val"] = disparity
    assert "10 pictures" in converted("ddff12", tmp_path / "ddff.h5", tmp_path / "ddff12")
    found = list(photographed_cases(tmp_path / "ddff12", 10))
    assert found[0].camera.focus_distance_m == pytest.approx(0.5)
    assert found[-1].camera.focus_distance_m == pytest.approx(7.0)
    assert np.isnan(found[0].truth_m[:3]).all()
    assert found[0].truth_m[3:] == pytest.approx(0.5, abs=1e-3)
    # nine views of the picture focused at 7 m, each shifted by what the disparities differ
    places = np.arange(-4, 5) * (0.28247 - 0.28247 * 0.5 / 7)
    sigma_px = thin_lens.defocus_at_depth(0.5, 7.0, found[-1].camera.k_cam_px)
    assert sigma_px == pytest.approx(places.std(), rel=1e-3)


def test_nyu_becomes_frames_to_refocus(tmp_path: Path) -> None:
    picture = np.random.default_rng(2).integers(0, 256, (480, 640, 3), np.uint8)
    with h5py.File(tmp_path / "nyu.mat", "w") as file:
        file["images"] = picture.T[None]
        file["depths"] = np.broadcast_to(np.linspace(1, 1.9, 480, dtype=np.float32), (1, 640, 480))
    assert "1 pictures" in converted("nyu", tmp_path / "nyu.mat", tmp_path / "rgbd")
    (photo,) = load_photos(tmp_path / "rgbd")
    np.testing.assert_array_equal(photo.image, picture)
    assert np.isnan(photo.depth_m[:45]).all()
    assert photo.depth_m[470, 300] == pytest.approx(1 + 0.9 * 470 / 479, abs=1e-3)
    (case,) = refocused_cases(tmp_path / "rgbd", 1)
    assert case.camera == REFERENCE


@pytest.mark.parametrize("layout", ["ddff12", "nyu", "defocusnet"])
def test_files_of_another_layout_are_refused_in_a_line(tmp_path: Path, layout: str) -> None:
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["other"] = 1
    source = tmp_path if layout == "defocusnet" else tmp_path / "other.h5"
    said = converted(layout, source, tmp_path / "out")
    assert f"in {source}" in said or f"{source} has no" in said.replace("\n", "")
    assert not (tmp_path / "out" / "cameras.json").exists()


def test_own_photographs_are_scored_by_their_cameras(tmp_path: Path) -> None:
    depth_m = np.full((48, 64), 1.5, np.float32)
    save_photos(tmp_path / "desk", [(Photo("a", PICTURE, depth_m), OWN_CAMERA)])
    (case,) = photographed_cases(tmp_path / "desk", 1)
    assert case.side == "auto"
    assert case.camera.intrinsics is None


@pytest.mark.parametrize(
    ("file", "content", "said"),
    [
        ("cameras.json", '{"a": {"k_cam_px": 3.0}}', "no focus_distance_m of a"),
        ("cameras.json", '{"a": {"k_cam_px"', r"cameras.json: Invalid JSON"),
        ("cameras.json", '{"a": null}', r"cameras.json: a: Input should be a valid dictionary"),
        ("cameras.json", '{"a.png": {}}', r"cameras.json has no a, which is .*a.png"),
        ("cameras.json", json.dumps({"a": OWN_CAMERA | {"fx": 900}}), "a: fx.* 'gamma_px' or 'fx_px'"),
        ("cameras.json", json.dumps({"a": OWN_CAMERA | {"k_cam_px": "3"}}), "a: k_cam_px: .*valid number"),
        ("cameras.json", json.dumps({"a": OWN_CAMERA | {"gamma_px": -1}}), "a: gamma_px: .*greater than 0"),
        ("cameras.json", None, "desk has no cameras.json"),
        ("depth/a.png", None, "depth/a.png is missing"),
        ("depth/a.png", "", "depth/a.png is no depth: a grey PNG of 16 bits"),
        ("color/a.jpg", "", "two pictures of the name a"),
        ("color/b.png", "", "cameras.json has no b"),
        ("color/a.png", None, "no pictures in"),
        ("../color/a.png", "", "is a set of pictures itself"),
    ],
)
def test_a_mistake_in_a_set_is_named_before_anything_is_scored(
    tmp_path: Path, file: str, content: str | None, said: str
) -> None:
    save_photos(tmp_path / "desk", [(Photo("a", PICTURE, np.ones((48, 64), np.float32)), OWN_CAMERA)])
    wrong = tmp_path / "desk" / file
    wrong.parent.mkdir(exist_ok=True)
    if content is None:
        wrong.unlink()
    else:
        wrong.write_text(content)
    with pytest.raises((ValueError, FileNotFoundError), match=said):
        evaluation_sets(tmp_path, quick=True)


def test_what_a_file_manager_hides_among_pictures_is_none(tmp_path: Path) -> None:
    save_photos(tmp_path / "desk", [(Photo("a", PICTURE, np.ones((48, 64), np.float32)), OWN_CAMERA)])
    (tmp_path / "desk" / "color" / ".DS_Store").write_bytes(b"no picture")
    assert [case.name for case in photographed_cases(tmp_path / "desk", 1)] == ["a"]


def test_sharp_frames_under_a_name_of_their_own_are_refused_before_anything_is_scored(tmp_path: Path) -> None:
    save_photos(tmp_path / "nyu", [(Photo("a", PICTURE, np.ones((48, 64), np.float32)), {"fx_px": 518.9})])
    with pytest.raises(ValueError, match=f"no focus_distance_m of a.*scored in {tmp_path / 'rgbd'}"):
        evaluation_sets(tmp_path, quick=True)


def test_a_set_is_not_named_as_one_that_is_drawn(tmp_path: Path) -> None:
    save_photos(tmp_path / "procedural near", [(Photo("a", PICTURE, np.ones((48, 64), np.float32)), {})])
    with pytest.raises(ValueError, match="name it otherwise"):
        evaluation_sets(tmp_path, quick=True)
