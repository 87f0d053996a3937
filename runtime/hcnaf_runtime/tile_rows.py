"""Which rows of a tile of columns are computed, and how.

Only rows where F_2 changes: they are found at a few landmarks. The rows left out below and above are one tall cell
each, whose masses come out with the others, so what is left out is known exactly, since F_2 is monotone: it is the
certificate. Where F_2 is smooth along y it is computed at a few places and interpolated to all rows (see `rows`).
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hcnaf_runtime.plane import Distribution, Window
from hcnaf_runtime.rows import panels
from hcnaf_runtime.tiles import Tiles, batches

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
Mask = npt.NDArray[np.bool_]

RESOLVED_TAIL = 1e-6
"""What is held in a tail is told from rounding from here on."""

SCOUTS = 8
"""Landmarks are looked at from every so many-th node. What that overlooks is found with the cells, and mended."""

COARSE, FINE = 8, 20
"""Order of the panels of rows that landmarks are at, and of those that rows are interpolated from."""

TRY = 10.0
"""Rows are interpolated, and judged then, where landmarks promise an error of less than so many times the goal."""

LANES = 16
"""Numbers of nodes are alike if they fill as many vectors of this length: a product takes as long for all."""

WASTE = 1 << 17
"""Most of them that are padding: computing so many takes about as long as starting another run."""


@dataclass(frozen=True)
class Nodes:
    """Where F_2 is taken for J tiles of w columns, and what it counts for there."""

    x: Float32  # [J, S]
    weight: Float32  # [J, S, w]
    doubt: Float32  # [J, S, w]
    used: Indices  # [J], how many of the S nodes: the rest is padding

    def some(self, j: Indices, count: Indices) -> "Nodes":
        """Those of the tiles j with so many columns [J], with no more padding than they need."""
        S, w = int(self.used[j].max()), int(count[j].max())
        return Nodes(self.x[j, :S], self.weight[j, :S, :w], self.doubt[j, :S, :w], self.used[j])


class Found:
    """What the cells of J tiles of w columns came to, [J, w] each: error, and mass inside and outside."""

    def __init__(self, tile: Tiles) -> None:
        self.error, self.inside, self.outside = np.zeros((3, *tile.columns.shape), np.float32)

    def clear(self, which: Indices) -> None:
        """Forget the tiles `which`."""
        for values in (self.error, self.inside, self.outside):
            values[which] = 0.0


@dataclass(frozen=True)
class Canvas:
    """The maps that are filled: theta [B, P], their window, mass [B, R, C] to be written, the share of a column
    that either end of it may lose, and the most numbers in an intermediate of a graph run."""

    flow: Distribution
    theta: Float32
    window: Window
    mass: Float32
    ends: tuple[float, float]
    chunk: int

    @property
    def rows(self) -> int:
        """R."""
        return len(self.window.y) - 1


class TileRows:
    """J tiles of w columns, their `nodes`, what each column holds (`share`) and its cells may be wrong by (`goal`)
    [J, w]; and what they came to, in `found`."""

    def __init__(self, canvas: Canvas, tile: Tiles, nodes: Nodes, share: Float64, goal: Float64) -> None:
        self.canvas, self.tile, self.nodes, self.share, self.goal = canvas, tile, nodes, share, goal
        self.landmarks, self.panels = panels(canvas.rows, COARSE), panels(canvas.rows, FINE)
        self.found = Found(tile)

    def fill(self) -> Found:
        """Compute the rows where there is anything."""
        low, high, smooth = self._look()
        good = self._interpolate(np.flatnonzero(smooth))
        return self.fill_rows(low, high, np.flatnonzero(~good))

    def fill_rows(self, low: Indices, high: Indices, which: Indices) -> Found:
        """Compute rows `low` to `high` [J] of the tiles `which`, or all where those miss anything."""
        self._evaluate(low, high, which)
        allowed = sum(self.canvas.ends) * (self.share * self.tile.own).sum(axis=1) + 1e-9
        missed = self.found.outside.sum(axis=1) > allowed
        again = np.flatnonzero(missed & (high - low < self.canvas.rows))
        if len(again):
            low[again], high[again] = 0, self.canvas.rows
            self._evaluate(low, high, again)
        return self.found

    def _look(self) -> tuple[Indices, Indices, Mask]:
        """From every SCOUTS-th node: rows `low` to `high` [J] outside which there should be nothing, and whether
        F_2 looks so smooth [J] that rows can be interpolated."""
        tile, nodes, points = self.tile, self.nodes, self.landmarks.points
        scouts = np.append(np.arange(0, nodes.x.shape[1] - 1, SCOUTS), nodes.x.shape[1] - 1)
        cdf = self._at_landmarks(nodes.x[:, scouts])
        unused = (nodes.weight[:, scouts] == 0.0).all(axis=-1)[:, None]  # padding decides nothing
        below = np.where(unused, 0.0, cdf - cdf[:, :1]).max(axis=2)
        above = np.where(unused, 0.0, cdf[:, -1:] - cdf).max(axis=2)[:, ::-1]
        rows, ends = self.canvas.rows, self.canvas.ends
        low = _reach(points, below, ends[0])
        high = np.maximum(rows - _reach(rows - points[::-1], above, ends[1]), low)
        if rows < 2 * FINE:
            return low, high, np.zeros(len(tile), np.bool_)
        predicted = _fall(*self.landmarks.tails(np.diff(cdf, axis=1)), (FINE - COARSE) // 2)
        promising = predicted * self.share.max(axis=1) < TRY * self.goal.min(axis=1)
        return low, high, promising & (high - low > len(self.panels.points))

    def _at_landmarks(self, x: Float32) -> Float32:
        """F_2 [J, E, S] at the landmarks given x [J, S]."""
        y = self.landmarks.places(self.canvas.window.y)
        cdf = np.empty((len(x), len(y), x.shape[1]), np.float32)
        for j in self._runs(np.full(len(x), len(y)), np.full(len(x), x.shape[1])):
            cdf[j] = self.canvas.flow.grid_cdf(self._theta(j), x[j], np.broadcast_to(y, (len(j), len(y))))
        return cdf

    def _theta(self, j: Indices) -> Float32:
        return self.canvas.theta[self.tile.maps[j]]

    def _interpolate(self, which: Indices) -> Mask:
        """All rows of the tiles `which` from a few; for which of all tiles [J] that is good enough."""
        y = self.panels.places(self.canvas.window.y)
        good = np.zeros(len(self.tile), np.bool_)
        for some in self._runs(np.full(len(which), len(y)), self.nodes.used[which]):
            j = which[some]
            between, wrong = self._mass(j, np.tile(y, (len(j), 1)))
            off = _fall(*self.panels.tails(between), 1)
            fine = good[j] = off <= self.goal[j].min(axis=1) / 2.0
            if fine.any():
                self._spread(j[fine], between[fine], wrong[fine], off[fine])
        return good

    def _spread(self, j: Indices, between: Float32, wrong: Float32, off: Float64) -> None:
        """Masses `between` places [., n, w] to all rows, with errors `wrong` [., w] in x and `off` [.] in y."""
        mass = self.panels.increments(between)
        below = -np.minimum(mass.min(axis=(1, 2)), 0.0)
        total, w = between.sum(axis=1), wrong.shape[1]
        if below.any():  # the other rows give way: columns keep their mass
            np.maximum(mass, 0.0, out=mass)
            mass *= (total / np.maximum(mass.sum(axis=1), 1e-30))[:, None]
        self.found.error[j, :w] = wrong + np.maximum(off, below)[:, None]
        self.found.inside[j, :w] = total
        self._put(j, mass, np.zeros_like(j), np.full_like(j, self.canvas.rows))

    def _evaluate(self, low: Indices, high: Indices, which: Indices) -> None:
        """Rows `low` to `high` [J] of the tiles `which`, one by one, and what is outside them."""
        found, rows = self.found, self.canvas.rows
        found.clear(which)
        tall = max(1, self.canvas.chunk // (self.canvas.flow.hidden * self.nodes.x.shape[1]) - 5)
        pieces = np.maximum(-(-(high - low)[which] // tall), 1)
        owner = np.repeat(which, pieces)
        rank = np.arange(len(owner)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
        start = low[owner] + rank * tall
        stop = np.minimum(start + tall, high[owner])
        below = np.where(rank == 0, 0, start)
        above = np.where(stop == high[owner], rows, stop)
        for some in self._runs(stop - start + 3, self.nodes.used[owner]):
            j, first, last = owner[some], start[some], stop[some]
            middle = np.minimum(first[:, None] + np.arange((last - first).max() + 1), last[:, None])
            edges = np.concatenate([below[some, None], middle, above[some, None]], axis=1)
            mass, wrong = self._mass(j, self.canvas.window.y[edges])
            inner, w = mass[:, 1:-1], wrong.shape[1]
            np.maximum.at(found.error[:, :w], j, wrong)
            np.add.at(found.inside[:, :w], j, inner.sum(axis=1))  # pieces of one tile add up
            np.add.at(found.outside[:, :w], j, mass[:, 0] + mass[:, -1])
            self._put(j, inner, first, last)

    def _mass(self, j: Indices, y: Float32) -> tuple[Float32, Float32]:
        """Masses between y [., E] in the tiles j, and their errors: `Distribution.cell_mass`."""
        own = self.nodes.some(j, self.tile.count)
        return self.canvas.flow.cell_mass(self._theta(j), own.x, own.weight, own.doubt, y)

    def _runs(self, edges: Indices, nodes: Indices) -> list[Indices]:
        """Groups of items, alike in their numbers of `edges` and `nodes` [n], for a graph run each."""
        groups = []
        sizes = -(-nodes // LANES)
        for size in np.unique(sizes):
            alike = np.flatnonzero(sizes == size)
            each = self.canvas.flow.hidden * LANES * int(size)
            budget, waste = max(1, self.canvas.chunk // each), WASTE // each
            groups += [alike[some] for some in batches(edges[alike] + 2, budget, waste)]
        return groups

    def _put(self, j: Indices, mass: Float32, first: Indices, last: Indices) -> None:
        """Put mass [len(j), rows, w] of the tiles j into the maps' rows `first` to `last`."""
        for i, (owner, low, high) in enumerate(zip(j.tolist(), first.tolist(), last.tolist(), strict=True)):
            n = self.tile.count[owner]
            columns = self.tile.columns[owner, :n]
            at = slice(columns[0], columns[0] + n) if columns[-1] - columns[0] == n - 1 else columns
            self.canvas.mass[self.tile.maps[owner]][low:high, at] = mass[i, : high - low, :n]


