"""Which windows are scored, and which of them see the same traffic."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hcnaf_export.data.tracks import FUTURE, HISTORY, TrackSet

PART = 250
"""Windows scored between two reports of progress, at most."""


class Part(NamedTuple):
    """Windows [W, 2] (track, step) of one track set, and the cluster [W] of each."""

    tracks: TrackSet
    windows: NDArray[np.int32]
    cluster: NDArray[np.int64]


def parts(sets: Sequence[TrackSet], limit: int = 0) -> list[Part]:
    """The windows of track sets in parts: at most about `limit` of them all, evenly taken; 0 for all.

    Windows of one network within one window's length (5 s) see the same traffic: they form a cluster.
    """
    found = []
    for number, tracks in enumerate(sets):
        windows = _evenly(tracks.windows, -(-limit // len(sets)) if limit else len(tracks.windows))
        for some in np.array_split(windows, max(1, -(-len(windows) // PART))):
            if len(some):
                found.append(Part(tracks, some, _clusters(number, some)))
    return found


def fewer(whole: Sequence[Part], limit: int) -> list[Part]:
    """At most about `limit` of the windows of some parts, evenly taken over each track set."""
    total = sum(len(part.windows) for part in whole)
    if limit >= total:
        return list(whole)
    found = []
    first = 0
    for part in whole:
        last = first + len(part.windows)
        # Of n windows in a row the k-th one taken is n k // limit, whatever the parts they come in.
        taken = np.arange(-(-first * limit // total), -(-last * limit // total)) * total // limit - first
        if len(taken):
            found.append(Part(part.tracks, part.windows[taken], part.cluster[taken]))
        first = last
    return found


def cluster_of(some: Sequence[Part]) -> NDArray[np.int64]:
    """The cluster of each window of some parts, [W]."""
    return np.concatenate([part.cluster for part in some])


def _clusters(number: int, windows: NDArray[np.int32]) -> NDArray[np.int64]:
    """Which windows of track set `number` see the same traffic."""
    return number * 10**6 + windows[:, 1].astype(np.int64) // (HISTORY + FUTURE)


def _evenly(windows: NDArray[np.int32], count: int) -> NDArray[np.int32]:
    W = len(windows)
    count = min(W, count)
    return windows[(np.arange(count) * W) // max(count, 1)]
