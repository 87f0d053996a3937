"""Risk of trajectories: the probability that the own box meets somebody else's on the way.

Two boxes meet when the centre of one lies in the Minkowski sum of both, an octagon. So at one time

    P(collision with an agent) = mass of the agent's density over the octagon about the own pose

exact by quadrature (`regions`). What happens over a whole trajectory depends on how an agent's places at different
times hang together, which the densities do not say. It is bounded, at the times looked at, by

    max_t p_t  <=  P(collision at any of these times)  <=  min(1, sum_t p_t)

and can be estimated from samples that are coupled over time. Agents are taken as independent wherever they are
combined. Between the times looked at nothing is checked.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from hcnaf_runtime import frames
from hcnaf_runtime.agents import Heading, at_present_box, excluded, given_headings
from hcnaf_runtime.boxes import boxes_meet, octagons, reach
from hcnaf_runtime.encoder import Theta
from hcnaf_runtime.errors import InputError
from hcnaf_runtime.footprint import motion_headings
from hcnaf_runtime.maps import Timings
from hcnaf_runtime.plane import Distribution
from hcnaf_runtime.regions import check_tolerance, probability
from hcnaf_runtime.scene import Scene
from hcnaf_runtime.sketch import bracket

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

TOLERANCE = 1e-4
"""What the probability of one agent at one time may be off by, about: far below what a planner tells apart."""

FARTHEST = 1000.0
"""Half the width (m) of the square about an agent in which the middle of its forecast is looked for."""

_CHUNK = 1 << 20  # boxes that are compared at once


@dataclass(frozen=True, eq=False)
class Risk:
    """Probabilities that trajectories meet other agents' boxes. K trajectories, T times, A agents."""

    horizons: Float32
    """[T]: time ahead (s)."""
    agents: npt.NDArray[np.int64]
    """[A]: index of each agent in the scene."""
    forecast: Mask
    """[A]: whether it entered with its forecast, else at its present box: 1 where the boxes meet."""
    per_agent: Float64
    """[K, T, A]: probability of a collision at each time."""
    error: Float64
    """[K, T, A]: what the quadrature may be off by, as far as can be told."""
    agent_estimate: Float64 | None
    """[K, A]: share of coupled samples that collide at any of the times; None where none were drawn."""
    notes: tuple[str, ...]
    """What was assumed, such as agents that stay where they are."""
    timings: Timings

    @property
    def per_step(self) -> Float64:
        """[K, T]: probability of a collision with anybody at each time, agents taken as independent."""
        return _any(self.per_agent)

    @property
    def agent_lower(self) -> Float64:
        """[K, A]: lower bound of the probability over the trajectory, the largest at any time."""
        return np.asarray(self.per_agent.max(axis=1, initial=0.0))

    @property
    def agent_upper(self) -> Float64:
        """[K, A]: upper bound of the probability over the trajectory, the sum over the times."""
        return np.asarray(np.minimum(self.per_agent.sum(axis=1), 1.0))

    @property
    def lower(self) -> Float64:
        """[K]: lower bound for a collision with anybody, agents taken as independent."""
        return _any(self.agent_lower)

    @property
    def upper(self) -> Float64:
        """[K]: upper bound for a collision with anybody; needs no independence."""
        return np.asarray(np.minimum(self.per_agent.sum(axis=(1, 2)), 1.0))

    @property
    def estimate(self) -> Float64 | None:
        """[K]: estimate for a collision with anybody from coupled samples, agents taken as independent."""
        return None if self.agent_estimate is None else _any(self.agent_estimate)


