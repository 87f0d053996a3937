"""Which columns of a window are computed, and from how many nodes.

    F_1 at all edges --> columns with mass --> one node in each (Halo) --> columns in doubt --> more nodes (RULES)

Columns of all maps are pooled in tiles, and tiles in batches of bounded size.
"""

import numpy as np
import numpy.typing as npt

from hcnaf_runtime import smooth
from hcnaf_runtime.canvas import Canvas
from hcnaf_runtime.plane import Distribution, Window
from hcnaf_runtime.quadrature import Halo, Rule
from hcnaf_runtime.tile_rows import Found, Nodes, TileRows
from hcnaf_runtime.tiles import Tiles, batches, cut

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
Mask = npt.NDArray[np.bool_]
HALO = Halo(2, Rule(1, 2))
"""The first try: the centre of every column, and two neighbours on either side."""

RULES = tuple(Rule(2**k, 7) for k in range(7))
"""Rules tried in turn where the first try is in doubt; the last one has 448 nodes per column."""

HOPELESS = 8
"""From so many panels on a column must gain by a rule to be tried with the next."""

WIDTH = 44
"""Most columns in a tile, and most nodes in one where each column has several."""

BATCH = 8192
"""Most nodes in the tiles that are looked at together."""

NEGLIGIBLE = 1e-9
"""Columns with less mass are left empty; thousands of them do not add up to what float32 resolves near 1."""

SATURATED = 1e-9, 1.5e-7
"""What float32 resolves near 0 and near 1: F_2 this close to its value at the window's edge is flat up to it."""

ROUNDED = 5e-7
"""What a map may lose to these two, and what is lost in rounding: it is no one's to spend."""

RESOLVED = 1e-3
"""A rule's nodes may miss F_1 by this share of a column's mass. A spike between two nodes misses it by far
more, and would otherwise pass for converged, since no rule sees it; accuracy itself is judged by the cells."""

MOST = 0.25
"""No end of a column loses more than this share of it."""

MARGIN = 2
"""Rows more that a column in doubt gets on either side."""


