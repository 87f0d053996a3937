"""Coverage of highest-density regions: do 95 % of the labels lie where 95 % of the forecast's mass is densest?

The region of level a is where the density is high enough to hold the mass a. A label lies in it if and only if
the mass that is denser than the label is below a. That mass is estimated from samples of the forecast, each with
its own log-density: with `draws` = n samples a label lies in the region if fewer than a (n + 1) of them are
denser. For a calibrated forecast the label and its n samples are exchangeable, so that this happens with
probability exactly a, whatever n, where a (n + 1) is whole: no bias comes from estimating. The standard error is
over clusters and holds the scatter of the samples too.

References:
    Hyndman, Computing and graphing highest density regions, The American Statistician 50 (1996).
"""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import NDArray

from hcnaf_export.evaluation.spread import mean_and_error

Float = NDArray[np.float64]
Int = NDArray[np.int64]

LEVELS = (0.5, 0.8, 0.95)
"""The masses of the regions."""

DRAWS = 199
"""Samples per window and horizon: each of LEVELS times DRAWS + 1 is whole."""


class RegionScore(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One region: its horizon (s), its level, the share of labels in it, and that share's standard error."""

    horizon: float
    level: float
    covered: float
    error: float


class RegionScores(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Coverage of highest-density regions on `windows` snippets in `clusters`, from `draws` samples each."""

    windows: int
    clusters: int
    draws: int
    rows: tuple[RegionScore, ...]


def denser(drawn: NDArray[np.floating], log_prob: Float) -> Int:
    """How many of the samples, log-densities [W, Q, n], are denser than the label's [W, Q]; [W, Q]."""
    return np.asarray((drawn > log_prob[..., None]).sum(axis=-1), dtype=np.int64)


def summarise_regions(
    horizons: tuple[float, ...], ranks: Int, cluster: Int, draws: int = DRAWS, levels: tuple[float, ...] = LEVELS
) -> RegionScores:
    """Scores of `denser` [W, Q] and each window's cluster [W]."""
    rows = []
    for level in levels:
        covered, error = mean_and_error(ranks < round(level * (draws + 1), 6), cluster)
        rows += [RegionScore(t, level, float(covered[q]), float(error[q])) for q, t in enumerate(horizons)]
    rows.sort(key=lambda row: (row.horizon, row.level))
    return RegionScores(len(ranks), len(np.unique(cluster)), draws, tuple(rows))
