"""Textures: every kind is as sharp as pixels allow, and what is plain is as soft as the light upon it."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from model_export import textures
from model_export.datasets.photos import write_image
from model_export.textures import KIND_SHARES, PATTERNS, draw_texture, load_photographs, plain_texture

SIZE = 128
PHOTOGRAPH = np.random.default_rng(0).integers(0, 256, (300, 400, 3)).astype(np.uint8)


def largest_step(texture: NDArray[np.float32]) -> float:
    """The largest difference between neighbours."""
    return max(float(np.abs(np.diff(texture, axis=axis)).max()) for axis in (0, 1))


@pytest.mark.parametrize("kind", [kind for kind in KIND_SHARES if kind not in ("noise", "clouds")])
def test_a_texture_has_edges_as_sharp_as_pixels_allow(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(textures, "KIND_SHARES", {kind: 1.0})
    monkeypatch.setattr(textures, "FADED_SHARE", 0.0)
    drawn = [draw_texture(np.random.default_rng(seed), [PHOTOGRAPH], SIZE) for seed in range(12)]
    assert np.median([largest_step(texture) / max(float(np.ptp(texture)), 0.05) for texture in drawn]) > 0.35
    for texture in drawn:
        assert texture.shape == (SIZE, SIZE, 3)
        assert 0 <= texture.min() <= texture.max() <= 1


@pytest.mark.parametrize("pattern", PATTERNS)
def test_a_pattern_repeats(pattern: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Moved by its period a pattern is itself again: its autocorrelation has a second peak."""
    monkeypatch.setattr(textures, "PATTERNS", (pattern,))
    monkeypatch.setattr(textures, "BENT_SHARE", 0.0)
    monkeypatch.setattr(textures, "PERIOD_PX", (8.0, 24.0))
    for seed in range(4):
        grey = textures._pattern(np.random.default_rng(seed), SIZE).mean(2)
        power = np.abs(np.fft.rfft2(grey - grey.mean())) ** 2
        likeness = np.fft.irfft2(power, s=grey.shape) / power.mean() / 2
        away = np.hypot(*np.meshgrid(*[np.minimum(np.arange(SIZE), SIZE - np.arange(SIZE))] * 2)) > SIZE / 4
        assert likeness[away].max() > 0.3 * likeness[0, 0]


def test_clouds_are_soft_themselves(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(textures, "KIND_SHARES", {"clouds": 1.0})
    monkeypatch.setattr(textures, "FADED_SHARE", 0.0)
    drawn = [draw_texture(np.random.default_rng(seed), [], SIZE) for seed in range(24)]
    assert max(largest_step(texture) / max(float(np.ptp(texture)), 0.05) for texture in drawn) < 0.5
    assert np.median([np.ptp(texture) for texture in drawn]) > 0.2


def test_what_is_plain_has_no_edge() -> None:
    for seed in range(12):
        texture = plain_texture(np.random.default_rng(seed), np.array([0.5, 0.4, 0.3], np.float32), SIZE)
        assert largest_step(texture) < 0.1


def test_a_file_that_is_no_picture_is_named(tmp_path: Path) -> None:
    write_image(tmp_path / "good.png", PHOTOGRAPH)
    (tmp_path / "._good.png").write_bytes(b"macOS'")
    assert len(load_photographs(tmp_path)) == 1
    (tmp_path / "bad.png").write_bytes(b"no picture")
    with pytest.raises(ValueError, match=r"bad\.png is no picture"):
        load_photographs(tmp_path)
