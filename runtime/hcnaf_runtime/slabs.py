"""Polygons cut into trapezoids with upright sides.

A convex polygon is cut at the x of its corners, between which its bottom and its top are straight. Of any other
one each edge stands on the polygon's lowest y; the trapezoids under edges that run left (counter-clockwise) count,
those under edges that run right are taken off.
"""

import numpy as np
import numpy.typing as npt

from hcnaf_runtime.trapezoids import Trapezoids

Float64 = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]

_UPRIGHT = 1e-7  # edges that cover less of x (m) hold nothing
_STRAIGHT = 1e-9  # m²: corners that turn less than that are none


def slabs(corners: Float64, owner: Indices, n: int) -> Trapezoids:
    """Polygons with corners [2, V, M] as trapezoids; `owner` [M] is ascending, n of them to a map."""
    turns = _turns(corners)
    convex = (turns >= -_STRAIGHT).all(axis=0) | (turns <= _STRAIGHT).all(axis=0)
    if convex.all():
        return _convex(corners, owner, n)
    parts = _convex(corners[..., convex], owner[convex], n), _standing(corners[..., ~convex], owner[~convex], n)
    index, sign = np.concatenate([p.owner for p in parts]), np.concatenate([p.sign for p in parts])
    sides = np.concatenate([p.sides for p in parts], axis=-1)
    return _trapezoids(index, n, sign, sides).take(np.argsort(index, kind="stable"))


def _trapezoids(owner: Indices, n: int, sign: Float64, sides: Float64) -> Trapezoids:
    """Trapezoids of regions, n to a map."""
    return Trapezoids(owner, owner // n, sign, sides, np.full((2, len(owner)), np.nan))


def _convex(corners: Float64, owner: Indices, n: int) -> Trapezoids:
    """Convex polygons with corners [2, V, M], cut at the x of their corners."""
    x, y = corners
    V = len(x)
    run = np.roll(x, -1, axis=0) - x
    slope = (np.roll(y, -1, axis=0) - y) / np.where(np.abs(run) > _UPRIGHT, run, np.inf)
    offset = y - slope * x
    run *= np.where(_area(x, y) < 0.0, -1.0, 1.0)
    floor, roof = np.where(run > _UPRIGHT, offset, -np.inf), np.where(run < -_UPRIGHT, offset, np.inf)
    cuts = np.sort(x, axis=0)
    bottom, top, line = np.full(x.shape, -np.inf), np.full(x.shape, np.inf), np.empty(x.shape)
    for e in range(V):  # the highest of the lines below and the lowest of those above
        rise = slope[e] * cuts
        np.maximum(bottom, np.add(floor[e], rise, out=line), out=bottom)
        np.minimum(top, np.add(roof[e], rise, out=line), out=top)
    rows = np.stack([cuts, bottom, np.maximum(bottom, top)]).swapaxes(1, 2)  # [3, M, V]
    wide = np.flatnonzero(np.diff(rows[0], axis=1).ravel() > _UPRIGHT)
    which, slab = np.divmod(wide, V - 1)
    left = which * V + slab
    sides = np.stack([rows.reshape(3, -1).take(k, axis=1) for k in (left, left + 1)], axis=1)
    owner = owner[which]
    return _trapezoids(owner, n, np.ones(len(owner)), sides)


def _standing(corners: Float64, owner: Indices, n: int) -> Trapezoids:
    """Simple polygons with corners [2, V, M]: a trapezoid from each edge down to the lowest y."""
    x, y = corners
    ends = np.stack([corners, np.roll(corners, -1, axis=1)], axis=1)  # [2, 2, V, M]
    run = np.diff(ends[0], axis=0)[0]
    ends = np.where(run < 0.0, ends[:, ::-1], ends)
    base = np.broadcast_to(y.min(axis=0), ends.shape[1:])
    edge, which = np.nonzero(np.abs(run) > _UPRIGHT)
    sides = np.stack([ends[0], base, ends[1]])[:, :, edge, which]
    sign = -np.sign(run)[edge, which] * np.where(_area(x, y) < 0.0, -1.0, 1.0)[which]
    owner = owner[which]
    return _trapezoids(owner, n, sign, sides)


def _area(x: Float64, y: Float64) -> Float64:
    """[M]: twice the area, positive where corners [V, M] go round counter-clockwise."""
    x, y = x - x[0], y - y[0]
    area: Float64 = (x * np.roll(y, -1, axis=0) - y * np.roll(x, -1, axis=0)).sum(axis=0)
    return area


def _turns(corners: Float64) -> Float64:
    """[V, M]: at every corner, how far the polygon turns left (m²)."""
    dx, dy = np.roll(corners, -1, axis=1) - corners
    for _ in range(2):  # a corner that is repeated has the direction that led to it
        for k in range(len(dx)):
            still = (dx[k] == 0.0) & (dy[k] == 0.0)
            dx[k], dy[k] = np.where(still, dx[k - 1], dx[k]), np.where(still, dy[k - 1], dy[k])
    return np.asarray(dx * np.roll(dy, -1, axis=0) - dy * np.roll(dx, -1, axis=0))
