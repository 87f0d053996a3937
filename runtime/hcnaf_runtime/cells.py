"""Cell masses from the flow's distribution functions F_1(x) and F_2(y given x).

The mass of the cell [x_a, x_b] x [y_a, y_b] is

    integral over [x_a, x_b] of  (F_2(y_b given x) - F_2(y_a given x)) dF_1(x)

exact in y, a quadrature in x (see `quadrature`). A column's cells telescope to its increment of F_1 times
what F_2 leaves inside the window, whatever the quadrature, so a map never loses or invents mass.

    F_1 at all edges --> columns with mass --> one node in each (Halo) --> columns in doubt --> more nodes (RULES)

Columns of all maps are pooled in tiles. In a tile only the rows are computed where F_2 changes, found at a few
landmarks; the rows left out below and above are one tall cell each, whose masses come out with the others.
So what is left out is known exactly, since F_2 is monotone: it is the certificate.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from hcnaf_runtime.quadrature import Halo, Rule
from hcnaf_runtime.tiles import Tiles, batches, cut

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
Mask = npt.NDArray[np.bool_]

HALO = Halo(2, Rule(1, 2))
"""The first try: the centre of every column, and two neighbours on either side."""

RULES = tuple(Rule(2**k, 4) for k in range(7))
"""Rules tried in turn where the first try is in doubt; the last one has 256 nodes per column."""

WIDTH = 64
"""Most columns in a tile, and most nodes in one where each column has several."""

NEGLIGIBLE = 1e-9
"""Columns with less mass are left empty; thousands of them do not add up to what float32 resolves near 1."""

SATURATED = 1e-9, 1.5e-7
"""What float32 resolves near 0 and near 1: F_2 this close to its value at the window's edge is flat up to it."""

RESOLVED = 1e-3
"""A rule's nodes may miss F_1 by this share of a column's mass. A spike between two nodes misses it by far
more, and would otherwise pass for converged, since no rule sees it; accuracy itself is judged by the cells."""

LANDMARKS = 32
"""At about so many rows F_2 is looked at first,"""

SCOUTS = 4
"""and only at every so many-th node. What that overlooks is found when the cells are computed, and mended."""

CHUNK = 1 << 19
"""Numbers in the widest intermediate of a graph run, nodes x edges x hidden units: 2 MiB."""


class Distribution(Protocol):
    """The two-dimensional flow as the graphs of a bundle give it, for theta [B, P] of B maps."""

    @property
    def hidden(self) -> int:
        """H, hidden units per dimension."""

    def marginal_cdf(self, theta: Float32, x: Float32) -> Float32:
        """F_1 [B, K] at `x` [B, K] (m)."""

    def conditional_cdf(self, theta: Float32, x: Float32, y: Float32) -> Float32:
        """F_2 [B, S, E] at `y` [B, S, E] given `x` [B, S] (m)."""

    def cell_mass(self, theta: Float32, x: Float32, weight: Float32, y: Float32) -> Float32:
        """[B, E - 1, C]: sum over s of weight [B, C, S] times F_2's increments along y [B, E] given x [B, S]."""


