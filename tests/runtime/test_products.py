"""Products in blocks are products."""

import numpy as np
import pytest

from hcnaf_runtime import products
from hcnaf_runtime.products import product


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(("a", "b"), [((7, 5), (5, 3)), ((4, 90, 60), (4, 60, 200)), ((90, 60), (2, 3, 60, 200))])
def test_products(a, b, dtype, monkeypatch):
    rng = np.random.default_rng(0)
    left, right = rng.normal(size=a).astype(dtype), rng.normal(size=b).astype(dtype)
    for small in (1, 60 * 200 * 7, products.SMALL):
        monkeypatch.setattr(products, "SMALL", small)
        found = product(left, right)
        assert found.dtype == dtype
        np.testing.assert_allclose(found, left @ right, rtol=1e-4, atol=1e-4)
        into = np.full((*found.shape[:-1], found.shape[-1] + 2), -1, dtype)
        assert product(left, right, into[..., 1:-1]).base is into
        np.testing.assert_array_equal(into[..., 1:-1], found)
        assert (into[..., [0, -1]] == -1).all()
