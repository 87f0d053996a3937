"""Sparse maps equal dense ones within their certificate, cell by cell and added up."""

import numpy as np
import pytest

from hcnaf_runtime import Forecaster, Grid, Scene, embedded_scenes

HORIZONS = tuple(0.2 * (k + 1) for k in range(20))
LOST_MASS = 1e-4


@pytest.fixture(scope="module")
def embedded() -> Forecaster:
    return Forecaster(threads=2)


@pytest.mark.parametrize(("grid", "apart"), [(Grid(200, 200, 0.5), 1e-4), (Grid(400, 400, 0.25), 2.5e-4)])
@pytest.mark.parametrize("name", embedded_scenes())
def test_sparse_equals_dense_within_the_certificate(name, grid, apart, embedded):
    """`apart`: what the errors of all cells of a map may add up to, each below a hundred-thousandth."""
    scene = Scene.load(embedded_scenes()[name])
    dense = embedded.pom(scene, grid, HORIZONS)
    sparse = embedded.pom(scene, grid, HORIZONS, lost_mass=LOST_MASS)
    assert (sparse.lost_mass <= LOST_MASS).all()
    difference = np.abs(sparse.mass.astype(np.float64) - dense.mass)
    assert (difference.max(axis=(2, 3)) <= sparse.lost_mass + 1e-5).all()
    assert (difference.sum(axis=(2, 3)) <= sparse.lost_mass + apart).all()