class Columns:
    """Maps being filled, with what is known of each column [B, C]: its share of the mass, its error, and what of
    it is inside and outside of the rows computed."""

    def __init__(
        self,
        flow: Distribution,
        theta: Float32,
        window: Window,
        mass: Float32,
        maps: Indices,
        tolerance: float,
        lost_mass: float,
        chunk: int,
    ) -> None:
        self.flow, self.theta, self.window = flow, theta, window
        self.tolerance, self.budget = tolerance, max(lost_mass - ROUNDED, 0.0)
        self.canvas = Canvas(flow, theta, window, mass, maps, chunk)

    def run(self) -> None:
        """Fill the maps."""
        self._begin()
        done = self._smooth()
        if not done.all():
            self._tiles(~done)

    def _tiles(self, wanted: Mask) -> None:
        """Fill the maps `wanted` [B] tile by tile."""
        self._clear(wanted)
        tiles = cut(self.kept, WIDTH, gap=2 * HALO.reach)
        for some in batches(tiles.count + 2 * HALO.reach, BATCH):
            self._centres(tiles.some(some))
        pending = self.error > self.goal
        for rule in RULES:
            if not pending.any():
                break
            before = self.error.copy()
            tiles = cut(pending, max(1, WIDTH // rule.size))
            for some in batches(tiles.count * rule.size, BATCH):
                self._refine(rule, tiles.some(some))
            pending &= self.error > self.goal
            if rule.panels >= HOPELESS:  # such as the rounding of F_2
                pending &= (self.error < 0.9 * before) | (self.error >= self.share)

    def _begin(self) -> None:
        """What F_1 tells: the columns' shares, and what cells may be wrong by."""
        left, right = self.window.x[:1], self.window.x[-1:]
        further = np.arange(1, smooth.AROUND + 1, dtype=np.float32) * (right - left) / (len(self.window.x) - 1)
        edges = np.concatenate([left - further[::-1], self.window.x, right + further])
        edges = np.broadcast_to(edges, (len(self.theta), len(edges)))
        self.around = self.flow.marginal_cdf(self.theta, edges).astype(np.float64)
        self.cdf = self.around[:, smooth.AROUND : -smooth.AROUND]
        self.share = np.maximum(np.diff(self.cdf, axis=1), 0.0)
        self.goal = np.maximum(self.tolerance, _noise(self.window.x) * self.share)
        self.error = np.zeros_like(self.share)
        # A column more than there are takes what belongs to padding.
        self.inside, self.outside = np.zeros((2, *self.cdf.shape))

    def _smooth(self) -> Mask:
        """Fill maps whose F_2 is smooth both ways. Which of them are [B]."""
        done = np.zeros(len(self.theta), np.bool_)
        for found in smooth.fill(self.canvas, self.around, self.goal):
            self.inside[found.maps, :-1] = found.inside
            self.error[found.maps] = found.error
            done[found.maps] = True
        return done

    def _clear(self, wanted: Mask) -> None:
        """The maps `wanted` [B] empty, and which of their columns to keep."""
        for k in self.canvas.maps[wanted]:
            self.canvas.mass[k] = 0.0
        self.kept = _kept(self.share, self.budget / 2.0) & wanted[:, None]
        self.ends = _ends(self.share, self.kept, self.budget)
        dropped = wanted[:, None] & ~self.kept
        self.outside[:, :-1][dropped] = self.share[dropped]
        if self.budget == 0.0:
            self.error[dropped] = self.share[dropped]

    def _centres(self, tile: Tiles) -> None:
        """One node per column."""
        reach, w = HALO.reach, tile.columns.shape[1]
        left = float(self.window.x[0])
        pitch = (float(self.window.x[-1]) - left) / (len(self.window.x) - 1)
        weights, misfit = self._weights(tile, HALO.rule)
        first = tile.columns[:, :1] - reach + np.arange(w + 2 * reach)
        x = (left + (first + 0.5) * pitch).astype(np.float32)
        bands = np.stack([weights @ HALO.spread, weights @ HALO.doubt]).astype(np.float32)
        nodes = Nodes(x, bands, step=1)
        self._note(tile, self._rows(tile, nodes).fill(), misfit)

    def _refine(self, rule: Rule, tile: Tiles) -> None:
        """Several nodes in each column."""
        J = len(tile)
        weights, misfit = self._weights(tile, rule)
        x = self._places(tile, rule.support[rule.nodes]).reshape(J, -1)
        bands = np.stack([weights, weights @ rule.doubt]).astype(np.float32)
        nodes = Nodes(x, bands, step=rule.size)
        low, high = self._held(tile)
        self.canvas.mass[self.canvas.maps[tile.maps, None], :, tile.columns] = 0.0
        found = self._rows(tile, nodes).fill_rows(low, high, np.arange(J))
        unresolved = misfit > np.maximum(RESOLVED * self._of(self.share, tile), self._of(self.goal, tile))
        self._note(tile, found, np.where(unresolved, np.inf, 0.0))

    def _rows(self, tile: Tiles, nodes: Nodes) -> TileRows:
        share, goal, *ends = (self._of(v, tile) for v in (self.share, self.goal, *self.ends))
        return TileRows(self.canvas, tile, nodes, share, goal, np.stack(ends))

    def _held(self, tile: Tiles) -> tuple[Indices, Indices]:
        """The rows `low` to `high` [J] that hold anything, by what is there now, and MARGIN more."""
        mass = self.canvas.mass[self.canvas.maps[tile.maps, None], :, tile.columns]  # [J, w, R]
        below = np.cumsum(mass, axis=-1)
        low, high = (self._of(end * self.share, tile)[..., None] for end in self.ends)
        empty = np.count_nonzero(below <= low, axis=-1)
        full = np.count_nonzero(below >= below[..., -1:] - high, axis=-1)
        low = np.maximum(empty.min(axis=1) - MARGIN, 0)
        high = np.minimum(self.canvas.rows - full.min(axis=1) + 1 + MARGIN, self.canvas.rows)
        return low, np.maximum(high, low)

    def _of(self, values: Float64, tile: Tiles) -> Float64:
        """What is known of a tile's columns, [J, w]."""
        return values[tile.maps[:, None], tile.columns]

    def _weights(self, tile: Tiles, rule: Rule) -> tuple[Float64, Float64]:
        """Weights [J, w, S] of the rule's nodes in each column, zero in padding, and its misfit of F_1 [J, w]."""
        n = len(rule.support) - 2
        x = self._places(tile, np.concatenate([rule.support[1:-1], rule.checks]))
        found = self.flow.marginal_cdf(self.theta[tile.maps], x.reshape(len(tile), -1))
        cdf = found.astype(np.float64).reshape(x.shape)
        left, right = (self.cdf[tile.maps[:, None], tile.columns + side][..., None] for side in (0, 1))
        F = np.concatenate([left, cdf[..., :n], right], axis=-1)
        return rule.weights(F) * tile.own[:, :, None], rule.misfit(F, cdf[..., n:])

    def _places(self, tile: Tiles, share: Float64) -> Float32:
        """Points [J, w, n] at these shares [n] of the way from each column's left edge to its right."""
        left = self.window.x[tile.columns].astype(np.float64)[..., None]
        right = self.window.x[tile.columns + 1].astype(np.float64)[..., None]
        return (left + (right - left) * share).astype(np.float32)

    def _note(self, tile: Tiles, found: Found, unsure: Float64) -> None:
        """Note what was found in a tile's columns, and errors with what else is `unsure` [J, w]: none is wrong by
        more than it holds."""
        maps, columns = tile.maps[:, None], np.where(tile.own, tile.columns, len(self.window.x) - 1)
        self.inside[maps, columns] = found.inside
        self.outside[maps, columns] = found.outside
        own = tile.own
        maps = np.broadcast_to(maps, own.shape)[own]
        columns = columns[own]
        error = np.maximum(found.error, unsure)[own]
        self.error[maps, columns] = np.minimum(error, self.share[maps, columns])


def _kept(share: Float64, budget: float) -> Mask:
    """Columns [B, C] to compute: all but the smallest, which together hold at most `budget` per map."""
    ascending = np.sort(share, axis=1)
    dropped = np.count_nonzero(np.cumsum(ascending, axis=1) <= budget, axis=1)
    threshold = np.take_along_axis(ascending, np.maximum(dropped - 1, 0)[:, None], axis=1)
    threshold = np.where(dropped[:, None] > 0, threshold, 0.0)
    return np.asarray(share > np.maximum(threshold, NEGLIGIBLE))


def _ends(share: Float64, kept: Mask, budget: float) -> Float64:
    """[2, B, C]: the shares that a column's lower and upper end may lose.

    Columns left out may lose half of `budget`, either end of the others a quarter: half of that in shares of what
    a column holds, and half of it equally, so that columns that hold little are not followed as far out.
    """
    count = np.maximum(kept.sum(axis=1, keepdims=True), 1)
    held = np.maximum(share, 1e-30)
    ends = budget / 8.0 * (1.0 + 1.0 / (count * held)) if budget else NEGLIGIBLE / held
    return np.stack([np.clip(ends, least, MOST) for least in SATURATED])


def _noise(x: Float32) -> Float64:
    """[C]: what rounding x to float32 changes in F_1, in units of a column's mass; no rule sees past it."""
    edges = x.astype(np.float64)
    reach = np.maximum(np.abs(edges[:-1]), np.abs(edges[1:]))
    return np.finfo(np.float32).eps * reach / np.diff(edges)
