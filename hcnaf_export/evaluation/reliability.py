"""Reliability of cell probabilities: of the cells that were given 10 %, do 10 % hold the label?

A cell is a square of CELL = 2 m, about a car's width, of the window GRID in the agent's frame, 120 m by 100 m. Its
predicted probability p is the exact mass of the cell; it is hit if it holds the label. Bins over p have the gap

    gap_b = (sum of p - hits) / cells       over the cells of all windows with p in bin b
    ECE   = sum_b (cells_b / cells) |gap_b| over 15 bins of equal width from 0 to 1

Nearly all cells of a window are as good as empty, and agree with their forecast: over all of them the ECE is next
to nothing for any forecast (`ece_all`, the textbook's form). So

    ece      is over the cells with p of at least LEAST = 1 %, the ones a forecast has anything to say about
    ece_top  is over the likeliest cell of each window: the calibration of confidence (Guo et al.)

With few windows gaps scatter, and |gap| does not average out: `ece_noise` and `ece_top_noise` are about what a
calibrated forecast would score, sum_b (cells_b / cells) sqrt(2 / pi) times the standard error of gap_b over
clusters. A histogram with 15 bins of equal width is nearly all in the first one, so the diagram is drawn over 15
bins of equal width in log p, from 1e-4 to 1 (`log_bins`).

References:
    Naeini et al., Obtaining well calibrated probabilities using Bayesian binning, AAAI 2015 (ECE).
    Guo et al., On calibration of modern neural networks, ICML 2017. Zadrozny & Elkan, ICML 2001 (diagrams).
"""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from hcnaf_export.evaluation.spread import sum_error
from hcnaf_runtime.grid import Grid

Float = NDArray[np.float64]
Int = NDArray[np.int64]

CELL = 2.0
"""Side of a cell (m)."""

GRID = Grid(60, 50, CELL, (-20.0, -50.0))
"""The window: x from -20 to 100 m, y from -50 to 50 m of the agent."""

BINS = 15

LEAST = 0.01
"""Cells below are left out of `ece`."""

FAINTEST = 1e-4
"""Where the bins of the diagram begin."""


