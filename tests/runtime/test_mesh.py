"""Meshes: exact for what their polynomials can be, weights that add up, features that F_1 shows."""

import numpy as np
import pytest
from scipy.stats import norm

from hcnaf_runtime.mesh import Mesh

MESHES = [Mesh(200, 200, 24, 32), Mesh(203, 197, 24, 32), Mesh(130, 300, 12, 20), Mesh(60, 90, 24, 32)]


def smooth(x, y):
    """A polynomial in shares of the window."""
    return 0.3 + 0.2 * x - 0.4 * x**2 * y + 0.5 * y**3 - 0.1 * x * y**2


def edges(mesh, more=0):
    """The columns' edges and so many more on either side, in shares of the window."""
    return np.arange(-more, mesh.columns + 1 + more) / mesh.columns


def on_mesh(mesh, function):
    x = mesh.places(np.linspace(0, 1, mesh.columns + 1, dtype=np.float32)).astype(np.float64)
    y = mesh.between.points / mesh.rows
    return function(x, y[:, None])[None].astype(np.float32)


@pytest.mark.parametrize("mesh", MESHES)
def test_columns_take_what_they_hold(mesh):
    F = norm.cdf(edges(mesh, 1), [[0.6], [0.3]], [[0.2], [0.5]])
    weights = mesh.weights(F)
    assert weights.shape == (2, mesh.rule.size, mesh.columns)
    np.testing.assert_allclose(weights.sum(axis=1), np.diff(F, axis=1)[:, 1:-1], atol=1e-7)


@pytest.mark.parametrize("mesh", MESHES)
def test_integrals_of_polynomials_are_exact(mesh):
    """g quadratic and F cubic: two nodes in a column are enough for their product."""
    x = edges(mesh, 1)
    F = 0.2 + 0.5 * x - 0.3 * x**2 + 0.4 * x**3
    found = on_mesh(mesh, lambda x, y: x + 0 * y)[:, :1] @ mesh.weights(F[None])
    x = edges(mesh)
    primitive = 0.5 * x**2 / 2 - 0.6 * x**3 / 3 + 1.2 * x**4 / 4
    np.testing.assert_allclose(found[0, 0], np.diff(primitive), atol=1e-7)


@pytest.mark.parametrize("mesh", MESHES)
def test_candidates_are_where_they_are_said_to_be(mesh):
    low, high = mesh.at_candidates(on_mesh(mesh, smooth))
    x = (np.arange(mesh.columns) + 0.5) / mesh.columns
    y = mesh.candidates[:, None] / mesh.rows
    np.testing.assert_allclose(low[0], smooth(x, y), atol=1e-6)
    np.testing.assert_allclose(high[0], smooth(x, y + 1 / mesh.rows), atol=1e-6)
    assert mesh.candidates.max() < mesh.rows


@pytest.mark.parametrize("mesh", MESHES)
def test_a_misfit_is_what_polynomials_cannot_be(mesh):
    gentle = np.stack([smooth(edges(mesh), 0.5)] * mesh.columns)
    assert mesh.misfit(gentle).max() < 1e-12
    stepped = gentle + 1e-5 * (np.arange(mesh.columns + 1) > np.arange(mesh.columns)[:, None])
    # At the end of a panel nodes are dense and polynomials nimble.
    assert np.median(mesh.misfit(stepped)) > 2e-6
    assert mesh.misfit(10 * stepped - 9 * gentle) == pytest.approx(10 * mesh.misfit(stepped), abs=1e-12)


def test_what_pays():
    assert Mesh(200, 200, 48, 48).worth
    assert not Mesh(190, 200, 48, 48).worth
    assert not Mesh(200, 190, 48, 48).worth
    assert Mesh(10_000, 10_000, 48, 48).rule.panels == 8
