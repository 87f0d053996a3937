"""Grids: placed exactly, parsed strictly."""

import numpy as np
import pytest

from hcnaf_runtime import Grid
from hcnaf_runtime.errors import GridError


def test_parse():
    assert Grid.parse("200x100@0.5") == Grid(200, 100, 0.5)


@pytest.mark.parametrize(
    "text",
    ["", "200", "200x200", "0x5@1", "5x0@1", "5x5@0", "5x5@-1", "5x5@nan", "5x5@1e999", "9999x5@1", "5x5@."],
)
def test_parse_refuses(text):
    with pytest.raises(GridError):
        Grid.parse(text)


def test_edges_are_the_same_float_in_every_grid_that_shares_them():
    small, large = Grid(10, 10, 0.1).at(0.7, -3.0), Grid(500, 300, 0.1).at(0.7, -3.0)
    np.testing.assert_array_equal(small.x_edges, large.x_edges[:11])
    np.testing.assert_array_equal(small.y_edges, large.y_edges[:11])
    assert small.x_edges.dtype == np.float32


def test_centres_are_row_major_from_the_lower_left():
    centres = Grid(3, 2, 0.5).at(1.0, 2.0).centres
    assert centres.shape == (2, 3, 2)
    np.testing.assert_allclose(centres[0, 0], [1.25, 2.25])
    np.testing.assert_allclose(centres[1, 2], [2.25, 2.75])


def test_places():
    assert Grid(200, 200, 0.5).ahead().origin == (-25.0, -50.0)
    assert Grid(4, 2, 1.0).around(10.2, -3.4).origin == (8.0, -4.0)


def test_unplaced_and_unresolvable_grids():
    with pytest.raises(GridError, match="no origin"):
        _ = Grid(2, 2, 1.0).x_edges
    with pytest.raises(GridError, match="too small for float32"):
        Grid(10, 10, 0.01).at(1e6, 0.0)
    with pytest.raises(GridError, match="too small for float32"):
        Grid(10, 10, 0.5).at(float("inf"), 0.0)
