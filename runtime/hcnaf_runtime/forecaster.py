"""The forecaster: scenes in, densities and occupancy maps out. The one class most users meet."""

import os
import time
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from hcnaf_runtime import cells, frames, pages, regions, risk, samples
from hcnaf_runtime.agents import Heading
from hcnaf_runtime.bundle import Bundle
from hcnaf_runtime.encoder import Encoder, Horizons, Theta
from hcnaf_runtime.errors import GridError, InputError
from hcnaf_runtime.flow import Flow
from hcnaf_runtime.grid import Grid
from hcnaf_runtime.maps import Maps, Timings
from hcnaf_runtime.occupancy import LOST_MASS, Occupancy, occupancy
from hcnaf_runtime.plane import Window
from hcnaf_runtime.regions import Probability, box_corners, forecast_probability, rectangle_corners
from hcnaf_runtime.risk import Risk, collision_probability
from hcnaf_runtime.samples import Samples
from hcnaf_runtime.scene import Condition, Scene
from hcnaf_runtime.session import Settings, default_threads

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Frame = Literal["agent", "scene"]
_Filled = tuple[Float32, Float64, Float64, Float64]  # mass, what it sums to, quadrature error, lost mass

DEFAULT_GRID = Grid(200, 200, 0.5)
TOLERANCE = 2e-6
"""Cells are refined until they change by less; five times below what a map is promised to be accurate to."""

_MOST_BYTES = 4 << 30
_STRIP = 1 << 21  # fine cells of scene-frame maps that are held at once


