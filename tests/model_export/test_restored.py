"""A model folder comes back as networks that give its answers, and that training can go on from."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from onnxruntime import InferenceSession

from model_export.config import SceneConfig
from model_export.losses import Batch, run_pair
from model_export.networks import Pair
from model_export.restored import restored, spread_norms
from model_export.scenes import Material
from model_export.train import held_out
from service.inference.artifact import load_model_folder, write_manifest

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
    return held_out(SceneConfig(size_px=64, margin_px=16), Material(), 4)


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
