"""Weights in whole steps whose errors make up for each other: GPTQ (Frantar et al., ICLR 2023).

A sum of products is off by what rounding each weight does, times what the weight sees. What is seen is correlated, so
the weights that are not rounded yet can take back, on the whole, what rounding one has done.
"""

from functools import reduce
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import cholesky, inv
from torch import Tensor
from torch.nn import functional

RIDGE = 1e-2  # of the mean variance: weights do not lean on what is but seldom seen apart

Floats = NDArray[np.float64]


class Seen(NamedTuple):
    """What the k weights of an output see: means [k] and covariances [k,k]."""

    means: Floats
    covariances: Floats

    @classmethod
    def of(cls, maps: list[NDArray[np.float32]], kernel: tuple[int, int], dilation: int, padding: int) -> "Seen":
        """What a convolution of stride 1 sees of maps [n,c,h,w], k = c * kernel cells in the order of its weights."""
        patches = [_patches(torch.from_numpy(each), kernel, dilation, padding) for each in maps]
        count = sum(len(each) for each in patches)
        means = reduce(torch.add, (each.sum(0, dtype=torch.float64) for each in patches)) / count
        products = reduce(torch.add, ((each.T @ each).double() for each in patches)) / count
        return cls(means.numpy(), (products - torch.outer(means, means)).numpy())


def _patches(maps: Tensor, kernel: tuple[int, int], dilation: int, padding: int) -> Tensor:
    """What the kernel lies on at each cell [cells,k]."""
    return functional.unfold(maps, kernel, dilation, padding).transpose(1, 2).flatten(0, 1)


def rounded(weights: Floats, most: int, covariances: Floats) -> Floats:
    """Weights [o,k], in steps, as whole numbers of at most ``most`` either way, for outputs that see such covariances.

    One weight after the other is rounded, and those after it are changed so that the output's variance from what it was
    becomes least.
    """
    count = len(covariances)
    ridge = RIDGE * np.trace(covariances) / count
    factor = cholesky(inv(covariances + max(ridge, np.finfo(float).tiny) * np.eye(count)))
    left, whole = weights.copy(), np.empty_like(weights)
    for k in range(count):
        whole[:, k] = np.clip(np.rint(left[:, k]), -most, most)
        left[:, k:] -= np.outer((left[:, k] - whole[:, k]) / factor[k, k], factor[k, k:])
    return whole
