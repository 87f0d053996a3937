"""Occupancy maps: what a forecast gives back."""

import os
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hcnaf_runtime import modes
from hcnaf_runtime.npz import write_npz

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]

SAVED = (
    "mass",
    "horizons",
    "agents",
    "pose",
    "origin",
    "resolution",
    "frame",
    "window_mass",
    "quadrature_error",
    "lost_mass",
)
"""The fields of forecast.npz."""


@dataclass(frozen=True)
class Timings:
    """Seconds spent in the hyper-network (0 if theta was known already) and in everything after it."""

    hypernet: float
    maps: float


@dataclass(frozen=True, eq=False)
class Maps:
    """The probability that each agent's box centre is in each cell, at each horizon."""

    mass: Float32
    """[A, T, rows, cols]: row 0 is the lowest y, column 0 the lowest x."""
    horizons: Float32
    """[T]: time ahead (s); a single 0 for a bundle without time."""
    agents: npt.NDArray[np.int64]
    """[A]: index of each agent in the scene."""
    pose: Float64
    """[A, 3]: x, y (m) and yaw (rad) of each agent now, in the scene frame."""
    origin: Float64
    """[2]: x, y of the grid's lower-left corner (m), in `frame`."""
    resolution: float
    """Size of a cell (m)."""
    frame: str
    """"agent": each map is in its agent's frame (x forward, y left, from the box centre); or "scene"."""
    window_mass: Float64
    """[A, T]: the probability inside the grid."""
    quadrature_error: Float64
    """[A, T]: the largest change of a cell in the last refinement."""
    lost_mass: Float64
    """[A, T]: the certificate: at most so much was left out of the window's cells."""
    notes: tuple[str, ...]
    """What was assumed, such as an absent optional raster channel."""
    timings: Timings

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the fields SAVED as an .npz file; either all of it appears or nothing does."""
        write_npz(path, {name: getattr(self, name) for name in SAVED})

    def sparse(self, agent: int, horizon: int) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp], Float32]:
        """Rows, columns and masses of the cells that hold anything, [n] each; by position in A and T."""
        mass = self.mass[agent, horizon]
        rows, columns = np.nonzero(mass)
        return rows, columns, mass[rows, columns]

    def peak(self, agent: int, horizon: int) -> tuple[float, float, float]:
        """x, y (m, in `frame`) of the most probable cell's centre and its mass; by position in A and T."""
        mass = self.mass[agent, horizon]
        row, column = np.unravel_index(int(mass.argmax()), mass.shape)
        x, y = self.origin + (np.array([column, row]) + 0.5) * self.resolution
        return float(x), float(y), float(mass[row, column])

    def modes(
        self, agent: int, horizon: int, k: int | None = None, prominence: float = modes.PROMINENCE
    ) -> modes.Modes:
        """The `k` (None: all) modes of a map in `frame`, the heaviest first; by position in A and T.

        A mode is a local maximum with the mass of all cells from which ascent leads to it: see `modes.modes`.
        Raises InputError for a `k` or `prominence` out of range.
        """
        return modes.modes(self.mass[agent, horizon], self.origin, self.resolution, k, prominence)

    def region(self, agent: int, horizon: int, level: float) -> tuple[npt.NDArray[np.bool_], float]:
        """The smallest set of cells [rows, cols] with probability `level`, and the mass of its least likely cell.

        What the window misses counts as outside: if `window_mass` is below `level`, the region is every cell and
        the threshold 0. By position in A and T. Raises InputError for a level that is not between 0 and 1.
        """
        return modes.region(self.mass[agent, horizon], level)
