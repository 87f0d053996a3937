"""Occupancy of the whole scene: the probability that anybody's box covers a place.

    theta --> weighted centres (centres) --> their headings and boxes on the grid (footprint) --> p_i of each agent
    probability = 1 - prod (1 - p_i), as if agents moved independently        expected number = sum p_i

Agents without a forecast stay where they are: p_i is 1 on the cells of their present box.
"""

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from hcnaf_runtime import frames
from hcnaf_runtime.agents import Heading, at_present_box, excluded, given_headings
from hcnaf_runtime.centres import Centres, centres
from hcnaf_runtime.encoder import Theta
from hcnaf_runtime.errors import InputError
from hcnaf_runtime.footprint import motion_changes, motion_headings, raster, spread, swept
from hcnaf_runtime.grid import Grid
from hcnaf_runtime.maps import Timings
from hcnaf_runtime.npz import write_npz
from hcnaf_runtime.plane import Distribution
from hcnaf_runtime.scene import Scene

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]

LOST_MASS = 1e-4
"""Probability of each agent that may be left out."""

SHARES = 4
"""Parts that the horizons are shared out in, every so many-th: as much work, on as many threads as there are."""

FINER = 16
"""Centres are located no better than the grid's cells over this, which moves the edge of a box by half as much."""

SAVED = (
    "probability",
    "expected",
    "horizons",
    "forecast",
    "present",
    "origin",
    "resolution",
    "frame",
    "lost_mass",
)
"""The fields of occupancy.npz."""


