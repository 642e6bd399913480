"""Noise filters take faint texture and keep outlines, as those in cameras do."""

import numpy as np
import pytest
import torch
from torch import Tensor

from model_export import noise_filter
from model_export.noise_filter import filtered

SIZE, STEP = 64, 100 / 255


@pytest.fixture(params=[0.0, 1.0], ids=["means", "cored"])
def alone(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """One of the filters, without what follows it."""
    monkeypatch.setattr(noise_filter, "CORED_SHARE", request.param)
    for share in ("COLOUR_SHARE", "SHARPENED_SHARE", "COMPRESSED_SHARE"):
        monkeypatch.setattr(noise_filter, share, 0.0)


def texture(levels: float) -> Tensor:
    """Grain [24,3,h,w] of so many grey levels, left dark and right bright."""
    seen = torch.randn(24, 1, SIZE, SIZE, generator=torch.Generator().manual_seed(0)).expand(-1, 3, -1, -1)
    return 0.3 + STEP * (torch.arange(SIZE) >= SIZE // 2) + levels / 255 * seen


def gain(levels: float) -> float:
    """How much of the grain is left, of a grain's own amplitude."""
    rng = np.random.default_rng(0)
    seen = texture(levels) - texture(0)
    left = filtered(rng, texture(levels)) - texture(0)
    inside = (..., slice(8, -8), slice(4, SIZE // 2 - 8))
    return float((left[inside] * seen[inside]).sum() / (seen[inside] ** 2).sum())


@pytest.mark.usefixtures("alone")
def test_faint_texture_goes_and_strong_texture_stays() -> None:
    assert gain(2) < 0.6
    assert gain(25) > 0.75


@pytest.mark.usefixtures("alone")
def test_outlines_stay() -> None:
    left = filtered(np.random.default_rng(0), texture(0)).mean((0, 1, 2))
    steps = left.diff()
    assert float(steps[SIZE // 2 - 1]) > 0.8 * STEP
    assert float(steps.sum()) == pytest.approx(STEP, rel=0.02)


def test_the_same_seed_filters_alike_and_grey_levels_are_whole() -> None:
    one, same, other = (filtered(np.random.default_rng(seed), texture(3)) for seed in (1, 1, 2))
    assert torch.equal(one, same)
    assert not torch.equal(one, other)
    torch.testing.assert_close(one * 255, (one * 255).round(), atol=1e-3, rtol=0)
