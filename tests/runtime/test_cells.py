"""Cell masses against a Gaussian's own, computed by high-order quadrature of its density in float64."""

import numpy as np
import pytest
from gaussian_bundle import make_theta
from scipy.stats import norm

from hcnaf_runtime import Forecaster, Grid
from hcnaf_runtime.cells import masses
from hcnaf_runtime.plane import CHUNK, Window

GAUSSIANS = {
    "wide": (5, 1, 2, 1.5, 0.5),
    "narrow": (0.1, 0.2, 0.1, 0.1, 0.0),
    "narrow diagonal": (0.1, 0.2, 0.1, 0.1, 0.99),
    "narrow diagonal far away": (60.1, 0.2, 0.1, 0.1, 0.99),
    "on a corner": (0.0, 0.0, 0.1, 0.1, -0.99),
    "long ridge": (20, 3, 3, 3, -0.995),
    "thin across": (3.3, 0.7, 0.05, 2, 0.5),
    "thin along": (3.3, 0.7, 3, 0.05, 0.9),
    "wider than the window": (0, 0, 30, 20, 0.3),
    "half outside": (75, 0, 2, 2, 0.9),
}


def found(flow, theta, window, tolerance, chunk=CHUNK):
    cells = masses(flow, theta, window, tolerance, chunk=chunk)
    return cells.mass, cells.error


def _window(grid):
    return Window(grid.x_edges, grid.y_edges)


WINDOW = _window(Grid(200, 200, 0.5).ahead())


def _truth(theta, window, panels=24):
    """[R, C]: 16-point Gauss-Legendre on `panels` panels of every column."""
    mx, my, sx, sy, rho = theta[0].astype(np.float64)
    t, w = np.polynomial.legendre.leggauss(16)
    X, Y = window.x.astype(np.float64), window.y.astype(np.float64)
    truth = np.zeros((len(Y) - 1, len(X) - 1))
    for c in np.flatnonzero((X[1:] > mx - 9 * sx) & (X[:-1] < mx + 9 * sx)):
        edges = np.linspace(X[c], X[c + 1], panels + 1)
        half = (edges[1] - edges[0]) / 2
        x = ((edges[:-1] + half)[:, None] + half * t).ravel()
        F = norm.cdf((Y[:, None] - my - rho * sy / sx * (x - mx)) / (sy * np.sqrt(1 - rho**2)))
        truth[:, c] = np.diff(F, axis=0) @ (np.tile(w * half, panels) * norm.pdf(x, mx, sx))
    return truth


@pytest.mark.parametrize("name", GAUSSIANS)
def test_cells_columns_and_error(name, forecaster):
    theta = make_theta(*GAUSSIANS[name])
    mass, error = found(forecaster.flow, theta, WINDOW, 1e-6)
    truth = _truth(theta, WINDOW)
    assert np.abs(mass[0] - truth).max() < 2e-6
    assert error[0] < 5e-6
    assert np.abs(mass[0].sum(axis=0, dtype=np.float64) - truth.sum(axis=0)).max() < 1e-6
    assert mass.min() >= 0


def test_what_cannot_be_resolved_is_confessed(forecaster):
    """A ridge a millimetre thin across half a metre: the reported error covers the real one."""
    theta = make_theta(0.01, 0.01, 0.02, 0.02, 0.999)
    mass, error = found(forecaster.flow, theta, WINDOW, 1e-6)
    real = np.abs(mass[0] - _truth(theta, WINDOW, panels=2000)).max()
    assert 1e-5 < real <= error[0]
    assert mass.sum(dtype=np.float64) == pytest.approx(1, abs=1e-6)


def test_column_sums_are_exact_whatever_the_tolerance(forecaster):
    theta = make_theta(*GAUSSIANS["narrow diagonal"])
    edges = np.broadcast_to(WINDOW.x, (1, len(WINDOW.x)))
    columns = np.diff(forecaster.flow.marginal_cdf(theta, edges)[0])
    for tolerance in (1e-2, 1e-6):
        mass, _ = found(forecaster.flow, theta, WINDOW, tolerance)
        slack = max(tolerance, 1e-6)
        np.testing.assert_allclose(mass[0].sum(axis=0), columns, atol=slack)


def test_batch_equals_stacked_singles(forecaster):
    theta = np.concatenate([make_theta(*values) for values in GAUSSIANS.values()])
    together, error = found(forecaster.flow, theta, WINDOW, 1e-6)
    for b in range(len(theta)):
        alone, own_error = found(forecaster.flow, theta[b : b + 1], WINDOW, 1e-6)
        np.testing.assert_allclose(together[b], alone[0], atol=1e-8)  # padding changes the order of sums
        assert error[b] == pytest.approx(own_error[0], abs=1e-7)


