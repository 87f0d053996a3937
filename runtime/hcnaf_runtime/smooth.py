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

MESHES = (24, 32), (32, 44), (48, 48)
"""Nodes of a panel of columns and order of a panel of rows, tried in turn."""

PROMISING = 5e-5
"""Tried where F_1 at the columns' edges is as smooth as the polynomials of the first mesh to within this."""

AROUND, ALONE = 3, 2.0
"""Tried where no column holds more or less than a polynomial through so many others on either side says, by more
than so many times what a cell may be wrong by: a spike that nodes do not see would."""

HOLDS, WIDE = 1e-6, 0.5
"""Tried where more than this share of the columns hold so much: narrower maps cost less tile by tile."""

FAR = 10.0
"""A map that misses what is allowed by more than so many times is not tried again."""

SEEN = 1.5
"""The worst cell is taken to be wrong by so many times as much as the worst of those that are checked."""

GOLDEN = 0.6180339887498949
"""In the next column the cell that is checked is by so much of the column's rise further up, modulo 1."""

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
        left = _promising(around, goal, meshes[0])
        for each in meshes:
            if left.any():
                yield from Smooth(canvas, each, around, goal).fill(left)


def _promising(around: Float64, goal: Float64, coarse: Mesh) -> Mask:
    """[B]: which maps to try, by F_1."""
    cdf = around[:, AROUND:-AROUND]
    found = (np.diff(cdf, axis=1) > HOLDS).mean(axis=1) > WIDE
    if found.any():
        alone = np.abs(np.diff(around, 2 * AROUND + 1, axis=1)) / math.comb(2 * AROUND, AROUND)
        found &= (alone < ALONE * goal).all(axis=1) & (coarse.misfit(cdf) < PROMISING)
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
        each = max(self.mesh.rows, self.mesh.rule.size) * self.mesh.columns
        for group in _cut(np.flatnonzero(left), self.canvas.chunk // each):
            fine = []
            for some in _cut(group, self.canvas.chunk // self._size):
                tried = self._evaluated(some)
                missed = tried.error / self.goal[some].min(axis=1)
                left[some] = missed <= FAR
                fine.append(tried[missed <= 1.0])
                if not len(fine[0].maps):
                    return
            filled = self._checked(_joined(fine))
            left[filled.maps] = False
            yield filled

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
        return Tried(maps, cdf, mass, SEEN * fall(*between.tails(mass), 1))

    def _checked(self, tried: Tried) -> Filled:
        """Fill the maps that pass the checks."""
        error = np.maximum(tried.error[:, None], SEEN * self._missed(tried.maps, tried.cdf))
        good = (error <= self.goal[tried.maps]).all(axis=1)
        maps, mass, error = tried.maps[good], tried.mass[good], error[good]
        inside = column_sums(mass)
        below = self._put(self.canvas.maps[maps], mass, inside)
        return Filled(maps, np.maximum(error, below[:, None]), inside)

    def _put(self, places: Indices, mass: Float32, inside: Float32) -> Float32:
        """Put all cells, from what columns hold between points [n, E - 1, C] and in all [n, C], in `places` [n] of
        the canvas. How far below 0 they were [n]."""
        below, into, between = np.empty(len(places), np.float32), self.canvas.mass, self.mesh.between
        R, C = self.mesh.rows, self.mesh.columns
        if R * C > TOGETHER:
            for i, place in enumerate(places):
                below[i] = settle(between.increments(mass[i], into[place]), inside[i])
            return below
        for some in _cut(np.arange(len(places)), TOGETHER // (R * C)):
            cells = between.increments(mass[some], _scratch.of(len(some), R, C))
            below[some] = settle(cells, inside[some])
            into[places[some]] = cells
        return below

    def _missed(self, maps: Indices, cdf: Float32) -> Float64:
        """[n, C]: how far the cell that is checked in each column is off, from F_2 on the mesh."""
        low, high = self.mesh.at_candidates(cdf)
        which = _rising(low)
        known = np.take_along_axis(high - low, which[:, None], axis=1)[:, 0]
        x, y = self.canvas.window.x, self.canvas.window.y
        middle = np.broadcast_to((x[1:] + x[:-1]) / 2.0, which.shape)
        edges = y[self.mesh.candidates[which][..., None] + [0, 1]]
        found = self.canvas.flow.conditional_cdf(self.canvas.theta[maps], middle, edges)
        off = np.abs(np.diff(found, axis=2)[..., 0] - known)
        return np.asarray(off * np.diff(self.around[maps, AROUND:-AROUND], axis=1))


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


def _rising(known: Float32) -> Indices:
    """[n, C]: among the K values of F_2 `known` in each column [n, K, C], the last before some share of its rise,
    a different one in each column."""
    level = (np.arange(known.shape[2]) * GOLDEN % 1.0).astype(np.float32)
    low, high = known[:, :1], known[:, -1:]
    passed = np.count_nonzero(known <= low + (high - low) * level, axis=1)
    return np.asarray(np.maximum(passed - 1, 0), np.intp)
