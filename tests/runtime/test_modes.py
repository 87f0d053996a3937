"""Modes and highest-density regions of maps."""

import numpy as np
import pytest

from hcnaf_runtime import Grid
from hcnaf_runtime.errors import InputError
from hcnaf_runtime.modes import modes, region, watershed

ORIGIN = np.array([-3.0, 5.0])


def _bumps(*bumps, shape=(60, 80)):
    """A map of Gaussian bumps, each row, column, width (cells) and mass."""
    row, column = np.indices(shape)
    total = np.zeros(shape)
    for r, c, width, mass in bumps:
        bump = np.exp(-((row - r) ** 2 + (column - c) ** 2) / (2 * width**2))
        total += mass * bump / bump.sum()
    return total.astype(np.float32)


def _rough(seed):
    rng = np.random.default_rng(seed)
    mass = rng.random((23, 31)) ** 3
    mass[mass < 0.2] = 0.0
    return (mass / mass.sum()).astype(np.float32)


MAPS = [
    _bumps((20, 20, 3, 0.5), (40, 60, 4, 0.4)),
    *(_rough(s) for s in range(4)),
    np.full((3, 4), 0.05, np.float32),
]


@pytest.mark.parametrize("prominence", [0.0, 0.1, 0.5, 1.0])
@pytest.mark.parametrize("mass", MAPS)
def test_basins_together_hold_what_the_map_holds(mass, prominence):
    found = modes(mass, ORIGIN, 0.5, prominence=prominence)
    assert found.mass.sum() == pytest.approx(mass.sum(dtype=np.float64), rel=1e-9)
    assert (np.diff(found.mass) <= 0).all()
    assert (found.mass >= found.peak * (1 - 1e-9)).all()


@pytest.mark.parametrize("mass", MAPS)
def test_without_prominence_the_modes_are_the_local_maxima(mass):
    labels, peaks = watershed(mass, 0.0)
    padded = np.pad(mass, 1)
    around = [
        padded[1 + r : padded.shape[0] - 1 + r, 1 + c : padded.shape[1] - 1 + c]
        for r in (-1, 0, 1)
        for c in (-1, 0, 1)
    ]
    highest = np.max(around, axis=0)
    assert np.isin(peaks, np.flatnonzero(mass.ravel() >= highest.ravel())).all()
    strict = np.flatnonzero((mass > 0) & (np.sum(np.array(around) >= mass, axis=0) == 1))
    assert np.isin(strict, peaks).all()
    np.testing.assert_array_equal(labels >= 0, mass.ravel() > 0)
    assert (mass.ravel()[peaks][labels[labels >= 0]] >= mass.ravel()[labels >= 0]).all()


def test_two_bumps_are_two_modes_with_their_places_and_masses():
    mass = _bumps((20, 20, 3, 0.3), (40, 60, 4, 0.6))
    found = modes(mass, ORIGIN, 0.5)
    np.testing.assert_allclose(found.mass, [0.6, 0.3], atol=1e-4)
    np.testing.assert_allclose(found.places, ORIGIN + 0.5 * (np.array([[60, 40], [20, 20]]) + 0.5))
    np.testing.assert_allclose(found.peak, [mass[40, 60], mass[20, 20]])
    assert len(modes(mass, ORIGIN, 0.5, k=1).mass) == 1


def test_ripples_are_no_modes():
    rng = np.random.default_rng(0)
    smooth = _bumps((30, 40, 15, 1.0))
    rippled = smooth * (1 + 0.03 * rng.standard_normal(smooth.shape)).astype(np.float32)
    assert len(modes(rippled, ORIGIN, 0.5, prominence=0.0).mass) > 20
    assert modes(rippled, ORIGIN, 0.5, prominence=0.2).mass.tolist() == pytest.approx([rippled.sum()])


def test_a_plateau_is_one_mode_and_a_terrace_none():
    mass = np.zeros((9, 12), np.float32)
    mass[1:8, 1:7] = 0.01
    mass[3:5, 2:5] = 0.02
    mass[4, 8:11] = 0.005
    assert modes(mass, ORIGIN, 1.0, prominence=0.0).peak.tolist() == pytest.approx([0.02, 0.005])
    terrace = np.zeros((5, 9), np.float32)
    terrace[1:4, 1:6] = 0.01
    terrace[1, 6:8] = [0.02, 0.03]
    found = modes(terrace, ORIGIN, 1.0, prominence=0.0)
    assert found.peak.tolist() == pytest.approx([0.03])
    assert found.mass[0] == pytest.approx(terrace.sum())


def test_more_prominence_never_makes_more_modes():
    for mass in MAPS:
        counts = [len(modes(mass, ORIGIN, 1.0, prominence=p).mass) for p in (0.0, 0.2, 0.5, 0.9, 1.0)]
        assert counts == sorted(counts, reverse=True)


def test_an_empty_map_has_no_modes():
    found = modes(np.zeros((4, 5), np.float32), ORIGIN, 1.0)
    assert (found.places.shape, len(found.peak), len(found.mass)) == ((0, 2), 0, 0)


@pytest.mark.parametrize("level", [0.1, 0.5, 0.9])
@pytest.mark.parametrize("mass", MAPS)
def test_a_region_holds_its_level_and_nothing_less_would(mass, level):
    mask, threshold = region(mass, level)
    if mass.sum(dtype=np.float64) < level:
        assert (mask.all(), threshold) == (True, 0.0)
        return
    assert mass[mask].sum(dtype=np.float64) >= level
    assert mass[mass > threshold].sum(dtype=np.float64) < level
    np.testing.assert_array_equal(mask, mass >= threshold)
    assert threshold > 0


def test_a_region_that_the_window_does_not_hold_is_the_window():
    mask, threshold = region(_bumps((20, 20, 3, 0.7)), 0.8)
    assert mask.all()
    assert threshold == 0.0


def test_maps_know_their_modes_and_regions(forecaster, scene):
    maps = forecaster.pom(scene, horizons=[2.0])
    found = maps.modes(0, 0, k=3)
    assert len(found.mass) == 1
    np.testing.assert_allclose([*found.places[0], found.peak[0]], maps.peak(0, 0), rtol=1e-6)
    assert found.mass[0] == pytest.approx(maps.window_mass[0, 0], rel=1e-6)
    maps = forecaster.pom(scene, Grid(200, 100, 0.1).at(0.0, -5.0), [2.0])
    mask, threshold = maps.region(0, 0, 0.5)
    # Of a Gaussian: the ellipse of area 2 pi ln 2 times the root of the covariance's determinant.
    sx = 0.3 + 0.4 * 2.0
    assert mask.sum() * maps.resolution**2 == pytest.approx(2 * np.pi * np.log(2) * sx * 0.4 * sx * 0.8, rel=0.03)
    assert maps.mass[0, 0][mask].min() == pytest.approx(threshold)


@pytest.mark.parametrize("change", [{"k": 0}, {"prominence": -0.1}, {"prominence": 1.1}])
def test_what_makes_no_modes_is_refused(change):
    with pytest.raises(InputError, match=r"^\w+ is .*, expected"):
        modes(MAPS[0], ORIGIN, 1.0, **change)


@pytest.mark.parametrize("level", [0.0, 1.0, float("nan")])
def test_what_is_no_level_is_refused(level):
    with pytest.raises(InputError, match="level is"):
        region(MAPS[0], level)
