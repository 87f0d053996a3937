"""Constant velocity with Gaussian errors, for tracks of positions alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TrackGaussian:
    """p(x, y | row k) = N(x; |v| k, var_x) N(y; 0, var_y) from the last position, x along the last displacement v.

    Attributes:
        variance: [F, 2] by row after now, along and across, m²: the training set's mean squares.
    """

    variance: Float

    @classmethod
    def fit(cls, history: ArrayLike, points: ArrayLike) -> TrackGaussian:
        """Of histories [W, T, 2] in any frame and what followed [W, F, 2] in the frame above, m."""
        expected = constant_velocity(history, np.shape(points)[1])
        return cls(np.square(np.asarray(points, dtype=np.float64) - expected).mean(axis=0))

    def nll(self, history: ArrayLike, points: ArrayLike) -> Float:
        """-log p of positions, [W, F] in nats per m²."""
        errors = np.asarray(points, dtype=np.float64) - constant_velocity(history, len(self.variance))
        terms = np.square(errors) / self.variance + np.log(2.0 * np.pi * self.variance)
        return np.asarray(0.5 * terms.sum(axis=-1))

    def paths(self, history: ArrayLike, normal: ArrayLike) -> Float:
        """Paths [W, n, F, 2] (m) for standard normal numbers [W, n, 2]: one pair moves all rows of a path."""
        spread = np.sqrt(self.variance) * np.asarray(normal)[:, :, None]
        return np.asarray(constant_velocity(history, len(self.variance))[:, None] + spread)


def constant_velocity(history: ArrayLike, rows: int) -> Float:
    """Positions of so many rows after now, along and across the last displacement: [W, rows, 2], m."""
    past = np.asarray(history, dtype=np.float64)
    along = np.linalg.norm(past[:, -1] - past[:, -2], axis=-1)[:, None] * np.arange(1, rows + 1)
    return np.stack([along, np.zeros_like(along)], axis=-1)
