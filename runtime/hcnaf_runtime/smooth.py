"""Whole maps from few points, where F_2 is smooth in x and in y.

    F_1 at the columns' edges --> smooth? --> F_2 on a mesh --> a cell of each column computed --> all cells

What the nodes and points of a mesh do not show, a feature between them, checks do: in every column a cell is
computed, where F_2 rises, and compared with what is interpolated. A map that fails gets a finer mesh, or is left
to `tile_rows`.
"""

import math
import threading
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hcnaf_runtime.canvas import Canvas, column_sums, settle
from hcnaf_runtime.mesh import Mesh, mesh
from hcnaf_runtime.products import product
from hcnaf_runtime.rows import fall

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
Mask = npt.NDArray[np.bool_]

MESHES = (256, 32, 47, 0.99), (128, 36, 72, 0.97), (128, 48, 96, 0.95)
"""The most columns of a panel, its nodes, the order of a panel of rows, and how evenly both are spaced; tried in
turn. Products take as long as with the next multiple of 16 nodes."""

AROUND, ALONE = 3, 2.0
"""Tried where no column holds more or less than a polynomial through so many others on either side says, by more
than so many times what a cell may be wrong by: a spike that nodes do not see would."""

HOLDS, WIDE = 1e-6, 0.5
"""Tried where more than this share of the columns hold so much: narrower maps cost less tile by tile."""

FAR = 10.0
"""A map that misses what is allowed by more than so many times is not tried again."""

SEEN = 1.5
"""The worst cell is taken to be wrong by so many times as much as the worst of those that are checked."""

FALLS = 0.5
"""Coefficients in y are not taken to fall any faster: the last may be small by chance."""

GOLDEN, SILVER = 0.6180339887498949, 0.4142135623730951
"""In the next column the cell that is checked is by so much of the column's rise further up, modulo 1, and by so
much of what is between two LANDMARKS."""

LANDMARKS = 4
"""Every so many-th point tells where columns rise."""

TOGETHER = 1 << 18
"""Cells that are interpolated together: with fewer threads wait for Python's lock, with more for memory."""


@dataclass(frozen=True)
class Filled:
    """The maps that were filled [n], of those of the canvas, and of each column [n, C] the error and the mass."""

    maps: Indices
    error: Float64
    inside: Float32


@dataclass(frozen=True)
class Tried:
    """Some maps [n], F_2 at nodes and points [n, E, S], what columns hold between points [n, E - 1, C], and what
    their cells may be wrong by in y [n]."""

    maps: Indices
    cdf: Float32
    mass: Float32
    error: Float64

    def __getitem__(self, which: Mask) -> "Tried":
        return Tried(self.maps[which], self.cdf[which], self.mass[which], self.error[which])


def fill(canvas: Canvas, around: Float64, goal: Float64) -> Iterator[Filled]:
    """Fill the maps of the canvas that are smooth, given F_1 at the columns' edges and at AROUND more on either
    side [B, C + 1 + 2 AROUND], and what cells may be wrong by [B, C]."""
    meshes = [each for orders in MESHES if (each := mesh(goal.shape[1], canvas.rows, *orders)).worth]
    if meshes:
        left = _promising(around, goal)
        for each in meshes:
            if left.any():
                yield from Smooth(canvas, each, around, goal).fill(left)


def _promising(around: Float64, goal: Float64) -> Mask:
    """[B]: which maps to try, by F_1."""
    found = (np.diff(around[:, AROUND:-AROUND], axis=1) > HOLDS).mean(axis=1) > WIDE
    if found.any():
        alone = np.abs(np.diff(around, 2 * AROUND + 1, axis=1)) / math.comb(2 * AROUND, AROUND)
        found &= (alone < ALONE * goal).all(axis=1)
    return np.asarray(found)


