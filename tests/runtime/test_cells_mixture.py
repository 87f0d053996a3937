"""Certified maps of distributions that a single Gaussian is not: two modes, gaps between them, crossing ridges.

The distributions are mixtures written in numpy (`analytic`), in place of a bundle's graphs.
"""

import numpy as np
import pytest
from analytic import Mixture

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


GRID = Grid(200, 200, 0.5).ahead()
WINDOW = Window(GRID.x_edges, GRID.y_edges)


@pytest.mark.parametrize("name", MIXTURES)
def test_dense_maps_are_exact_and_sparse_ones_within_the_certificate(name):
    mixture, theta = Mixture(MIXTURES[name]), np.zeros((1, 1), np.float32)
    truth = mixture.truth(WINDOW)
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
