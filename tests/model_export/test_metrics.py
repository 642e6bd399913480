"""Scores, each checked where its value is known."""

import numpy as np
import pytest

from model_export.metrics import best_constant, completed, mean_scores, score


def test_scores_of_a_known_error() -> None:
    truth = np.array([1.0, 2.0, 4.0], np.float32)
    scores = score(truth * np.float32(1.3), truth)
    assert scores.abs_rel == pytest.approx(0.3, rel=1e-5)
    assert scores.rmse == pytest.approx(0.3 * np.sqrt(7), rel=1e-5)
    assert scores.mse == pytest.approx(scores.rmse**2)
    assert scores.log10 == pytest.approx(np.log10(1.3), rel=1e-5)
    assert (scores.delta1, scores.delta2, scores.delta3) == (0, 1, 1)


def test_no_constant_beats_the_best_one() -> None:
    truth = np.random.default_rng(0).uniform(0.5, 3, 999).astype(np.float32)
    found = score(np.full_like(truth, best_constant(truth)), truth).abs_rel
    others = [score(np.full_like(truth, c), truth).abs_rel for c in np.linspace(0.4, 3, 200)]
    assert found <= min(others) + 1e-4


def test_an_unanswered_pixel_is_scored_with_the_median() -> None:
    depth = np.array([1.0, np.nan, 3.0, 2.0], np.float32)
    np.testing.assert_array_equal(completed(depth), np.array([1, 2, 3, 2], np.float32))
    np.testing.assert_array_equal(completed(np.full(3, np.nan, np.float32)), np.ones(3, np.float32))


def test_the_mean_is_over_pictures() -> None:
    one, two = np.ones(10, np.float32), np.ones(1000, np.float32)
    mean = mean_scores([score(one * np.float32(1.2), one), score(two, two)])
    assert mean.abs_rel == pytest.approx(0.1, rel=1e-5)
