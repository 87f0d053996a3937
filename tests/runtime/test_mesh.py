"""Meshes: exact for what their polynomials can be, weights that add up, what even spacing is for."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from hcnaf_runtime import smooth
from hcnaf_runtime.mesh import Mesh

EXACT = [
    Mesh(200, 200, 128, 24, 32, 0.0),
    Mesh(203, 197, 256, 24, 32, 0.0),
    Mesh(130, 300, 64, 12, 20, 0.0),
    Mesh(60, 90, 50, 24, 32, 0.0),
]
EVEN = [Mesh(columns, rows, *orders) for orders in smooth.MESHES for columns, rows in ((200, 200), (203, 400))]
MESHES = EXACT + EVEN

PRECISE = 1e-3
"""The share of a polynomial of a low degree that evenly spaced points are wrong by, at most: at the ends."""

FAST = 2.1
"""Radians of a wave per node: crowded ones follow less than 2, even ones pi."""


def polynomial(x, y):
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
    """g linear and F cubic: two nodes in a column are enough for their product."""
    x = edges(mesh, 1)
    F = 0.2 + 0.5 * x - 0.3 * x**2 + 0.4 * x**3
    found = on_mesh(mesh, lambda x, y: x + 0 * y)[:, :1] @ mesh.weights(F[None])
    x = edges(mesh)
    primitive = 0.5 * x**2 / 2 - 0.6 * x**3 / 3 + 1.2 * x**4 / 4
    held = np.diff(F := 0.2 + 0.5 * x - 0.3 * x**2 + 0.4 * x**3)
    assert np.abs(found[0, 0] - np.diff(primitive)).max() < 1e-7 + PRECISE * (mesh.even > 0) * held.max()


@pytest.mark.parametrize("mesh", MESHES)
def test_rises_are_those_of_the_rows_asked_for(mesh):
    rows = (np.arange(mesh.columns) * 7 % mesh.rows)[None]
    found = mesh.rises(mesh.middles(on_mesh(mesh, polynomial)), rows)[0]
    x, y = (np.arange(mesh.columns) + 0.5) / mesh.columns, rows[0] / mesh.rows
    rise = polynomial(x, y + 1 / mesh.rows) - polynomial(x, y)
    assert np.abs(found - rise).max() < 1e-6 + PRECISE * (mesh.even > 0) * np.abs(rise).max()


@pytest.mark.parametrize("mesh", EVEN)
def test_even_spacing_resolves_more(mesh):
    """A wave that as many nodes and points crowded at the ends cannot follow any more."""

    def wave(x, y):
        return np.sin(FAST * mesh.rule.size * x) + np.cos(FAST * len(mesh.between.points) * y)

    x, off = (np.arange(mesh.columns) + 0.5) / mesh.columns, []
    for each in (mesh, replace(mesh, even=0.0)):
        y = each.between.points / mesh.rows
        off.append(np.abs(each.middles(on_mesh(each, wave))[0] - wave(x[:, None], y)).max())
    assert off[0] < 0.1 < 0.5 < off[1]


def test_what_pays():
    assert Mesh(200, 200, 128, 48, 96, 0.9).worth
    assert not Mesh(190, 200, 128, 48, 96, 0.9).worth
    assert not Mesh(200, 190, 128, 48, 96, 0.9).worth
    assert Mesh(10_000, 10_000, 128, 48, 96, 0.9).rule.panels == 8
