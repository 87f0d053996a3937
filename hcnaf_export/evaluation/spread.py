"""Means and sums with standard errors that know about dependence."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def mean_and_error(values: ArrayLike, cluster: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Means [Q] of values [W, Q] and their standard errors, with windows of one cluster taken as dependent.

    The cluster-robust error: sqrt(C / (C - 1) sum_c (sum_{i in c} (v_i - mean))²) / W. With windows that
    overlap in time it is far larger than the naive std / sqrt(W), and right. NaN for a single cluster.
    """
    v = np.asarray(values, dtype=np.float64)
    return v.mean(axis=0), sum_error(v, cluster) / len(v)


def sum_error(values: ArrayLike, cluster: ArrayLike) -> NDArray[np.float64]:
    """Standard errors [Q] of the sums of values [W, Q], likewise."""
    v = np.asarray(values, dtype=np.float64)
    _, group = np.unique(np.asarray(cluster), return_inverse=True)
    C = int(group.max()) + 1
    sums = np.zeros((C, v.shape[1]))
    np.add.at(sums, group, v - v.mean(axis=0))
    factor = C / (C - 1) if C > 1 else np.nan
    return np.asarray(np.sqrt(factor * np.square(sums).sum(axis=0)))
