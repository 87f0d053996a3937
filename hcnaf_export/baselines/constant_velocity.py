"""What any forecast has to beat: constant velocity with Gaussian errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hcnaf_export.data.tracks import STEP, TrackSet
from hcnaf_runtime.errors import HorizonError

Float = NDArray[np.float64]

LOG_2PI = float(np.log(2.0 * np.pi))


@dataclass(frozen=True, eq=False)
class ConstantVelocityGaussian:
    """p(x, y | t) = N(x; v t, var_x(t)) N(y; 0, var_y(t)) in the frame of the observed state now (x forward).

    v is the observed speed. The two variances per horizon are the training set's mean squares.

    Attributes:
        horizons: [Q] s.
        variance: [Q, 2], along and across, m².
    """

    horizons: tuple[float, ...]
    variance: Float
    name: str = "constant velocity"

    @classmethod
    def fit(cls, sets: Sequence[TrackSet], horizons: Sequence[float]) -> ConstantVelocityGaussian:
        """Variances of the windows of some track sets, at horizons (s, multiples of the recording's step)."""
        squares = [np.square(_errors(s, s.windows, horizons)) for s in sets]
        return cls(tuple(horizons), np.concatenate(squares).mean(axis=0))

    def nll(self, tracks: TrackSet, windows: ArrayLike, horizons: Sequence[float]) -> Float:
        """-log p of the recorded labels, nats per m²: [W, Q] for windows [W, 2] (track, step).

        Raises:
            HorizonError: a horizon that was not fitted.
        """
        missing = sorted(set(horizons) - set(self.horizons))
        if missing:
            raise HorizonError(f"the baseline was not fitted at {missing[0]:g} s; fit it at the horizons to score")
        variance = self.variance[[self.horizons.index(t) for t in horizons]]
        errors = _errors(tracks, np.asarray(windows), horizons)
        return np.asarray((0.5 * (errors**2 / variance + np.log(variance) + LOG_2PI)).sum(axis=-1))


def label_steps(horizons: Sequence[float]) -> NDArray[np.int64]:
    """Rows after now of horizons (s). Raises HorizonError where there is no row at a horizon."""
    steps = np.rint(np.asarray(horizons) / STEP).astype(np.int64)
    if (steps < 1).any() or (np.abs(steps * STEP - horizons) > 1e-6).any():
        raise HorizonError(f"horizons are {list(horizons)} s, labels exist at multiples of {STEP} s; choose those")
    return steps


def labels(tracks: TrackSet, windows: NDArray[np.int32], horizons: Sequence[float]) -> Float:
    """Recorded labels [W, Q, 2] in the network's frame, m."""
    track, step = windows.T
    rows = tracks.rows(track[:, None], step[:, None] + label_steps(horizons))
    if (rows < 0).any():
        raise HorizonError(f"a window of {tracks.name} ends before {max(horizons):g} s; score shorter horizons")
    return tracks.label[rows].astype(np.float64)


def _errors(tracks: TrackSet, windows: NDArray[np.int32], horizons: Sequence[float]) -> Float:
    """Label minus (v t, 0) in the frame of the observed state now: [W, Q, 2], m."""
    track, step = windows.T
    x, y, yaw, speed = tracks.observed[tracks.rows(track, step)].astype(np.float64).T[..., None]
    d = labels(tracks, windows, horizons)
    dx, dy = d[..., 0] - x, d[..., 1] - y
    along = np.cos(yaw) * dx + np.sin(yaw) * dy - speed * np.asarray(horizons)
    return np.stack([along, np.cos(yaw) * dy - np.sin(yaw) * dx], axis=-1)
