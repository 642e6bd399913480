"""Furnished rooms become frames; Blender itself is not run here."""

import json
import sys
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest

from model_export.datasets.homes import SIZE_PX, VIEWS, Furniture, due, render, unpack
from model_export.frames import load_frames

ENTRY = {"name": "Table", "model": "/table/table.obj", "width": 120.0, "depth": 60.0, "height": 75.0}
# answers as the worker does: the first view shows a step in depth, the second is dark, of the others nothing was seen
BLENDER = """
import json, sys
from pathlib import Path
import numpy as np
spec, out = json.loads(Path(sys.argv[2]).read_text()), Path(sys.argv[3])
assert spec["models"][0]["top_m"] == 0.7 and spec["pictures"]
for room in spec["rooms"]:
    for view in range(room["views"]):
        name = f"{room['name']}_{view}"
        if view < 2:
            shape = (room["height_px"], room["width_px"])
            depth_m = np.where(np.arange(shape[1]) < 100, 1.5, 100.0) * np.ones(shape)
            light = np.full((*shape, 3), 0.25 * (view == 0))
            np.savez(out / f"{name}.npz", light=light, depth_m=depth_m, focal_length_px=420.0)
        print("rendered", name, flush=True)
"""


def catalogue(**changes: object) -> str:
    return "\n".join(f"{name}#1={value}" for name, value in (ENTRY | changes).items()) + "\n"


def library(folder: Path, told: str) -> Path:
    folder.mkdir()
    with zipfile.ZipFile(folder / "Some.sh3f", "w") as packed:
        packed.writestr("PluginFurnitureCatalog.properties", told)
        packed.writestr("table/table.obj", "v 0 0 0\n")
    return folder


def test_a_library_says_how_large_its_furniture_is(tmp_path: Path) -> None:
    (found,) = unpack(library(tmp_path / "in", catalogue(dropOnTopElevation=70)), tmp_path / "out")
    assert found.size_m == pytest.approx((1.2, 0.6, 0.75))
    assert found.top_m == pytest.approx(0.7)
    assert Path(found.path).read_text() == "v 0 0 0\n"


def test_a_library_that_was_unpacked_in_part_is_unpacked_again(tmp_path: Path) -> None:
    packed = library(tmp_path / "in", catalogue()) / "Some.sh3f"
    whole = packed.read_bytes()
    packed.write_bytes(whole.replace(b"v 0 0 0", b"v 0 0 1"))  # after the catalogue
    with pytest.raises(ValueError, match=r"Some\.sh3f is damaged: Bad CRC-32"):
        unpack(tmp_path / "in", tmp_path / "out")
    packed.write_bytes(whole)
    (found,) = unpack(tmp_path / "in", tmp_path / "out")
    assert Path(found.path).read_text() == "v 0 0 0\n"


@pytest.mark.parametrize(
    "changes", [{"elevation": 40}, {"category": "Vehicles"}, {"doorOrWindow": "true"}, {"width": 500}, {"model": "/no"}]
)
def test_what_does_not_stand_in_a_room_is_left_out(tmp_path: Path, changes: dict[str, object]) -> None:
    with pytest.raises(FileNotFoundError, match="sweethome3d-furniture"):
        unpack(library(tmp_path / "in", catalogue(**changes)), tmp_path / "out")


@pytest.fixture
def blender(tmp_path: Path) -> Path:
    script = tmp_path / "blender.py"
    script.write_text(BLENDER)
    python = tmp_path / "python"
    python.write_text(f'#!/bin/sh\nexec "{sys.executable}" "{script}" "$@"\n')
    python.chmod(0o755)
    return python


def test_views_become_frames_and_are_not_rendered_again(tmp_path: Path, blender: Path) -> None:
    textures, out, said = tmp_path / "textures", tmp_path / "out", list[str]()
    textures.mkdir()
    cv2.imwrite(str(textures / "grey.png"), np.full((4, 4, 3), 128, np.uint8))
    model = Furniture("table.obj", (1.2, 0.6, 0.75), 0.7)
    render(blender, [model], textures, due(out, 2), out, said.append)
    assert len(said) == 2 * VIEWS
    frames = load_frames(out)
    assert len(frames) == 2  # neither the dark nor the unseen
    for frame in frames:
        assert frame.image.shape == (SIZE_PX[1], SIZE_PX[0], 3)
        assert frame.image.min() == frame.image.max() == 255
        assert frame.depth_m[:, :100] == pytest.approx(1.5, rel=1e-3)
        assert frame.depth_m[0, -1] == pytest.approx(1.5, rel=1e-3)  # too far to tell: as what is beside it
        assert frame.focal_length_px == 420
    assert "CC BY" in (out / "LICENCES.md").read_text()
    assert not list((out / "raw").iterdir())
    assert len(json.loads((out / "cameras.json").read_text())) == 2 * VIEWS
    assert [room["seed"] for room in due(out, 3)] == [2]
