"""Interpolation along y: where F_2 is smooth a few points tell all rows.

The rows of a window are cut into a few panels. In each, a function of y is known at Chebyshev points, the panel's
ends among them, and interpolated by a polynomial. Panels share their ends, so that increments between rows
telescope whatever the interpolation does.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import numpy.typing as npt

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]

TALLEST, MOST = 64, 8
"""A panel has at most so many rows, unless there were more than so many panels."""


@dataclass(frozen=True)
class Panels:
    """`rows` rows in panels of equal height, each with `order` + 1 points."""

    rows: int
    order: int

    @property
    def count(self) -> int:
        """How many panels there are."""
        return min(-(-self.rows // TALLEST), MOST)

    @cached_property
    def points(self) -> Float64:
        """[count order + 1]: where the function is known, ascending, in rows from the lowest edge."""
        inner = _chebyshev(self.order)[:-1]
        starts = np.arange(self.count)[:, None]
        return np.append((starts + inner).ravel(), float(self.count)) * (self.rows / self.count)

    def places(self, edges: Float32) -> Float32:
        """`points` as coordinates, for the rows' equally spaced `edges` [rows + 1]."""
        low, high = float(edges[0]), float(edges[-1])
        return (low + (high - low) / self.rows * self.points).astype(np.float32)

    def increments(self, between: Float32) -> Float32:
        """[..., rows, C]: a function's increments from row to row, from those `between` points [..., n, C]."""
        return self._from_gaps @ between

    def tails(self, between: Float32) -> tuple[Float32, Float32]:
        """[...] twice: how large the last two Chebyshev coefficients but two, and the last two, are at worst, from
        the increments `between` points [..., n, C]."""
        *lead, _, C = between.shape
        parts = between.reshape(*lead, self.count, self.order, C)
        size = np.abs(self._modes @ parts).reshape(*lead, self.count, 2, -1).max(axis=(-3, -1))
        return size[..., 0], size[..., 1]

    @cached_property
    def _from_gaps(self) -> Float32:
        """[rows, count order]: increments of rows from the increments between points."""
        place: Float64 = np.arange(self.rows + 1, dtype=np.float64) * (self.count / self.rows)
        panel = np.minimum(place.astype(np.intp), self.count - 1)
        within: Float64 = place - panel
        own = _interpolation(_chebyshev(self.order), within) @ _sums(self.order)
        at_edges = np.repeat(np.arange(self.count) < panel[:, None], self.order, axis=1).astype(np.float64)
        for p in range(self.count):
            at_edges[panel == p, p * self.order : (p + 1) * self.order] = own[panel == p]
        return np.diff(at_edges, axis=0).astype(np.float32)

    @cached_property
    def _modes(self) -> Float32:
        """[4, order]: the last four Chebyshev coefficients from the increments between a panel's points."""
        values = np.polynomial.chebyshev.chebvander(2.0 * _chebyshev(self.order) - 1.0, self.order)
        return (np.linalg.inv(values)[-4:] @ _sums(self.order)).astype(np.float32)


@lru_cache(maxsize=16)
def panels(rows: int, order: int) -> Panels:
    """The panels of so many rows; what belongs to them is computed once."""
    return Panels(rows, order)


def _chebyshev(order: int) -> Float64:
    """[order + 1]: Chebyshev points of the second kind on the unit interval, ascending."""
    return (1.0 - np.cos(np.pi * np.arange(order + 1) / order)) / 2.0


def _sums(order: int) -> Float64:
    """[order + 1, order]: values at the points, from 0 at the first, out of increments between them."""
    return np.tri(order + 1, order, -1)


def _interpolation(points: Float64, at: Float64) -> Float64:
    """[len(at), len(points)]: the polynomial through Chebyshev `points` `at` others, barycentric form."""
    weight = np.where(np.arange(len(points)) % 2, -1.0, 1.0)
    weight[[0, -1]] /= 2.0
    gap = at[:, None] - points
    hit = np.abs(gap) < 1e-12
    terms = weight / np.where(hit, 1.0, gap)
    result: Float64 = np.where(hit.any(axis=1, keepdims=True), hit, terms / terms.sum(axis=1, keepdims=True))
    return result
