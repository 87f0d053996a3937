"""Samples of a forecast, trajectories, and quantiles: the inverse of its distribution functions.

A sample is u uniform on (0, 1)^2 put through the inverse of (F_1, F_2). Agents get independent u. Independent u at
every horizon make samples of each marginal; one u for all horizons makes paths.
"""

import os
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from hcnaf_runtime import frames
from hcnaf_runtime.encoder import Horizons, Theta
from hcnaf_runtime.errors import InputError
from hcnaf_runtime.npz import write_npz
from hcnaf_runtime.scene import Condition, Scene

if TYPE_CHECKING:
    from hcnaf_runtime.forecaster import Forecaster

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]

MOST = 100_000_000
"""Points drawn at once, at most."""

HIGHEST = np.float32(1.0) - np.float32(2.0**-24)
"""The largest float32 below 1."""


@dataclass(frozen=True, eq=False)
class Samples:
    """Where each agent's box centre may be at each horizon, drawn from the forecast."""

    points: Float64
    """[A, T, n, 2]: x, y (m), in `frame`."""
    log_prob: Float32
    """[A, T, n]: log-density of the marginal of each horizon at the points (nats per m²)."""
    horizons: Float32
    """[T]: time ahead (s); a single 0 for a bundle without time."""
    agents: npt.NDArray[np.int64]
    """[A]: index of each agent in the scene."""
    pose: Float64
    """[A, 3]: x, y (m) and yaw (rad) of each agent now, in the scene frame."""
    frame: str
    """"agent": x forward, y left of each agent, from its box centre now; or "scene"."""
    coupled: bool
    """Whether sample i is one path through all horizons; else horizons are independent."""
    notes: tuple[str, ...]
    """What was assumed, such as an absent optional raster channel."""

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write all fields but the notes as an .npz file; either all of it appears or nothing does."""
        write_npz(path, {f.name: getattr(self, f.name) for f in fields(self) if f.name != "notes"})


def sample(
    forecaster: "Forecaster",
    scene: Scene | Condition,
    n: int,
    horizons: Horizons = None,
    seed: int = 0,
    frame: str = "agent",
) -> Samples:
    """`n` samples of each agent at each horizon, all independent.

    The same seed gives the same samples, whatever the number of threads. Raises SceneError, HorizonError,
    BundleError where the bundle has no graph `inverse`, or InputError for n, seed or frame out of range.
    """
    return _draw(forecaster, scene, n, horizons, seed, frame, coupled=False)


def trajectories(
    forecaster: "Forecaster",
    scene: Scene | Condition,
    n: int,
    horizons: Horizons = None,
    seed: int = 0,
    frame: str = "agent",
) -> Samples:
    """`n` paths of each agent: sample i has the same quantiles (u_1, u_2) at all horizons.

    At every horizon the points are samples of the forecast's marginal, exactly, and paths are as continuous in
    time as the forecast. How one horizon depends on another is this coupling by quantiles: it is a construction
    and was not learnt. The model knows marginals only. A path does not depend on which other horizons are asked
    for.

    Raises what `sample` raises.
    """
    return _draw(forecaster, scene, n, horizons, seed, frame, coupled=True)


def quantile(
    forecaster: "Forecaster", scene: Scene | Condition, levels: npt.NDArray[Any], horizons: Horizons = None
) -> Float64:
    """Quantiles [A, T, n, 2] (m, each agent's frame): the inverse of `Forecaster.cdf`.

    `levels` is [n, 2], inside (0, 1): x is where F_1(x) is the first, y is where F_2(y given x) is the second. For
    y given a known x take the first level from `Forecaster.cdf`. Levels closer to 1 than float32 tells are held
    there. Raises SceneError, HorizonError, BundleError where the bundle has no graph `inverse`, or InputError.
    """
    given = np.asarray(levels)
    if given.ndim != 2 or given.shape[1] != 2 or given.dtype.kind not in "fiu" or not given.size:
        raise InputError(f"levels are {given.dtype} {list(given.shape)}, expected float [n, 2] with n at least 1")
    if not ((given > 0.0) & (given < 1.0)).all():
        raise InputError("levels must be above 0 and below 1; move those that are not")
    theta = forecaster.theta(scene, horizons)
    A, T, _ = theta.values.shape
    uniform = np.broadcast_to(_inside(given), (A, T, *given.shape))
    return _points(forecaster, theta, uniform)[0].astype(np.float64)


def _draw(
    forecaster: "Forecaster",
    scene: Scene | Condition,
    n: int,
    horizons: Horizons,
    seed: int,
    frame: str,
    *,
    coupled: bool,
) -> Samples:
    _check(scene, n, seed, frame)
    theta = forecaster.theta(scene, horizons)
    A, T, _ = theta.values.shape
    if A * T * n > MOST:
        raise InputError(f"{A * T * n} points asked for, at most {MOST}; ask for fewer samples or horizons")
    generator = np.random.default_rng(seed)
    uniform = _inside(generator.random((A, 1 if coupled else T, n, 2)))
    local, log_prob = _points(forecaster, theta, np.broadcast_to(uniform, (A, T, n, 2)))
    points = local.astype(np.float64)
    if frame == "scene":
        points = np.stack([frames.to_scene(p, pose) for p, pose in zip(points, theta.pose, strict=True)])
    return Samples(points, log_prob, theta.horizons, theta.agents, theta.pose, frame, coupled, theta.notes)


def _points(forecaster: "Forecaster", theta: Theta, uniform: Float32) -> tuple[Float32, Float32]:
    """Points [A, T, n, 2] (m, agent frame) and log-densities [A, T, n]."""
    A, T, P = theta.values.shape
    n = uniform.shape[2]
    points, log_prob = forecaster.flow.inverse(theta.values.reshape(A * T, P), uniform.reshape(A * T, n, 2))
    return points.reshape(A, T, n, 2), log_prob.reshape(A, T, n)


def _inside(uniform: npt.NDArray[Any]) -> Float32:
    """As float32, which would round up to 1."""
    low = np.finfo(np.float32).tiny
    return np.clip(uniform.astype(np.float32), low, HIGHEST)


def _check(scene: Scene | Condition, n: int, seed: int, frame: str) -> None:
    if n < 1:
        raise InputError(f"{n} samples asked for, expected at least 1")
    if seed < 0:
        raise InputError(f"seed is {seed}, expected 0 or more")
    if frame not in ("agent", "scene"):
        raise InputError(f"frame is '{frame}', expected 'agent' or 'scene'")
    if frame == "scene" and isinstance(scene, Condition):
        raise InputError("frame is 'scene', a condition has none; use 'agent'")
