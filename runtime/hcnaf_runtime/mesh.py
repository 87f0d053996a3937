"""Nodes among the columns of a window and points among its rows, from which F_2 is interpolated to all cells.

Columns and rows are cut into a few wide panels: Gauss-Legendre nodes along x, where F_2 is integrated against F_1,
and Chebyshev points along y, between which it telescopes (`rows`).
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import numpy.typing as npt

from hcnaf_runtime.products import product
from hcnaf_runtime.quadrature import Rule
from hcnaf_runtime.rows import Panels, how_many, panels

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]

WIDEST = 128
"""A panel has at most so many columns or rows, unless there were too many panels."""

WORTH = 2
"""A mesh pays with so many times as many columns as nodes, and rows as points, or more."""

APART = 8
"""Every so many-th row can be checked."""

PAIR = Rule(1, 2)
"""The nodes that a single column is integrated at."""


@dataclass(frozen=True)
class Mesh:
    """So many `columns` and `rows` in panels with `nodes` and of `order` each."""

    columns: int
    rows: int
    nodes: int
    order: int

    @cached_property
    def rule(self) -> Rule:
        """The panels of columns, with S nodes in all."""
        return Rule(how_many(self.columns, WIDEST), self.nodes)

    @property
    def between(self) -> Panels:
        """The panels of rows, with E points in all."""
        return panels(self.rows, self.order, WIDEST)

    @property
    def worth(self) -> bool:
        """Whether there are few enough nodes and points."""
        return self.columns >= WORTH * self.rule.size and self.rows >= WORTH * len(self.between.points)

    def places(self, edges: Float32) -> Float32:
        """[S]: the nodes as coordinates, for the columns' equally spaced `edges` [C + 1]."""
        low, high = float(edges[0]), float(edges[-1])
        return (low + (high - low) * self.rule.support[self.rule.nodes]).astype(np.float32)

    def misfit(self, cdf: Float64) -> Float64:
        """[B]: how far values at the columns' edges [B, C + 1] are from one polynomial in each panel, fitted by
        least squares."""
        worst = np.zeros(len(cdf))
        for own, basis in self._bases:
            values = np.ascontiguousarray(cdf[:, own])
            off = np.abs(values - product(product(values, basis), np.ascontiguousarray(basis.T)))
            worst = np.maximum(worst, off.max(axis=1))
        return worst

    @cached_property
    def _bases(self) -> list[tuple[slice, Float64]]:
        """For each panel the edges in it, and orthonormal polynomials there."""
        count, found = self.rule.panels, []
        place: Float64 = np.arange(self.columns + 1, dtype=np.float64) * count / self.columns
        for p in range(count):
            own = slice(*np.searchsorted(place, [p - 1e-9, p + 1 + 1e-9]).tolist())
            powers = np.polynomial.legendre.legvander(2.0 * (place[own] - p) - 1.0, self.nodes - 1)
            found.append((own, np.linalg.qr(powers)[0]))
        return found

    def weights(self, cdf: Float64) -> Float32:
        """[B, S, C]: what each column takes from the nodes, by F_1 at the columns' edges and at the next ones on
        either side [B, C + 3].

        F_2 is interpolated to two Gauss nodes in each column, whose weights are those of the cubic through F_1 at
        the column's edges and the next ones. They sum to the column's increment of F_1 exactly.
        """
        shares = sum(_CUBIC[k, :, None, None] * cdf[:, k : k + self.columns] for k in range(4))
        near, far = np.asarray(shares, np.float32)[:, :, None]
        found = near * self._inside[0]
        found += far * self._inside[1]
        return np.asarray(found)

    @cached_property
    def _inside(self) -> Float32:
        """[2, S, C]: values at the columns' two nodes from those at the mesh's."""
        places = (np.arange(self.columns)[:, None] + PAIR.support[PAIR.nodes]) / self.columns
        found = self.rule.at(places.T.ravel()).reshape(2, self.columns, -1).swapaxes(1, 2)
        return np.ascontiguousarray(found, np.float32)

    @cached_property
    def candidates(self) -> Indices:
        """[K]: the rows that can be checked."""
        return np.arange(APART // 2, self.rows, APART)

    def at_candidates(self, values: Float32) -> tuple[Float32, Float32]:
        """[B, K, C] twice: what is interpolated from `values` at nodes and points [B, E, S] to the lower and the
        upper edge of each candidate, in the middle of the columns."""
        found = product(product(self._edges, values), self._centres)
        return found[:, : len(self.candidates)], found[:, len(self.candidates) :]

    @cached_property
    def _edges(self) -> Float32:
        """[2 K, E]: values at the edges below the candidates, and above them, from those at the points."""
        return self.between.at(np.concatenate([self.candidates, self.candidates + 1]))

    @cached_property
    def _centres(self) -> Float32:
        """[S, C]: values in the middle of the columns from those at the nodes."""
        return np.ascontiguousarray(self.rule.at((np.arange(self.columns) + 0.5) / self.columns).T, np.float32)


@lru_cache(maxsize=16)
def mesh(columns: int, rows: int, nodes: int, order: int) -> Mesh:
    """A mesh; what belongs to it is computed once."""
    return Mesh(columns, rows, nodes, order)


def _slopes() -> Float64:
    """[4, 2]: the weights of a column's two nodes by F_1 at four edges, from the one before the column on."""
    cubics = np.linalg.inv(np.vander(np.arange(-1.0, 3.0), increasing=True)).T  # [4, power]
    t, powers = PAIR.support[PAIR.nodes], np.arange(1, 4)[:, None]
    slopes: Float64 = cubics[:, 1:] @ (powers * t ** (powers - 1)) / 2.0
    return slopes


_CUBIC = _slopes()
