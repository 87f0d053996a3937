"""The local maxima of an occupancy map, each with the mass of its basin, by watershed.

every cell --> its steepest neighbour --> ... --> a peak        (pointers, doubled until all point at peaks)
basins --> joined where the saddle between them is hardly lower than the lower peak (numerical ripples, plateaus)
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hcnaf_runtime.errors import InputError

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]

PROMINENCE = 0.1
"""A peak must rise above the saddle to a higher one by this share of its height, or it is part of that one."""

_NEIGHBOURS = tuple((dr, dc) for dr in (-1, 0, 1) for dc in (-1, 0, 1) if (dr, dc) != (0, 0))


@dataclass(frozen=True, eq=False)
class Modes:
    """The modes of one map, the heaviest basin first."""

    places: Float64
    """[k, 2]: x, y of the centres of the peak cells (m), in the map's frame."""
    peak: Float64
    """[k]: the probability of the peak cell."""
    mass: Float64
    """[k]: the probability of the basin; all basins of a map together hold what the map holds."""


def modes(
    mass: Float32, origin: Float64, resolution: float, k: int | None = None, prominence: float = PROMINENCE
) -> Modes:
    """The `k` modes (None: all) of the map `mass` [rows, cols], whose lower-left corner is `origin` [2] (m).

    Each cell belongs to the peak that steepest ascent over its eight neighbours leads to. `prominence` is between
    0 (every local maximum, a plateau being one) and 1 (one mode for each region that touches no other). Raises
    InputError for a `k` or `prominence` out of range.
    """
    if k is not None and k < 1:
        raise InputError(f"k is {k}, expected at least 1, or None for all modes")
    if not 0.0 <= prominence <= 1.0:
        raise InputError(f"prominence is {prominence}, expected a share of a peak's height from 0 to 1")
    labels, peaks = watershed(mass, prominence)
    if not len(peaks):
        return Modes(np.empty((0, 2)), np.empty(0), np.empty(0))
    held = mass.ravel()[labels >= 0].astype(np.float64)
    basin = np.bincount(labels[labels >= 0], weights=held, minlength=len(peaks)).astype(np.float64)
    order = np.argsort(-basin, kind="stable")[:k]
    row, column = np.unravel_index(peaks[order], mass.shape)
    places = origin + (np.column_stack([column, row]) + 0.5) * resolution
    return Modes(places, mass.ravel()[peaks[order]].astype(np.float64), basin[order])


def watershed(mass: Float32, prominence: float = PROMINENCE) -> tuple[Indices, Indices]:
    """The basin [rows * cols] of each cell (-1 where there is no mass), and each basin's peak as a flat index."""
    cells = np.flatnonzero(mass.ravel() > 0)
    if not len(cells):
        return np.full(mass.size, -1), np.empty(0, np.intp)
    height = np.append(mass.ravel()[cells].astype(np.float64), 0.0)  # the last: whatever is not there
    near = _near(cells, mass.shape)
    goal = _rest(_steepest(height, near))
    peaks, basin = np.unique(goal, return_inverse=True)
    joined = _joined(*_saddles(height, near, basin), height[peaks], prominence)
    roots, basin = np.unique(joined[basin], return_inverse=True)
    labels = np.full(mass.size, -1)
    labels[cells] = basin
    return labels, cells[peaks[roots]]


def _near(cells: Indices, shape: tuple[int, ...]) -> Indices:
    """[8, n]: the position in `cells` [n] of each one's neighbours; n where there is none."""
    rows, columns = shape
    place = np.full((rows + 2, columns + 2), len(cells))
    row, column = cells // columns + 1, cells % columns + 1
    place[row, column] = np.arange(len(cells))
    return np.stack([place[row + dr, column + dc] for dr, dc in _NEIGHBOURS])


def _steepest(height: Float64, near: Indices) -> Indices:
    """[n]: where each cell leads: up the steepest slope, to the later of equal neighbours, or to itself."""
    n = near.shape[1]
    distance = np.array([np.hypot(*step) for step in _NEIGHBOURS])[:, None]
    slope = (height[near] - height[:n]) / distance
    slope[(slope == 0.0) & (near < np.arange(n))] = -np.inf  # along a plateau one way only: no cycles
    best = slope.argmax(axis=0)
    own = np.arange(n)
    up = (slope[best, own] >= 0.0) & (near[best, own] < n)
    return np.where(up, near[best, own], own)


def _rest(pointer: Indices) -> Indices:
    """Where each pointer ends, by doubling."""
    while True:
        further = pointer[pointer]
        if np.array_equal(further, pointer):
            return pointer
        pointer = further


def _saddles(height: Float64, near: Indices, basin: Indices) -> tuple[Indices, Float64]:
    """Pairs [m, 2] of basins that touch, and the height [m] of the pass between them, from the highest down."""
    n = near.shape[1]
    side, own = np.nonzero(near[:4] < n)  # half of the neighbours: every pair once
    other = near[side, own]
    apart = basin[own] != basin[other]
    own, other = own[apart], other[apart]
    pairs = np.sort(np.column_stack([basin[own], basin[other]]), axis=1)
    heights = np.minimum(height[own], height[other])
    order = np.argsort(-heights, kind="stable")
    _, first = np.unique(pairs[order], axis=0, return_index=True)
    kept = order[np.sort(first)]
    return pairs[kept], heights[kept]


def _joined(pairs: Indices, saddles: Float64, peaks: Float64, prominence: float) -> Indices:
    """The basin that each basin [p] of `peaks` [p] becomes part of: a higher one beyond a saddle high enough.

    Basins are few, and each joining depends on those before.
    """
    parent = list(range(len(peaks)))

    def root(i: int) -> int:
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = parent[i]
        return i

    for (i, j), saddle in zip(pairs.tolist(), saddles.tolist(), strict=True):
        low, high = sorted((root(i), root(j)), key=lambda k: (peaks[k], k))
        if low != high and saddle >= (1.0 - prominence) * peaks[low]:
            parent[low] = high
    return np.array([root(i) for i in range(len(parent))])


def region(mass: Float32, level: float) -> tuple[npt.NDArray[np.bool_], float]:
    """The highest-density region of probability `level`: its cells [rows, cols] and the mass of the least of them.

    The smallest set of cells that holds `level` of the whole probability; cells of equal mass enter together. What
    the map misses counts as outside: where it holds less than `level`, the region is all of it, and the threshold
    0. Raises InputError for a level that is not between 0 and 1.
    """
    if not 0.0 < level < 1.0:
        raise InputError(f"level is {level}, expected a probability between 0 and 1")
    order = np.sort(mass.ravel())[::-1]
    total = np.cumsum(order, dtype=np.float64)
    count = int(np.searchsorted(total, level))
    if count == len(order):
        return np.ones(mass.shape, np.bool_), 0.0
    return mass >= order[count], float(order[count])
