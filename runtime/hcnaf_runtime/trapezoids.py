"""Probability of trapezoids with upright sides: what every region is cut into.

Between x_0 and x_1, above one straight line and below another, the mass is

    integral over [x_0, x_1] of  g(x) dF_1(x),     g(x) = F_2(top(x) given x) - F_2(bottom(x) given x)

exact in y, a quadrature in x from values of F_1 alone (`rules`). Where two tries do not tell enough, the trapezoid
is cut in two. Nodes of all trapezoids of a map are run together: a graph takes longest to read theta.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from hcnaf_runtime.plane import CHUNK, Distribution
from hcnaf_runtime.rules import ADDED, GAUSS, KRONROD, SHARED, first_try, second_try

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
Mask = npt.NDArray[np.bool_]
T = TypeVar("T")

DEPTH = 12
"""How many times a trapezoid may be halved."""

WIDTH = 128
"""Most trapezoids in a row of a run."""

SAME = 1e-7
"""Sides no further apart (m) are one."""

GUESS = 0.2
"""Share of the room between the limits of a trapezoid's mass that is taken for the error of a single node."""


NOISE = 4.0
"""How much larger the doubt is than the roundings that it stems from."""


@dataclass(frozen=True, eq=False)
class Trapezoids:
    """M trapezoids, each a part of a region and counted with a sign."""

    owner: Indices
    """[M]: the region it belongs to."""
    map: Indices
    """[M]: the row of theta, ascending."""
    sign: Float64
    """[M]: 1 or -1."""
    sides: Float64
    """[3, 2, M]: x, bottom and top (m) of the left and the right side."""
    F: Float64
    """[2, M]: F_1 at the left and the right side; NaN until it is known."""

    def __len__(self) -> int:
        return len(self.owner)

    def box(self) -> tuple[Float64, Float64]:
        """The upright boxes [2, M] about them: their lowest and highest x and y (m)."""
        x, bottom, top = self.sides
        low = np.stack([x[0], np.minimum(bottom[0], bottom[1])])
        return low, np.stack([x[1], np.maximum(top[0], top[1])])

    def take(self, which: Indices | Mask) -> "Trapezoids":
        """Those selected, in their order."""
        chosen = np.flatnonzero(which) if which.dtype == bool else which
        sides = self.sides.reshape(6, -1).take(chosen, axis=1).reshape(3, 2, -1)
        F = self.F.take(chosen, axis=1)
        return Trapezoids(self.owner[chosen], self.map[chosen], self.sign[chosen], sides, F)

    def between(self, a: Float64, b: Float64) -> "Trapezoids":
        """The part of each from `a` to `b` [M], where its left side is 0 and its right side 1."""
        left, span = self.sides[:, 0], self.sides[:, 1] - self.sides[:, 0]
        sides = np.stack([left + span * a, left + span * b], axis=1)
        return Trapezoids(self.owner, self.map, self.sign, sides, np.full_like(self.F, np.nan))

    def halves(self, middle: Float64) -> "Trapezoids":
        """Each cut upright in two, side by side: [2 M], if F_1 in their middles is `middle` [M]."""
        half = np.tile([0.0, 0.5], len(self))
        parts = self.take(np.repeat(np.arange(len(self)), 2)).between(half, half + 0.5)
        F = np.stack([np.column_stack([self.F[0], middle]), np.column_stack([middle, self.F[1]])])
        return replace(parts, F=F.reshape(2, -1))


