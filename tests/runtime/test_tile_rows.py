"""Parts of the way from tiles to graph runs: weights put in place, sums, and maps shared out."""

import numpy as np
import pytest

from hcnaf_runtime.cells import _shares
from hcnaf_runtime.plane import Window
from hcnaf_runtime.tile_rows import Nodes, column_sums

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
