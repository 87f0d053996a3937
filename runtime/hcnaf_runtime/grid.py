"""Grids: where the cells of a map lie. Row-major from the lower-left corner, as in nav_msgs/OccupancyGrid."""

import math
import re
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from hcnaf_runtime.errors import GridError

Float32 = npt.NDArray[np.float32]

MAX_SIDE = 4096
"""Most columns or rows of a grid."""

_SPEC = re.compile(r"(\d{1,6})x(\d{1,6})@([0-9.eE+-]{1,20})")


@dataclass(frozen=True)
class Grid:
    """`width` columns by `height` rows of square cells, `resolution` metres wide.

    `origin` is x, y of the lower-left corner (m); None leaves the place to whoever lays the grid out. Raises
    GridError for an empty, oversized or infinite grid.
    """

    width: int
    height: int
    resolution: float
    origin: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            if not 1 <= getattr(self, name) <= MAX_SIDE:
                raise GridError(f"grid {name} is {getattr(self, name)}, expected 1 to {MAX_SIDE} cells")
        if not (math.isfinite(self.resolution) and self.resolution > 0):
            raise GridError(f"grid resolution is {self.resolution}, expected a positive number of metres")
        if self.origin is not None:
            self._check_edges()

    def _check_edges(self) -> None:
        # Edges that coincide in float32 would make cells without width.
        for edges in (self.x_edges, self.y_edges):
            if not (np.isfinite(edges).all() and (np.diff(edges) > 0).all()):
                raise GridError(f"grid at {self.origin} has cells too small for float32; move or coarsen it")

    @classmethod
    def parse(cls, text: str) -> "Grid":
        """A grid from "COLUMNSxROWS@METRES", for example "200x200@0.5"."""
        match = _SPEC.fullmatch(text.strip())
        try:
            if match is not None:
                return cls(int(match[1]), int(match[2]), float(match[3]))
        except ValueError:
            pass
        raise GridError(f"grid is '{text}', expected COLUMNSxROWS@METRES such as 200x200@0.5")

    def at(self, x: float, y: float) -> "Grid":
        """The same grid with its lower-left corner at x, y (m)."""
        return replace(self, origin=(float(x), float(y)))

    def around(self, x: float, y: float) -> "Grid":
        """The same grid about the point x, y (m); edges fall on multiples of the resolution."""
        r = self.resolution
        return self.at(
            (round(x / r) - self.width // 2) * r,
            (round(y / r) - self.height // 2) * r,
        )

    def ahead(self) -> "Grid":
        """The same grid in an agent's frame: a quarter of its width behind the agent, the rest ahead."""
        r = self.resolution
        return self.at(-(self.width // 4) * r, -(self.height // 2) * r)

    @property
    def x_edges(self) -> Float32:
        """[width + 1]: the columns' edges (m)."""
        return _edges(self._placed[0], self.width, self.resolution)

    @property
    def y_edges(self) -> Float32:
        """[height + 1]: the rows' edges (m)."""
        return _edges(self._placed[1], self.height, self.resolution)

    @property
    def centres(self) -> Float32:
        """[height, width, 2]: x, y of every cell's centre (m)."""
        x0, y0 = self._placed
        x = x0 + (np.arange(self.width) + 0.5) * self.resolution
        y = y0 + (np.arange(self.height) + 0.5) * self.resolution
        return np.stack(np.meshgrid(x, y), axis=-1).astype(np.float32)

    @property
    def corners(self) -> npt.NDArray[np.float64]:
        """[4, 2]: x, y of the grid's corners (m)."""
        x0, y0 = self._placed
        x1, y1 = x0 + self.width * self.resolution, y0 + self.height * self.resolution
        return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])

    @property
    def _placed(self) -> tuple[float, float]:
        if self.origin is None:
            raise GridError("grid has no origin yet; place it with at(), around() or ahead()")
        return self.origin


def _edges(origin: float, count: int, resolution: float) -> Float32:
    # From the origin each time, in float64: the same edge is the same float32 in every grid that shares it.
    with np.errstate(over="ignore"):  # what overflows is refused by the check that follows
        return (origin + np.arange(count + 1) * resolution).astype(np.float32)