@dataclass(frozen=True)
class Smooth:
    """A try with one mesh."""

    canvas: Canvas
    mesh: Mesh
    around: Float64
    goal: Float64

    def fill(self, left: Mask) -> Iterator[Filled]:
        """Fill those of the maps that are `left` [B] and smooth. Neither they are left then nor those that are far
        from smooth. Where all maps looked at first fail the mesh is taken to be too coarse for the others."""
        count = 0
        for group in self._groups(np.flatnonzero(left)):
            tried = [self._evaluated(some) for some in _cut(group, self.canvas.chunk // self._size)]
            fine = _joined([each[self._near(each.maps, each.error[:, None], left)] for each in tried])
            if len(fine.maps):
                filled = self._checked(fine, left)
                left[filled.maps] = False
                count += len(filled.maps)
                yield filled
            if not count:
                return

    def _groups(self, maps: Indices) -> list[Indices]:
        """`maps` in parts that are checked and put together: the last, of a forecast the furthest ahead and
        smoothest, before all others, unless one graph run takes all."""
        each = max(self.mesh.rows, self.mesh.rule.size) * self.mesh.columns
        rest = len(maps) - int(len(maps) * self._size > self.canvas.chunk)
        return [*_cut(maps[rest:], 1), *_cut(maps[:rest], self.canvas.chunk // each)]

    def _near(self, maps: Indices, error: Float64, left: Mask) -> Mask:
        """Which of the `maps` are within their goal by this `error` [n, 1 or C]. Those far from it are not
        `left`."""
        missed = (error / self.goal[maps]).max(axis=1)
        left[maps] = missed <= FAR
        return np.asarray(missed <= 1.0)

    @property
    def _size(self) -> int:
        """Numbers in the widest intermediate for a map."""
        return self.canvas.flow.hidden * self.mesh.rule.size * len(self.mesh.between.points)

    def _evaluated(self, maps: Indices) -> Tried:
        """F_2 on the mesh."""
        window, between, theta = self.canvas.window, self.mesh.between, self.canvas.theta[maps]
        y = np.broadcast_to(between.places(window.y), (len(maps), len(between.points)))
        parts = np.array_split(self.mesh.places(window.x), -(-self._size // (2 * self.canvas.chunk)))
        found = [self.canvas.flow.grid_cdf(theta, np.broadcast_to(x, (len(maps), len(x))), y) for x in parts]
        cdf = np.concatenate(found, axis=2) if len(found) > 1 else found[0]
        mass = product(np.diff(cdf, axis=1), self.mesh.weights(self.around[maps, AROUND - 1 : 1 - AROUND]))
        return Tried(maps, cdf, mass, SEEN * fall(*between.tails(mass), 1, FALLS))

    def _checked(self, tried: Tried, left: Mask) -> Filled:
        """Fill the maps that pass the checks."""
        error = np.maximum(tried.error[:, None], SEEN * self._missed(tried.maps, tried.cdf))
        good = self._near(tried.maps, error, left)
        maps, mass, error = tried.maps[good], tried.mass[good], error[good]
        inside = column_sums(mass)
        error = np.maximum(error, self._put(self.canvas.maps[maps], mass, inside)[:, None])
        done = np.flatnonzero((error <= self.goal[maps]).all(axis=1))
        return Filled(maps[done], error[done], inside[done])

    def _put(self, places: Indices, mass: Float32, inside: Float32) -> Float32:
        """Put all cells, from what columns hold between points [n, E - 1, C] and in all [n, C], in `places` [n] of
        the canvas. How far below 0 they were [n]."""
        below, into, between = np.empty(len(places), np.float32), self.canvas.mass, self.mesh.between
        R, C = self.mesh.rows, self.mesh.columns
        if R * C > TOGETHER:
            for i, place in enumerate(places):
                below[i] = settle(between.increments(mass[i], into[place]), inside[i], into[place])
            return below
        for some in _cut(np.arange(len(places)), TOGETHER // (R * C)):
            cells = between.increments(mass[some], _scratch.of(len(some), R, C))
            for i, own in zip(some.tolist(), cells, strict=True):
                below[i] = settle(own, inside[i], into[places[i]])
        return below

    def _missed(self, maps: Indices, cdf: Float32) -> Float64:
        """[n, C]: how far the cell that is checked in each column is off, from F_2 on the mesh."""
        middles = self.mesh.middles(cdf)
        rows = self._rising(middles)
        x, y = self.canvas.window.x, self.canvas.window.y
        middle = np.broadcast_to((x[1:] + x[:-1]) / 2.0, rows.shape)
        found = self.canvas.flow.conditional_cdf(self.canvas.theta[maps], middle, y[rows[..., None] + [0, 1]])
        off = np.abs(np.diff(found, axis=2)[..., 0] - self.mesh.rises(middles, rows))
        return np.asarray(off * np.diff(self.around[maps, AROUND:-AROUND], axis=1))

    def _rising(self, middles: Float32) -> Indices:
        """[n, C]: a row of each column, by F_2 at the points in its middle [n, C, E]: after a share of its rise
        that is a different one in each column."""
        points = self.mesh.between.points[::LANDMARKS]
        known = np.ascontiguousarray(middles[..., ::LANDMARKS].swapaxes(1, 2))
        column = np.arange(known.shape[2])
        level = (column * GOLDEN % 1.0).astype(np.float32)
        low, high = known[:, :1], known[:, -1:]
        passed = np.count_nonzero(known[:, 1:-1] <= low + (high - low) * level, axis=1)
        further = column * SILVER % 1.0
        place = points[passed] + (points[passed + 1] - points[passed]) * further
        return np.asarray(np.minimum(place, self.mesh.rows - 1), np.intp)


class _Scratch(threading.local):
    """Memory of each thread for cells on their way to the map. Asked for each time it may come in small pages that
    go back each time, which takes as long as filling it."""

    array: Float32 | None = None

    def of(self, *shape: int) -> Float32:
        """At most TOGETHER numbers; those of the call before are gone."""
        if self.array is None:
            self.array = np.empty(TOGETHER, np.float32)
        return self.array[: int(np.prod(shape))].reshape(shape)


_scratch = _Scratch()


def _cut(maps: Indices, most: int) -> list[Indices]:
    """`maps` in even parts of at most so many, or single ones."""
    return np.array_split(maps, -(-len(maps) // max(1, most))) if len(maps) else []


def _joined(parts: list[Tried]) -> Tried:
    if len(parts) == 1:
        return parts[0]
    return Tried(*(np.concatenate([getattr(p, f) for p in parts]) for f in ("maps", "cdf", "mass", "error")))