@dataclass(frozen=True)
class Window:
    """The edges of the cells' columns and rows, equally spaced, float32 [C + 1] and [R + 1] (m)."""

    x: Float32
    y: Float32

    def strips(self, most: int) -> Iterator["Window"]:
        """The window from left to right in parts of at most about `most` cells."""
        width = max(1, most // (len(self.y) - 1))
        return (Window(self.x[c : c + width + 1], self.y) for c in range(0, len(self.x) - 1, width))


@dataclass(frozen=True)
class Cells:
    """Maps of a window."""

    mass: Float32
    """[B, R, C]."""
    error: Float64
    """[B]: what the quadrature may miss in the worst cell, as far as refinement can tell."""
    lost: Float64
    """[B]: a bound on the mass inside the window that was left out, itself at most `lost_mass`."""


def masses(
    flow: Distribution,
    theta: Float32,
    window: Window,
    tolerance: float,
    lost_mass: float = 0.0,
    chunk: int = CHUNK,
) -> Cells:
    """The mass of every cell.

    A column is refined until its cells change by less than `tolerance`. Columns and rows are left out while what
    they hold stays below `lost_mass` per map; with 0 only what float32 cannot tell from nothing. Memory beyond
    the result is bounded by `chunk`, whatever the size of the window and the number of maps.
    """
    return _Filling(flow, theta, window, tolerance, lost_mass, chunk).run()


class _Filling:
    """Maps being filled, with what is known of each column: its share of the mass [B, C] and error [B, C]."""

    def __init__(
        self, flow: Distribution, theta: Float32, window: Window, tolerance: float, lost_mass: float, chunk: int
    ) -> None:
        self.flow, self.theta, self.window, self.chunk = flow, theta, window, chunk
        rows = len(window.y) - 1
        # Either end of a tile's columns may lose a fifth, the columns left out a half: together below lost_mass.
        self.ends = max(lost_mass / 5.0, SATURATED[0]), max(lost_mass / 5.0, SATURATED[1])
        self.marks = np.append(np.arange(0, rows, max(1, rows // LANDMARKS)), rows)
        self.share = self._shares()
        self.kept = _kept(self.share, lost_mass / 2.0)
        self.mass = np.zeros((len(theta), rows, len(window.x) - 1), np.float32)
        self.error = np.where(self.kept, 0.0, self.share if lost_mass == 0.0 else 0.0)
        self.outside = np.where(self.kept, 0.0, self.share)  # [B, C]: what is left out of each column
        self.goal = np.maximum(tolerance, _noise(window.x) * self.share)

    def run(self) -> Cells:
        self._centres()
        pending = self.error > self.goal
        for rule in RULES:
            if not pending.any():
                break
            self._refine(rule, pending)
            pending &= self.error > self.goal
        np.maximum(self.mass, 0.0, out=self.mass)
        return Cells(self.mass, self.error.max(axis=1), self.outside.sum(axis=1))

    def _shares(self) -> Float64:
        """Increments of F_1 [B, C]."""
        B, edges = len(self.theta), len(self.window.x)
        step = max(1, self.chunk // (self.flow.hidden * edges))
        shares = np.empty((B, edges - 1))
        for b in range(0, B, step):
            theta = self.theta[b : b + step]
            cdf = self.flow.marginal_cdf(theta, np.broadcast_to(self.window.x, (len(theta), edges)))
            shares[b : b + step] = np.diff(cdf.astype(np.float64), axis=1)
        return np.maximum(shares, 0.0, out=shares)

    def _centres(self) -> None:
        """One node per column."""
        reach, C = HALO.reach, len(self.window.x) - 1
        pitch = (float(self.window.x[-1]) - float(self.window.x[0])) / C
        tiles = cut(self.kept, WIDTH, gap=2 * reach)
        for some in batches(tiles.count, np.ones_like(tiles.count), self._budget(1 + len(self.marks) // SCOUTS)):
            tile = tiles.some(some)
            w = tile.columns.shape[1]
            weights, misfit = self._weights(tile, HALO.rule)
            first = tile.columns[:, :1] - reach + np.arange(w + 2 * reach)
            x = (float(self.window.x[0]) + (first + 0.5) * pitch).astype(np.float32)
            weight = np.zeros((len(tile), 2 * w, w + 2 * reach), np.float32)
            for k in range(2 * reach + 1):
                weight[:, np.arange(w), np.arange(w) + k] = weights @ HALO.spread[:, k]
                weight[:, np.arange(w) + w, np.arange(w) + k] = weights @ HALO.doubt[:, k]
            doubt = np.zeros((len(tile), w))
            negative = np.zeros((len(tile), w))
            for j, rows, block in self._blocks(tile, x, weight):
                n = int(tile.count[j])
                columns = slice(int(tile.columns[j, 0]), int(tile.columns[j, 0]) + n)
                self.mass[tile.maps[j]][rows, columns] = block[:, :n]
                doubt[j] = np.maximum(doubt[j], np.abs(block[:, w:]).max(axis=0))
                negative[j] -= np.minimum(block[:, :w], 0.0).sum(axis=0)
            self._judge(tile, np.maximum(np.maximum(doubt, negative), misfit))

    def _refine(self, rule: Rule, pending: Mask) -> None:
        """Several nodes in each of the columns pending [B, C], judged by what changes."""
        tiles = cut(pending, max(1, WIDTH // rule.size))
        sizes = tiles.count * rule.size
        for some in batches(sizes, np.ones_like(sizes), self._budget(1 + len(self.marks) // SCOUTS)):
            tile = tiles.some(some)
            J, w = tile.columns.shape
            weights, misfit = self._weights(tile, rule)
            x = self._places(tile, rule.support[rule.nodes]).reshape(J, -1)
            weight = np.zeros((J, w, w, rule.size), np.float32)
            weight[:, np.arange(w), np.arange(w)] = weights
            before = self.mass[tile.maps[:, None], :, tile.columns]  # [J, w, R]
            self.mass[tile.maps[:, None], :, tile.columns] = 0.0
            negative = np.zeros((J, w))
            for j, rows, block in self._blocks(tile, x, weight.reshape(J, w, -1)):
                n = int(tile.count[j])
                self.mass[tile.maps[j]][rows, tile.columns[j, :n]] = block[:, :n]
                negative[j] -= np.minimum(block, 0.0).sum(axis=0)
            change = np.abs(self.mass[tile.maps[:, None], :, tile.columns] - before).max(axis=-1)
            share = self.share[tile.maps[:, None], tile.columns]
            goal = self.goal[tile.maps[:, None], tile.columns]
            unresolved = misfit > np.maximum(RESOLVED * share, goal)
            self._judge(tile, np.where(unresolved, np.inf, np.maximum(change, negative)))

    def _judge(self, tile: Tiles, error: Float64) -> None:
        """Note the errors [J, w] of a tile's columns: none is wrong by more than it holds."""
        own = tile.own
        maps = np.broadcast_to(tile.maps[:, None], own.shape)[own]
        columns = tile.columns[own]
        self.error[maps, columns] = np.minimum(error[own], self.share[maps, columns])

    def _weights(self, tile: Tiles, rule: Rule) -> tuple[Float64, Float64]:
        """Weights [J, w, S] of the rule's nodes in each column, zero in padding, and its misfit of F_1 [J, w]."""
        x = self._places(tile, np.concatenate([rule.support, rule.checks]))
        cdf = self.flow.marginal_cdf(self.theta[tile.maps], x.reshape(len(tile), -1)).reshape(x.shape)
        F, at_checks = np.split(cdf.astype(np.float64), [len(rule.support)], axis=-1)
        return rule.weights(F) * tile.own[:, :, None], rule.misfit(F, at_checks)

    def _places(self, tile: Tiles, share: Float64) -> Float32:
        """Points [J, w, n] at these shares [n] of the way from each column's left edge to its right."""
        left = self.window.x[tile.columns].astype(np.float64)[..., None]
        right = self.window.x[tile.columns + 1].astype(np.float64)[..., None]
        return (left + (right - left) * share).astype(np.float32)

    def _blocks(self, tile: Tiles, x: Float32, weight: Float32) -> Iterator[tuple[int, slice, Float32]]:
        """Of each tile the rows that hold anything, and what weight [J, n, S] makes of them: [rows, n]."""
        low, high = self._rows(tile, x, weight)
        yield from self._evaluate(tile, x, weight, low, high)
        maps = tile.maps[:, None]
        allowed = sum(self.ends) * self.share[maps, tile.columns]
        missed = ((self.outside[maps, tile.columns] > allowed + 1e-9) & tile.own).any(axis=1)
        again = np.flatnonzero(missed & (high - low < len(self.window.y) - 1))
        if len(again):
            low[again], high[again] = 0, len(self.window.y) - 1
            yield from self._evaluate(tile, x, weight, low, high, again)

    def _evaluate(
        self, tile: Tiles, x: Float32, weight: Float32, low: Indices, high: Indices, of: Indices | None = None
    ) -> Iterator[tuple[int, slice, Float32]]:
        """Rows `low` to `high` [J] of the tiles `of` (all by default), noting what is outside them."""
        which = np.arange(len(tile)) if of is None else of
        self.outside[tile.maps[which, None], tile.columns[which]] = 0.0
        tall = max(1, self.chunk // (self.flow.hidden * x.shape[1]) - 5)
        pieces = np.maximum(-(-(high - low)[which] // tall), 1)
        owner = np.repeat(which, pieces)
        rank = np.arange(len(owner)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
        start = low[owner] + rank * tall
        stop = np.minimum(start + tall, high[owner])
        below = np.where(rank == 0, 0, start)
        above = np.where(stop == high[owner], len(self.window.y) - 1, stop)
        for some in batches(stop - start + 5, np.ones_like(start), self._budget(x.shape[1])):
            j, first, last = owner[some], start[some], stop[some]
            middle = np.minimum(first[:, None] + np.arange((last - first).max() + 1), last[:, None])
            rows = np.concatenate([below[some, None], middle, above[some, None]], axis=1)
            out = self.flow.cell_mass(self.theta[tile.maps[j]], x[j], weight[j], self.window.y[rows])
            for i, owned in enumerate(j):
                self._note(tile, owned, out[i, 0] + out[i, -1])
                yield int(owned), slice(int(first[i]), int(last[i])), out[i, 1 : 1 + last[i] - first[i]]

    def _note(self, tile: Tiles, j: int, outside: Float32) -> None:
        n = tile.count[j]
        self.outside[tile.maps[j], tile.columns[j, :n]] += np.maximum(outside[:n], 0.0)

    def _rows(self, tile: Tiles, x: Float32, weight: Float32) -> tuple[Indices, Indices]:
        """First and last + 1 row [J] outside which there should be nothing, by every SCOUTS-th node."""
        scouts = np.append(np.arange(0, x.shape[1] - 1, SCOUTS), x.shape[1] - 1)
        y = np.broadcast_to(self.window.y[self.marks], (len(x), len(scouts), len(self.marks)))
        cdf = self.flow.conditional_cdf(self.theta[tile.maps], x[:, scouts], y)
        w = tile.columns.shape[1]
        unused = (weight[:, :w, scouts] == 0.0).all(axis=1)[..., None]  # padding decides nothing
        empty = np.count_nonzero(((cdf <= cdf[..., :1] + self.ends[0]) | unused).all(axis=1), axis=1)
        full = np.count_nonzero(((cdf >= cdf[..., -1:] - self.ends[1]) | unused).all(axis=1), axis=1)
        low = np.maximum(empty - 1, 0)
        high = np.maximum(np.minimum(len(self.marks) - full, len(self.marks) - 1), low)
        return self.marks[low], self.marks[high]

    def _budget(self, other: int) -> int:
        return max(1, self.chunk // (self.flow.hidden * other))


def _kept(share: Float64, budget: float) -> Mask:
    """Columns [B, C] to compute: all but the smallest, which together hold at most `budget` per map."""
    ascending = np.sort(share, axis=1)
    dropped = np.count_nonzero(np.cumsum(ascending, axis=1) <= budget, axis=1)
    threshold = np.take_along_axis(ascending, np.maximum(dropped - 1, 0)[:, None], axis=1)
    threshold = np.where(dropped[:, None] > 0, threshold, 0.0)
    return np.asarray(share > np.maximum(threshold, NEGLIGIBLE))


def _noise(x: Float32) -> Float64:
    """[C]: what rounding x to float32 changes in F_1, in units of a column's mass; no rule sees past it."""
    edges = x.astype(np.float64)
    reach = np.maximum(np.abs(edges[:-1]), np.abs(edges[1:]))
    return np.finfo(np.float32).eps * reach / np.diff(edges)
