"""What can be scored: a density of future positions, and what it may be able to do besides.

`Predictor` is all that an evaluation needs. What a predictor can do besides is a protocol each, with a flag that
says whether this one can: an evaluation takes what there is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from hcnaf_export.data.tracks import TrackSet
from hcnaf_runtime.grid import Grid

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]
Int = NDArray[np.int64]
Windows = NDArray[np.int32]


class Predictor(Protocol):
    """A conditional density of future positions."""

    @property
    def name(self) -> str:
        """What it is called in tables."""

    def nll(self, tracks: TrackSet, windows: Windows, horizons: Sequence[float]) -> Float:
        """-log p of the recorded labels (nats per m²), [W, Q], of windows [W, 2] (track, step) at horizons (s)."""


@runtime_checkable
class Sampler(Protocol):
    """What can draw paths too."""

    @property
    def draws(self) -> bool:
        """Whether this one can."""

    def paths(self, tracks: TrackSet, windows: Windows, horizons: Sequence[float], count: int) -> Float:
        """`count` paths per window [W, count, Q, 2] (m, the network's frame), horizons coupled by quantiles."""


@runtime_checkable
class Drawer(Protocol):
    """What knows the log-density of its own samples."""

    @property
    def draws(self) -> bool:
        """Whether this one does."""

    def drawn_log_prob(self, tracks: TrackSet, windows: Windows, horizons: Sequence[float], count: int) -> Float32:
        """log p at `count` independent samples of each window and horizon, [W, Q, count] (nats per m²)."""


@runtime_checkable
class Transformer(Protocol):
    """What has distribution functions: its Rosenblatt transform is known."""

    @property
    def transforms(self) -> bool:
        """Whether this one has."""

    def pit(self, tracks: TrackSet, windows: Windows, horizons: Sequence[float]) -> Float:
        """F_1(x) and F_2(y given x) of the recorded labels, [W, Q, 2], in the agent's frame (x forward)."""


@runtime_checkable
class Mapper(Protocol):
    """What gives the probability of cells."""

    @property
    def maps(self) -> bool:
        """Whether this one does."""

    def cells(
        self, tracks: TrackSet, windows: Windows, horizons: Sequence[float], grid: Grid
    ) -> tuple[Float32, Int]:
        """The mass of each cell of `grid` in the agent's frame, [W, Q, rows, columns], and the cell that holds the
        label [W, Q], row-major, -1 where none does."""
