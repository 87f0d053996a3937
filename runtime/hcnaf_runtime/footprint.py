"""What a box covers when its centre and heading are known only as weighted cells.

    P(a point is covered) = sum over cells of  mass * share of the cell from which the box covers the point

While its centre moves through the cell, the box's edges move and turn. In the box's own axes (u along, v across)
the share is a product of two ramps: 1 where the box covers the point from all of the cell, 0 where from none,
linear between, as wide as the edge moves at that place. For a certain centre the ramps are steps, and the result
is the box's raster.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from hcnaf_runtime.frames import to_scene
from hcnaf_runtime.grid import Grid

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

BLOCK = 1 << 16
"""Cells of the grid that are looked at together; a few arrays of them fit in a core's cache."""

ALIKE = 1.6
"""Places are looked at together when the cells around them differ in number by no more than this factor."""

SHARPEST = 1e-6
"""Width of the narrowest ramp (m), so that a certain centre divides by no zero."""

_STEP = 1e-3


@dataclass(frozen=True, eq=False)
class Boxes:
    """Boxes whose centres are in cells of some extent."""

    places: Float64
    """[n, 2]: the cells' middles (m), in the grid's frame."""
    headings: Float64
    """[n]: there (rad)."""
    along: Float64
    """[n]: how far the ends move along the box (m) while its centre moves through the cell."""
    across: Float64
    """[n, 3]: the square of how far the sides move across it (m²) at u along the box: a + b u + c u²."""
    mass: Float64
    """[n]: the cells' probabilities."""


def motion_headings(places: npt.NDArray[np.floating[Any]], length: float) -> Float64:
    """Headings [...] (rad) at `places` [..., 2] (m), both in the frame of the agent now, up to half a turn.

    A vehicle that leaves along an arc, tangent to its heading now, points twice as far round as the chord to where
    it is; it is taken to turn by no more than a right angle and then to go straight. A place behind is reached
    backwards. Less than half the box's `length` (m) ahead, where the chord says little, the turn fades to none.
    Uncertainty about the heading is what this makes of the uncertainty about the place.
    """
    x, y = places[..., 0], places[..., 1]
    chord = np.arctan2(y * np.where(x < 0.0, -1.0, 1.0), np.abs(x))
    turn = np.clip(2.0 * chord, -math.pi / 2, math.pi / 2)
    share = np.clip(np.abs(x) / (length / 2), 0.0, 1.0)
    return np.asarray(turn * share * share * (3.0 - 2.0 * share))


def motion_changes(places: Float64, length: float) -> Float64:
    """How `motion_headings` change with x and y: [n, 2] (rad/m)."""
    steps = np.array([[_STEP, 0.0], [0.0, _STEP]])
    change = [motion_headings(places + s, length) - motion_headings(places - s, length) for s in steps]
    half_turns = np.column_stack(change) / math.pi
    return np.asarray((half_turns - np.rint(half_turns)) * math.pi / (2.0 * _STEP))


def swept(
    places: Float64, extents: Float64, turns: Float64, changes: Float64 | float, mass: Float64, pose: Float64
) -> Boxes:
    """Boxes of an agent whose centre is in cells `extents` [n, 2] (m) large about `places` [n, 2] of its frame.

    They are turned by `turns` [n] (rad), which change with x and y by `changes` [n, 2] (rad/m); `pose` is the
    agent's own, x, y (m) and yaw (rad), in the grid's frame.
    """
    c, s = np.cos(turns), np.sin(turns)
    x, y = extents.T
    lever = extents * changes
    a = (x * s) ** 2 + (y * c) ** 2
    b = 2.0 * (y * c * lever[:, 1] - x * s * lever[:, 0])
    across = np.column_stack([a, b, (lever**2).sum(axis=1)])
    return Boxes(to_scene(places, pose), turns + pose[2], np.hypot(x * c, y * s), across, mass)


def raster(x: float, y: float, heading: float, size: npt.NDArray[Any], grid: Grid) -> Float64:
    """1 where the box covers a cell's centre, its edge included, else 0: [height, width], in the grid's frame."""
    box = Boxes(np.array([[x, y]]), np.array([heading]), np.zeros(1), np.zeros((1, 3)), np.ones(1))
    # A centre on the edge has a half, one on a corner a quarter.
    return np.asarray(spread(box, size, grid) > 0.2, np.float64)


