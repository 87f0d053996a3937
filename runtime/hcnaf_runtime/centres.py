"""A forecast as weighted cells: where an agent's centre may be, cut as finely as its density is narrow.

A map has cells of one size. Whoever asks what a box covers needs them small where the mass is: centimetres for a
car that certainly stays, half a metre for one that may be anywhere in 40 m. So the range in x that holds the mass
is found by zooming into F_1 and cut into strips, the range in y of each strip by zooming into F_2 at its middle
and cut into cells. Cuts are spaced evenly in the mean of place and mass. A cell's mass is the strip's increment of
F_1 times the cell's increment of F_2: what cells hold together is exact, and in each the density is taken to be
even. Where there is little, neighbours are merged.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hcnaf_runtime.plane import Distribution

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]

WIDEST = 1.0
"""Cuts are on average no further apart than this (m),"""

ACROSS = 32
"""nor than the range that holds the mass, over this."""

PITCHES, LIGHT = (2.0, 4.0), 1e-3
"""Where a square so wide (m) holds less than this, its cells become one: a long tail has many of them."""

COUNTS = np.array([n for k in range(2, 10) for n in (2**k, 3 * 2 ** (k - 1))])
"""Numbers of strips or cells; few different ones, so that many maps are computed together."""

EDGES = 17
"""Places at which a distribution function is looked at in each zoom."""

ZOOMS = 8
"""Most zooms; each makes the range up to eight times narrower."""

RESOLVED = 2e-7
"""What float32 tells apart near 1."""

CHUNK = 1 << 20
"""Numbers in the widest intermediate of a graph run, cells x hidden units: 4 MiB."""


@dataclass(frozen=True, eq=False)
class Centres:
    """The cells of one map that hold anything, in the agent's frame."""

    places: Float64
    """[n, 2]: x, y of the cells' middles (m)."""
    extents: Float64
    """[n, 2]: the cells' lengths along x and y (m)."""
    mass: Float64
    """[n]: their probabilities."""


@dataclass(frozen=True, eq=False)
class _Range:
    """`low` to `high` [...] (m), and the distribution function [..., EDGES] at `edges` in and about it."""

    low: Float64
    high: Float64
    edges: Float64
    cdf: Float64

    def some(self, which: Indices) -> "_Range":
        """Those at positions `which` of the first axis."""
        return _Range(self.low[which], self.high[which], self.edges[which], self.cdf[which])

    def cuts(self, n: int) -> Float64:
        """[..., n + 1]: from `low` to `high`, evenly spaced in the mean of place and mass."""
        low, high = self.low[..., None], self.high[..., None]
        x = np.clip(self.edges, low, high)
        F = np.maximum.accumulate(self.cdf - self.cdf[..., :1], axis=-1)
        F /= np.maximum(F[..., -1:], RESOLVED)
        G = (F + (x - low) / np.maximum(high - low, 1e-12)) / 2.0
        wanted = np.linspace(0.0, G[..., -1], n + 1, axis=-1)
        before = np.clip(np.count_nonzero(G[..., None, :] <= wanted[..., None], axis=-1) - 1, 0, EDGES - 2)
        x0, x1, G0, G1 = (np.take_along_axis(v, k, axis=-1) for v in (x, G) for k in (before, before + 1))
        return np.asarray(x0 + (x1 - x0) * np.clip((wanted - G0) / np.maximum(G1 - G0, 1e-12), 0.0, 1.0))


@dataclass(frozen=True, eq=False)
class _Strips:
    """Strips of G maps, n in each: their edges in x [G, n + 1], share of the mass and range in y [G, n]."""

    maps: Indices
    edges: Float64
    share: Float64
    y: _Range

    @property
    def middle(self) -> Float64:
        """[G, n] (m)."""
        return (self.edges[:, 1:] + self.edges[:, :-1]) / 2


def centres(
    flow: Distribution, theta: Float32, low: Float64, high: Float64, finest: float, lost_mass: float
) -> list[Centres]:
    """The weighted cells of each of the B maps of theta [B, P] in its window, `low` to `high` [B, 2] (m).

    No cell is cut finer than `finest` (m). Of the mass inside the window at most `lost_mass` per map is left out.
    """
    lost = max(lost_mass / 8.0, RESOLVED)  # at each end in x, and in y; a half goes with the lightest cells
    x = _range(lambda x: flow.marginal_cdf(theta, x), low[:, 0], high[:, 0], lost)
    counts = _counts(x.high - x.low, finest)
    result = [Centres(np.empty((0, 2)), np.empty((0, 2)), np.empty(0))] * len(theta)
    for n in np.unique(counts):
        for maps in _runs(np.flatnonzero(counts == n), flow.hidden * int(n) * EDGES):
            window = low[maps, 1], high[maps, 1]
            strips = _strips(flow, theta, maps, x.some(maps).cuts(int(n)), window, lost)
            for b, found in _cells(flow, theta, strips, finest):
                for pitch in PITCHES:
                    found = _merged(found, pitch)
                result[b] = _without_lightest(found, lost_mass / 2.0)
    return result


def _strips(
    flow: Distribution,
    theta: Float32,
    maps: Indices,
    edges: Float64,
    window: tuple[Float64, Float64],
    lost: float,
) -> _Strips:
    cdf = flow.marginal_cdf(theta[maps], edges.astype(np.float32)).astype(np.float64)
    share = np.maximum(np.diff(cdf, axis=1), 0.0)
    middle = ((edges[:, 1:] + edges[:, :-1]) / 2).astype(np.float32)
    low, high = (np.repeat(end[:, None], middle.shape[1], axis=1) for end in window)
    return _Strips(
        maps, edges, share, _range(lambda y: flow.conditional_cdf(theta[maps], middle, y), low, high, lost)
    )


