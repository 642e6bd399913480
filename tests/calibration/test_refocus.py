"""What is said of photographs whose focus or aperture was not locked, on circles whose camera is known."""

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from service.calibration.fit import Circles, fit_constants
from service.calibration.refocus import refocused
from service.optics import thin_lens

K_CAM, GAMMA, FOCUS = 6.0, 0.7, 1.2
DEPTHS_M = np.array((0.7, 0.9, 1.1, 1.4, 1.8))
FOLLOWED = (FOCUS * (DEPTHS_M / FOCUS) ** 0.3).tolist()
DRIFTED = [FOCUS * part for part in (0.9, 0.95, 1.0, 1.05, 1.1)]


def circles(
    focus_m: Sequence[float],
    *,
    opened: Sequence[float] = (1, 1, 1, 1, 1),
    seed: int = 0,
    k_cam_px: float = K_CAM,
    errors: tuple[float, float, float] = (0.005, 0.0, 0.01),
) -> Circles:
    """Photographs of a tilted sheet at each depth, each with its focus and aperture; errors as simulated lenses'.

    ``errors`` are those of a photograph's blur, of how it changes over its depths, and of a circle's.
    """
    rng = np.random.default_rng(seed)
    picture = np.repeat(np.arange(DEPTHS_M.size), 40)
    focus, k_cam = np.asarray(focus_m)[picture], k_cam_px * np.asarray(opened)[picture]
    along = rng.uniform(-0.05, 0.05, picture.size)
    depth = DEPTHS_M[picture] * (1 + along)
    blur = thin_lens.blur_at_depth(depth, focus, k_cam * FOCUS / focus, GAMMA)
    error = errors[0] * rng.standard_normal(DEPTHS_M.size)[picture] + errors[2] * rng.standard_normal(picture.size)
    error += errors[1] * rng.standard_normal(DEPTHS_M.size)[picture] * along / along.std()
    nowhere = np.zeros(picture.size, np.bool_)
    return Circles(depth, blur * np.exp(error), np.full(picture.size, 0.02), picture, nowhere)


def said(some: Circles) -> tuple[float, tuple[str, ...]]:
    """The k_cam found, and what is said of the focus."""
    found = fit_constants(some, resamples=0)
    assert not found.warnings
    return found.k_cam_px.value, refocused(some, found)


@pytest.mark.parametrize("seed", range(6))
def test_of_one_focus_nothing_is_said(seed: int) -> None:
    k_cam, words = said(circles([FOCUS] * 5, seed=seed))
    assert k_cam == pytest.approx(K_CAM, rel=0.02)
    assert not words


@pytest.mark.parametrize("seed", [1, 9, 19])
def test_what_photographs_are_off_by_each_in_its_own_way_is_no_focus_that_moved(seed: int) -> None:
    """Circles of one are off together; a small k_cam tells focus so little that it would take on any of that."""
    assert not said(circles([FOCUS] * 5, seed=seed, k_cam_px=1.5, errors=(0.005, 0.0015, 0.003)))[1]


@pytest.mark.parametrize(
    ("focus_m", "opened"),
    [(FOLLOWED, (1, 1, 1, 1, 1)), (DRIFTED, (1, 1, 1, 1, 1)), ([FOCUS] * 5, (1, 1, 1, 0.7, 0.7))],
    ids=["follows the sheet", "drifts", "other aperture"],
)
def test_a_focus_or_an_aperture_that_changed_is_said_though_one_curve_fits(
    focus_m: Sequence[float], opened: Sequence[float]
) -> None:
    k_cam, words = said(circles(focus_m, opened=opened))
    assert abs(k_cam / K_CAM - 1) > 0.1
    assert re.match(r"within photographs .* had moved by \d+% between them: .* lock focus", words[0])


def test_of_a_focus_that_hardly_moved_and_of_mere_noise_nothing_is_said() -> None:
    moved = [FOCUS * part for part in (0.98, 0.99, 1.0, 1.01, 1.02)]
    some = circles(moved)
    focus = np.array(moved)[some.picture]
    exact = np.asarray(thin_lens.blur_at_depth(some.depth_m, focus, K_CAM * FOCUS / focus, GAMMA))
    noise = 0.1 * np.random.default_rng(101).standard_normal(some.picture.size)
    still = circles([FOCUS] * 5, seed=1)
    for one in (replace(some, blur_px=exact), replace(still, blur_px=still.blur_px * np.exp(noise))):
        assert not said(one)[1]


def test_photographs_that_tell_nothing_of_it_are_passed_over() -> None:
    some = circles(FOLLOWED)
    found = fit_constants(some, resamples=0)
    sharp = replace(some, is_focused=np.ones_like(some.is_focused))
    few = np.flatnonzero(np.tile(np.arange(40) < 7, 5))
    for part, of_part in ((sharp, found), (some.only(few), replace(found, is_outlier=found.is_outlier[few]))):
        assert not refocused(part, of_part)
    assert not refocused(some, replace(found, is_outlier=some.picture != 2))
