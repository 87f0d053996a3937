"""A Gaussian with full covariance per class: the baseline of the MNIST protocol that any right code reproduces."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hcnaf_runtime.errors import DataError

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Gaussians:
    """`mean` [K, D], and `factor` [K, D, D] with the covariances factor factor^T (lower triangular)."""

    mean: Array
    factor: Array

    @classmethod
    def fit(cls, x: NDArray[np.floating], labels: NDArray[np.int64], classes: int) -> Gaussians:
        """Mean and covariance of each class, by maximum likelihood, for points x [N, D].

        Raises:
            DataError: a class has too few points for a covariance.
        """
        parts = [x[labels == k].astype(np.float64) for k in range(classes)]
        least = min(len(part) for part in parts)
        if least <= x.shape[1]:
            raise DataError(f"a class has {least} points, expected more than the {x.shape[1]} dimensions")
        factor = [np.linalg.cholesky(np.cov(part, rowvar=False, bias=True)) for part in parts]
        return cls(np.stack([part.mean(0) for part in parts]), np.stack(factor))

    def log_prob(self, x: NDArray[np.floating]) -> Array:
        """log p(x | class) [K, N] in nats for points x [N, D]."""
        return np.stack([self._one(k, x.astype(np.float64)) for k in range(len(self.mean))])

    def _one(self, k: int, x: Array) -> Array:
        z = np.linalg.solve(self.factor[k], (x - self.mean[k]).T)
        log_det = -np.log(np.diagonal(self.factor[k])).sum()
        out: Array = log_det - 0.5 * (z**2).sum(0) - 0.5 * x.shape[1] * math.log(2.0 * math.pi)
        return out


def marginal(log_prob: Array) -> Array:
    """log sum_y p(x | y) / K [N] from log p(x | y) [K, N]."""
    highest = log_prob.max(0)
    total: Array = highest + np.log(np.exp(log_prob - highest).mean(0))
    return total