def spread(boxes: Boxes, size: npt.NDArray[Any], grid: Grid) -> Float64:
    """The probability [height, width] that the box, `size` its length and width (m), covers each cell's centre."""
    half = np.asarray(size, np.float64) / 2
    reach = _reach(boxes, half)
    corner = (boxes.places - grid.corners[0]) / grid.resolution - 0.5  # in cells, from the first cell's centre
    first = np.ceil(corner - reach / grid.resolution).astype(np.int64)
    span = np.floor(2.0 * reach / grid.resolution).astype(np.int64) + 1
    near = ((first + span > 0) & (first < [grid.width, grid.height])).all(axis=1) & (boxes.mass > 0.0)
    margin = span[near].max(axis=0, initial=0)
    padded = np.zeros((grid.height + 2 * margin[1], grid.width + 2 * margin[0]))
    index = (first[:, 1] + margin[1]) * padded.shape[1] + first[:, 0] + margin[0]
    offset = (first - corner) * grid.resolution
    for some in _blocks(np.flatnonzero(near), span):
        shares = _shares(boxes, some, offset[some], half, span[some].max(axis=0), grid.resolution)
        shares *= boxes.mass[some, None, None].astype(np.float32)
        _add(padded, index[some], shares)
    return padded[margin[1] : margin[1] + grid.height, margin[0] : margin[0] + grid.width]


def _reach(boxes: Boxes, half: Float64) -> Float64:
    """Half the size [n, 2] of the upright rectangle around all that each box may cover."""
    c, s = np.abs(np.cos(boxes.headings)), np.abs(np.sin(boxes.headings))
    u = half[0] + boxes.along / 2
    v = half[1] + np.sqrt(boxes.across[:, 0] + np.abs(boxes.across[:, 1]) * u + boxes.across[:, 2] * u**2) / 2
    return np.column_stack([c * u + s * v, s * u + c * v])


def _blocks(places: npt.NDArray[np.intp], span: Integers) -> Iterator[npt.NDArray[np.intp]]:
    """`places` in blocks of few cells, and of cells around them [n, 2] that do not differ much in number."""
    around = span[places].prod(axis=1)
    order = np.argsort(around)
    start = 0
    while start < len(order):
        most = ALIKE * int(around[order[start]])
        alike = int(np.searchsorted(around[order], most, side="right"))
        stop = min(alike, start + max(1, int(BLOCK / most)))
        yield places[order[start:stop]]
        start = stop


def _shares(
    boxes: Boxes, some: npt.NDArray[np.intp], offset: Float64, half: Float64, span: Integers, r: float
) -> Float32:
    """[n, rows, columns]: of `some` boxes, the share of the cell from which each covers the points around it.

    `offset` [n, 2] (m) leads from the cell's middle to the first of these points, r apart.
    """
    x, y = (offset[:, k, None] + np.arange(span[k]) * r for k in (0, 1))
    c, s = np.cos(boxes.headings[some])[:, None], np.sin(boxes.headings[some])[:, None]
    u, v = _outer(x * c, y * s), _outer(-x * s, y * c)
    a, b, k = (boxes.across[some, j, None, None].astype(np.float32) for j in range(3))
    width = k * u
    width += b
    width *= u
    width += a
    np.sqrt(np.maximum(width, np.float32(SHARPEST**2), out=width), out=width)
    shares = _ramp(v, half[1], width)
    along = np.maximum(boxes.along[some], SHARPEST).astype(np.float32)[:, None, None]
    shares *= _ramp(u, half[0], along)
    return shares


def _outer(column: Float64, row: Float64) -> Float32:
    return np.add(column.astype(np.float32)[:, None, :], row.astype(np.float32)[:, :, None])


def _ramp(place: Float32, half: float, width: Float32) -> Float32:
    """1 within `half` of 0 and 0 beyond, over `width` about it. Overwrites `place`."""
    np.abs(place, out=place)
    np.subtract(np.float32(half), place, out=place)
    place /= width
    place += np.float32(0.5)
    return np.clip(place, np.float32(0.0), np.float32(1.0), out=place)


def _add(padded: Float64, index: Integers, shares: Float32) -> None:
    """Add blocks of `shares` whose first cells are at the flat positions `index` [n]."""
    rows, columns = shares.shape[1:]
    within = np.arange(rows)[:, None] * padded.shape[1] + np.arange(columns)
    lowest = index.min()
    where = (index - lowest)[:, None, None] + within
    found = np.bincount(where.ravel(), weights=shares.ravel())
    padded.ravel()[lowest : lowest + len(found)] += found
