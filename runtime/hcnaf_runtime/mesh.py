"""Nodes among the columns of a window and points among its rows, from which F_2 is interpolated to all cells.

Columns and rows are cut into a few wide panels: Gauss-Legendre nodes along x, where F_2 is integrated against F_1,
and Chebyshev points along y, between which it telescopes (`rows`); both spaced more evenly (`spacing`).
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import numpy.typing as npt

from hcnaf_runtime.products import product
from hcnaf_runtime.quadrature import Rule
from hcnaf_runtime.rows import Panels, how_many, panels
from hcnaf_runtime.spacing import crowded, spaced

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]

TALLEST = 256
"""A panel has at most so many rows, unless there were too many panels."""

WORTH = 2
"""A mesh pays with so many times as many columns as nodes, and rows as points, or more."""

PAIR = Rule(1, 2)
"""The nodes that a single column is integrated at."""


@dataclass(frozen=True)
class Mesh:
    """So many `columns` and `rows`: panels of at most `widest` columns with so many `nodes` each, and panels of
    rows of this `order`, both spaced as `even`ly."""

    columns: int
    rows: int
    widest: int
    nodes: int
    order: int
    even: float

    @cached_property
    def rule(self) -> Rule:
        """The panels of columns, with S nodes in all."""
        return Rule(how_many(self.columns, self.widest), self.nodes)

    @property
    def between(self) -> Panels:
        """The panels of rows, with E points in all."""
        return panels(self.rows, self.order, TALLEST, self.even)

    @property
    def worth(self) -> bool:
        """Whether there are few enough nodes and points."""
        return self.columns >= WORTH * self.rule.size and self.rows >= WORTH * len(self.between.points)

    def places(self, edges: Float32) -> Float32:
        """[S]: the nodes as coordinates, for the columns' equally spaced `edges` [C + 1]."""
        low, high, count = float(edges[0]), float(edges[-1]), self.rule.panels
        nodes = spaced(self.rule.support[self.rule.nodes] * count, self.even) / count
        return (low + (high - low) * nodes).astype(np.float32)

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
        places = np.arange(self.columns)[:, None] + PAIR.support[PAIR.nodes]
        found = self._at(places.T.ravel()).reshape(2, self.columns, -1).swapaxes(1, 2)
        return np.ascontiguousarray(found, np.float32)

    def _at(self, places: Float64) -> Float64:
        """[n, S]: values at `places` [n], in columns from the lower edge on, from those at the nodes."""
        count = self.rule.panels
        return self.rule.at(crowded(places * count / self.columns, self.even) / count)

    def middles(self, values: Float32) -> Float32:
        """[B, C, E]: what is interpolated to the middle of the columns, from `values` at nodes and points
        [B, E, S]."""
        return product(self._centres, values.swapaxes(1, 2))

    def rises(self, middles: Float32, rows: Indices) -> Float32:
        """[B, C]: by how much `middles` [B, C, E] rise in a row of each column, `rows` [B, C]."""
        return np.asarray(np.einsum("...e,...e", self._in_rows[rows], middles))

    @cached_property
    def _in_rows(self) -> Float32:
        """[R, E]: by how much values rise in each row, from those at the points."""
        return np.diff(self.between.at(np.arange(self.rows + 1)), axis=0)

    @cached_property
    def _centres(self) -> Float32:
        """[C, S]: values in the middle of the columns from those at the nodes."""
        return self._at(np.arange(0.5, self.columns)).astype(np.float32)


@lru_cache(maxsize=16)
def mesh(columns: int, rows: int, widest: int, nodes: int, order: int, even: float) -> Mesh:
    """A mesh; what belongs to it is computed once."""
    return Mesh(columns, rows, widest, nodes, order, even)


def _slopes() -> Float64:
    """[4, 2]: the weights of a column's two nodes by F_1 at four edges, from the one before the column on."""
    cubics = np.linalg.inv(np.vander(np.arange(-1.0, 3.0), increasing=True)).T  # [4, power]
    t, powers = PAIR.support[PAIR.nodes], np.arange(1, 4)[:, None]
    slopes: Float64 = cubics[:, 1:] @ (powers * t ** (powers - 1)) / 2.0
    return slopes


_CUBIC = _slopes()
