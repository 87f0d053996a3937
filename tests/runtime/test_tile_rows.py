"""Parts of the way from tiles to graph runs: weights put in place, sums, and maps shared out."""

import numpy as np
import pytest

from hcnaf_runtime.canvas import column_sums
from hcnaf_runtime.cells import _shares
from hcnaf_runtime.columns import _ends, _kept
from hcnaf_runtime.plane import Window
from hcnaf_runtime.tile_rows import Nodes, TileRows

WINDOW = Window(np.arange(5, dtype=np.float32), np.arange(4, dtype=np.float32))


@pytest.mark.parametrize(("step", "K"), [(1, 5), (7, 7)])
def test_a_column_takes_its_own_nodes(step, K):
    rng = np.random.default_rng(0)
    J, w = 3, 4
    bands = rng.normal(size=(2, J, w, K)).astype(np.float32)
    x = rng.normal(size=(J, (w - 1) * step + K)).astype(np.float32)
    some, weight, doubt = Nodes(x, bands, step).some(np.array([2, 0]), 3)
    assert weight.shape == (2, 2 * step + K, 3)
    np.testing.assert_array_equal(some, x[[2, 0], : 2 * step + K])
    for dense, band in ((weight, bands[0]), (doubt, bands[1])):
        expected = np.zeros_like(dense)
        for i, j in enumerate([2, 0]):
            for c in range(3):
                expected[i, c * step : c * step + K, c] = band[j, c]
        np.testing.assert_array_equal(dense, expected)
    np.testing.assert_array_equal(Nodes(x, bands, step).used(np.array([1, w])), [K, x.shape[1]])
    column = Nodes(x, bands, step).columns(np.arange(x.shape[1]))
    np.testing.assert_array_equal(column, [0, 0, 0, 1, 2, 3, 3, 3] if step == 1 else np.repeat(np.arange(4), 7))


def test_a_scout_looks_out_for_the_columns_around_it():
    """A column that holds much beside one that holds little: what is negligible for the latter is not for it."""
    rng = np.random.default_rng(0)
    w, K = 20, 5
    rows = object.__new__(TileRows)
    rows.nodes = Nodes(np.zeros((2, w + K - 1), np.float32), np.zeros((2, 2, w, K), np.float32), 1)
    rows.ends = rng.uniform(size=(2, 2, w))
    scouts = np.array([0, 8, 16, 23])
    nearest = np.abs(np.arange(w)[:, None] + 2 - scouts + 0.1).argmin(axis=1)
    expected = np.stack([rows.ends[:, :, nearest == s].min(axis=-1) for s in range(4)], axis=-1)
    np.testing.assert_array_equal(rows._least_ends(scouts), expected)


@pytest.mark.parametrize("lost_mass", [1e-5, 1e-4, 1e-2])
def test_what_columns_and_their_ends_may_lose_is_the_bound(lost_mass):
    share = np.random.default_rng(1).dirichlet(np.full(200, 0.1), size=5)
    kept = _kept(share, lost_mass / 2.0)
    low, high = _ends(share, kept, lost_mass) * np.where(kept, share, 0.0)
    lost = np.where(kept, 0.0, share).sum(axis=1) + low.sum(axis=1) + high.sum(axis=1)
    assert (lost <= lost_mass * 1.001).all()
    assert (lost >= lost_mass * 0.7).all()
    light, heavy = (np.where(kept, share, fill) for fill in (1.0, 0.0))
    rows = np.arange(5)
    ends = _ends(share, kept, lost_mass)[0]
    assert (ends[rows, light.argmin(axis=1)] > 10.0 * ends[rows, heavy.argmax(axis=1)]).all()


def test_a_dense_map_loses_what_float32_does_not_tell_from_nothing():
    share = np.array([[0.9, 0.1 - 1e-8, 1e-8, 0.0]])
    low, high = _ends(share, _kept(share, 0.0), 0.0)
    np.testing.assert_allclose(low[0], [1e-9 / 0.9, 1e-8, 0.1, 0.25], rtol=1e-6)
    np.testing.assert_allclose(high[0], [1.5e-7, 1.5e-7, 0.1, 0.25], rtol=1e-6)


def test_column_sums():
    mass = np.random.default_rng(0).random((3, 17, 5), np.float32)
    np.testing.assert_allclose(column_sums(mass[:, 1:-1]), mass[:, 1:-1].sum(axis=1), rtol=1e-6)


@pytest.mark.parametrize("maps", [1, 2, 3, 20, 200, 5000])
def test_every_map_is_in_one_share_and_later_ones_are_spread(maps):
    shares = [share for share, *_ in _shares(WINDOW, maps)]
    if maps == 1:
        assert [share.tolist() for share in shares] == [[0], [0]]  # either half of it
        return
    np.testing.assert_array_equal(np.sort(np.concatenate(shares)), np.arange(maps))
    if maps % (2 * len(shares)) == 0:
        assert len({int(share.sum()) for share in shares}) == 1
