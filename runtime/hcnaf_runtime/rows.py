"""Interpolation along y: where F_2 is smooth a few points tell all rows.

The rows of a window are cut into a few panels. In each, a function of y is known at Chebyshev points, the panel's
ends among them, and interpolated by a polynomial (in y, or in what spaces the points more evenly: `spacing`).
Panels share their ends, so that increments between rows telescope whatever the interpolation does.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import numpy.typing as npt

from hcnaf_runtime.products import product
from hcnaf_runtime.spacing import crowded, spaced

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]

TALLEST, MOST = 64, 8
"""A panel has at most so many rows, unless another height is asked for or there were more than so many panels."""


@dataclass(frozen=True)
class Panels:
    """`rows` rows in panels of equal height, at most `tallest`, with `order` + 1 points each, `even`ly spaced."""

    rows: int
    order: int
    tallest: int = TALLEST
    even: float = 0.0

    @property
    def count(self) -> int:
        """How many panels there are."""
        return how_many(self.rows, self.tallest)

    @cached_property
    def points(self) -> Float64:
        """[count order + 1]: where the function is known, ascending, in rows from the lowest edge."""
        inner = spaced(_chebyshev(self.order)[:-1], self.even)
        starts = np.arange(self.count)[:, None]
        return np.append((starts + inner).ravel(), float(self.count)) * (self.rows / self.count)

    def places(self, edges: Float32) -> Float32:
        """`points` as coordinates, for the rows' equally spaced `edges` [rows + 1]."""
        low, high = float(edges[0]), float(edges[-1])
        return (low + (high - low) / self.rows * self.points).astype(np.float32)

    def increments(self, between: Float32, out: Float32 | None = None) -> Float32:
        """[..., rows, C]: a function's increments from row to row, from those `between` points [..., n, C]; into
        `out` if given."""
        if self.rows % self.count:
            return product(self._from_gaps, between, out)
        *lead, _, C = between.shape
        if out is None:
            out = np.empty((*lead, self.rows, C), np.float32)
        into = out.reshape(*lead, self.count, -1, C)  # never a copy: only the rows are divided
        product(self._from_own_gaps, between.reshape(*lead, self.count, self.order, C), into)
        return out

    def at(self, edges: Indices) -> Float32:
        """[n, count order + 1]: a function's values at these row `edges` [n] from those at the points."""
        from_gaps = np.concatenate([np.zeros_like(self._from_gaps[:1]), np.cumsum(self._from_gaps, axis=0)])[edges]
        ends = np.pad(from_gaps, ((0, 0), (1, 1)))
        found: Float32 = ends[:, :-1] - ends[:, 1:]
        found[:, 0] += 1.0
        return found

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
        own = self._from_sums(within)
        at_edges = np.repeat(np.arange(self.count) < panel[:, None], self.order, axis=1).astype(np.float64)
        for p in range(self.count):
            at_edges[panel == p, p * self.order : (p + 1) * self.order] = own[panel == p]
        return np.diff(at_edges, axis=0).astype(np.float32)

    @cached_property
    def _from_own_gaps(self) -> Float32:
        """[rows / count, order]: increments of a panel's rows from those between its points, if rows are divided
        equally."""
        own = self._from_sums(np.linspace(0.0, 1.0, self.rows // self.count + 1))
        return np.diff(own, axis=0).astype(np.float32)

    def _from_sums(self, places: Float64) -> Float64:
        """[n, order]: values at `places` [n] in a panel, from 0 at its lower end, out of increments between its
        points."""
        at: Float64 = _interpolation(_chebyshev(self.order), crowded(places, self.even)) @ _sums(self.order)
        return at

    @cached_property
    def _modes(self) -> Float32:
        """[4, order]: the last four Chebyshev coefficients from the increments between a panel's points."""
        values = np.polynomial.chebyshev.chebvander(2.0 * _chebyshev(self.order) - 1.0, self.order)
        return (np.linalg.inv(values)[-4:] @ _sums(self.order)).astype(np.float32)


def how_many(size: int, largest: int) -> int:
    """How many panels `size` rows or columns are cut into."""
    return min(-(-size // largest), MOST)


@lru_cache(maxsize=16)
def panels(rows: int, order: int, tallest: int = TALLEST, even: float = 0.0) -> Panels:
    """The panels of so many rows; what belongs to them is computed once."""
    return Panels(rows, order, tallest, even)


def fall(before: Float32, after: Float32, steps: int, least: float = 1e-2) -> Float64:
    """What coefficients that fell from `before` to `after` add up to from `steps` further on, if they go on so.

    Steps below 0 go back. However fast they fell, each is taken to be at least a `least` share of the one before.
    """
    ratio = np.clip(after / np.maximum(before, 1e-12), least, 0.99)
    return np.asarray(2.0 * after * ratio**steps / (1.0 - ratio), np.float64)


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
