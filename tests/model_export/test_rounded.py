"""Claims: weights rounded for what they see answer nearer to what they did than the nearest whole numbers do."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from model_export.rounded import Seen, rounded

Floats = NDArray[np.float64]


def test_sums_of_what_goes_together_scatter_less_than_with_each_weight_rounded_to_the_nearest() -> None:
    rng = np.random.default_rng(0)
    weights = rng.normal(0, 10, (8, 64))
    seen = rng.normal(0, 1, (5000, 6)) @ rng.normal(0, 1, (6, 64)) + 0.1 * rng.normal(0, 1, (5000, 64))
    covariances = np.cov(seen.T)
    whole = rounded(weights, 64, covariances)
    assert np.array_equal(whole, np.rint(whole))
    assert np.abs(whole).max() <= 64
    assert np.abs(whole - weights).max() < 3
    assert scatter(whole, weights, seen) < 0.5 * scatter(np.rint(weights), weights, seen)


def test_weights_of_what_has_nothing_to_do_with_each_other_are_rounded_to_the_nearest() -> None:
    weights = np.random.default_rng(1).normal(0, 40, (4, 12))
    for variance in (1.0, 0.0):
        assert np.array_equal(rounded(weights, 64, variance * np.eye(12)), np.clip(np.rint(weights), -64, 64))


def test_a_convolution_answers_with_the_mean_and_the_variance_of_what_it_is_seen_to_see() -> None:
    torch.manual_seed(2)
    maps, kernels = torch.rand(3, 4, 12, 10), torch.randn(5, 4, 3, 3)
    seen = Seen.of([one[None].numpy() for one in maps], (3, 3), 2, 2)
    answers = functional.conv2d(maps.double(), kernels.double(), padding=2, dilation=2).movedim(1, 0).flatten(1)
    by_output = kernels.double().flatten(1).numpy()
    np.testing.assert_allclose(by_output @ seen.means, answers.mean(1), rtol=1e-5)
    np.testing.assert_allclose(
        np.diag(by_output @ seen.covariances @ by_output.T), answers.var(1, correction=0), rtol=1e-4
    )


def scatter(whole: Floats, weights: Floats, seen: Floats) -> float:
    return float(np.std(seen @ (whole - weights).T))