def _reach(points: Float64, held: Float32, end: float) -> Indices:
    """Rows [J] below which less than `end` is held, from what is `held` [J, M] below `points` [M], ascending.

    Between two points the tail is taken as a Gaussian's, and a row is added in case it is not.
    """
    last = len(points) - 1
    k = np.count_nonzero(held <= end, axis=1) - 1
    place = points[k]
    if end > RESOLVED_TAIL:
        depth = np.sqrt(-2.0 * np.log(np.clip(held, 1e-12, 0.99)))
        near, far = (np.take_along_axis(depth, np.minimum(k + i, last)[:, None], axis=1)[:, 0] for i in (0, 1))
        part = (near - np.sqrt(-2.0 * np.log(end))) / np.maximum(near - far, 1e-6)
        step = points[np.minimum(k + 1, last)] - place
        place = np.maximum(place + np.clip(part, 0.0, 1.0) * step - 1.0, place)
    whole: Indices = np.floor(place + 1e-6).astype(np.intp)
    return whole


def _fall(before: Float32, after: Float32, steps: int) -> Float64:
    """What coefficients that fell from `before` to `after` add up to from `steps` further on, if they go on so."""
    ratio = np.minimum(after / np.maximum(before, 1e-12), 0.99)
    return np.asarray(2.0 * after * ratio**steps / (1.0 - ratio), np.float64)
