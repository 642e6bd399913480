"""What a camera's sharpening leaves at circles' edges, and that light as it fell, or by a tone curve, does not."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from model_export.render import GAUSSIAN
from service.calibration.edge import EdgeFit, PointSpread, fit_edge
from service.calibration.sharpening import sharpened
from service.opencv import cv2
from service.optics.light import decode_srgb, encode_srgb
from tests.calibration.test_edge import circle, photographed

Levels = NDArray[np.float32]
SPREAD = PointSpread("gaussian")


def as_it_fell(levels: Levels) -> Levels:
    return levels


def with_contrast(levels: Levels) -> Levels:
    return np.asarray(3 * levels**2 - 2 * levels**3, np.float32)


def with_sharpening(levels: Levels) -> Levels:
    return np.asarray(levels + 0.6 * (levels - cv2.GaussianBlur(levels, (0, 0), 1.0)), np.float32)


def edges(develop: Callable[[Levels], Levels], *blur_px: float) -> list[EdgeFit]:
    """Circles of a sheet of paper that were blurred so, and noisy, as a file has them."""
    read, paper = [], 0.8 * circle()
    for sigma in blur_px:
        light = np.clip(photographed(paper, sigma, GAUSSIAN, 0.005), 0, 1)
        levels = np.rint(255 * np.clip(develop(encode_srgb(light)), 0, 1)) / 255
        read.append(fit_edge(decode_srgb(levels.astype(np.float32)), 63, 65, 24))
    return read


@pytest.mark.parametrize("develop", [as_it_fell, with_contrast, with_sharpening])
def test_sharpening_is_told_by_its_ring(develop: Callable[[Levels], Levels]) -> None:
    sharp, blurred = edges(develop, 0.7, 0.9), edges(develop, 1.5)
    assert len(sharpened(9 * blurred + 12 * sharp, SPREAD)) == (develop is with_sharpening)


@pytest.mark.parametrize(("part", "is_told"), [(0.2, False), (0.4, True)])
def test_a_ring_of_a_hundredth_of_the_contrast_is_told(part: float, *, is_told: bool) -> None:
    """A sharpening of 0.2 leaves 0.006 about a sharp circle, one of 0.4 leaves 0.015."""

    def develop(levels: Levels) -> Levels:
        return as_it_fell(levels) + np.float32(part / 0.6) * (with_sharpening(levels) - levels)

    assert len(sharpened(24 * edges(develop, 0.7), SPREAD)) == is_told


@pytest.mark.parametrize(("ringed", "is_told"), [(17, False), (19, True)])
def test_three_quarters_of_the_sharpest_circles_tell_sharpening(ringed: int, *, is_told: bool) -> None:
    (with_ring,), (without,) = edges(with_sharpening, 0.9), edges(as_it_fell, 0.7)
    assert len(sharpened([*ringed * [with_ring], *(24 - ringed) * [without]], SPREAD)) == is_told
