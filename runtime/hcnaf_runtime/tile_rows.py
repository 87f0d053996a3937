"""Which rows of a tile of columns are computed, and how.

Only rows where F_2 changes: they are found at a few landmarks. The rows left out below and above are one tall cell
each, whose masses come out with the others, so what is left out is known exactly, since F_2 is monotone: it is the
certificate. Where F_2 is smooth along y it is computed at a few places and interpolated to all rows (see `rows`).
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hcnaf_runtime.canvas import Canvas, column_sums, settle
from hcnaf_runtime.rows import Panels, fall, panels
from hcnaf_runtime.tiles import Tiles, batches

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
Mask = npt.NDArray[np.bool_]

RESOLVED_TAIL = 1e-6
"""What is held in a tail is told from rounding from here on."""

SCOUTS = 8
"""Landmarks are looked at from every so many-th node. What that overlooks is found with the cells, and mended."""

COARSE = 8
"""Order of the panels of rows that landmarks are at."""

ORDERS = {10: 0.1, 12: 0.1, 20: 1.0}
"""Orders of the panels that rows are interpolated from: the first for which landmarks promise an error of less
than so many times the goal. Most keep more than that, but not where F_2 is rough."""

CAUTION = 20.0
"""Rows that were interpolated are good enough if their coefficients promise an error so many times less than the
goal: they promise up to ten times too little, and the errors of many cells add up."""

WORTH = 2
"""Rows are interpolated, and judged then, where they are so many times as many as the points or more: where that
is not good enough they are computed one by one after all."""

LANES = 16
"""Numbers of nodes are alike if they fill as many vectors of this length: a product takes as long for all."""

WASTE = 1 << 17
"""Most of them that are padding: computing so many takes about as long as starting another run."""


@dataclass(frozen=True)
class Nodes:
    """Where F_2 is taken for J tiles of w columns, and what it counts for there.

    Column c of a tile takes the K nodes from c `step` on.
    """

    x: Float32  # [J, S], S = (w - 1) step + K
    bands: Float32  # [2, J, w, K]: weights, and their doubts; 0 in padding
    step: int

    def used(self, count: Indices) -> Indices:
        """How many of the S nodes tiles with `count` columns take: the rest is padding."""
        return np.asarray((count - 1) * self.step + self.bands.shape[-1])

    def columns(self, s: Indices) -> Indices:
        """The columns that the nodes s lie in, or the nearest to them."""
        w, K = self.bands.shape[-2:]
        return np.asarray(np.clip((s - (K - self.step) // 2) // self.step, 0, w - 1))

    def some(self, j: Indices, w: int) -> tuple[Float32, Float32, Float32]:
        """Nodes [., S], weights and doubts [., S, w] of the first `w` columns of the tiles j."""
        K = self.bands.shape[-1]
        S = (w - 1) * self.step + K
        dense = np.zeros((2, len(j), S, w), np.float32)
        size = dense.itemsize
        along = *dense.strides[:2], (self.step * w + 1) * size, w * size  # as_strided costs 15 microseconds
        np.ndarray((2, len(j), w, K), np.float32, dense, strides=along)[:] = self.bands[:, j, :w]
        return self.x[j, :S], dense[0], dense[1]


class Found:
    """What the cells of J tiles of w columns came to, [J, w] each: error, and mass inside and outside."""

    def __init__(self, tile: Tiles) -> None:
        self.error, self.inside, self.outside = np.zeros((3, *tile.columns.shape), np.float32)

    def note(self, which: Indices, first: Indices, pieces: Float32) -> None:
        """Put the three [3, n, w] of the tiles `which`, each from its `first` of n pieces on."""
        if len(which):
            self.error[which] = np.maximum.reduceat(pieces[0], first)
            self.inside[which], self.outside[which] = np.add.reduceat(pieces[1:], first, axis=1)


class TileRows:
    """J tiles of w columns, their `nodes`, what each column holds (`share`) and its cells may be wrong by (`goal`)
    [J, w], the shares of a column that its lower and its upper end may lose (`ends`) [2, J, w]; and what they came
    to, in `found`."""

    def __init__(
        self, canvas: Canvas, tile: Tiles, nodes: Nodes, share: Float64, goal: Float64, ends: Float64
    ) -> None:
        self.canvas, self.tile, self.nodes = canvas, tile, nodes
        self.share, self.goal, self.ends = share, goal, ends
        self.landmarks = panels(canvas.rows, COARSE)
        self.used = nodes.used(tile.count)
        self.found = Found(tile)

    def fill(self) -> Found:
        """Compute the rows where there is anything."""
        low, high, order = self._look()
        good = np.zeros(len(self.tile), np.bool_)
        for each in ORDERS:  # where an order was not good enough the next may be
            between = panels(self.canvas.rows, each)
            willing = (order > 0) & (order <= each) & (high - low >= WORTH * len(between.points))
            good |= self._interpolate(np.flatnonzero(willing & ~good), between)
        return self.fill_rows(low, high, np.flatnonzero(~good))

    def fill_rows(self, low: Indices, high: Indices, which: Indices) -> Found:
        """Compute rows `low` to `high` [J] of the tiles `which`, or all where those miss anything."""
        self._evaluate(low, high, which)
        allowed = (self.ends.sum(axis=0) * self.share * self.tile.own).sum(axis=1) + 1e-9
        missed = self.found.outside.sum(axis=1) > allowed
        again = np.flatnonzero(missed & (high - low < self.canvas.rows))
        if len(again):
            low[again], high[again] = 0, self.canvas.rows
            self._evaluate(low, high, again)
        return self.found

    def _look(self) -> tuple[Indices, Indices, Indices]:
        """From every SCOUTS-th node: rows `low` to `high` [J] outside which there should be nothing, and the order
        of the panels that rows can be interpolated from [J], 0 for none."""
        points, last = self.landmarks.points, self.nodes.x.shape[1] - 1
        scouts = np.append(np.arange(0, last, SCOUTS), last)
        cdf = self._at_landmarks(self.nodes.x[:, scouts])
        ends = self._least_ends(scouts)
        unused = scouts >= self.used[:, None]  # padding decides nothing
        rows = self.canvas.rows
        below = np.where(unused, rows, _reach(points, cdf - cdf[:, :1], ends[0])).min(axis=1)
        above = _reach(rows - points[::-1], (cdf[:, -1:] - cdf)[:, ::-1], ends[1])
        low, high = below, rows - np.where(unused, rows, above).min(axis=1)
        high = np.maximum(high, low)
        return low, high, self._order(*self.landmarks.tails(np.diff(cdf, axis=1)), high - low)

    def _least_ends(self, scouts: Indices) -> Float64:
        """[2, J, len(scouts)]: the least that ends of columns may lose, of those nearest to each scout."""
        first = np.append(0, (scouts[1:] + scouts[:-1]) // 2)
        return np.asarray(np.minimum.reduceat(self.ends, self.nodes.columns(first), axis=2))

    def _order(self, before: Float32, after: Float32, height: Indices) -> Indices:
        """The least of ORDERS [J] that is enough as landmarks tell and pays for so many rows [J]; 0 for none."""
        order, goal = np.zeros(len(self.tile), np.intp), self.goal.min(axis=1)
        for each, most in reversed(ORDERS.items()):
            predicted = np.minimum(fall(before, after, (each - COARSE) // 2), 1.0) * self.share.max(axis=1)
            worth = height >= WORTH * len(panels(self.canvas.rows, each).points)
            order[(predicted < most * goal) & worth] = each
        return order

    def _at_landmarks(self, x: Float32) -> Float32:
        """F_2 [J, E, S] at the landmarks given x [J, S].

        Tiles of one map are taken together where there are many: with few nodes a run's products take as long as
        with LANES.
        """
        y, n = self.landmarks.places(self.canvas.window.y), x.shape[1]
        many = len(x) * len(y) * LANES * self.canvas.flow.hidden > self.canvas.chunk
        owner = self.tile.maps if many else np.arange(len(x))
        order = np.argsort(owner, kind="stable")
        _, first, count = np.unique(owner[order], return_index=True, return_counts=True)
        cdf = np.empty((len(x), len(y), n), np.float32)
        for some in self._runs(np.full(len(count), len(y)), count * n):
            rank = np.arange(count[some].max())
            j = order[first[some, None] + np.minimum(rank, count[some, None] - 1)]  # [., tiles of a map]
            where = np.broadcast_to(y, (len(some), len(y)))
            together = self.canvas.flow.grid_cdf(self._theta(j[:, 0]), x[j].reshape(len(some), -1), where)
            cdf[j] = together.reshape(len(some), len(y), -1, n).swapaxes(1, 2)
        return cdf

    def _theta(self, j: Indices) -> Float32:
        return self.canvas.theta[self.tile.maps[j]]

    def _interpolate(self, which: Indices, between: Panels) -> Mask:
        """All rows of the tiles `which` from points `between` them; for which tiles [J] that is good enough."""
        y = between.places(self.canvas.window.y)
        good = np.zeros(len(self.tile), np.bool_)
        for some in self._runs(np.full(len(which), len(y)), self.used[which]):
            j = which[some]
            mass, wrong = self._mass(j, np.broadcast_to(y, (len(j), len(y))))
            off = fall(*between.tails(mass), 1)
            fine = good[j] = off <= self.goal[j].min(axis=1) / CAUTION
            if fine.any():
                self._spread(j[fine], between.increments(mass[fine]), wrong[fine], off[fine])
        return good

    def _spread(self, j: Indices, mass: Float32, wrong: Float32, off: Float64) -> None:
        """Interpolated `mass` [., rows, w] of tiles j, with errors `wrong` [., w] in x and `off` [.] in y."""
        w = wrong.shape[1]
        total = column_sums(mass)
        below = settle(mass, total, mass)
        self.found.error[j, :w] = wrong + np.maximum(off, below)[:, None]
        self.found.inside[j, :w] = total
        self._put(j, mass, np.zeros_like(j), np.full_like(j, self.canvas.rows))

    def _evaluate(self, low: Indices, high: Indices, which: Indices) -> None:
        """Rows `low` to `high` [J] of the tiles `which`, one by one, and what is outside them."""
        rows = self.canvas.rows
        tall = max(1, self.canvas.chunk // (self.canvas.flow.hidden * self.nodes.x.shape[1]) - 5)
        pieces = np.maximum(-(-(high - low)[which] // tall), 1)
        owner = np.repeat(which, pieces)
        rank = np.arange(len(owner)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
        start = low[owner] + rank * tall
        stop = np.minimum(start + tall, high[owner])
        below = np.where(rank == 0, 0, start)
        above = np.where(stop == high[owner], rows, stop)
        found = np.zeros((3, len(owner), self.tile.columns.shape[1]), np.float32)
        for some in self._runs(stop - start + 3, self.used[owner]):
            j, first, last = owner[some], start[some], stop[some]
            middle = np.minimum(first[:, None] + np.arange((last - first).max() + 1), last[:, None])
            edges = np.concatenate([below[some, None], middle, above[some, None]], axis=1)
            mass, wrong = self._mass(j, self.canvas.window.y[edges])
            inner, w = mass[:, 1:-1], wrong.shape[1]
            found[0, some, :w] = wrong
            found[1, some, :w] = column_sums(inner)
            found[2, some, :w] = mass[:, 0] + mass[:, -1]
            self._put(j, inner, first, last)
        self.found.note(which, np.cumsum(pieces) - pieces, found)

    def _mass(self, j: Indices, y: Float32) -> tuple[Float32, Float32]:
        """Masses between y [., E] in the tiles j, and their errors: `Distribution.cell_mass`."""
        x, weight, doubt = self.nodes.some(j, int(self.tile.count[j].max()))
        return self.canvas.flow.cell_mass(self._theta(j), x, weight, doubt, y)

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
        own = self.canvas.maps[self.tile.maps]
        for i, (owner, low, high) in enumerate(zip(j.tolist(), first.tolist(), last.tolist(), strict=True)):
            n = self.tile.count[owner]
            columns = self.tile.columns[owner, :n]
            at = slice(columns[0], columns[0] + n) if columns[-1] - columns[0] == n - 1 else columns
            self.canvas.mass[own[owner]][low:high, at] = mass[i, : high - low, :n]


def _reach(points: Float64, held: Float32, end: Float64) -> Indices:
    """Rows [J, n] below which less than `end` [J, n] is held, from what is `held` [J, M, n] below `points` [M],
    ascending.

    Between two points the tail is taken as a Gaussian's, and a row is added in case it is not.
    """
    last = len(points) - 1
    k = np.count_nonzero(held <= end[:, None], axis=1) - 1
    after = np.minimum(k + 1, last)
    place = points[k]
    at = (np.take_along_axis(held, i[:, None], axis=1)[:, 0] for i in (k, after))
    near, far = (np.sqrt(-2.0 * np.log(np.clip(v, 1e-12, 0.99))) for v in at)
    part = (near - np.sqrt(-2.0 * np.log(end))) / np.maximum(near - far, 1e-6)
    step = points[after] - place
    further = np.maximum(place + np.clip(part, 0.0, 1.0) * step - 1.0, place)
    whole: Indices = np.floor(np.where(end > RESOLVED_TAIL, further, place) + 1e-6).astype(np.intp)
    return whole