class Forecaster:
    """Forecasts with one bundle. Thread-safe; frees what it takes when it is dropped.

    `bundle` is an open Bundle, a directory, or None for the embedded model. `threads` is how many CPUs it may use
    (None: those usable by this process, at most 4). `spinning` and `flush_denormals` trade the rest of the machine
    for latency: see `session.Settings`. Graphs are loaded on first use, or now with a scene to `warm_up` on.
    """

    def __init__(
        self,
        bundle: Bundle | str | os.PathLike[str] | None = None,
        threads: int | None = None,
        *,
        spinning: bool = False,
        flush_denormals: bool = False,
        warm_up: Scene | Condition | None = None,
    ) -> None:
        if threads is not None and threads < 1:
            raise InputError(f"threads is {threads}, expected at least 1")
        self.bundle = bundle if isinstance(bundle, Bundle) else Bundle.open(bundle)
        self.threads = threads or default_threads()
        settings = Settings(self.threads, spinning, flush_denormals)
        self.flow = Flow(self.bundle, settings)
        self._encoder = Encoder(self.bundle, settings)
        if warm_up is not None:
            self.warm_up(warm_up)

    def warm_up(self, scene: Scene | Condition, horizons: Horizons = None) -> None:
        """Load every graph that forecasts need and run it once, so that the first real scene takes no longer.

        Give a scene of the usual size: what onnxruntime allocates for it is kept and used again.
        """
        self.flow.load()
        if self.flow.dims == 2:
            self.pom(scene, horizons=horizons)
        self.log_prob(scene, np.zeros((1, self.flow.dims), np.float32), horizons)

    def theta(self, scene: Scene | Condition, horizons: Horizons = None) -> Theta:
        """The flow's weights. The hyper-network runs once per scene and horizons; the last are remembered.

        `horizons` (s) default to every whole second in the trained range, and are absent for a Condition.
        Raises SceneError where the scene does not fit the bundle and HorizonError outside the trained range.
        """
        return self._encoder.theta(scene, horizons)[0]

    def log_prob(
        self,
        scene: Scene | Condition,
        points: npt.NDArray[Any],
        horizons: Horizons = None,
        frame: Frame = "agent",
    ) -> Float32:
        """Log-density [A, T, N] of each agent's box centre at `points` (nats per m²).

        `points` is [N, D], [A, N, D] or [A, T, N, D] (m), in each agent's own frame or in the scene frame.
        The two differ by a rigid motion, so the density is the same number in both. Raises SceneError,
        HorizonError, or InputError for points of another shape or not finite.
        """
        _check_frame(frame, scene)
        theta = self.theta(scene, horizons)
        A, T, P = theta.values.shape
        places = _points(points, A, T, self.flow.dims)
        if frame == "scene":
            places = np.stack([frames.to_agent(p, pose) for p, pose in zip(places, theta.pose, strict=True)])
        D, N = places.shape[-1], places.shape[-2]
        flat = np.ascontiguousarray(places.reshape(A * T, N, D), dtype=np.float32)
        return self.flow.log_prob(theta.values.reshape(A * T, P), flat).reshape(A, T, N)

    def cdf(self, scene: Scene | Condition, points: npt.NDArray[Any], horizons: Horizons = None) -> Float32:
        """F_1(x) and F_2(y given x) [A, T, N, 2] at `points` in each agent's frame (m).

        `points` is [N, 2], [A, N, 2] or [A, T, N, 2]. Both are uniform on (0, 1) for a calibrated forecast (the
        probability integral transform). Raises SceneError, HorizonError, InputError, or BundleError where D is
        not 2.
        """
        theta = self.theta(scene, horizons)
        A, T, P = theta.values.shape
        flat = np.ascontiguousarray(_points(points, A, T, self.flow.dims), dtype=np.float32).reshape(A * T, -1, 2)
        values = theta.values.reshape(A * T, P)
        found = [
            self.flow.marginal_cdf(values, flat[..., 0]),
            self.flow.conditional_cdf(values, flat[..., 0], flat[..., 1:])[..., 0],
        ]
        return np.stack(found, axis=-1).reshape(A, T, -1, 2)

    def pom(
        self,
        scene: Scene | Condition,
        grid: Grid | None = None,
        horizons: Horizons = None,
        frame: Frame = "agent",
        tolerance: float | None = None,
        lost_mass: float = 0.0,
    ) -> Maps:
        """Occupancy maps: the probability of every cell, from the flow's distribution functions.

        In the agent's frame (x forward, y left, origin at the box centre) each cell is exact up to `tolerance`: by
        default TOLERANCE, or a twentieth of `lost_mass` if that is more; errors of a column's cells
        add up to nothing.
        In the scene frame the map is computed in the agent's frame with half the cell size, over the box that
        covers the grid, and each fine cell's mass is moved to the scene cell that holds its centre: mass is
        conserved, and displaced by less than half a cell.

        `lost_mass` asks for certified sparse maps: cells are left empty where nothing much is, while what they
        would have held stays below it; `Maps.lost_mass` says how much it was. 0 leaves out only what float32
        cannot see.

        `grid` defaults to 200x200@0.5. One without an origin reaches a quarter of its width behind the agent
        (agent frame), or lies about the middle of the forecast agents (scene frame) or about 0 (a Condition).
        Raises SceneError, HorizonError, GridError, or InputError for a tolerance or lost_mass out of range.
        """
        _check_frame(frame, scene)
        tolerance = max(TOLERANCE, lost_mass / 20.0) if tolerance is None else tolerance
        _check_accuracy(tolerance, lost_mass)
        theta, seconds = self._encoder.theta(scene, horizons)
        start = time.perf_counter()
        placed = _place(grid or DEFAULT_GRID, scene, frame, theta)
        fill = self._agent_maps if frame == "agent" else self._scene_maps
        mass, inside, error, lost = fill(theta, placed, tolerance, lost_mass)
        return Maps(
            mass=mass,
            horizons=theta.horizons,
            agents=theta.agents,
            pose=theta.pose,
            origin=placed.corners[0],
            resolution=placed.resolution,
            frame=frame,
            window_mass=inside,
            quadrature_error=error,
            lost_mass=lost,
            notes=theta.notes,
            timings=Timings(seconds, time.perf_counter() - start),
        )

    def sample(
        self,
        scene: Scene | Condition,
        n: int,
        horizons: Horizons = None,
        seed: int = 0,
        frame: Frame = "agent",
    ) -> Samples:
        """`n` samples of each agent at each horizon, all independent: see `samples.sample`."""
        return samples.sample(self, scene, n, horizons, seed, frame)

    def trajectories(
        self,
        scene: Scene | Condition,
        n: int,
        horizons: Horizons = None,
        seed: int = 0,
        frame: Frame = "agent",
    ) -> Samples:
        """`n` paths of each agent, horizons coupled by quantiles (not learnt): see `samples.trajectories`."""
        return samples.trajectories(self, scene, n, horizons, seed, frame)

    def quantile(self, scene: Scene | Condition, levels: npt.NDArray[Any], horizons: Horizons = None) -> Float64:
        """The inverse of `cdf`, [A, T, n, 2] (m, agents' frames) for levels [n, 2]: see `samples.quantile`."""
        return samples.quantile(self, scene, levels, horizons)

    def occupancy(
        self,
        scene: Scene,
        grid: Grid | None = None,
        horizons: Horizons = None,
        heading: Heading = "motion",
        lost_mass: float = LOST_MASS,
        exclude: Sequence[int] = (),
    ) -> Occupancy:
        """The probability that anybody's box covers the centre of each cell, in the scene frame.

        The centre of each forecast agent is spread over its box: at the `heading` that "motion" to where it would
        be implies (see `footprint.motion_headings`), at its "present" one, or at given ones [A, T] (rad). Agents
        are taken as independent. Those without a forecast stay at their present box; those not observed now, and
        those of index `exclude` in the scene (such as the own vehicle), are left out. Of each forecast agent at
        most `lost_mass` is left out. Probabilities are accurate to about 0.01 where they change from cell to cell,
        and to 0.001 on average.

        `grid` defaults to 200x200@0.5; one without an origin lies about the middle of the forecast agents. Raises
        SceneError, HorizonError, GridError, BundleError where D is not 2, or InputError for a condition, and for a
        heading, lost_mass or exclude out of range.
        """
        _check_frame("scene", scene)
        theta, seconds = self._encoder.theta(scene, horizons)
        placed = _place(grid or DEFAULT_GRID, scene, "scene", theta)
        return occupancy(self.flow, scene, theta, placed, heading, lost_mass, exclude, seconds)

    def polygon_probability(
        self,
        scene: Scene | Condition,
        polygons: npt.NDArray[Any],
        horizons: Horizons = None,
        frame: Frame = "agent",
        tolerance: float = regions.TOLERANCE,
    ) -> Probability:
        """Probability [A, T, n] that each agent's box centre is in each of `polygons`, with an error estimate.

        `polygons` is [n, V, 2], [A, n, V, 2] or [A, T, n, V, 2] (m), in each agent's own frame or in the scene
        frame. They are simple, convex or not; corners go round either way and may be repeated. Values are exact up
        to about `tolerance`. Raises SceneError, HorizonError, BundleError where D is not 2, or InputError.
        """
        _check_frame(frame, scene)
        return forecast_probability(self.flow, self.theta(scene, horizons), polygons, frame, tolerance)

    def box_probability(
        self,
        scene: Scene | Condition,
        boxes: npt.NDArray[Any],
        horizons: Horizons = None,
        frame: Frame = "agent",
        tolerance: float = regions.TOLERANCE,
    ) -> Probability:
        """`polygon_probability` [A, T, n] of upright `boxes`: two opposite corners, x_0, y_0, x_1, y_1 (m).

        `boxes` is [n, 4], [A, n, 4] or [A, T, n, 4]; upright in the frame that is named.
        """
        return self.polygon_probability(scene, box_corners(boxes), horizons, frame, tolerance)

    def rectangle_probability(
        self,
        scene: Scene | Condition,
        rectangles: npt.NDArray[Any],
        horizons: Horizons = None,
        frame: Frame = "agent",
        tolerance: float = regions.TOLERANCE,
    ) -> Probability:
        """`polygon_probability` [A, T, n] of turned `rectangles`: x, y of the middle, yaw, length, width (m, rad).

        `rectangles` is [n, 5], [A, n, 5] or [A, T, n, 5].
        """
        return self.polygon_probability(scene, rectangle_corners(rectangles), horizons, frame, tolerance)

    def collision_probability(
        self,
        scene: Scene,
        trajectories: npt.NDArray[Any],
        ego_size: Sequence[float],
        horizons: Horizons = None,
        heading: Heading = "motion",
        include_others: bool = True,
        exclude: Sequence[int] = (),
        draws: int = 0,
        seed: int = 0,
        tolerance: float = risk.TOLERANCE,
    ) -> Risk:
        """The probability that the own box meets another's on each of K `trajectories`, at each of T `horizons`.

        `trajectories` is [K, T, 3 or more] or [T, 3 or more]: x, y of the own box's centre (m) and its yaw (rad)
        in the scene frame, a row for each horizon; `ego_size` is its length and width (m). The boxes of other
        agents are turned by the `heading` that "motion" to the median of their forecast implies (see
        `footprint.motion_headings`), by their "present" one, or by given ones [A, T] (rad, scene frame).

        With `include_others`, agents without a forecast stay at their present box. Those not observed now and
        those of index `exclude` are left out: if the own vehicle is an agent of the scene, exclude it. With
        `draws` the result has an estimate over the whole trajectory, from so many samples of each agent that are
        coupled over time. The probability for one agent at one time is computed to about `tolerance`; what may be
        less than that is given as 0.

        Raises SceneError, HorizonError, BundleError where D is not 2, or InputError for a condition and for
        arguments of another shape or out of range.
        """
        _check_frame("scene", scene)
        theta, seconds = self._encoder.theta(scene, horizons)
        points = None if draws == 0 else _drawn(self, scene, draws, horizons, seed)
        return collision_probability(
            self.flow,
            scene,
            theta,
            trajectories,
            ego_size,
            heading,
            include_others,
            exclude,
            points,
            tolerance,
            seconds,
        )

    def _agent_maps(self, theta: Theta, grid: Grid, tolerance: float, lost_mass: float) -> _Filled:
        A, T, P = theta.values.shape
        window = Window(grid.x_edges, grid.y_edges)
        found = cells.masses(self.flow, theta.values.reshape(A * T, P), window, tolerance, lost_mass)
        mass = found.mass.reshape(A, T, grid.height, grid.width)
        inside, error, lost = (values.reshape(A, T) for values in (found.inside, found.error, found.lost))
        return mass, inside, error, lost

    def _scene_maps(self, theta: Theta, grid: Grid, tolerance: float, lost_mass: float) -> _Filled:
        A, T, _ = theta.values.shape
        mass = pages.zeros((A, T, grid.height, grid.width))
        error, lost = np.zeros((A, T)), np.zeros((A, T))
        for a, pose in enumerate(theta.pose):
            strips = list(frames.covering(grid, pose, grid.resolution / 2).strips(max(1, _STRIP // T)))
            for strip in strips:
                fine = cells.masses(self.flow, theta.values[a], strip, tolerance, lost_mass / len(strips))
                for t in range(T):
                    frames.deposit(fine.mass[t], strip, pose, grid, mass[a, t])
                error[a] = np.maximum(error[a], fine.error)
                lost[a] += fine.lost
        return mass, mass.sum(axis=(2, 3), dtype=np.float64), error, lost


def _drawn(forecaster: Forecaster, scene: Scene, draws: int, horizons: Horizons, seed: int) -> npt.NDArray[Any]:
    """[A, T, draws, 2]: coupled samples in the scene frame."""
    from hcnaf_runtime.samples import trajectories

    return trajectories(forecaster, scene, draws, horizons, seed, "scene").points


def _check_accuracy(tolerance: float, lost_mass: float) -> None:
    if not tolerance > 0.0:
        raise InputError(f"tolerance is {tolerance}, expected a positive number such as {TOLERANCE:g}")
    if not 0.0 <= lost_mass < 1.0:
        raise InputError(f"lost_mass is {lost_mass}, expected a share of the mass from 0 to below 1")


def _check_frame(frame: str, scene: Scene | Condition) -> None:
    if frame not in ("agent", "scene"):
        raise InputError(f"frame is '{frame}', expected 'agent' or 'scene'")
    if frame == "scene" and isinstance(scene, Condition):
        raise InputError("frame is 'scene', a condition has none; use 'agent'")


def _points(points: npt.NDArray[Any], A: int, T: int, D: int) -> npt.NDArray[Any]:
    """`points` as [A, T, N, D]."""
    found = np.asarray(points)
    if found.ndim == 3:
        found = found[:, None]
    try:
        if found.ndim not in (2, 4) or found.shape[-1] != D or found.dtype.kind not in "fiu":
            raise ValueError
        result = np.broadcast_to(found, (A, T, found.shape[-2], D))
    except ValueError:
        raise InputError(
            f"points is {np.asarray(points).dtype} {list(np.shape(points))}, expected float "
            f"[N, {D}], [{A}, N, {D}] or [{A}, {T}, N, {D}]"
        ) from None
    if not np.isfinite(found).all():
        raise InputError("points hold NaN or infinity, expected finite numbers (m)")
    return result


def _place(grid: Grid, scene: Scene | Condition, frame: str, theta: Theta) -> Grid:
    """The grid with an origin, once it is known that the maps fit in memory."""
    A, T, _ = theta.values.shape
    size = 4 * A * T * grid.width * grid.height
    if size > _MOST_BYTES:
        raise GridError(
            f"maps of {size >> 20} MiB asked for, at most {_MOST_BYTES >> 20}; ask for fewer or coarser"
        )
    if grid.origin is not None:
        return grid
    if isinstance(scene, Condition):
        return grid.around(0.0, 0.0)
    if frame == "agent":
        return grid.ahead()
    low, high = theta.pose[:, :2].min(axis=0), theta.pose[:, :2].max(axis=0)
    return grid.around(*((low + high) / 2).tolist())
