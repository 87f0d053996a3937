"""Independent pixels per class: what can be had without looking at any other pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hcnaf_export.data.mnist import ALPHA, CLASSES, Images, log_jacobian

Array = NDArray[np.float64]

LEVELS = 256
SMOOTHING = 0.1
"""Added to every count."""


@dataclass(frozen=True, eq=False)
class Histograms:
    """`log_density` [K, D, LEVELS]: log p(u_d | class) with u in (0, 1), constant within a grey level."""

    log_density: Array

    @classmethod
    def fit(cls, images: Images) -> Histograms:
        """The grey levels of each class and pixel, counted."""
        D = images.pixels.shape[1]
        counts = np.full((CLASSES, D, LEVELS), SMOOTHING)
        np.add.at(counts, (images.labels[:, None], np.arange(D), images.pixels), 1.0)
        return cls(np.log(counts / counts.sum(-1, keepdims=True)) + np.log(LEVELS))

    def log_prob(self, x: NDArray[np.floating]) -> Array:
        """log p(x | class) [K, N] of logits [N, D], nats."""
        u = (1.0 / (1.0 + np.exp(-x.astype(np.float64))) - ALPHA) / (1.0 - 2.0 * ALPHA)
        level = np.clip(np.floor(u * LEVELS), 0, LEVELS - 1).astype(np.int64)
        pixel = np.arange(x.shape[1])
        return np.stack([one[pixel, level].sum(-1) for one in self.log_density]) - log_jacobian(x)
