"""The flow of a bundle as functions: its graphs, and densities at many points in bounded memory."""

from typing import Any

import numpy as np
import numpy.typing as npt

from hcnaf_runtime.bundle import Bundle
from hcnaf_runtime.cells import CHUNK, Distribution
from hcnaf_runtime.session import Settings

Float32 = npt.NDArray[np.float32]


class Flow(Distribution):
    """The graphs of `bundle` that take theta [B, P]. Stateless and safe to share between threads."""

    def __init__(self, bundle: Bundle, settings: Settings) -> None:
        self._bundle = bundle
        self._settings = settings

    @property
    def dims(self) -> int:
        """D."""
        return self._bundle.manifest.flow.dims

    @property
    def hidden(self) -> int:
        """H, hidden units per dimension."""
        return self._bundle.manifest.flow.hidden

    def marginal_cdf(self, theta: Float32, x: Float32) -> Float32:
        """F_1 [B, K] at `x` [B, K] (m)."""
        return self._run("marginal_cdf", "cdf", theta=theta, x=x)

    def conditional_cdf(self, theta: Float32, x: Float32, y: Float32) -> Float32:
        """F_2 [B, S, E] at `y` [B, S, E] given `x` [B, S] (m)."""
        return self._run("conditional_cdf", "cdf", theta=theta, x=x, y=y)

    def cell_mass(self, theta: Float32, x: Float32, weight: Float32, y: Float32) -> Float32:
        """[B, E - 1, C]: sum over s of weight [B, C, S] times F_2's increments along y [E] given x [B, S]."""
        return self._run("cell_mass", "mass", theta=theta, x=x, weight=weight, y=y)

    def log_prob(self, theta: Float32, points: Float32, chunk: int = CHUNK) -> Float32:
        """log p [B, N] at `points` [B, N, D] (nats per m² for D = 2), in runs of `chunk` numbers."""
        B, N, _ = points.shape
        step = max(1, chunk // (self.hidden * self.dims))
        if step >= B * N:
            return self._run("flow", "log_prob", theta=theta, points=points)
        result = np.empty((B, N), np.float32)
        for b in range(B):
            for n in range(0, N, step):
                some = points[b : b + 1, n : n + step]
                result[b, n : n + step] = self._run("flow", "log_prob", theta=theta[b : b + 1], points=some)[0]
        return result

    def _run(self, graph: Any, output: str, **feeds: Float32) -> Float32:
        session = self._bundle.session(graph, self._settings)
        tensors = {name: np.ascontiguousarray(value) for name, value in feeds.items()}
        result: Float32 = session.run([output], tensors)[0]
        return result
