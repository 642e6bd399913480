"""One depth from two hypotheses, beside drawing truths from both."""

import numpy as np
import pytest
from numpy.typing import NDArray

from service.inference.hypotheses import HARDLY_OUT, LEAST_P_NEAR, SIGMA_OF_LAPLACE, doubted, in_metres, merged


def drawn_truths(near_m: float, far_m: float, p_near: float, error: float) -> NDArray[np.float64]:
    """A million, some about the near hypothesis and some about the far one."""
    rng = np.random.default_rng(5)
    about = np.where(rng.random(1_000_000) < p_near, near_m, far_m)
    return np.asarray(about * np.exp(rng.laplace(0, error / SIGMA_OF_LAPLACE, about.size)))


def answer(near_m: float, far_m: float, p_near: float, error: float) -> tuple[float, float, bool]:
    one = [np.array([value], np.float32) for value in (near_m, far_m, p_near, error)]
    depth_m, deviation, is_far = merged(one[0], one[1], one[2], one[3])
    return float(depth_m[0]), float(deviation[0]), bool(is_far[0])


@pytest.mark.parametrize("error", [0.05, 0.2, 0.5])
@pytest.mark.parametrize("p_near", [0.01, 0.2, 0.36, 0.45, 0.7, 0.97])
@pytest.mark.parametrize(("near_m", "far_m"), [(1.6, 2.6), (1.9, 2.1), (0.4, 5.0)])
def test_depth_is_the_median_of_both_and_its_error_their_deviation_from_it(
    near_m: float, far_m: float, p_near: float, error: float
) -> None:
    truths, near_truths, far_truths = (drawn_truths(near_m, far_m, p, error) for p in (p_near, 1.0, 0.0))
    depth_m, deviation, _ = answer(near_m, far_m, p_near, error)
    weight = min(far_m / near_m, (1 - LEAST_P_NEAR) / LEAST_P_NEAR)
    nearer = weight * p_near * (near_truths < depth_m).mean() + (1 - p_near) * (far_truths < depth_m).mean()
    assert nearer / (weight * p_near + 1 - p_near) == pytest.approx(0.5, abs=0.003)
    assert deviation == pytest.approx(np.sqrt((np.log(truths / depth_m) ** 2).mean()), rel=0.01)


@pytest.mark.parametrize(("p_near", "depth_m"), [(1.0, 1.5), (0.0, 3.0)])
def test_what_is_surely_on_one_side_is_that_hypothesis_with_its_own_error(p_near: float, depth_m: float) -> None:
    assert answer(1.5, 3.0, p_near, 0.3)[:2] == pytest.approx((depth_m, 0.3), rel=1e-6)


@pytest.mark.parametrize("error", [1e-3, 0.05, 0.5])
def test_depth_never_grows_where_near_grows_likelier(error: float) -> None:
    p_near = np.linspace(0, 1, 1001, dtype=np.float32)
    same = np.ones_like(p_near)
    depth_m, _, is_far = merged(1.5 * same, 3 * same, p_near, error * same)
    assert (np.diff(depth_m) <= 1e-6).all()
    assert depth_m[0] == pytest.approx(3.0)
    assert depth_m[-1] == pytest.approx(1.5)
    assert (is_far == (p_near < LEAST_P_NEAR)).all()


def test_hypotheses_far_apart_or_at_one_place_do_not_overflow() -> None:
    near_m, far_m = np.array([0.01, 2.0, 2.0], np.float32), np.array([90.0, 2.0, 2.0000002], np.float32)
    depth_m, deviation, _ = merged(near_m, far_m, np.full(3, 0.35, np.float32), np.full(3, 1e-4, np.float32))
    assert np.isfinite(depth_m).all()
    assert np.isfinite(deviation).all()
    assert (near_m <= depth_m * 1.000001).all()
    assert (depth_m <= far_m * 1.000001).all()


@pytest.mark.parametrize(("defocus", "share"), [(0.0, 0.0), (HARDLY_OUT, 0.5), (10 * HARDLY_OUT, 0.99)])
def test_the_side_is_as_sure_as_blur_can_tell(defocus: float, share: float) -> None:
    odds = np.array([1e-3, 0.25, 1.0, 3.0, 999.0])
    p_near = (odds / (1 + odds)).astype(np.float32)
    found = doubted(p_near, np.full_like(p_near, defocus)).astype(np.float64)
    np.testing.assert_allclose(np.log(found / (1 - found)), share * np.log(odds), atol=0.002)


def test_a_sure_side_does_not_overflow() -> None:
    found = doubted(np.array([0, 1, 0, 1], np.float32), np.array([0, 0, 9, 9], np.float32))
    np.testing.assert_allclose(found, [0.5, 0.5, 0, 1], atol=1e-5)


def test_a_deviation_in_metres_is_what_depth_is_off_its_median_by() -> None:
    rng = np.random.default_rng(0)
    error = np.array([0.02, 0.1, 0.2, 0.3])
    drawn = np.exp(rng.laplace(0, error / SIGMA_OF_LAPLACE, (2_000_000, 4)))
    off = np.sqrt(np.mean((drawn - 1) ** 2, 0))
    np.testing.assert_allclose(in_metres(error.astype(np.float32)), off, rtol=0.01)


def test_a_deviation_in_metres_grows_to_the_whole_depth_and_no_further() -> None:
    error = np.linspace(0.01, 1, 100).astype(np.float32)
    found = in_metres(error)
    assert found.dtype == np.float32
    assert (found >= error).all()
    assert (np.diff(found) > 0).all()
    assert found[-1] == 1
