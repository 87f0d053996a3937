"""The two-dimensional flow as maps see it, and the window that they cover."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

Float32 = npt.NDArray[np.float32]

CHUNK = 1 << 19
"""Numbers in the widest intermediate of a graph run, nodes x edges x hidden units: 2 MiB."""


class Distribution(Protocol):
    """The two-dimensional flow as the graphs of a bundle give it, for theta [B, P] of B maps."""

    @property
    def hidden(self) -> int:
        """H, hidden units per dimension."""

    def marginal_cdf(self, theta: Float32, x: Float32) -> Float32:
        """F_1 [B, K] at `x` [B, K] (m)."""

    def cell_mass(
        self, theta: Float32, x: Float32, weight: Float32, doubt: Float32, y: Float32
    ) -> tuple[Float32, Float32]:
        """Mass [B, E - 1, C], the sum over s of weight [B, S, C] times F_2's increments along y [B, E] given x
        [B, S]; and [B, C], the largest |sum| with the weights `doubt`, or what was below 0."""

    def conditional_cdf(self, theta: Float32, x: Float32, y: Float32) -> Float32:
        """F_2 [B, S, E] at `y` [B, S, E] given `x` [B, S] (m)."""

    def grid_cdf(self, theta: Float32, x: Float32, y: Float32) -> Float32:
        """F_2 [B, E, S] at every pair of `x` [B, S] and `y` [B, E] (m)."""

    def each(self, work: Callable[[Any], object], items: Iterable[Any]) -> None:
        """Call `work` with each item, on as many threads as there are."""


@dataclass(frozen=True)
class Window:
    """The edges of the cells' columns and rows, equally spaced, float32 [C + 1] and [R + 1] (m)."""

    x: Float32
    y: Float32

    def strips(self, most: int) -> Iterator["Window"]:
        """The window from left to right in parts of at most about `most` cells."""
        width = max(1, most // (len(self.y) - 1))
        return (Window(self.x[c : c + width + 1], self.y) for c in range(0, len(self.x) - 1, width))
