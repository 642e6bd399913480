"""A model folder comes back as networks that give its answers, and that training can go on from."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from onnxruntime import InferenceSession
from typer.testing import CliRunner

from model_export.batch_norms import restored, spread_norms
from model_export.cli import commands
from model_export.config import SceneConfig, TrainConfig
from model_export.export import export_checkpoint
from model_export.losses import Batch, run_pair
from model_export.networks import Pair
from model_export.pool import held_out
from model_export.scenes import Material
from service.inference.artifact import Graphs, load_model_folder, write_manifest

SHIPPED = Path(__file__).parents[2] / "service" / "models"
GAIN = 0.9


@pytest.fixture(scope="module")
def shipped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What ships, with a gain."""
    folder = tmp_path_factory.mktemp("models") / "gained"
    shutil.copytree(SHIPPED, folder)
    write_manifest(folder, load_model_folder(folder).manifest.model_copy(update={"blur_gain": GAIN}))
    return folder


@pytest.fixture(scope="module")
def batch() -> Batch:
    return held_out(SceneConfig(size_px=64, margin_px=16), Material(), range(4))


def differences(pair: Pair, batch: Batch) -> list[float]:
    """The largest difference of each output of the blur network from the shipped graph's."""
    session = InferenceSession(SHIPPED / load_model_folder(SHIPPED).manifest.graphs.blur.file)
    blur_px, *answers = session.run(None, {"image": batch.image.numpy()})
    with torch.inference_mode():
        seen = pair.blur(batch.image)
    own = (seen.blur_px, seen.log_error, *seen.features)
    return [float(np.abs(a - b.numpy()).max()) for a, b in zip((GAIN * blur_px, *answers), own, strict=True)]


def test_the_answers_are_the_folders_before_and_after_the_norms_have_their_part(shipped: Path, batch: Batch) -> None:
    pair = restored(shipped)
    assert max(differences(pair, batch)) < 1e-3
    with torch.inference_mode():
        _, before = run_pair(pair, batch)
    spread_norms(pair, [lambda: run_pair(pair, batch)])
    assert max(differences(pair, batch)) < 1e-3
    with torch.inference_mode():
        _, after = run_pair(pair, batch)
    torch.testing.assert_close(after.log_ratio_near, before.log_ratio_near, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(after.log_scale, before.log_scale, rtol=1e-3, atol=1e-3)


def test_in_training_mode_the_norms_see_what_they_were_set_to(shipped: Path, batch: Batch) -> None:
    pair = restored(shipped)
    spread_norms(pair, [lambda: run_pair(pair, batch)])
    with torch.inference_mode():
        settled = pair.blur(batch.image).blur_px
        pair.modules().train()
        on_this_batch = pair.blur(batch.image).blur_px
    torch.testing.assert_close(on_this_batch, settled, rtol=0.01, atol=0.01)


def test_another_kind_of_folder_is_refused() -> None:
    with pytest.raises(ValueError, match="no folded graphs"):
        restored(SHIPPED / "int8")


def test_a_folder_is_exported_anew_with_its_weights_and_what_they_learned_from(shipped: Path, tmp_path: Path) -> None:
    given: list[Pair] = []

    def write_graphs(pair: Pair, folder: Path) -> Graphs:
        given.append(pair)
        graphs = load_model_folder(shipped).manifest.graphs
        for graph in (graphs.blur, graphs.depth, graphs.layout):
            assert graph is not None
            shutil.copy(shipped / graph.file, folder)
        return graphs

    manifest = export_checkpoint(shipped, (), tmp_path / "anew", write_graphs=write_graphs)
    own, expected = given[0].modules().state_dict(), restored(shipped).modules().state_dict()
    torch.testing.assert_close(own, expected, rtol=0, atol=0)
    before, anew = load_model_folder(shipped), load_model_folder(tmp_path / "anew")
    assert (manifest.training.config, manifest.training.steps, manifest.ranges) == (
        TrainConfig.from_dict(before.manifest.training.config).as_dict(),  # what is newer has its default
        before.manifest.training.steps,
        before.manifest.ranges,
    )
    licences = anew.card().partition("## Licence and sources")[2].partition("## Scores")[0]
    assert "CC0" in licences
    assert licences in before.card()


@pytest.mark.parametrize(
    ("checkpoint", "out", "said"),
    [
        ("checkpoint.pt", "model", "--textures"),
        ("runs", "model", "is this a model folder?"),
        ("int8", "model", "has no folded graphs"),
        ("runs", "runs", "written over"),
    ],
)
def test_what_cannot_be_exported_is_said_and_nothing_written(
    checkpoint: str, out: str, said: str, tmp_path: Path
) -> None:
    (tmp_path / "checkpoint.pt").touch()
    (tmp_path / "runs").mkdir()
    (tmp_path / "int8").symlink_to(SHIPPED / "int8")
    arguments = ["export", "--checkpoint", tmp_path / checkpoint, "--out", tmp_path / out]
    result = CliRunner().invoke(commands, list(map(str, arguments)))
    assert result.exit_code == 1
    assert said in result.stderr.replace("\n", "")
    assert not (tmp_path / "model").exists()
    assert not any((tmp_path / "runs").iterdir())
