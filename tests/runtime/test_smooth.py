"""Whole maps from few points: exact where they are filled, left alone where something is between the points."""

import numpy as np
import pytest
from analytic import Bent, Mixture

from hcnaf_runtime import Grid, smooth
from hcnaf_runtime.cells import masses
from hcnaf_runtime.columns import Columns
from hcnaf_runtime.plane import Window

TOLERANCE = 2e-6


def window(columns=200, rows=200, side=100.0):
    grid = Grid(columns, rows, side / 200).at(-side * columns / 400, -side * rows / 400)
    return Window(grid.x_edges, grid.y_edges)


@pytest.fixture
def filled(monkeypatch):
    """How many of the maps (halves of one that is alone) were filled from a mesh."""
    done = []
    original = Columns._smooth

    def noting(self):
        found = original(self)
        done.extend(found.tolist())
        return found

    monkeypatch.setattr(Columns, "_smooth", noting)
    return done


def maps(flow, where, count=2, **options):
    return masses(flow, np.zeros((count, 1), np.float32), where, TOLERANCE, **options)


SMOOTH = {
    "a wide Gaussian": Mixture([(1.0, 3, -5, 20, 15, 0.4)]),
    "two hills": Mixture([(0.6, -20, -15, 14, 12, 0.5), (0.4, 25, 20, 14, 16, -0.3)]),
    "bent": Bent(lambda x: 10 * np.sin(x / 15), lambda x: 12 + x / 20),
    "beyond the window": Mixture([(1.0, 30, 40, 40, 50, 0.2)]),
}


@pytest.mark.parametrize("name", SMOOTH)
@pytest.mark.parametrize("shape", [(200, 200), (203, 197), (120, 400), (520, 510)])
def test_smooth_maps_are_filled_and_exact(name, shape, filled):
    flow, where = SMOOTH[name], window(*shape)
    found, truth = maps(flow, where), SMOOTH[name].truth(where, panels=2)
    assert all(filled)
    assert len(filled) == 2
    for mass in found.mass:
        assert np.abs(mass - truth).max() < 3e-6
        assert np.abs(mass.sum(axis=0, dtype=np.float64) - truth.sum(axis=0)).max() < 1e-6
        assert mass.min() >= 0
    np.testing.assert_allclose(found.inside, truth.sum(), atol=1e-5)
    assert (found.lost == 0).all()
    assert (found.error <= TOLERANCE).all()


def test_what_is_reported_is_about_what_it_is(filled):
    """Over many smooth maps: the worst cell is seldom further off than the error that is reported."""
    where, rng = window(), np.random.default_rng(0)
    ratios = []
    for _ in range(12):
        mean, spread, phase = rng.uniform(5, 15), rng.uniform(6, 10), rng.uniform(0, 6)
        flow = Bent(lambda x, m=mean, p=phase: m * np.sin(x / 11 + p), lambda x, s=spread: s + 0 * x)
        found = maps(flow, where, 1)
        ratios.append(np.abs(found.mass[0] - flow.truth(where, panels=2)).max() / found.error[0])
    assert all(filled)
    assert np.median(ratios) > 0.05  # nor is it far less
    assert max(ratios) < 2.0


def bump(at, width, height):
    return lambda x: height * np.exp(-0.5 * ((x - at) / width) ** 2)


BETWEEN = {
    # F_1 is smooth, and knows nothing of these.
    "a jerk within a column": Bent(bump(11.2, 0.15, 9.0), lambda x: 10 + 0 * x),
    "a jerk on an edge": Bent(bump(11.5, 0.1, -9.0), lambda x: 10 + 0 * x),
    "a step": Bent(lambda x: np.where(x > 3.3, 6.0, -6.0), lambda x: 10 + 0 * x),
    "a sudden waist": Bent(lambda x: 0 * x, lambda x: 10 - bump(-20.3, 0.3, 7.0)(x)),
    "thin along x": Bent(lambda x: 7.3 + 0 * x, lambda x: 0.2 + 0 * x),
    "a thin line on a hill": Mixture([(0.99, 0, 0, 20, 15, 0), (0.01, 0, 6.2, 20, 0.1, 0)]),
    "a thin diagonal on a hill": Mixture([(0.98, 0, 0, 20, 15, 0), (0.02, 0, 0, 20, 15, 0.9999)]),
    # F_1 does.
    "a spike": Mixture([(0.9999, 0, 0, 20, 15, 0), (1e-4, 10.2, 5.3, 0.05, 0.08, 0)]),
    "a small spike": Mixture([(0.99998, 0, 0, 20, 15, 0), (2e-5, 10.2, 5.3, 0.05, 0.08, 0)]),
    "a wall": Mixture([(0.98, 0, 0, 20, 15, 0), (0.02, -7.7, 0, 0.1, 20, 0)]),
}


