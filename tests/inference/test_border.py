"""A black border shows nothing; what is dark in a photograph does."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from service.inference.border import black_border, continued

HEIGHT, WIDTH = 480, 640

Pixels = NDArray[np.uint8]


def scene(low: int = 40, high: int = 220) -> Pixels:
    """Blurred noise of these levels."""
    noise = np.random.default_rng(0).random((HEIGHT, WIDTH, 3)).astype(np.float32)
    soft = cv2.GaussianBlur(noise, (0, 0), 6)
    return np.asarray(low + (high - low) * (soft - soft.min()) / np.ptp(soft), np.uint8)


def compressed(rgb: Pixels) -> Pixels:
    return np.asarray(cv2.imdecode(cv2.imencode(".jpg", rgb, [cv2.IMWRITE_JPEG_QUALITY, 80])[1], 1), np.uint8)


def outside(shape: str) -> NDArray[np.bool_]:
    v, u = np.mgrid[-1 : 1 : HEIGHT * 1j, -1 : 1 : WIDTH * 1j]
    return np.asarray(
        {
            "bars": abs(v) > 0.75,
            "one bar": u > 0.8,
            "rectified": (abs(v) > 0.85 + 0.15 * u**2) | (abs(u) > 0.85 + 0.15 * v**2),
            "turned": abs(v + 0.15 * u) > 0.95,
            "circle": u**2 + (v * HEIGHT / WIDTH) ** 2 > 1.1,
        }[shape]
    )


@pytest.mark.parametrize("shape", ["bars", "one bar", "rectified", "turned", "circle"])
def test_a_border_is_found_to_a_few_pixels_however_it_is_shaped(shape: str) -> None:
    hidden, rgb = outside(shape), scene()
    rgb[hidden] = 0
    rgb[200:280, 260:380] = 0  # something black in the middle is none of it
    found = black_border(compressed(rgb))
    assert found is not None
    assert (found != hidden).mean() < 0.01


def test_a_border_about_a_scene_without_blue_is_found() -> None:
    hidden, rgb = outside("circle"), scene()
    rgb[..., 2] = 0
    rgb[hidden] = 0
    found = black_border(rgb)
    assert found is not None
    assert (found != hidden).mean() < 0.01


def shadow(rgb: Pixels) -> Pixels:
    light = np.clip((np.arange(WIDTH) - 160) / 160, 0, 1)[:, np.newaxis]
    return np.asarray(rgb * light, np.uint8)


def with_square(rgb: Pixels) -> Pixels:
    rgb[160:320, 240:440] = 0
    return rgb


def with_dark_object(rgb: Pixels) -> Pixels:
    levels = np.random.default_rng(1).integers(-5, 12, (HEIGHT - 120, 200, 1))
    rgb[120:, :200] = np.maximum(levels, 0)
    return rgb


def with_dark_red_object(rgb: Pixels) -> Pixels:
    return np.asarray(with_dark_object(rgb) * np.where(rgb.max(2, keepdims=True) < 20, (1, 0, 0), 1), np.uint8)


@pytest.mark.parametrize(
    "darken", [np.copy, np.zeros_like, shadow, with_square, with_dark_object, with_dark_red_object]
)
def test_what_is_dark_in_a_photograph_is_no_border(darken: Callable[[Pixels], Pixels]) -> None:
    assert black_border(darken(scene())) is None


def test_what_is_seen_is_continued_mirrored() -> None:
    rgb, hidden = scene(), outside("bars")
    top = int(np.argmin(hidden[:, 0]))
    seen = top + 2  # what compression may have spoilt is none of it
    rgb[hidden] = 0
    filled = continued(rgb, hidden)
    np.testing.assert_array_equal(filled[:seen], rgb[seen + 1 : 2 * seen + 1][::-1])
    np.testing.assert_array_equal(filled[seen : HEIGHT - seen], rgb[seen : HEIGHT - seen])


@pytest.mark.parametrize("turns", range(4))
def test_a_border_wider_than_what_is_seen_is_continued_by_the_far_edge(turns: int) -> None:
    rgb, hidden = scene(), np.zeros((HEIGHT, WIDTH), np.bool_)
    hidden[:, :400] = True
    filled = np.rot90(continued(np.rot90(rgb, turns).copy(), np.rot90(hidden, turns).copy()), -turns)
    np.testing.assert_array_equal(filled[:, :402], rgb[:, np.minimum(2 * 402 - np.arange(402), WIDTH - 1)])
    np.testing.assert_array_equal(filled[:, 402:], rgb[:, 402:])


def test_where_nothing_is_seen_beyond_the_outline_its_nearest_pixel_is_continued() -> None:
    rgb, hidden = scene(), np.ones((HEIGHT, WIDTH), np.bool_)
    hidden[50:60, 70:80] = False
    filled = continued(rgb, hidden)
    np.testing.assert_array_equal(filled[:40, 74], np.repeat(rgb[52:53, 74], 40, axis=0))
    np.testing.assert_array_equal(filled[52:58, 72:78], rgb[52:58, 72:78])
