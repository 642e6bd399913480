"""A pair with fewer channels answers as the wide one did, as far as the channels that stay can say it."""

from io import StringIO
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from rich.console import Console

from model_export.checkpoint import Checkpoint, starting_pair
from model_export.config import SceneConfig, TrainConfig
from model_export.losses import Batch, run_pair
from model_export.narrowed import narrow, narrowed
from model_export.networks import Pair, Widths, make_pair
from model_export.pool import held_out
from model_export.scenes import Material

SHIPPED = Path(__file__).parents[2] / "service" / "models"
WIDE = Widths((16, 32, 16, 32), (16, 32, 16, 32))
NARROW = Widths((16, 16, 16, 32), (16, 16, 16, 32))


@pytest.fixture(scope="module")
def batch() -> Batch:
    return held_out(SceneConfig(size_px=64, margin_px=16), Material(), range(4))


def blur_and_depth(pair: Pair, batch: Batch) -> tuple[torch.Tensor, torch.Tensor]:
    with torch.inference_mode():
        blur, depth = run_pair(pair, batch)
    return blur.blur_px, depth.log_ratio_near


def wide_pair() -> Pair:
    torch.manual_seed(3)
    pair = make_pair("compact", WIDE)
    pair.modules().eval()
    return pair


def kernels_of_the_second_level(pair: Pair) -> list[torch.Tensor]:
    modules = pair.modules()
    return [value for name, value in modules.state_dict().items() if ".1.layers." in name and value.dim() == 4]


def test_channels_that_repeat_others_go_without_a_trace(batch: Batch) -> None:
    pair = wide_pair()
    for kernels in kernels_of_the_second_level(pair):
        kernels[16:] = kernels[:16]
    before = blur_and_depth(pair, batch)
    narrow_pair = narrowed(pair, NARROW, [batch])
    assert Widths.of(narrow_pair.modules().state_dict()) == NARROW
    for was, now in zip(before, blur_and_depth(narrow_pair, batch), strict=True):
        torch.testing.assert_close(now, was, rtol=1e-3, atol=1e-3)
    for was, still in zip(before, blur_and_depth(pair, batch), strict=True):
        torch.testing.assert_close(still, was)  # the wide one is left as it was


def test_of_channels_that_say_different_things_the_sums_say_more_than_silence(batch: Batch) -> None:
    pair = wide_pair()
    was, _ = blur_and_depth(pair, batch)
    summed, _ = blur_and_depth(narrowed(pair, NARROW, [batch]), batch)
    for kernels in kernels_of_the_second_level(pair):
        kernels[16:] = 0
    silent, _ = blur_and_depth(pair, batch)
    assert (summed / was).log().abs().mean() < 0.5 * (silent / was).log().abs().mean()


@pytest.mark.parametrize(
    "widths",
    [
        Widths((16, 64, 16, 32), (16, 16, 16, 32)),
        Widths((16, 16, 16, 16), (16, 16, 16, 32)),
        Widths((8, 16, 16, 32), (16, 16, 16, 32)),
        Widths((16, 16, 32), (16, 16, 16, 32)),
        Widths((16, 0, 16, 32), (16, 16, 16, 32)),
    ],
    ids=["more", "fewer at the coarsest", "fewer at the finest", "fewer levels", "none"],
)
def test_only_channels_between_the_finest_and_the_coarsest_level_become_fewer(widths: Widths, batch: Batch) -> None:
    with pytest.raises(ValueError, match="only those between"):
        narrowed(make_pair("compact", WIDE), widths, [batch])


def test_a_shipped_folder_becomes_a_checkpoint_that_training_begins_with(batch: Batch, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "noise.png"), np.random.default_rng(0).integers(0, 255, (90, 120, 3), np.uint8))
    scenes = TrainConfig(pool=8, batch=4, settle_batches=4, scenes=SceneConfig(size_px=64, margin_px=16))
    shipped = starting_pair(SHIPPED, "compact")
    own = Widths.of(shipped.modules().state_dict())
    widths = Widths((own.blur[0], own.blur[1] - 4, *own.blur[2:]), own.depth)
    out, said = tmp_path / "narrow.pt", Console(file=StringIO())
    change = narrow(SHIPPED, tmp_path, widths, out, scenes, said)
    assert 0 < change.blur < 0.2
    assert 0 < change.depth < 0.1
    assert Checkpoint.load(out).step == 0
    begun = starting_pair(out, "compact")
    assert Widths.of(begun.modules().state_dict()) == widths
    for was, now in zip(blur_and_depth(shipped, batch), blur_and_depth(begun, batch), strict=True):
        assert not torch.equal(was, now)
        assert (was - now).abs().mean() < 0.3 * was.abs().mean()
