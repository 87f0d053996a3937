"""Scores of samples and paths, by the definitions of the motion forecasting benchmarks.

All displacements are between box centres, in metres. A window's paths are n draws x_1 .. x_n of what
`hcnaf_runtime.samples.trajectories` gives, y is its recorded label (with label noise), Q horizons:

    min_ade_k     min over k paths of (1 / Q) sum_q |x_q - y_q|
    min_fde_k     min over k paths of |x_Q - y_Q|, at the last horizon
    miss_rate_k   share of windows with min_fde_k > 2 m
    energy_score  E|X - y| - E|X - X'| / 2 per horizon, X and X' independent draws of its marginal: 0 at best,
                  proper, in metres

Each is the expected value for k paths drawn at random: a window's n draws are cut in n / k groups and averaged.
Paths are coupled by quantiles, so min_ade_k is about that coupling too; energy_score is about marginals only.

References:
    Caesar et al., nuScenes, CVPR 2020 (minADE, minFDE, miss rate). Gneiting & Raftery, JASA 102 (2007), eq. 22.
"""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from hcnaf_export.evaluation.spread import mean_and_error

Float = NDArray[np.float64]

PATHS = (6, 20)
"""The k scored."""

DRAWS = 120
"""Paths drawn per window: whole groups of each k."""

MISS = 2.0
"""A final displacement above this is a miss (m)."""


class PathScore(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Scores of the best of k paths over all horizons, with standard errors; miss_rate is a share from 0 to 1."""

    k: int
    min_ade: float
    min_ade_error: float
    min_fde: float
    min_fde_error: float
    miss_rate: float
    miss_rate_error: float


class EnergyScore(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One horizon (s): the energy score (m) and its standard error."""

    horizon: float
    energy_score: float
    error: float


class SampleScores(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Scores of samples on `windows` snippets in `clusters`, `draws` paths each."""

    windows: int
    clusters: int
    draws: int
    paths: tuple[PathScore, ...]
    energy: tuple[EnergyScore, ...]

    def record(self, split: str) -> dict[str, dict[str, float]]:
        """Columns by horizon and by k."""
        found = {f"{split} energy score (m)": {f"{e.horizon:g} s": e.energy_score for e in self.energy}}
        for p in self.paths:
            found[f"{split} best of {p.k} paths"] = {
                "min_ade (m)": p.min_ade,
                "min_fde (m)": p.min_fde,
                "miss_rate": p.miss_rate,
            }
        return found


class WindowScores(NamedTuple):
    """Scores of each of W windows: min_ade, min_fde and misses [W, len(PATHS)], energy [W, Q]."""

    min_ade: Float
    min_fde: Float
    misses: Float
    energy: Float


def score_paths(points: Float, truth: Float, ks: tuple[int, ...] = PATHS) -> WindowScores:
    """Scores of paths `points` [W, n, Q, 2] against labels `truth` [W, Q, 2] (m); every k divides n."""
    away = np.linalg.norm(points - truth[:, None], axis=-1)  # [W, n, Q]
    columns = [(_best(away.mean(axis=2), k), _best(away[..., -1], k)) for k in ks]
    min_ade = np.stack([ade.mean(axis=1) for ade, _ in columns], axis=1)
    min_fde = np.stack([fde.mean(axis=1) for _, fde in columns], axis=1)
    misses = np.stack([(fde > MISS).mean(axis=1) for _, fde in columns], axis=1)
    return WindowScores(min_ade, min_fde, misses, energy_scores(points, truth))


def energy_scores(points: Float, truth: Float) -> Float:
    """[W, Q] of at least two draws, without bias: a draw is not compared with itself."""
    n = points.shape[1]
    near = np.linalg.norm(points - truth[:, None], axis=-1).mean(axis=1)
    apart = np.stack([np.linalg.norm(p[:, None] - p[None], axis=-1).sum(axis=(0, 1)) for p in points])
    return np.asarray(near - 0.5 * apart / (n * (n - 1)))


def summarise_paths(
    horizons: tuple[float, ...], found: WindowScores, cluster: NDArray[np.int64], draws: int = DRAWS
) -> SampleScores:
    """Means over windows with their standard errors over clusters [W]."""
    parts = [mean_and_error(v, cluster) for v in found[:3]]
    rows = [[float(v[i]) for part in parts for v in part] for i in range(len(PATHS))]
    energy = mean_and_error(found.energy, cluster)
    return SampleScores(
        windows=len(cluster),
        clusters=len(np.unique(cluster)),
        draws=draws,
        paths=tuple(PathScore(k, *row) for k, row in zip(PATHS, rows, strict=True)),
        energy=tuple(EnergyScore(t, float(v), float(e)) for t, v, e in zip(horizons, *energy, strict=True)),
    )


def joined(parts: list[WindowScores]) -> WindowScores:
    """Windows of several parts, one after the other."""
    return WindowScores(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _best(error: Float, k: int) -> Float:
    """Least error [W, n / k] of each group of k paths."""
    W, n = error.shape
    return np.asarray(error.reshape(W, n // k, k).min(axis=2))