class Bin(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Cells with a probability from low to high: how many, their mean probability, the share of them that is hit,
    and the standard error of the difference of the two, over clusters."""

    low: float
    high: float
    cells: int
    predicted: float
    observed: float
    error: float


class ReliabilityScore(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One horizon (s).

    Attributes:
        ece: over cells of at least LEAST. ece_noise: what sampling alone would make of it.
        ece_top: over the likeliest cells. ece_top_noise: likewise.
        ece_all: over all cells of the window.
        outside: share of labels outside of the window.
        bins: of equal width over the cells of at least LEAST. log_bins: of equal width in log p. Empty ones are
            left out.
    """

    horizon: float
    ece: float
    ece_noise: float
    ece_top: float
    ece_top_noise: float
    ece_all: float
    outside: float
    bins: tuple[Bin, ...]
    log_bins: tuple[Bin, ...]


class ReliabilityScores(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Cells of `cell` m in the window x_0, y_0, x_1, y_1, on `windows` snippets in `clusters`."""

    windows: int
    clusters: int
    cell: float
    window: tuple[float, float, float, float]
    rows: tuple[ReliabilityScore, ...]


class Tally(NamedTuple):
    """Cells, their summed probability and their hits [W, Q, bins] for each window."""

    cells: Float
    predicted: Float
    hits: Float


class Tallies(NamedTuple):
    """Equal bins over cells of at least LEAST; one bin of the fainter ones; equal bins over the likeliest cells;
    log bins; and labels outside of the window, as the cells of a single bin."""

    equal: Tally
    faint: Tally
    top: Tally
    log: Tally
    outside: Tally


def tally(mass: NDArray[np.floating], where: Int) -> Tallies:
    """What `summarise_reliability` needs of cell masses [W, Q, rows, columns] and labels' cells [W, Q]."""
    p = mass.reshape(*where.shape, -1).astype(np.float64)
    hit = np.arange(p.shape[-1]) == where[..., None]
    best = p.argmax(axis=-1)[..., None]
    top, top_hit = np.take_along_axis(p, best, -1), np.take_along_axis(hit, best, -1)
    strong = p >= LEAST
    return Tallies(
        _counted(_equal(p), strong, p, hit),
        _counted(np.zeros(p.shape, np.int64), ~strong, p, hit, bins=1),
        _counted(_equal(top), np.ones(top.shape, bool), top, top_hit),
        _counted(_logarithmic(p), p >= FAINTEST, p, hit),
        Tally((where < 0)[..., None].astype(np.float64), *np.zeros((2, *where.shape, 1))),
    )


def joined(some: list[Tallies]) -> Tallies:
    """Windows of several parts, one after the other."""
    return Tallies(
        *(Tally(*(np.concatenate(v) for v in zip(*kind, strict=True))) for kind in zip(*some, strict=True))
    )


def summarise_reliability(
    horizons: tuple[float, ...], found: Tallies, cluster: Int, grid: Grid = GRID
) -> ReliabilityScores:
    """Scores of `tally` and each window's cluster [W]."""
    rows = [_row(t, Tallies(*(_at(kind, q) for kind in found)), cluster) for q, t in enumerate(horizons)]
    low, high = grid.corners[0], grid.corners[2]
    window = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
    return ReliabilityScores(len(cluster), len(np.unique(cluster)), grid.resolution, window, tuple(rows))


def _row(horizon: float, found: Tallies, cluster: Int) -> ReliabilityScore:
    """Scores of one horizon: tallies [W, bins]."""
    width, decades = np.linspace(0.0, 1.0, BINS + 1), np.geomspace(FAINTEST, 1.0, BINS + 1)
    bins = _bins(found.equal, width, cluster)
    top = _bins(found.top, width, cluster)
    # All cells: the faint ones fall in the first bin, where their gaps add up with those of the others.
    whole = Tally(*(np.concatenate([e[:, :1] + f, e[:, 1:]], axis=1) for e, f in zip(*found[:2], strict=True)))
    return ReliabilityScore(
        horizon,
        *_ece(bins),
        *_ece(top),
        _ece(_bins(whole, width, cluster))[0],
        float(found.outside.cells.mean()),
        tuple(bins),
        tuple(_bins(found.log, decades, cluster)),
    )


def _ece(bins: list[Bin]) -> tuple[float, float]:
    """The ECE, and what a calibrated forecast would score on average."""
    total = sum(b.cells for b in bins)
    gaps = sum(b.cells * abs(b.predicted - b.observed) for b in bins)
    noise = sum(b.cells * b.error for b in bins) * np.sqrt(2.0 / np.pi)
    return (gaps / total, float(noise / total)) if total else (float("nan"), float("nan"))


def _bins(found: Tally, edges: Float, cluster: Int) -> list[Bin]:
    """The bins that hold any cells, from a tally [W, bins]."""
    cells, predicted, hits = (v.sum(axis=0) for v in found)
    error = sum_error(found.predicted - found.hits, cluster)
    return [
        Bin(
            float(edges[b]),
            float(edges[b + 1]),
            int(cells[b]),
            float(predicted[b] / cells[b]),
            float(hits[b] / cells[b]),
            float(error[b] / cells[b]),
        )
        for b in np.flatnonzero(cells)
    ]


def _counted(index: Int, chosen: NDArray[np.bool_], p: Float, hit: NDArray[np.bool_], bins: int = BINS) -> Tally:
    """Tally [W, Q, bins] of the `chosen` cells [W, Q, cells], each in the bin `index`."""
    W, Q = p.shape[:2]
    rows = np.arange(W * Q).reshape(W, Q, 1) * bins
    flat = (rows + index)[chosen]
    shape, size = (W, Q, bins), W * Q * bins
    weights = (np.ones(len(flat)), p[chosen], hit[chosen].astype(np.float64))
    return Tally(*(np.bincount(flat, w, size).astype(np.float64).reshape(shape) for w in weights))


def _equal(p: Float) -> Int:
    return np.clip((p * BINS).astype(np.int64), 0, BINS - 1)


def _logarithmic(p: Float) -> Int:
    decade = 1.0 - np.log(np.maximum(p, FAINTEST)) / np.log(FAINTEST)
    return np.asarray(np.clip((decade * BINS).astype(np.int64), 0, BINS - 1))


def _at(found: Tally, q: int) -> Tally:
    return Tally(*(v[:, q] for v in found))
