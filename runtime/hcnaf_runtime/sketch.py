"""A coarse map of each theta: where its mass is, and how fast things change there.

It tells between which limits the mass of a trapezoid lies: where they are further apart than may be overlooked,
nodes are spent. And it tells how finely to cut what is computed, so that nothing slips through between two nodes.
The limits hold where F_2 does not turn within a column; nobody has looked closer.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hcnaf_runtime.plane import CHUNK, Distribution
from hcnaf_runtime.trapezoids import Trapezoids

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]

COLUMNS, ROWS = 16, 24

SPAN = 2
"""Columns that a trapezoid may cover; their number divides COLUMNS."""

STRIDE, FINE = 2.0, 2e-6
"""A line may climb by STRIDE times the spread of F_2 within a trapezoid, as seen from the middle of the mass, for
a tolerance of FINE; for others as much further as three nodes allow, which are off by its sixth power."""

MOST = 64
"""Parts that a trapezoid is cut into within a column."""

_PROBED = 3  # places in x where the range in y is looked for
_STEPS = 16  # a bracket is searched in so many steps, each time


@dataclass(frozen=True, eq=False)
class Sketch:
    """Coarse cells as summed tables. The outermost reach to infinity, so that nothing is left out."""

    corner: Float64
    """[2, B]: lower-left corner of each map's cells (m)."""
    step: Float64
    """[2, B]: size of its cells (m)."""
    sums: Float64
    """[2, B, COLUMNS + 1, ROWS + 1]: at least, and at most, the mass to the left of and below each node, where
    F_2 rises or falls along x within a column but does not turn."""
    between: Float64
    """[2, B, COLUMNS / SPAN, ROWS + 1]: the least and the largest F_2 at each row within SPAN columns."""
    climb: Float64
    """[B, COLUMNS / SPAN]: how much the mean of y changes along x within SPAN columns (m)."""
    spread: Float64
    """[B, COLUMNS / SPAN]: over how much of y F_2 rises there (m)."""

    def bound(self, low: Float64, high: Float64, maps: Indices) -> Float64:
        """About the most that maps [M] hold in boxes from `low` to `high` [2, M] (m), or more: [M].

        A box beyond all columns is taken for the nearest one.
        """
        corner, density = self.corner[:, maps], (1.0 / self.step)[:, maps]
        most = np.array([[COLUMNS], [ROWS]])
        first = ((low - corner) * density + 1e-6).clip(0.0, most - [[1], [0]]).astype(np.intp)  # rounded down
        last = ((high - corner) * density + (1.0 - 1e-6)).clip([[1], [0]], most).astype(np.intp)  # rounded up
        least, much = self.sums.reshape(2, -1)
        left, right = ((maps * (COLUMNS + 1) + k) * (ROWS + 1) for k in (first[0], last[0]))
        below_top = much[right + last[1]] - much[left + last[1]]
        below_bottom = least[right + first[1]] - least[left + first[1]]
        return np.asarray(below_top - below_bottom)

    def limits(self, parts: Trapezoids) -> tuple[Float64, Float64]:
        """About the least and the most that trapezoids hold, cut by `cut` and with known ends: [M] each."""
        x, bottom, top = parts.sides
        corner, density = self.corner[:, parts.map], (1.0 / self.step)[:, parts.map]
        most = COLUMNS // SPAN
        column = ((x[0] + x[1]) / 2 - corner[0]) * density[0] / SPAN
        row = (parts.map * most + column.clip(0.0, most - 1).astype(np.intp)) * (ROWS + 1)

        def near(y: Float64, slack: float) -> Indices:
            return np.asarray(((y - corner[1]) * density[1] + slack).clip(0.0, ROWS).astype(np.intp) + row)

        least, much = self.between.reshape(2, -1)
        share = parts.F[1] - parts.F[0]
        inner = least[near(top.min(axis=0), -1e-6)] - much[near(bottom.max(axis=0), 1.0 + 1e-6)]
        outer = much[near(top.max(axis=0), 1.0 - 1e-6)] - least[near(bottom.min(axis=0), 1e-6)]
        return share * np.maximum(inner, 0.0), share * outer

    def cut(self, parts: Trapezoids, tolerance: float) -> Trapezoids:
        """Trapezoids that lie in SPAN columns each, or beyond all, and whose lines do not climb much there."""
        start, end = (parts.sides[0] - self.corner[0, parts.map]) / (SPAN * self.step[0, parts.map])
        most = COLUMNS // SPAN
        first = np.floor(start).clip(-1, most).astype(np.intp)
        last = np.maximum(np.ceil(end).clip(0, most + 1).astype(np.intp), first + 1)
        index, within = _expanded(last - first)
        column = first[index] + within
        begin, width = start[index], (end - start)[index]
        a, b = (((k - begin) / width).clip(0.0, 1.0) for k in (column, column + 1))
        a, b = np.where(within == 0, 0.0, a), np.where(column + 1 == last[index], 1.0, b)
        place = parts.map[index] * most + column.clip(0, most - 1)
        bottom, top = (parts.sides[1:, 1] - parts.sides[1:, 0])[:, index] - self.climb.ravel()[place] * width
        rise = np.maximum(np.abs(bottom), np.abs(top)) * (b - a)
        stride = STRIDE * (tolerance / FINE) ** (1 / 6)
        finer = np.ceil(rise / (stride * self.spread.ravel()[place])).clip(1, MOST).astype(np.intp)
        finer[(column < 0) | (column == most)] = 1
        again, within = _expanded(finer)
        a, length, index = a[again], ((b - a) / finer)[again], index[again]
        left = a + length * within
        return parts.take(index).between(left, left + length)


