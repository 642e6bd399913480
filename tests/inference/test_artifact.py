"""The model folder: what the manifest does not vouch for is refused, by name."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from service.config import SHIPPED_MODEL
from service.inference.artifact import LAYOUT_MAP, ModelFolderError, load_model_folder, write_manifest
from tests.inference.oracle_pair import BLUR_RANGE, build_oracle_pair


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return build_oracle_pair(tmp_path / "model")


def edit(folder: Path, change: dict[str, Any]) -> None:
    path = folder / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))


def test_an_intact_folder_is_read_back_as_written(folder: Path) -> None:
    loaded = load_model_folder(folder)
    assert loaded.manifest.graphs.feature_names == ("features_red",)
    assert loaded.manifest.ranges.blur_px == BLUR_RANGE
    assert loaded.blur_graph.is_file()
    assert loaded.card().startswith("# Oracle")
    before = (folder / "manifest.json").read_bytes()
    write_manifest(folder, loaded.manifest)
    assert (folder / "manifest.json").read_bytes() == before


def test_ranges_are_pairs_in_json(folder: Path) -> None:
    assert json.loads((folder / "manifest.json").read_text())["ranges"]["blur_px"] == [0.3, 60.0]


@pytest.mark.parametrize("name", ["blur.onnx", "depth.onnx", "MODEL_CARD.md"])
def test_an_altered_file_is_refused_by_name(folder: Path, name: str) -> None:
    with (folder / name).open("ab") as stream:
        stream.write(b" ")
    with pytest.raises(ModelFolderError, match=rf"{name} is not the file"):
        load_model_folder(folder)


@pytest.mark.parametrize("name", ["blur.onnx", "depth.onnx", "MODEL_CARD.md", "manifest.json"])
def test_a_missing_file_is_refused_by_name(folder: Path, name: str) -> None:
    (folder / name).unlink()
    with pytest.raises(ModelFolderError, match=name):
        load_model_folder(folder)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"schema_version": 2}, "schema_version"),
        ({"surprise": 1}, "surprise"),
        ({"multiple": 15}, "multiple"),
        ({"card": {"file": "../card.md", "sha256": "0" * 64}}, "card.file"),
        ({"card": {"file": "/etc/passwd", "sha256": "0" * 64}}, "card.file"),
    ],
)
def test_a_manifest_that_breaks_the_schema_is_refused(folder: Path, change: dict[str, Any], fault: str) -> None:
    edit(folder, change)
    with pytest.raises(ModelFolderError, match=fault):
        load_model_folder(folder)


def test_a_link_out_of_the_folder_is_refused(folder: Path) -> None:
    outside = folder.parent / "outside.onnx"
    (folder / "blur.onnx").rename(outside)
    (folder / "blur.onnx").symlink_to(outside)
    with pytest.raises(ModelFolderError, match="out of the model folder"):
        load_model_folder(folder)


def test_no_manifest_is_written_for_the_wrong_bytes(folder: Path) -> None:
    manifest = load_model_folder(folder).manifest
    (folder / "manifest.json").unlink()
    (folder / "depth.onnx").write_bytes(b"half a graph")
    with pytest.raises(ModelFolderError, match=r"depth\.onnx"):
        write_manifest(folder, manifest)
    assert not (folder / "manifest.json").exists()


def test_graphs_that_do_not_fit_are_refused(folder: Path) -> None:
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["graphs"]["blur"]["outputs"].pop()
    edit(folder, manifest)
    with pytest.raises(ModelFolderError, match="features_red"):
        load_model_folder(folder)


@pytest.fixture
def with_layout(tmp_path: Path) -> Path:
    return Path(shutil.copytree(SHIPPED_MODEL, tmp_path / "shipped"))


def test_an_altered_layout_is_refused_by_name(with_layout: Path) -> None:
    with (with_layout / "layout.onnx").open("ab") as stream:
        stream.write(b" ")
    with pytest.raises(ModelFolderError, match=r"layout\.onnx is not the file"):
        load_model_folder(with_layout)


def test_a_layout_without_a_map_to_see_is_refused(with_layout: Path) -> None:
    manifest = json.loads((with_layout / "manifest.json").read_text())
    outputs = manifest["graphs"]["depth"]["outputs"]
    manifest["graphs"]["depth"]["outputs"] = [output for output in outputs if output["name"] != LAYOUT_MAP]
    edit(with_layout, manifest)
    with pytest.raises(ModelFolderError, match=LAYOUT_MAP):
        load_model_folder(with_layout)
