"""Products of matrices on the thread that asks for them.

numpy's BLAS shares out larger products to threads of its own, which go on spinning for a while when they are done.
Here the cores are busy with other maps: a product is taken in blocks of rows, each too small to be shared out.
"""

from typing import TypeVar

import numpy as np
import numpy.typing as npt

Real = TypeVar("Real", np.float32, np.float64)

SMALL = 1 << 19
"""Multiplications that OpenBLAS, which numpy comes with, leaves to a single thread."""


def product(a: npt.NDArray[Real], b: npt.NDArray[Real], out: npt.NDArray[Real] | None = None) -> npt.NDArray[Real]:
    """a @ b [..., m, n] for a [..., m, k] and b [..., k, n], into `out` if given."""
    m, (k, n) = a.shape[-2], b.shape[-2:]
    if out is None:
        out = np.empty((*np.broadcast_shapes(a.shape[:-2], b.shape[:-2]), m, n), a.dtype)
    rows = max(1, SMALL // max(k * n, 1))
    for i in range(0, m, rows):
        np.matmul(a[..., i : i + rows, :], b, out=out[..., i : i + rows, :])
    return out
