"""Cutting the columns of many maps into tiles, and tiles into batches that a graph runs at once.

A tile is a few columns of one map. Tiles of all maps are pooled, so that a batch is full whether it comes from
one wide map or from twenty narrow ones. Inside a batch everything is padded to the widest; what is padded
weighs nothing.
"""

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
    rank = np.arange(pieces.sum()) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    first = np.repeat(starts, pieces) + rank * width
    count = np.minimum(width, np.repeat(starts + lengths, pieces) - first)
    index = first[:, None] + np.minimum(np.arange(count.max()), count[:, None] - 1)
    return Tiles(maps[first], columns[index], count)


def batches(sizes: Indices, budget: int, waste: int | None = None) -> list[Indices]:
    """Groups of items, alike in `sizes` [n]: number * largest size is within `budget`, and what the others lack of
    the largest adds up to at most `waste`, if that is given."""
    order = np.argsort(sizes, kind="stable")
    groups, start, total = [], 0, 0
    for stop, size in enumerate(sizes[order].tolist()):
        padded = size * (stop + 1 - start)
        if stop > start and (padded > budget or (waste is not None and padded - total - size > waste)):
            groups.append(order[start:stop])
            start, total = stop, 0
        total += size
    return [*groups, order[start:]] if len(order) else []