def masses(
    flow: Distribution,
    theta: Float32,
    parts: Trapezoids,
    room: Float64,
    count: int,
    tolerance: float,
    chunk: int = CHUNK,
) -> tuple[Float64, Float64]:
    """The mass [count] of each region, the signed sum of its trapezoids, and what it may be off by [count].

    A trapezoid is refined until it is known to `tolerance`. One whose mass is known to little more than that,
    between limits `room` [M] apart, gets a single node.
    """
    total = np.zeros((2, count))

    def settle(parts: Trapezoids, mass: Float64, doubt: Float64) -> None:
        total[0] += np.bincount(parts.owner, parts.sign * mass, count)
        total[1] += np.bincount(parts.owner, doubt, count)

    small = room * GUESS <= tolerance
    few, parts = parts.take(small), parts.take(~small)
    g = _between(flow, theta, few, np.array([0.5]), chunk)
    settle(few, (few.F[1] - few.F[0]) * g[:, 0], GUESS * room[small])
    for depth in range(DEPTH):
        if not len(parts):
            break
        if depth == 0:
            F, g = _values(flow, theta, parts, GAUSS.t, chunk)
            mass, doubt = first_try(_with(parts, F), g)
            done = doubt <= tolerance
            settle(parts.take(done), mass[done], doubt[done])
            parts = parts.take(~done)
            F, g = _extended(flow, theta, parts, F[~done], g[~done], chunk)
        else:  # what had to be halved changes fast somewhere, perhaps near an end, where only the second try looks
            F, g = _values(flow, theta, parts, KRONROD.t, chunk)
        F = _with(parts, F)
        mass, doubt = second_try(F, g)
        done = (doubt <= np.maximum(tolerance, _noise(parts, F))) | (depth == DEPTH - 1)
        settle(parts.take(done), mass[done], doubt[done])
        parts = parts.take(~done).halves(F[~done, F.shape[1] // 2])
    return total[0], total[1]


def _noise(parts: Trapezoids, F: Float64) -> Float64:
    """[M]: the doubt that float32 makes by rounding x, and F_1 [M, q + 2] itself; no rule sees past it."""
    x, increment = parts.sides[0], F[:, -1] - F[:, 0]
    rounded = np.abs(x).max(axis=0) * increment / (x[1] - x[0]) + F[:, -1]
    return np.asarray(NOISE * np.finfo(np.float32).eps * rounded)


def _extended(
    flow: Distribution, theta: Float32, parts: Trapezoids, F: Float64, g: Float64, chunk: int
) -> tuple[Float64, Float64]:
    """F_1 and g [M, 7] at the nodes of KRONROD from those [M, 3] at GAUSS's."""
    more_F, more_g = _values(flow, theta, parts, KRONROD.t[ADDED], chunk)
    all_F, all_g = np.empty((len(parts), 7)), np.empty((len(parts), 7))
    all_F[:, SHARED], all_F[:, ADDED] = F, more_F
    all_g[:, SHARED], all_g[:, ADDED] = g, more_g
    return all_F, all_g


def _with(parts: Trapezoids, F: Float64) -> Float64:
    """[M, q + 2]: F_1 at the support, from `F` [M, q] at the nodes."""
    return np.column_stack([parts.F[0], F, parts.F[1]])


def _values(
    flow: Distribution, theta: Float32, parts: Trapezoids, t: Float64, chunk: int
) -> tuple[Float64, Float64]:
    """F_1 and g [M, q] at the places `t` [q] of the unit interval."""
    left, right = parts.sides[0]
    x = left[:, None] + (right - left)[:, None] * t
    return _marginal(flow, theta, parts.map, x, chunk), _between(flow, theta, parts, t, chunk)


def with_ends(flow: Distribution, theta: Float32, parts: Trapezoids, chunk: int = CHUNK) -> Trapezoids:
    """The same with F_1 at their sides, computed once where one begins at the end of the one before."""
    left, right = parts.sides[0]
    follows = (np.diff(parts.owner) == 0) & (np.abs(left[1:] - right[:-1]) < SAME)
    last = np.append(~follows, True)[: len(parts)]
    place = np.arange(len(parts)) + np.cumsum(last) - last
    x, maps = np.empty(len(parts) + last.sum()), np.empty(len(parts) + last.sum(), np.intp)
    x[place], maps[place] = left, parts.map
    x[place[last] + 1], maps[place[last] + 1] = right[last], parts.map[last]
    F = _marginal(flow, theta, maps, x[:, None], chunk)[:, 0]
    return replace(parts, F=np.stack([F[place], F[place + 1]]))


def _marginal(flow: Distribution, theta: Float32, maps: Indices, x: Float64, chunk: int) -> Float64:
    """F_1 [M, q] at `x` [M, q] (m) of `maps` [M], ascending."""
    F = np.empty(x.shape)
    for rows, members in _tiles(maps, max(1, chunk // (flow.hidden * x.shape[1]))):
        F[members] = flow.marginal_cdf(theta[rows], x[members].reshape(len(rows), -1).astype(np.float32)).reshape(
            *members.shape, -1
        )
    return F


def _between(flow: Distribution, theta: Float32, parts: Trapezoids, t: Float64, chunk: int) -> Float64:
    """g [M, q], the share between bottom and top, at the places `t` [q] of the unit interval."""
    q = len(t)
    g = np.empty((len(parts), q))
    start, span = parts.sides[:, 0], parts.sides[:, 1] - parts.sides[:, 0]
    for rows, members in _tiles(parts.map, max(1, chunk // (flow.hidden * 2 * q))):
        R, W = members.shape
        left, right = start[:, members, None], span[:, members, None]
        x = (left[0] + right[0] * t).astype(np.float32)
        y = np.empty((R, W, q, 2), np.float32)
        for k in (0, 1):
            np.add(left[k + 1], right[k + 1] * t, out=y[..., k], casting="same_kind")
        cdf = flow.conditional_cdf(theta[rows], x.reshape(R, W * q), y.reshape(R, W * q, 2))
        g[members] = np.maximum(cdf[..., 1] - cdf[..., 0], 0.0).reshape(R, W, q)
    return g


def _tiles(maps: Indices, budget: int) -> Iterator[tuple[Indices, Indices]]:
    """Rows of theta [R] and the trapezoids in each [R, W], R W within `budget`; short rows repeat their first."""
    width = min(WIDTH, budget)
    starts = np.flatnonzero(np.diff(maps, prepend=-1))
    counts = np.diff(starts, append=len(maps))
    rows = -(-counts // width)
    within = np.arange(rows.sum()) - np.repeat(np.cumsum(rows) - rows, rows)
    first = np.repeat(starts, rows) + within * width
    size = np.minimum(np.repeat(counts, rows) - within * width, width)
    longest = np.argsort(-size, kind="stable")  # rows of like length together: little to repeat
    at = 0
    while at < len(first):
        some = longest[at : at + max(1, budget // int(size[longest[at]]))]
        place = np.arange(size[some[0]])
        yield maps[first[some]], first[some, None] + np.where(place < size[some, None], place, 0)
        at += len(some)
