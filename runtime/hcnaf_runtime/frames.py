"""Between an agent's frame (origin at its box centre, x forward, y left) and the scene frame."""

import math

import numpy as np
import numpy.typing as npt

from hcnaf_runtime.grid import Grid
from hcnaf_runtime.plane import Window

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]


def _rotation(yaw: float) -> Float64:
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s], [s, c]])


def to_scene(points: npt.NDArray[np.floating], pose: Float64) -> Float64:
    """Points [..., 2] of the agent's frame in the scene frame; `pose` is x, y (m), yaw (rad)."""
    return points.astype(np.float64) @ _rotation(pose[2]).T + pose[:2]


def to_agent(points: npt.NDArray[np.floating], pose: Float64) -> Float64:
    """Points [..., 2] of the scene frame in the agent's frame; `pose` is x, y (m), yaw (rad)."""
    return (points.astype(np.float64) - pose[:2]) @ _rotation(pose[2])


def covering(grid: Grid, pose: Float64, resolution: float) -> Window:
    """The agent-frame box of cells, `resolution` wide, that covers a grid of the scene frame."""
    corners = to_agent(grid.corners, pose)
    low = np.floor(corners.min(axis=0) / resolution)
    high = np.ceil(corners.max(axis=0) / resolution)
    x, y = (np.arange(a, b + 1) * resolution for a, b in zip(low, high, strict=True))
    return Window(x.astype(np.float32), y.astype(np.float32))


def deposit(mass: Float32, window: Window, pose: Float64, grid: Grid, scene: Float32) -> None:
    """Add the mass [R, C] of a window of the agent's frame to the `scene` cells that hold its cells' centres.

    `scene` [height, width] is changed in place. Mass that falls outside `grid` is left out; the rest is conserved.
    """
    rows, columns = np.nonzero(mass)
    x, y = ((edges[:-1] + edges[1:]) / 2 for edges in (window.x, window.y))
    centres = to_scene(np.stack([x[columns], y[rows]], axis=-1), pose)
    column, row = np.floor((centres - grid.corners[0]) / grid.resolution).astype(np.int64).T
    inside = (column >= 0) & (column < grid.width) & (row >= 0) & (row < grid.height)
    np.add.at(scene, (row[inside], column[inside]), mass[rows, columns][inside])