@pytest.mark.parametrize("name", BETWEEN)
def test_what_is_between_the_points_is_found(name, filled):
    flow, where = BETWEEN[name], window()
    found, truth = maps(flow, where), BETWEEN[name].truth(where)
    assert not any(filled)
    # Tiles have a node in the middle of each column: this jerk is thinner than what is between two of them.
    assert np.abs(found.mass[0] - truth).max() < (3e-5 if name == "a jerk on an edge" else 1.5e-5)


@pytest.mark.parametrize("y", np.random.default_rng(0).uniform(-30, 30, 8))
def test_thin_lines_are_found_wherever_they_are(y):
    """No row is one that is never checked, and no point of a mesh need be near."""
    flow, where = Mixture([(0.99, 0, 0, 20, 15, 0), (0.01, 0, y, 20, 0.1, 0)]), window()
    assert np.abs(maps(flow, where).mass[0] - flow.truth(where)).max() < 2e-5


def test_smooth_and_other_maps_side_by_side(filled):
    """A share with both: each map gets what it gets alone."""

    kinds = SMOOTH["two hills"], BETWEEN["thin along x"]

    class Either(Mixture):
        """By theta one or the other."""

        def __getattribute__(self, name):
            if name not in ("marginal_cdf", "grid_cdf", "conditional_cdf", "cell_mass"):
                return super().__getattribute__(name)

            def each(theta, *given):
                return [
                    getattr(kinds[int(t[0])], name)(t[None], *(v[b : b + 1] for v in given))
                    for b, t in enumerate(theta)
                ]

            if name == "cell_mass":
                return lambda *given: tuple(np.concatenate(part) for part in zip(*each(*given), strict=True))
            return lambda *given: np.concatenate(each(*given))

    where = window()
    kind = np.array([0, 1, 1, 0, 1, 0, 0, 1], np.float32)
    found = masses(Either([(1.0, 0, 0, 1, 1, 0)]), kind[:, None], where, TOLERANCE)
    truths = [flow.truth(where) for flow in kinds]
    for mass, k in zip(found.mass, kind, strict=True):
        assert np.abs(mass - truths[int(k)]).max() < 5e-6
    assert sorted(filled) == sorted((kind == 0).tolist())


def test_certified_maps_of_smooth_ones_lose_nothing(filled):
    flow, where = SMOOTH["two hills"], window()
    found = maps(flow, where, lost_mass=1e-4)
    assert all(filled)
    assert (found.lost == 0).all()
    assert np.abs(found.mass[0] - flow.truth(where, panels=2)).max() < 5e-6


def test_small_windows_are_left_to_tiles(filled):
    maps(SMOOTH["two hills"], window(40, 200))
    maps(SMOOTH["two hills"], window(200, 40))
    assert not any(filled)


def test_runs_are_bounded(monkeypatch):
    """The graph is never asked for more than twice the chunk at once, however large the window."""
    flow, asked = SMOOTH["a wide Gaussian"], []

    class Counting(Mixture):
        def grid_cdf(self, theta, x, y):
            asked.append(len(x) * x.shape[1] * y.shape[1] * self.hidden)
            return super().grid_cdf(theta, x, y)

    chunk = 1 << 15
    counting = Counting(flow.parts)
    masses(counting, np.zeros((3, 1), np.float32), window(), TOLERANCE, chunk=chunk)
    assert max(asked) <= 2 * chunk * 1.1
    assert smooth._cut(np.arange(5), 0)[0].tolist() == [0]
