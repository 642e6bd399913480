"""One depth from the two that a blur fits: each is a Laplace law in ln z, and the truth follows one of them."""

import numpy as np
from numpy.typing import NDArray

from service.opencv import exp, log, where

SIGMA_OF_LAPLACE = np.float32(2**0.5)
LEAST_P_NEAR = 0.35
LEAST_DOUBT = np.float32(1e-6)
ALL_IN_DOUBT = 0.54  # of ln z: its deviation in metres is as large as the depth
MOST_IN_METRES = 0.95  # of depth: what is in such doubt grows but slowly from there, to the whole depth
# x at which log odds of the side count half: chosen on the development sets, 0.05 to 0.17 do as well (docs/findings.md)
HARDLY_OUT = 0.07

Array = NDArray[np.float32]


def doubted(p_near: Array, defocus: Array) -> Array:
    """Probabilities of being near as far as blur can tell: their log odds x^2 / (x^2 + HARDLY_OUT^2) times as large.

    ``defocus`` is x, without unit, of the same shape. What is in focus shows no side; a network says one all the same,
    by what things look like, and is too sure of it: of what a real lens shows with x below 0.03 three quarters were on
    the other side, where it stated a quarter.
    """
    variance = np.square(defocus)
    kept = np.clip(p_near, LEAST_DOUBT, 1 - LEAST_DOUBT)
    odds = log((1 - kept) / kept) * (variance / (variance + np.float32(HARDLY_OUT**2)))
    return np.reciprocal(1 + exp(odds))


def merged(near_m: Array, far_m: Array, p_near: Array, error: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Depth in metres, its relative standard deviation, and where the far hypothesis is the likelier; all of one shape.

    ``error`` is the relative standard deviation of either hypothesis, above 0; near is not beyond far. Depth is the
    median of both laws together: one hypothesis where its probability or their distance leaves no doubt, drawn towards
    the other where there is some, half way where neither is likelier. Its deviation is that from both laws.

    For the median a near truth counts far / near times as much, for that is how much more a wrong answer is off there,
    relatively; but no more than leaves far the likelier below ``LEAST_P_NEAR``: the network's probabilities are not
    that exact.
    """
    ratio, p_far = far_m / near_m, 1 - p_near
    odds = p_near * np.minimum(ratio, (1 - LEAST_P_NEAR) / LEAST_P_NEAR)
    lean = (odds - p_far) / (odds + p_far)
    is_far = lean < 0
    gap, scale = log(ratio), error / SIGMA_OF_LAPLACE
    # between the peaks the median solves a quadratic equation in exp(pull / scale)
    np.abs(lean, out=lean)
    square = np.square(lean)
    root = np.sqrt(square + (1 - square) * exp(-gap / scale))
    pull = scale * log((1 + lean) / np.maximum(lean + root, np.finfo(np.float32).tiny))
    from_near = where(is_far, gap - pull, pull)
    deviation = np.sqrt(error**2 + p_near * from_near**2 + p_far * (gap - from_near) ** 2)
    return near_m * exp(from_near), deviation, is_far


def in_metres(error: Array) -> Array:
    """What part of depth its standard deviation in metres is, where ``error`` is that of ln z; from 0 to 1 both.

    Of a Laplace law about ln z with standard deviation s the root mean square of what depth is off its median by is
    s sqrt((1 + s^2) / ((1 - 2 s^2) (1 - s^2 / 2))) of it: more than s, as a depth may be far too small sooner than far
    too large. That has no bound; no more is stated than 0.95 + 0.05 s, so that of two depths the surer one stays it.
    """
    variance = np.square(np.minimum(error, np.float32(ALL_IN_DOUBT)))
    variance *= (1 + variance) / ((1 - 2 * variance) * (1 - variance / 2))
    most: Array = MOST_IN_METRES + (1 - MOST_IN_METRES) * error
    return np.minimum(np.sqrt(variance), most)
