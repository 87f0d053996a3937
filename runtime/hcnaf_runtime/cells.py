"""Cell masses from the flow's distribution functions F_1(x) and F_2(y given x).

The mass of the cell [x_a, x_b] x [y_a, y_b] is

    integral over [x_a, x_b] of  (F_2(y_b given x) - F_2(y_a given x)) dF_1(x)

exact in y, a quadrature in x (see `quadrature`). A column's cells telescope to its increment of F_1 times
what F_2 leaves inside the window, whatever the quadrature, so a map never loses or invents mass.

Every column is refined on its own until two successive rules agree and F_1 is resolved by the nodes: where
the density is wide two and four nodes do; for a ridge narrower than a cell it takes up to a few hundred.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from hcnaf_runtime.quadrature import Rule

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
Mask = npt.NDArray[np.bool_]

RULES = (Rule(1, 2), *(Rule(2**k, 4) for k in range(7)))
"""The rules tried in turn; the last one has 256 nodes per column."""

NEGLIGIBLE = 1e-9
"""Columns with less mass are left empty; thousands of them do not add up to what float32 resolves near 1."""

SATURATED = 1e-9, 1.5e-7
"""What float32 resolves near 0 and near 1: F_2 this close to its value at the window's edge is flat up to it."""

RESOLVED = 1e-3
"""A column's nodes may miss F_1 by this share of its mass. A spike between two nodes misses it by far more,
and would otherwise pass for converged, since no rule sees it; accuracy itself is judged by the cells."""

CHUNK = 1 << 18
"""Numbers in the widest intermediate of a graph run, nodes x edges x hidden units: 1 MiB stays in cache."""


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
        """[B, E - 1, C]: sum over s of weight [B, C, S] times F_2's increments along y [E] given x [B, S]."""