def _cells(flow: Distribution, theta: Float32, strips: _Strips, finest: float) -> Iterator[tuple[int, Centres]]:
    """Each map's strips cut into cells."""
    heavy = strips.share > RESOLVED
    counts = _counts(np.where(heavy, strips.y.high - strips.y.low, 0.0).max(axis=1), finest)
    for m in np.unique(counts):
        for some in _runs(np.flatnonzero(counts == m), flow.hidden * strips.share.shape[1] * (int(m) + 1)):
            edges = strips.y.some(some).cuts(int(m))
            x = strips.middle[some]
            F = flow.conditional_cdf(theta[strips.maps[some]], x.astype(np.float32), edges.astype(np.float32))
            mass = strips.share[some, :, None] * np.maximum(np.diff(F.astype(np.float64), axis=-1), 0.0)
            width, height = np.diff(strips.edges[some]), np.diff(edges)
            y = (edges[..., 1:] + edges[..., :-1]) / 2
            for j, g in enumerate(some):
                s, e = np.nonzero(mass[j])
                places = np.column_stack([x[j, s], y[j, s, e]])
                extents = np.column_stack([width[j, s], height[j, s, e]])
                yield int(strips.maps[g]), Centres(places, extents, mass[j, s, e])


def _range(cdf: Callable[[Float32], Float32], low: Float64, high: Float64, lost: float) -> _Range:
    """The part of `low` to `high` [...] beyond which the distribution function changes by `lost` at either end."""
    edges, F = _looked(cdf, low, high)
    start, stop = F[..., :1] + lost, F[..., -1:] - lost
    zooming = np.ones(low.shape, np.bool_)  # each stops by itself: what is found does not depend on its neighbours
    for _ in range(ZOOMS):
        first = np.clip(np.count_nonzero(start >= F, axis=-1) - 1, 0, EDGES - 2)
        last = np.maximum(EDGES - np.maximum(np.count_nonzero(stop <= F, axis=-1), 1), first + 1)
        ends = [np.take_along_axis(edges, k[..., None], axis=-1)[..., 0] for k in (first, last)]
        shrunk = zooming & (ends[1] - ends[0] <= (high - low) / 2)
        low, high = (np.where(zooming, new, old) for new, old in zip(ends, (low, high), strict=True))
        zooming = shrunk
        if not zooming.any():
            break
        looked = _looked(cdf, low, high)
        edges, F = (np.where(zooming[..., None], new, old) for new, old in zip(looked, (edges, F), strict=True))
    return _Range(low, high, edges, F)


def _looked(cdf: Callable[[Float32], Float32], low: Float64, high: Float64) -> tuple[Float64, Float64]:
    """EDGES places from `low` to `high` [...], and the distribution function there: [..., EDGES] each."""
    edges = (low[..., None] + (high - low)[..., None] * np.linspace(0.0, 1.0, EDGES)).astype(np.float32)
    return edges.astype(np.float64), cdf(edges).astype(np.float64)


def _counts(width: Float64, finest: float) -> Indices:
    """Into how many parts [...] to cut `width` [...] (m)."""
    parts = np.minimum(np.maximum(width / WIDEST, ACROSS), width / finest)
    return np.asarray(COUNTS[np.minimum(np.searchsorted(COUNTS, parts - 1e-6), len(COUNTS) - 1)])


def _runs(maps: Indices, numbers: int) -> Iterator[Indices]:
    """`maps` in runs of at most CHUNK numbers, if each takes `numbers`."""
    step = max(1, CHUNK // numbers)
    return (maps[k : k + step] for k in range(0, len(maps), step))


def _merged(found: Centres, pitch: float) -> Centres:
    """The cells of each light square of a lattice as one, with their mass, mean and variances."""
    if not len(found.mass):
        return found
    corner = np.floor(found.places / pitch).astype(np.int64)
    corner -= corner.min(axis=0)
    square = corner[:, 0] * (corner[:, 1].max() + 1) + corner[:, 1]
    held = np.bincount(square, weights=found.mass)
    light = held[square] < LIGHT
    square, mass, places = square[light], found.mass[light], found.places[light]
    total = np.bincount(square, weights=mass)
    some = np.flatnonzero(total)

    def mean(values: Float64) -> Float64:
        sums = [np.bincount(square, weights=mass * column)[some] for column in values.T]
        return np.column_stack(sums) / total[some, None]

    middle = mean(places)
    variance = mean((places - middle[np.searchsorted(some, square)]) ** 2 + found.extents[light] ** 2 / 12.0)
    return Centres(
        np.concatenate([found.places[~light], middle]),
        np.concatenate([found.extents[~light], np.sqrt(12.0 * variance)]),
        np.concatenate([found.mass[~light], total[some]]),
    )


def _without_lightest(found: Centres, budget: float) -> Centres:
    """All but the lightest cells, which together hold at most `budget`."""
    order = np.argsort(found.mass)
    kept = order[np.searchsorted(np.cumsum(found.mass[order]), budget, side="right") :]
    return Centres(found.places[kept], found.extents[kept], found.mass[kept])
