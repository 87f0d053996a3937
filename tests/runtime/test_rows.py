"""Interpolation along rows: exact for polynomials, increments that add up, steps that are noticed."""

import numpy as np
import pytest
from scipy.stats import norm

from hcnaf_runtime.rows import Panels

SIZES = [(7, 8), (64, 8), (200, 20), (201, 16), (1000, 20)]


def between(panels, function):
    return np.diff(function(panels.points))[:, None].astype(np.float32)


@pytest.mark.parametrize(("rows", "order"), SIZES)
def test_polynomials_are_exact(rows, order):
    panels = Panels(rows, order)

    def cubic(row):
        t = 2.0 * row / rows - 1.0
        return 0.5 + 0.3 * t - 0.2 * t**2 + 0.1 * t**3

    found = panels.increments(between(panels, cubic))[:, 0]
    np.testing.assert_allclose(found, np.diff(cubic(np.arange(rows + 1.0))), atol=2e-7)


@pytest.mark.parametrize(("rows", "order"), SIZES)
def test_increments_add_up_whatever_the_function(rows, order):
    panels = Panels(rows, order)
    steps = np.random.default_rng(0).random((len(panels.points) - 1, 3)).astype(np.float32)
    found = panels.increments(steps)
    np.testing.assert_allclose(found.sum(axis=0, dtype=np.float64), steps.sum(axis=0, dtype=np.float64), rtol=1e-5)


@pytest.mark.parametrize(("rows", "order"), SIZES)
def test_points_cover_the_rows(rows, order):
    panels = Panels(rows, order)
    assert panels.points[0] == 0
    assert panels.points[-1] == rows
    assert (np.diff(panels.points) > 0).all()
    edges = np.linspace(-3.0, 5.0, rows + 1, dtype=np.float32)
    np.testing.assert_allclose(panels.places(edges)[[0, -1]], [-3.0, 5.0], atol=1e-6)


def test_a_smooth_function_is_told_from_a_step():
    """The last coefficients fall fast where interpolation is accurate, and do not where it is not."""
    panels = Panels(200, 20)

    def judged(sigma, centre=110.3):
        def cdf(row):
            return norm.cdf((row - centre) / sigma)

        steps = between(panels, cdf)
        error = np.abs(panels.increments(steps)[:, 0] - np.diff(cdf(np.arange(201.0)))).max()
        before, after = panels.tails(steps)
        return error, float(before), float(after)

    error, before, after = judged(20.0)
    assert error < 3e-7
    assert after < 1e-6
    error, before, after = judged(0.2)
    assert error > 0.05
    assert after > 1e-3
    assert after > 0.3 * before


@pytest.mark.parametrize(("rows", "order"), [(200, 20), (201, 16)])
def test_values_at_edges(rows, order):
    panels = Panels(rows, order)
    edges = np.array([0, 3, rows // 2, rows])
    square = (panels.points / rows) ** 2
    np.testing.assert_allclose(panels.at(edges) @ square, (edges / rows) ** 2, atol=1e-6)


@pytest.mark.parametrize("rows", [200, 201])
def test_increments_go_where_they_are_asked_to(rows):
    panels = Panels(rows, 20)
    steps = np.random.default_rng(0).random((2, len(panels.points) - 1, 3)).astype(np.float32)
    wide = np.full((2, rows, 7), -1.0, np.float32)
    found = panels.increments(steps, wide[..., 2:5])
    assert np.shares_memory(found, wide)
    np.testing.assert_array_equal(wide[..., 2:5], panels.increments(steps))
    assert (wide[..., [0, 1, 5, 6]] == -1).all()


def test_panels_of_other_heights():
    assert Panels(200, 32, 128).count == 2
    assert Panels(200, 32).count == 4
    assert len(Panels(200, 32, 128).points) == 65