def _expanded(count: Indices) -> tuple[Indices, Indices]:
    """For `count` [M] things of each: whose each is, and which of those."""
    index = np.repeat(np.arange(len(count)), count)
    return index, np.arange(len(index)) - np.repeat(np.cumsum(count) - count, count)


def ranges(flow: Distribution, theta: Float32, window: Float64, share: float) -> Float64:
    """From where to where maps of theta [B, P] have their mass in x and y, within `window`: both [2, 2, B] (m).

    Beyond either end is at most about `share` of it.
    """
    left, right = bracket(lambda x: flow.marginal_cdf(theta, x), window[0, 0], window[0, 1], share, rounds=2)
    x = np.linspace(left, right, _PROBED, axis=1).astype(np.float32)
    low, high = (np.broadcast_to(end[:, None], x.shape) for end in window[1])
    low, high = bracket(lambda y: flow.conditional_cdf(theta, x, y), low, high, share, rounds=1)
    return np.array([[left, right], [low.min(axis=1), high.max(axis=1)]])


def sketch(flow: Distribution, theta: Float32, ends: Float64, chunk: int = CHUNK) -> Sketch:
    """Maps of theta [B, P] in their `ranges` [2, 2, B]."""
    step = max(1, chunk // (flow.hidden * COLUMNS * (ROWS + 1)))
    starts = range(0, len(theta), step)
    parts = [_sketch(flow, theta[b : b + step], ends[..., b : b + step]) for b in starts]
    corner, size, sums, between = (np.concatenate([p[k] for p in parts], axis=1) for k in range(4))
    climb, spread = (np.concatenate([p[k] for p in parts]) for k in (4, 5))
    return Sketch(corner, size, sums, between, climb, spread)


def _sketch(flow: Distribution, theta: Float32, ends: Float64) -> tuple[Float64, ...]:
    """Corner, step, sums, between, climb and spread."""
    (left, right), (low, high) = ends
    x = np.linspace(left, right, COLUMNS + 1, axis=1).astype(np.float32)
    rows = np.linspace(low, high, ROWS + 1, axis=1)[:, None, 1:-1].astype(np.float32)
    below = np.zeros((*x.shape, ROWS + 1))
    below[..., 1:-1] = flow.conditional_cdf(theta, x, np.broadcast_to(rows, (*x.shape, ROWS - 1)))
    below[..., -1] = 1.0
    share_of = np.diff(flow.marginal_cdf(theta, x).astype(np.float64), axis=1)[..., None]
    sums = np.zeros((2, *below.shape))
    np.cumsum(share_of * np.minimum(below[:, :-1], below[:, 1:]), axis=1, out=sums[0, :, 1:])
    np.cumsum(share_of * np.maximum(below[:, :-1], below[:, 1:]), axis=1, out=sums[1, :, 1:])
    step = np.maximum(np.stack([(right - left) / COLUMNS, (high - low) / ROWS]), 1e-9)
    climb, spread = _course(below, step[1])
    edges = [below[:, k : COLUMNS + k - SPAN + 1 : SPAN] for k in range(SPAN + 1)]
    between = np.stack([np.min(edges, axis=0), np.max(edges, axis=0)])
    return np.stack([left, low]), step, sums, between, climb, spread


def _course(below: Float64, height: Float64) -> tuple[Float64, Float64]:
    """Climb and spread [B, COLUMNS / SPAN] from F_2 [B, COLUMNS + 1, ROWS + 1] at rows `height` [B] apart."""
    middle = np.clip(1.0 - below, 0.0, 1.0).sum(axis=2) * height[:, None]  # the mean of y, from the lowest row
    steepest = np.diff(below, axis=2).max(axis=2)
    # What rises within a row may do so at once: nobody has looked.
    spread = np.where(steepest < 0.9, 1.0 / np.maximum(steepest, 1e-3), 0.25) * height[:, None]
    least = np.minimum.reduceat(spread[:, :-1], np.arange(0, COLUMNS, SPAN), axis=1)
    return np.diff(middle[:, ::SPAN], axis=1), np.minimum(least, spread[:, SPAN::SPAN])


def bracket(
    cdf: Callable[[Float32], Float32], low: Float64, high: Float64, share: float, rounds: int
) -> tuple[Float64, Float64]:
    """Between which two values [...] `cdf` [..., n] goes from at most `share` to at least 1 - `share`.

    The search starts from `low` and `high` [...] and stays within; each round looks in _STEPS steps.
    """
    for _ in range(rounds):
        v = np.linspace(low, high, _STEPS + 1, axis=-1)
        F = cdf(v.astype(np.float32))
        before = np.maximum(np.count_nonzero(share >= F, axis=-1) - 1, 0)
        after = np.minimum(_STEPS + 1 - np.count_nonzero(1.0 - share <= F, axis=-1), _STEPS)
        low, high = (np.take_along_axis(v, k[..., None], axis=-1)[..., 0] for k in (before, after))
    return low, high
