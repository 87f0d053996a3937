"""What is below 0 is taken out of interpolated cells, and columns keep what they hold."""

import numpy as np
import pytest

from hcnaf_runtime.canvas import ROUNDED, column_sums, settle

RNG = np.random.default_rng(0)


def maps(dip):
    """[3, 20, 8]: positive cells but for one in each of two maps, -dip."""
    mass = RNG.uniform(1e-4, 2e-4, (3, 20, 8)).astype(np.float32)
    mass[0, 4, 2] = mass[2, 0, 7] = -dip
    return mass


def test_column_sums():
    mass = maps(1e-5)
    np.testing.assert_allclose(column_sums(mass), mass.sum(axis=1), rtol=1e-6)


@pytest.mark.parametrize("in_place", [True, False])
@pytest.mark.parametrize("dip", [1e-5, 1e-9])
def test_nothing_is_below_zero_and_columns_keep_what_they_hold(dip, in_place):
    mass = maps(dip)
    total, before = column_sums(mass), mass.copy()
    out = mass if in_place else np.full_like(mass, np.nan)
    below = settle(mass, total, out)
    np.testing.assert_allclose(below, [dip, 0.0, dip], rtol=1e-5)
    assert out.min() >= 0.0
    np.testing.assert_allclose(column_sums(out), total, atol=max(2e-9, ROUNDED * (dip < ROUNDED)))
    np.testing.assert_array_equal(out[1], before[1])  # each map by itself
    assert np.abs(out - np.maximum(before, 0.0)).max() <= dip


def test_a_column_that_holds_less_than_nothing_is_left_empty():
    mass = np.full((5, 3), 1e-5, np.float32)
    mass[2, 1] = -1e-4
    settle(mass, column_sums(mass), mass)
    np.testing.assert_array_equal(mass[:, 1], 0.0)
    assert (mass[:, [0, 2]] == np.float32(1e-5)).all()