def collision_probability(
    flow: Distribution,
    scene: Scene,
    theta: Theta,
    trajectories: npt.NDArray[Any],
    ego_size: Sequence[float],
    heading: Heading = "motion",
    include_others: bool = True,
    exclude: Sequence[int] = (),
    points: npt.NDArray[np.floating[Any]] | None = None,
    tolerance: float = TOLERANCE,
    seconds: float = 0.0,
) -> Risk:
    """The risk of `trajectories` among the agents of `scene`, whose forecasts are `theta`.

    `points` [A, T, n, 2] (m, scene frame) are samples of the forecast agents, coupled over time, for the estimate;
    `seconds` is what theta took. The other arguments are described at `Forecaster.collision_probability`.
    """
    start = time.perf_counter()
    T = len(theta.horizons)
    check_tolerance(tolerance)
    ego = _trajectories(trajectories, T)
    size = _size(ego_size)
    left_out = excluded(exclude, len(scene.past))
    kept = np.flatnonzero(~np.isin(theta.agents, left_out))
    turns = _turns(flow, scene, theta, heading)[kept]
    found, error = _masses(flow, scene, theta, kept, turns, ego, size, tolerance)
    others, notes = at_present_box(scene, theta, left_out) if include_others else (np.empty(0, np.int64), ())
    still = _present(scene, others, ego, size)
    estimate = None
    if points is not None:
        yaw = turns + theta.pose[kept, 2:]
        drawn = _estimate(points[kept], yaw, scene.size[theta.agents[kept]], ego, size, found > 0.0)
        estimate = np.concatenate([drawn, still.max(axis=1, initial=0.0)], axis=1)
    return Risk(
        horizons=theta.horizons,
        agents=np.concatenate([theta.agents[kept], others]),
        forecast=np.arange(len(kept) + len(others)) < len(kept),
        per_agent=np.concatenate([found, still], axis=2),
        error=np.concatenate([error, np.zeros_like(still)], axis=2),
        agent_estimate=estimate,
        notes=theta.notes + notes,
        timings=Timings(seconds, time.perf_counter() - start),
    )