@dataclass(frozen=True)
class Window:
    """The edges of the cells' columns and rows, float32 [C + 1] and [R + 1] (m)."""

    x: Float32
    y: Float32

    def strips(self, most: int) -> Iterator["Window"]:
        """The window from left to right in parts of at most about `most` cells."""
        width = max(1, most // (len(self.y) - 1))
        return (Window(self.x[c : c + width + 1], self.y) for c in range(0, len(self.x) - 1, width))


def masses(
    flow: Distribution, theta: Float32, window: Window, tolerance: float, chunk: int = CHUNK
) -> tuple[Float32, Float64]:
    """Mass of every cell [B, R, C], and the quadrature error [B]: the largest last difference of a cell.

    A column is refined until its cells change by less than `tolerance`. Memory beyond the result is bounded
    by `chunk`, whatever the size of the window.
    """
    edges = np.broadcast_to(window.x, (len(theta), len(window.x)))
    columns = np.diff(flow.marginal_cdf(theta, edges).astype(np.float64), axis=1)
    mass = np.zeros((len(theta), len(window.y) - 1, len(window.x) - 1), np.float32)
    error = np.zeros(len(theta))
    for b, share in enumerate(columns):
        error[b] = _Map(flow, theta[b : b + 1], window, mass[b], chunk).fill(share, tolerance)
    return np.maximum(mass, 0.0, out=mass), error


@dataclass(frozen=True)
class _Map:
    """One map being filled: theta [1, P], its window and its cells [R, C]."""

    flow: Distribution
    theta: Float32
    window: Window
    mass: Float32
    chunk: int

    def fill(self, share: Float64, tolerance: float) -> float:
        """Fill the columns, whose masses are `share` [C]; the largest error that is left in a cell."""
        error = np.maximum(share, 0.0)  # a cell cannot be wrong by more than its column holds
        goal = np.maximum(tolerance, _noise(self.window.x) * share)
        pending = np.flatnonzero(share > NEGLIGIBLE)
        for rule in RULES:
            for columns in self._batches(rule, pending):
                error[columns] = np.minimum(self._refine(rule, columns, goal[columns]), share[columns])
            pending = pending[error[pending] > goal[pending]]
        return float(error.max())

    def _batches(self, rule: Rule, columns: Indices) -> Iterator[Indices]:
        nodes = max(2 * len(rule.support), rule.size * len(self._landmarks))
        size = max(1, self.chunk // (self.flow.hidden * nodes))
        return (columns[i : i + size] for i in range(0, len(columns), size))

    def _refine(self, rule: Rule, columns: Indices, goal: Float64) -> Float64:
        """Compute `columns` by `rule`; the error [k] of their cells, infinite if not known."""
        x, weight, resolved = self._nodes(rule, columns, goal)
        fresh = np.zeros((len(self.mass), len(columns)), np.float32)
        low, high = self._rows(x)
        for some, rows in _groups(low, high, self.chunk // (self.flow.hidden * rule.size)):
            fresh[rows, some] = self._cells(x[some], weight[some], rows)
        change = np.abs(fresh - self.mass[:, columns]).max(axis=0)
        negative = -np.minimum(fresh, 0.0).sum(axis=0)  # will be cut off, and then the column's sum is off
        self.mass[:, columns] = fresh
        judged = resolved & (rule is not RULES[0])
        return np.where(judged, np.maximum(change, negative), np.inf)

    def _nodes(self, rule: Rule, columns: Indices, goal: Float64) -> tuple[Float32, Float32, Mask]:
        """The nodes [k, S], their weights [k, S], and whether they resolve F_1 [k], of each column."""
        left = self.window.x[columns].astype(np.float64)[:, None]
        right = self.window.x[columns + 1].astype(np.float64)[:, None]
        places = np.concatenate([rule.support, rule.checks])
        x = (left + (right - left) * places).astype(np.float32)
        cdf = self.flow.marginal_cdf(self.theta, x.reshape(1, -1)).reshape(x.shape).astype(np.float64)
        F, at_checks = np.split(cdf, [len(rule.support)], axis=1)
        allowed = np.maximum(RESOLVED * (F[:, -1] - F[:, 0]), goal)
        weight = rule.weights(F).astype(np.float32)
        return x[:, rule.nodes], weight, rule.misfit(F, at_checks) <= allowed

    @property
    def _landmarks(self) -> Indices:
        """Every n-th of the n² rows' edges, the first and the last included."""
        rows = len(self.mass)
        return np.append(np.arange(0, rows, math.isqrt(rows)), rows)

    def _rows(self, x: Float32) -> tuple[Indices, Indices]:
        """First and last + 1 row [k] outside which F_2 given `x` [k, S] has nothing: F_2 is monotone in y."""
        marks = self._landmarks
        y = np.broadcast_to(self.window.y[marks], (1, x.size, len(marks)))
        cdf = self.flow.conditional_cdf(self.theta, x.reshape(1, -1), y).reshape(*x.shape, len(marks))
        empty = np.count_nonzero((cdf <= cdf[..., :1] + SATURATED[0]).all(axis=1), axis=1)
        full = np.count_nonzero((cdf >= cdf[..., -1:] - SATURATED[1]).all(axis=1), axis=1)
        low, high = np.maximum(empty - 1, 0), np.minimum(len(marks) - full, len(marks) - 1)
        return marks[low], marks[np.maximum(low, high)]

    def _cells(self, x: Float32, weight: Float32, rows: slice) -> Float32:
        """Mass [rows, k] of the cells of k columns with the nodes `x` and weights [k, S]."""
        k, size = x.shape
        spread = np.zeros((k, k, size), np.float32)
        spread[np.arange(k), np.arange(k)] = weight
        spread = spread.reshape(1, k, k * size)
        step = max(1, self.chunk // (self.flow.hidden * x.size))
        parts = [
            self.flow.cell_mass(
                self.theta, x.reshape(1, -1), spread, self.window.y[row : min(row + step, rows.stop) + 1]
            )[0]
            for row in range(rows.start, rows.stop, step)
        ]
        return np.concatenate(parts)


def _groups(low: Indices, high: Indices, budget: int) -> Iterator[tuple[slice, slice]]:
    """Runs of columns whose common rows, times their number, stay within `budget`: (columns, rows)."""
    start = 0
    while start < len(low):
        bottom, top, stop = int(low[start]), int(high[start]), start + 1
        while stop < len(low):
            wider = min(bottom, int(low[stop])), max(top, int(high[stop]))
            if (wider[1] - wider[0] + 1) * (stop + 1 - start) > budget:
                break
            (bottom, top), stop = wider, stop + 1
        if top > bottom:
            yield slice(start, stop), slice(bottom, top)
        start = stop


def _noise(x: Float32) -> Float64:
    """[C]: what rounding x to float32 changes in F_1, in units of a column's mass; no rule sees past it."""
    edges = x.astype(np.float64)
    reach = np.maximum(np.abs(edges[:-1]), np.abs(edges[1:]))
    return np.finfo(np.float32).eps * reach / np.diff(edges)