@dataclass(frozen=True, eq=False)
class Occupancy:
    """The probability that anybody's box covers the centre of each cell, at each horizon, in the scene frame."""

    probability: Float32
    """[T, rows, cols]: that at least one box covers it, agents taken as independent. Row 0 is the lowest y,
    column 0 the lowest x. NaN is read as unknown; the forecaster leaves none."""
    expected: Float32
    """[T, rows, cols]: the expected number of boxes that cover it; needs no independence."""
    horizons: Float32
    """[T]: time ahead (s)."""
    forecast: npt.NDArray[np.int64]
    """Indices in the scene of the agents that entered with their forecast."""
    present: npt.NDArray[np.int64]
    """Indices in the scene of the agents that entered at their present box."""
    origin: Float64
    """[2]: x, y of the grid's lower-left corner (m)."""
    resolution: float
    """Size of a cell (m)."""
    frame: str
    """Name of the scene's frame."""
    lost_mass: float
    """The certificate: of each forecast agent at most so much probability was left out."""
    notes: tuple[str, ...]
    """What was assumed, such as agents that stay where they are."""
    timings: Timings

    @property
    def info(self) -> dict[str, Any]:
        """The grid as in nav_msgs/MapMetaData: resolution (m), width, height, origin x, y (m) and yaw (rad)."""
        _, height, width = self.probability.shape
        x, y = (float(v) for v in self.origin)
        origin = {"x": x, "y": y, "yaw": 0.0}
        return {"resolution": self.resolution, "width": width, "height": height, "origin": origin}

    def to_int8(self) -> npt.NDArray[np.int8]:
        """[T, rows * cols]: the data of a nav_msgs/OccupancyGrid for each horizon, beside `info`.

        Row-major from the lower-left cell; percent, rounded to the nearest of 0 to 100; -1 where the probability
        is NaN.
        """
        percent = np.rint(100.0 * self.probability.astype(np.float64))
        flat = np.where(np.isnan(percent), -1.0, np.clip(percent, 0.0, 100.0)).astype(np.int8)
        return flat.reshape(len(self.horizons), -1)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the fields SAVED as an .npz file; either all of it appears or nothing does."""
        write_npz(path, {name: getattr(self, name) for name in SAVED})


def occupancy(
    flow: Distribution,
    scene: Scene,
    theta: Theta,
    grid: Grid,
    heading: Heading = "motion",
    lost_mass: float = LOST_MASS,
    exclude: Sequence[int] = (),
    seconds: float = 0.0,
) -> Occupancy:
    """The occupancy of `scene`, whose forecasts are `theta`; `grid` has an origin in the scene frame.

    What the arguments mean is said at `Forecaster.occupancy`; `seconds` is what theta took. Raises InputError.
    """
    start = time.perf_counter()
    _check_lost_mass(lost_mass)
    left_out = excluded(exclude, len(scene.past))
    given = given_headings(heading, len(theta.agents), len(theta.horizons))
    T = len(theta.horizons)
    free, expected = np.ones((T, grid.height, grid.width)), np.zeros((T, grid.height, grid.width))
    forecast = np.flatnonzero(~np.isin(theta.agents, left_out))

    def share(times: npt.NDArray[np.intp]) -> None:
        for a, t, found in _centres(flow, scene, theta, grid, forecast, times, lost_mass):
            yaw = None if given is None else given[a, t]
            p = _covered(found, theta.pose[a], scene.size[theta.agents[a]], grid, heading, yaw)
            free[t] *= 1.0 - p
            expected[t] += p

    flow.each(share, [np.arange(k, T, SHARES) for k in range(min(T, SHARES))])
    present, notes = at_present_box(scene, theta, left_out)
    for i in present:
        x, y, sin, cos = scene.past[i, -1, :4].astype(np.float64)
        p = raster(x, y, np.arctan2(sin, cos), scene.size[i], grid)
        free *= 1.0 - p
        expected += p
    return Occupancy(
        probability=(1.0 - free).astype(np.float32),
        expected=expected.astype(np.float32),
        horizons=theta.horizons,
        forecast=theta.agents[forecast],
        present=present,
        origin=grid.corners[0],
        resolution=grid.resolution,
        frame=scene.frame,
        lost_mass=lost_mass,
        notes=theta.notes + notes,
        timings=Timings(seconds, time.perf_counter() - start),
    )


def _centres(
    flow: Distribution,
    scene: Scene,
    theta: Theta,
    grid: Grid,
    forecast: npt.NDArray[np.intp],
    times: npt.NDArray[np.intp],
    lost_mass: float,
) -> list[tuple[int, int, Centres]]:
    """Agent, horizon and centres of every map at `times`, as far as a box can reach the grid."""
    if not len(forecast):
        return []
    T = len(times)
    low, high = np.empty((len(forecast), 2)), np.empty((len(forecast), 2))
    for k, a in enumerate(forecast):
        corners = frames.to_agent(grid.corners, theta.pose[a])
        reach = float(np.hypot(*scene.size[theta.agents[a]])) / 2
        low[k], high[k] = corners.min(axis=0) - reach, corners.max(axis=0) + reach
    values = theta.values[np.ix_(forecast, times)].reshape(len(forecast) * T, -1)
    windows = np.repeat(low, T, axis=0), np.repeat(high, T, axis=0)
    found = centres(flow, values, *windows, grid.resolution / FINER, lost_mass)
    return [(int(forecast[b // T]), int(times[b % T]), cells) for b, cells in enumerate(found)]


def _covered(
    found: Centres, pose: Float64, size: Float32, grid: Grid, heading: Heading, given: float | None
) -> Float64:
    """[height, width]: the probability that one agent's box covers each cell's centre."""
    turns, changes = np.zeros(len(found.mass)), np.zeros((len(found.mass), 2))
    if given is not None:
        turns += given - pose[2]
    elif isinstance(heading, str) and heading == "motion":
        turns = motion_headings(found.places, float(size[0]))
        changes = motion_changes(found.places, float(size[0]))
    boxes = swept(found.places, found.extents, turns, changes, found.mass, pose)
    return np.clip(spread(boxes, size, grid), 0.0, 1.0)


def _check_lost_mass(lost_mass: float) -> None:
    if not 0.0 <= lost_mass < 1.0:
        raise InputError(f"lost_mass is {lost_mass}, expected a share of the mass from 0 to below 1")
