r"""The probability integral transform: is a label anywhere in its forecast with the probability that it says?

For a label (x, y) in the agent's frame (x forward) and a forecast with distribution functions F_1 and F_2

    u_1 = F_1(x),   u_2 = F_2(y given x)

are independent and uniform on (0, 1) if the forecast is calibrated. The Kolmogorov-Smirnov statistic of each,

    KS = sup_t |share of windows with u <= t  -  t|

is the largest error of any probability F_d gives on average over all windows; it falls to 0 with their number
only if the forecast is calibrated. Windows of a cluster depend on each other, so the usual critical value
1.36 / sqrt(W) is too small. `critical` is the 95 % quantile of sup_t |sum_c g_c S_c(t)| / W over standard normal
g_c, one for each cluster, with S_c(t) = sum_{i in c} (1(u_i <= t) - share(t)): a multiplier bootstrap. A
calibrated forecast exceeds it with 5 %.

References:
    Rosenblatt, Remarks on a multivariate transformation, 1952. Dawid, Statistical theory: the prequential
    approach, 1984. van der Vaart & Wellner, Weak Convergence and Empirical Processes, 1996, section 2.9
    (multipliers).
"""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Int = NDArray[np.int64]

BINS = 20
"""Of the histograms."""

LEVELS = 200
"""Values of t at which the critical value is computed."""

REPEATS, SEED = 1000, 0
"""Of the bootstrap."""


class CoordinatePit(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One coordinate: the KS statistic, its 5 % critical value, and the share of windows in each of BINS bins."""

    ks: float
    critical: float
    histogram: tuple[float, ...]


class PitScore(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One horizon (s): u_1 = F_1(x) along, u_2 = F_2(y given x) across."""

    horizon: float
    along: CoordinatePit
    across: CoordinatePit


class PitScores(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The transform on `windows` snippets in `clusters`."""

    windows: int
    clusters: int
    rows: tuple[PitScore, ...]


def summarise_pit(horizons: tuple[float, ...], u: Float, cluster: Int) -> PitScores:
    """Scores of u [W, Q, 2] and each window's cluster [W]."""
    rows = [
        PitScore(t, coordinate(u[:, q, 0], cluster), coordinate(u[:, q, 1], cluster))
        for q, t in enumerate(horizons)
    ]
    return PitScores(len(u), len(np.unique(cluster)), tuple(rows))


def coordinate(u: Float, cluster: Int) -> CoordinatePit:
    """Scores of one coordinate's u [W]."""
    counts, _ = np.histogram(u, BINS, (0.0, 1.0))
    return CoordinatePit(ks_statistic(u), critical_value(u, cluster), tuple((counts / len(u)).tolist()))


def ks_statistic(u: Float) -> float:
    """sup_t |share of u [W] at most t - t|, exactly."""
    ordered, W = np.sort(u), len(u)
    above = np.arange(1, W + 1) / W - ordered
    below = ordered - np.arange(W) / W
    return float(max(above.max(), below.max()))


def critical_value(u: Float, cluster: Int) -> float:
    """What KS of a calibrated forecast on such clusters exceeds with 5 %; NaN for a single cluster."""
    _, group = np.unique(cluster, return_inverse=True)
    C = int(group.max()) + 1
    if C < 2:
        return float("nan")
    levels = (np.arange(LEVELS) + 0.5) / LEVELS
    below = (u[:, None] <= levels).astype(np.float64)
    sums = np.zeros((C, LEVELS))
    np.add.at(sums, group, below - below.mean(axis=0))
    g = np.random.default_rng(SEED).standard_normal((REPEATS, C))
    largest = np.abs(g @ sums).max(axis=1) / len(u) * np.sqrt(C / (C - 1))
    return float(np.quantile(largest, 0.95))
