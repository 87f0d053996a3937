"""Cutting the columns of many maps into tiles, and tiles into batches that a graph runs at once.

A tile is a few columns of one map. Tiles of all maps are pooled, so that a batch is full whether it comes from
one wide map or from twenty narrow ones. Inside a batch everything is padded to the widest; what is padded
weighs nothing.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Indices = npt.NDArray[np.intp]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Tiles:
    """J tiles: the map each belongs to [J], and its columns [J, w], of which the first `count` [J] are its own
    and the rest repeat the last."""

    maps: Indices
    columns: Indices
    count: Indices

    def __len__(self) -> int:
        return len(self.maps)

    def some(self, index: Indices) -> "Tiles":
        """The tiles `index`, no wider than they need be."""
        width = int(self.count[index].max())
        return Tiles(self.maps[index], self.columns[index, :width], self.count[index])

    @property
    def own(self) -> Mask:
        """[J, w]: which columns are a tile's own."""
        return np.arange(self.columns.shape[1]) < self.count[:, None]


def cut(wanted: Mask, width: int, *, gap: int = 0) -> Tiles:
    """Tiles of at most `width` columns that hold all columns wanted [B, C].

    With a `gap` tiles are runs of neighbours, and runs up to `gap` columns apart are joined; without, tiles
    just list the columns wanted.
    """
    if gap:
        wanted = wanted.copy()
        maps, columns = np.nonzero(wanted)
        near = np.flatnonzero((np.diff(maps) == 0) & (np.diff(columns) > 1) & (np.diff(columns) <= gap + 1))
        for i in near:
            wanted[maps[i], columns[i] : columns[i + 1]] = True
    maps, columns = np.nonzero(wanted)
    if len(maps) == 0:
        return Tiles(np.zeros(0, np.intp), np.zeros((0, 1), np.intp), np.zeros(0, np.intp))
    fresh = np.diff(maps, prepend=-1) != 0
    if gap:
        fresh |= np.diff(columns, prepend=-2) != 1
    starts = np.flatnonzero(fresh)
    lengths = np.diff(starts, append=len(maps))
    pieces = -(-lengths // width)
    # A run in n pieces is cut evenly: of 65 columns in tiles of 64, two of 33.
    even = -(-lengths // pieces)
    rank = np.arange(pieces.sum()) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    first = np.repeat(starts, pieces) + rank * np.repeat(even, pieces)
    count = np.minimum(np.repeat(even, pieces), np.repeat(starts + lengths, pieces) - first)
    index = first[:, None] + np.minimum(np.arange(count.max()), count[:, None] - 1)
    return Tiles(maps[first], columns[index], count)


def batches(sizes: Indices, others: Indices, budget: int) -> Iterator[Indices]:
    """Groups of items, alike in `sizes` and `others`, with number * max size * max other within `budget`."""
    order = np.lexsort((others, sizes))
    start = 0
    while start < len(order):
        wide, tall, stop = int(sizes[order[start]]), int(others[order[start]]), start + 1
        while stop < len(order):
            wider, taller = max(wide, int(sizes[order[stop]])), max(tall, int(others[order[stop]]))
            if wider * taller * (stop + 1 - start) > budget:
                break
            wide, tall, stop = wider, taller, stop + 1
        yield order[start:stop]
        start = stop
