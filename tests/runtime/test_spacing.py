"""Evenly spaced points: where they are, and that nothing is lost on the way there and back."""

import numpy as np
import pytest

from hcnaf_runtime.spacing import crowded, spaced

CHEBYSHEV = (1.0 - np.cos(np.pi * np.arange(33) / 32)) / 2.0


@pytest.mark.parametrize("even", [0.0, 0.3, 0.9, 0.993])
def test_there_and_back(even):
    s = np.linspace(0.0, 3.0, 301)  # three panels
    np.testing.assert_allclose(crowded(spaced(s, even), even), s, atol=1e-12)


@pytest.mark.parametrize("even", [0.0, 0.5, 0.99])
def test_panels_keep_their_ends_and_their_symmetry(even):
    np.testing.assert_allclose(spaced(np.arange(4.0), even), np.arange(4.0), atol=1e-15)
    places = spaced(CHEBYSHEV, even)
    np.testing.assert_allclose(places + places[::-1], 1.0, atol=1e-12)
    assert (np.diff(places) > 0.0).all()


def test_points_come_as_even_as_asked_for():
    widest = [np.diff(spaced(CHEBYSHEV, even)).max() * 32 for even in (0.0, 0.5, 0.9, 0.99, 0.999999)]
    assert widest[0] == pytest.approx(np.pi / 2, rel=2e-3)
    assert widest == sorted(widest, reverse=True)
    assert widest[-1] == pytest.approx(1.0, abs=2e-3)
