"""Certified maps of distributions that a single Gaussian is not: two modes, gaps between them, crossing ridges.

The distribution is a mixture written in numpy, in place of a bundle's graphs.
"""

import numpy as np
import pytest
from scipy.stats import norm

from hcnaf_runtime import Grid
from hcnaf_runtime.cells import masses
from hcnaf_runtime.plane import Window

MIXTURES = {
    "two modes": [(0.5, 5, -10, 1, 1, 0.3), (0.5, 60, 30, 2, 0.7, -0.6)],
    "a sliver far away": [(0.999, 10, 0, 1.5, 1.5, 0), (0.001, 70, -40, 0.3, 0.3, 0.9)],
    "crossing ridges": [(0.5, 30, 0, 12, 12, 0.998), (0.5, 30, 0, 12, 12, -0.998)],
    "narrow on wide": [(0.9, 20, 0, 12, 12, 0), (0.1, 33.3, 11.1, 0.05, 0.08, 0)],
    "a fork": [(0.4, 30, 20, 10, 8, 0.99), (0.4, 30, -20, 10, 8, -0.99), (0.2, 45, 0, 8, 0.4, 0)],
    "mostly outside": [(0.7, 120, 0, 5, 5, 0), (0.3, 72, 45, 3, 4, 0.5)],
}


class Mixture:
    """The graphs' answers for a mixture of Gaussians (weight, mean x, mean y, sigma x, sigma y, rho)."""

    hidden = 20

    def __init__(self, parts):
        self.parts = [np.float64(part) for part in parts]

    def marginal_cdf(self, theta, x):
        return sum(w * norm.cdf(x, mx, sx) for w, mx, _, sx, _, _ in self.parts).astype(np.float32)

    def exact(self, x, y):
        """F_2 [B, E, S] given x [B, S] at y [B, E] in float64."""
        x, y = np.float64(x)[:, None], np.float64(y)[..., None]
        log_p = [np.log(w) + norm.logpdf(x, mx, sx) for w, mx, _, sx, _, _ in self.parts]
        top = np.max(log_p, axis=0)
        share = np.exp(log_p - top)
        share /= share.sum(axis=0)
        means = [my + rho * sy / sx * (x - mx) for _, mx, my, sx, sy, rho in self.parts]
        spreads = [sy * np.sqrt(1 - rho**2) for *_, sy, rho in self.parts]
        return sum(s * norm.cdf(y, m, d) for s, m, d in zip(share, means, spreads, strict=True))

    def grid_cdf(self, theta, x, y):
        return self.exact(x, y).astype(np.float32)

    def cell_mass(self, theta, x, weight, doubt, y):
        steps = np.maximum(np.diff(self.grid_cdf(theta, x, y), axis=1), 0)
        raw = steps @ weight
        error = np.maximum(np.abs(steps @ doubt).max(axis=1), -np.minimum(raw, 0).sum(axis=1))
        return np.maximum(raw, 0), error

    def each(self, work, items):
        for item in items:
            work(item)


GRID = Grid(200, 200, 0.5).ahead()
WINDOW = Window(GRID.x_edges, GRID.y_edges)


def _truth(mixture, panels=40):
    """[R, C] by 8-point Gauss-Legendre on `panels` panels of every column, in float64."""
    t, w = np.polynomial.legendre.leggauss(8)
    edges = np.linspace(0, 1, panels + 1)
    half = 0.5 / panels
    share = ((edges[:-1] + half)[:, None] + half * t).ravel()
    omega = np.tile(w * half, panels)
    x_edges, y_edges = WINDOW.x.astype(np.float64), WINDOW.y.astype(np.float64)
    truth = np.zeros((len(y_edges) - 1, len(x_edges) - 1))
    for c in range(truth.shape[1]):
        x = x_edges[c] + (x_edges[c + 1] - x_edges[c]) * share
        p = sum(part[0] * norm.pdf(x, part[1], part[3]) for part in mixture.parts)
        F = mixture.exact(x[None], y_edges[None])[0]
        truth[:, c] = np.diff(F, axis=0) @ (p * omega * (x_edges[c + 1] - x_edges[c]))
    return truth


@pytest.mark.parametrize("name", MIXTURES)
def test_dense_maps_are_exact_and_sparse_ones_within_the_certificate(name):
    mixture, theta = Mixture(MIXTURES[name]), np.zeros((1, 1), np.float32)
    truth = _truth(mixture)
    dense = masses(mixture, theta, WINDOW, 2e-6)
    assert np.abs(dense.mass[0] - truth).max() < 1e-5
    assert np.abs(dense.mass[0].sum(axis=0, dtype=np.float64) - truth.sum(axis=0)).max() < 2e-6
    for lost_mass in (1e-2, 1e-4):
        sparse = masses(mixture, theta, WINDOW, 2e-6, lost_mass)
        assert sparse.lost[0] <= lost_mass
        missing = truth.sum() - sparse.mass.sum(dtype=np.float64)
        assert -1e-5 <= missing <= sparse.lost[0] + 1e-5
        assert np.abs(sparse.mass - dense.mass).max() <= sparse.lost[0] + 4e-6
        assert np.count_nonzero(sparse.mass) <= np.count_nonzero(dense.mass)