@pytest.mark.parametrize("name", ["wide", "narrow diagonal", "long ridge", "wider than the window"])
@pytest.mark.parametrize("chunk", [1, 3_000, 1 << 24])
def test_chunked_equals_whole(name, chunk, forecaster):
    window = _window(Grid(60, 50, 0.5).at(-2, -10))
    theta = make_theta(*GAUSSIANS[name])
    whole, _ = found(forecaster.flow, theta, window, 1e-6)
    chunked, _ = found(forecaster.flow, theta, window, 1e-6, chunk)
    np.testing.assert_allclose(chunked, whole, atol=1e-7)


def test_a_window_is_a_part_of_a_larger_one(forecaster):
    theta = make_theta(*GAUSSIANS["long ridge"])
    whole, _ = found(forecaster.flow, theta, WINDOW, 1e-6)
    part, _ = found(forecaster.flow, theta, Window(WINDOW.x[60:110], WINDOW.y[90:120]), 1e-6)
    np.testing.assert_allclose(part[0], whole[0, 90:119, 60:109], atol=2e-6)


def test_finer_cells_add_up_to_coarser_ones(forecaster):
    theta = make_theta(*GAUSSIANS["narrow diagonal"])
    coarse, _ = found(forecaster.flow, theta, _window(Grid(20, 20, 0.5).at(-5, -5)), 1e-6)
    fine, _ = found(forecaster.flow, theta, _window(Grid(40, 40, 0.25).at(-5, -5)), 1e-6)
    summed = fine[0].reshape(20, 2, 20, 2).sum(axis=(1, 3))
    np.testing.assert_allclose(summed, coarse[0], atol=4e-6)


@pytest.mark.parametrize("mean", [1e4, -1e6])
def test_nothing_inside_is_nothing(mean, forecaster):
    mass, error = found(forecaster.flow, make_theta(mean, mean, 1, 1, 0), WINDOW, 1e-6)
    assert mass.max() == 0
    assert error[0] == 0


def test_a_huge_grid(forecaster):
    window = _window(Grid(4000, 3000, 0.02).at(-20, -30))
    theta = make_theta(10, 0, 0.5, 0.3, 0.8)
    mass, error = found(forecaster.flow, theta, window, 1e-6)
    assert mass.sum(dtype=np.float64) == pytest.approx(1, abs=2e-6)
    assert error[0] < 5e-6


def test_a_single_cell(forecaster):
    theta = make_theta(0, 0, 1, 1, 0)
    mass, _ = found(forecaster.flow, theta, Window(np.float32([-1, 1]), np.float32([-2, 2])), 1e-6)
    expected = (norm.cdf(1) - norm.cdf(-1)) * (norm.cdf(2) - norm.cdf(-2))
    assert mass[0, 0, 0] == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("lost_mass", [1e-2, 1e-4])
@pytest.mark.parametrize("name", GAUSSIANS)
def test_sparse_equals_dense_within_the_certificate(name, lost_mass, forecaster):
    theta = make_theta(*GAUSSIANS[name])
    dense = masses(forecaster.flow, theta, WINDOW, 1e-6)
    sparse = masses(forecaster.flow, theta, WINDOW, 1e-6, lost_mass)
    assert sparse.lost[0] <= lost_mass
    difference = np.abs(sparse.mass - dense.mass).astype(np.float64)
    assert difference.sum() <= sparse.lost[0] + 2e-5  # dense cells themselves agree to the tolerance
    assert difference.max() <= sparse.lost[0] + 2e-6


def test_a_ridge_that_leaves_the_scouts_rows_is_found(forecaster):
    """Steep ridges cross all rows between two scouted nodes; what the landmarks overlook is mended."""
    for rho in (0.999, -0.9999):
        theta = make_theta(10.0, 0.0, 8.0, 20.0, rho)
        cells = masses(forecaster.flow, theta, WINDOW, 1e-6, 1e-4)
        assert cells.lost[0] <= 1e-4
        mass, truth = cells.mass.sum(dtype=np.float64), _truth(theta, WINDOW).sum()
        assert mass - 5e-6 <= truth <= mass + cells.lost[0] + 5e-6


@pytest.mark.parametrize("lost_mass", [0.0, 1e-4])
def test_threads_change_nothing(lost_mass, bundle_path):
    theta = np.concatenate([make_theta(*values) for values in GAUSSIANS.values()])
    for some in (theta, theta[:1]):
        one, two = (masses(Forecaster(bundle_path, threads=n).flow, some, WINDOW, 2e-6, lost_mass) for n in (1, 2))
        for name in ("mass", "inside", "error", "lost"):
            np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