def _masses(
    flow: Distribution,
    scene: Scene,
    theta: Theta,
    kept: npt.NDArray[np.intp],
    turns: Float64,
    ego: Float64,
    size: Float64,
    tolerance: float,
) -> tuple[Float64, Float64]:
    """Probability and error [K, T, A] of the agents `kept`, whose boxes are turned by `turns` [A, T]."""
    K, T = ego.shape[:2]
    A, P = len(kept), theta.values.shape[-1]
    places = np.empty((3, A, T, K))
    for row, a in enumerate(kept):
        places[:2, row] = np.moveaxis(frames.to_agent(ego[..., :2], theta.pose[a]), (0, 1, 2), (2, 1, 0))
        places[2, row] = ego[..., 2].T - theta.pose[a, 2]
    sizes = scene.size[theta.agents[kept]].astype(np.float64)
    extent = reach(places[2], size, turns[..., None], sizes[:, None, None])
    low, high = ((places[:2] + sign * extent).reshape(2, A * T, K) for sign in (-1.0, 1.0))
    flat = places.reshape(3, -1)

    def corners(some: npt.NDArray[np.intp]) -> Float64:
        """[2, 8, m] of the octagons of regions [m]."""
        return np.moveaxis(
            octagons(flat[:, some], size, turns.ravel()[some // K], sizes[some // (T * K)]), (1, 2), (1, 0)
        )

    found = probability(flow, theta.values[kept].reshape(A * T, P), low, high, corners, tolerance)
    value, error = (np.moveaxis(v.reshape(A, T, K), (0, 1, 2), (2, 1, 0)) for v in (found.value, found.error))
    return value, error


def _turns(flow: Distribution, scene: Scene, theta: Theta, heading: Heading) -> Float64:
    """Headings [A, T] of the agents' boxes (rad), in their frame."""
    A, T, P = theta.values.shape
    given = given_headings(heading, A, T)
    if given is not None:
        return given - theta.pose[:, 2:]
    if isinstance(heading, str) and heading == "present":
        return np.zeros((A, T))
    middle = medians(flow, theta.values.reshape(A * T, P)).reshape(A, T, 2)
    lengths = scene.size[theta.agents, 0]
    return np.stack([motion_headings(m, float(n)) for m, n in zip(middle, lengths, strict=True)])


def medians(flow: Distribution, theta: Float32) -> Float64:
    """The median x of theta [B, P] and the median y given it: [B, 2] (m), to some centimetres."""
    found = np.empty((len(theta), 2))

    def part(some: slice) -> None:
        maps = theta[some]
        far = np.full((len(maps), 1), FARTHEST)
        x = np.mean(bracket(lambda v: flow.marginal_cdf(maps, v), -far[:, 0], far[:, 0], 0.5, rounds=4), axis=0)
        at = x[:, None].astype(np.float32)
        y = np.mean(bracket(lambda v: flow.conditional_cdf(maps, at, v), -far, far, 0.5, rounds=4), axis=0)
        found[some] = np.column_stack([x, y])

    flow.each(part, [slice(0, None, 2), slice(1, None, 2)] if len(theta) > 1 else [slice(None)])
    return found


def _present(scene: Scene, others: npt.NDArray[np.int64], ego: Float64, size: Float64) -> Float64:
    """1 where the own box meets that of agents `others` now, else 0: [K, T, n]."""
    state = scene.past[others, -1].astype(np.float64)
    sizes = scene.size[others].astype(np.float64)
    dx, dy = state[:, 0] - ego[..., :1], state[:, 1] - ego[..., 1:2]
    near = np.nonzero(dx * dx + dy * dy <= ((np.hypot(*size) + np.hypot(*sizes.T)) / 2) ** 2)
    k, t, who = near
    yaw = np.arctan2(state[:, 2], state[:, 3])[who]
    meet = np.zeros(dx.shape)
    meet[near] = boxes_meet(dx[near], dy[near], ego[k, t, 2], size, yaw, sizes[who])
    return meet


def _estimate(
    points: npt.NDArray[np.floating[Any]], yaw: Float64, sizes: Float32, ego: Float64, size: Float64, near: Mask
) -> Float64:
    """Share [K, A] of samples `points` [A, T, n, 2] that meet the own box at any time that is `near` [K, T, A]."""
    K, (A, _, n, _) = len(ego), points.shape
    share = np.zeros((K, A))
    for a in range(A):
        hit = np.zeros((K, n), np.bool_)
        for t in range(points.shape[1]):
            some = np.flatnonzero(near[:, t, a])
            for part in np.array_split(some, max(1, len(some) * n // _CHUNK)):
                pose = ego[part, t, None]  # [k, 1, 3]
                dx, dy = points[a, t, :, 0] - pose[..., 0], points[a, t, :, 1] - pose[..., 1]
                hit[part] |= boxes_meet(dx, dy, pose[..., 2], size, yaw[a, t], sizes[a].astype(np.float64))
        share[:, a] = hit.mean(axis=1)
    return share


def _any(p: Float64) -> Float64:
    """Probability that any of independent events [..., A] happens."""
    return np.asarray(1.0 - np.prod(1.0 - p, axis=-1))


def _trajectories(given: npt.NDArray[Any], T: int) -> Float64:
    """[K, T, 3]: x, y, yaw."""
    found = np.asarray(given)
    found = found[None] if found.ndim == 2 else found
    if found.ndim != 3 or found.shape[1] != T or found.shape[2] < 3 or found.dtype.kind not in "fiu":
        raise InputError(
            f"trajectories is {found.dtype} {list(np.shape(given))}, expected float [K, {T}, 3 or more]: x, y (m) "
            f"and yaw (rad) at each of the {T} horizons"
        )
    if not np.isfinite(found[..., :3]).all():
        raise InputError("trajectories hold NaN or infinity, expected finite numbers (m, rad)")
    return found[..., :3].astype(np.float64)


def _size(given: Sequence[float]) -> Float64:
    size = np.asarray(given, np.float64)
    if size.shape != (2,) or not (np.isfinite(size) & (size > 0.0)).all():
        raise InputError(
            f"ego_size is {list(np.ravel(given))}, expected length and width in metres, such as 4.6, 1.9"
        )
    return size
