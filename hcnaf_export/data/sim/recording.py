"""From what libsumo reported to a track set: tracks, parked vehicles, recorded noise, windows."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hcnaf_export.data.manifest import NoiseModel
from hcnaf_export.data.raster import Rasteriser
from hcnaf_export.data.sim.drivers import draw_body
from hcnaf_export.data.sim.roadmap import RoadMap
from hcnaf_export.data.sim.settings import SimSettings
from hcnaf_export.data.sim.traffic import Recording, box_centre
from hcnaf_export.data.tracks import FUTURE, HISTORY, STEP

Float = NDArray[np.float64]

SHORTEST = 10
"""Reported stretches of fewer rows are left out."""

CLEARANCE = 8.0
"""Nobody parks closer than this to a street's ends (m)."""

GRID = 1024.0
"""Recorded numbers lie on a grid of 1/1024 m (rad, m/s): as exact as anyone needs, and files compress."""

STRIDE = 5
"""Windows of one track start at least so many rows apart."""


SMOOTHING = (1.0, 4.0, 6.0, 4.0, 1.0)
"""Weights of the five rows around each row of a recorded track."""

EDGE = len(SMOOTHING) // 2
"""Rows at either end of a reported stretch that have no smoothed value."""


@dataclass(frozen=True)
class Tracks:
    """Tracks one after the other.

    Attributes:
        state: float64 [R, 4], box centre x, y, yaw, speed.
        start: int64 [n + 1], first row of each track, and R.
        step: int64 [n], step of each track's first row.
        size: float64 [n, 2], box length and width.
        parked: bool [n].
    """

    state: Float
    start: NDArray[np.int64]
    step: NDArray[np.int64]
    size: Float
    parked: NDArray[np.bool_]


def cut_tracks(recording: Recording) -> Tracks:
    """Box-centre tracks, cut where a vehicle was missing or jumped."""
    order = np.lexsort((recording.step, recording.vehicle))
    vehicle, step = recording.vehicle[order], recording.step[order]
    state = box_centre(recording.state[order], recording.size[vehicle, 0])
    moved = np.hypot(*np.diff(state[:, :2], axis=0).T)
    jump = moved > 0.5 + 2.0 * STEP * state[1:, 3]
    first = np.append(True, (np.diff(vehicle) != 0) | (np.diff(step) != 1) | jump)[: len(vehicle)]
    begin = np.flatnonzero(first)
    length = np.diff(np.append(begin, len(vehicle)))
    kept = length >= SHORTEST
    rows = np.repeat(kept, length)
    smooth, start = smoothed(state[rows], np.append(0, np.cumsum(length[kept])))
    size, count = recording.size[vehicle[begin[kept]]], int(kept.sum())
    return Tracks(smooth, start, step[begin[kept]] + EDGE, size, np.zeros(count, bool))


def smoothed(state: Float, start: NDArray[np.int64]) -> tuple[Float, NDArray[np.int64]]:
    """Tracks convolved with SMOOTHING, EDGE rows shorter at both ends; yaw is averaged across the seam at pi.

    Off a lane's centre line SUMO moves a vehicle along shifted chords of the lane: it jumps by some 0.1 m at
    their corners. Over half a second that evens out.

    Args:
        state: [R, 4] tracks one after the other.
        start: [n + 1] their first rows; every track has more than 2 EDGE rows.

    Returns:
        The smoothed rows and their `start`.
    """
    length = np.diff(start)
    offset = np.arange(len(state)) - np.repeat(start[:-1], length)
    middle = np.flatnonzero((offset >= EDGE) & (offset < np.repeat(length, length) - EDGE))
    near = state[middle[:, None] + np.arange(-EDGE, EDGE + 1)]
    weight = np.array(SMOOTHING) / sum(SMOOTHING)
    mean = np.einsum("rkc,k->rc", near, weight)
    turned = np.mod(near[..., 2] - state[middle, None, 2] + np.pi, 2.0 * np.pi) - np.pi
    mean[:, 2] = wrapped(state[middle, 2] + turned @ weight)
    return mean, start - 2 * EDGE * np.arange(len(start))


def wrapped(yaw: Float) -> Float:
    """The same directions in (-pi, pi]."""
    return np.pi - np.mod(np.pi - yaw, 2.0 * np.pi)


def park(roads: RoadMap, canvas: Rasteriser, settings: SimSettings, rng: np.random.Generator) -> Tracks:
    """Vehicles that stand beside the right-most lane for the whole recording, off every drivable area."""
    drivable = canvas.channel("drivable")
    poses: list[Float] = []
    sizes: list[tuple[float, float]] = []
    for lane in roads.streets:
        usable = lane.length - 2.0 * CLEARANCE
        if lane.index == _rightmost(roads)[lane.edge] and usable > 0.0:
            for _ in range(rng.poisson(settings.parked * lane.length / 1000.0)):
                _, length, width = draw_body(rng)
                along = CLEARANCE + usable * rng.random()
                pose = _beside(lane.shape, along, 0.5 * (lane.width + width) + rng.uniform(0.15, 0.6), rng)
                if _free(pose, (length, width), canvas, drivable, poses, sizes):
                    poses.append(pose)
                    sizes.append((length, width))
    count, rows = len(poses), round(settings.seconds / STEP)
    state = np.zeros((count, rows, 4))
    state[:, :, :3] = np.array(poses).reshape(-1, 1, 3)
    start = rows * np.arange(count + 1)
    size = np.array(sizes).reshape(-1, 2)
    return Tracks(state.reshape(-1, 4), start, np.zeros(count, np.int64), size, np.ones(count, bool))


def join(moving: Tracks, parked: Tracks) -> Tracks:
    """Both, the moving tracks first."""
    return Tracks(
        np.concatenate([moving.state, parked.state]),
        np.append(moving.start, moving.start[-1] + parked.start[1:]),
        np.append(moving.step, parked.step),
        np.concatenate([moving.size, parked.size]),
        np.append(moving.parked, parked.parked),
    )


def on_grid(values: Float) -> NDArray[np.float32]:
    """float32 values on the storage grid."""
    return (np.rint(values * GRID) / GRID).astype(np.float32)


def perceive(truth: NDArray[np.float32], noise: NoiseModel, rng: np.random.Generator) -> NDArray[np.float32]:
    """`truth` [R, 4] with independent Gaussian noise on x, y, yaw (wrapped) and speed (not below zero)."""
    scale = [noise.position, noise.position, noise.yaw, noise.speed]
    observed = truth + rng.normal(size=truth.shape) * scale
    observed[:, 2] = wrapped(observed[:, 2])
    observed[:, 3] = np.maximum(observed[:, 3], 0.0)
    return on_grid(observed)


def detections(count: int, noise: NoiseModel, rng: np.random.Generator) -> NDArray[np.bool_]:
    """bool [count], False where dropped: gaps of geometric length, `noise.drop` of all rows."""
    if noise.drop <= 0.0:
        return np.ones(count, bool)
    gap = max(noise.drop_length, 1.0)
    run = max(gap * (1.0 - noise.drop) / noise.drop, 1.0)
    pairs = int(count / (gap + run) * 1.5) + 50
    spells = np.stack([rng.geometric(1.0 / run, pairs), rng.geometric(1.0 / gap, pairs)], axis=1).ravel()
    seen = np.repeat(np.arange(2 * pairs) % 2 == 0, spells)
    # The chain may end early for very short counts only: the rest is seen.
    return np.append(seen, np.ones(max(count - len(seen), 0), bool))[:count]


def choose_windows(
    tracks: Tracks, seen: NDArray[np.bool_], count: int, settings: SimSettings, rng: np.random.Generator
) -> NDArray[np.int32]:
    """At most `count` windows [W, 2] (track, step of now), turning ones preferred, standing ones few."""
    track, offset = _candidates(tracks, seen, rng)
    now = tracks.start[track] + offset
    moved = np.hypot(*(tracks.state[now + FUTURE, :2] - tracks.state[now, :2]).T)
    turned = tracks.state[now + FUTURE, 2] - tracks.state[now, 2]
    turned = np.abs(np.mod(turned + np.pi, 2.0 * np.pi) - np.pi)
    standing, parked = moved < 0.5, tracks.parked[track]
    turning = ~standing & (turned > np.pi / 6.0)
    still = settings.standing_share * count
    quota = [(turning, settings.turning_share * count), (standing & parked, still / 3.0)]
    quota.append((standing & ~parked, still * 2.0 / 3.0))
    chosen = [_some(np.flatnonzero(which), int(most), rng) for which, most in quota]
    for rest in (~standing & ~turning, turning):
        left = np.setdiff1d(np.flatnonzero(rest), chosen[0])
        chosen.append(_some(left, count - sum(len(part) for part in chosen), rng))
    picked = np.sort(np.concatenate(chosen))
    return np.stack([track[picked], tracks.step[track[picked]] + offset[picked]], axis=1).astype(np.int32)


def _candidates(
    tracks: Tracks, seen: NDArray[np.bool_], rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(track, row in it) of every STRIDE-th possible now that is seen."""
    length = np.diff(tracks.start)
    track = np.repeat(np.arange(len(length)), length)
    offset = np.arange(len(track)) - tracks.start[track]
    phase = rng.integers(STRIDE, size=len(length))
    inside = (offset >= HISTORY - 1) & (offset < length[track] - FUTURE)
    possible = inside & seen & ((offset - phase[track]) % STRIDE == 0)
    return track[possible], offset[possible]


def _some(items: NDArray[np.int64], most: int, rng: np.random.Generator) -> NDArray[np.int64]:
    return rng.permutation(items)[: max(most, 0)]


def _rightmost(roads: RoadMap) -> dict[str, int]:
    lowest: dict[str, int] = {}
    for lane in roads.streets:
        lowest[lane.edge] = min(lane.index, lowest.get(lane.edge, lane.index))
    return lowest


def _beside(shape: Float, along: float, aside: float, rng: np.random.Generator) -> Float:
    """Pose [x, y, yaw] at a distance along a centre line, moved to the right; a few face the other way."""
    step = np.diff(shape, axis=0)
    reached = np.append(0.0, np.cumsum(np.hypot(step[:, 0], step[:, 1])))
    i = int(np.clip(np.searchsorted(reached, along) - 1, 0, len(step) - 1))
    yaw = np.arctan2(step[i, 1], step[i, 0])
    cos, sin = np.cos(yaw), np.sin(yaw)
    place = shape[i] + (along - reached[i]) * np.array([cos, sin]) + aside * np.array([sin, -cos])
    yaw += rng.normal(0.0, 0.03) + (np.pi if rng.random() < 0.1 else 0.0)
    return np.append(place, wrapped(yaw))


def _free(
    pose: Float,
    size: tuple[float, float],
    canvas: Rasteriser,
    drivable: NDArray[np.float32],
    poses: list[Float],
    sizes: list[tuple[float, float]],
) -> bool:
    """Whether a box reaches into no lane and no other parked box (taken as circles)."""
    u, v = np.meshgrid(np.linspace(-0.5, 0.5, 9) * size[0], np.linspace(-0.5, 0.5, 5) * size[1])
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    points = np.stack([pose[0] + cos * u - sin * v, pose[1] + sin * u + cos * v], axis=-1)
    pixel = ((points - canvas.origin) / canvas.resolution).astype(int).reshape(-1, 2)
    if (drivable[pixel[:, 1], pixel[:, 0]] > 0.5).any():
        return False
    return all(
        np.hypot(*(pose[:2] - other[:2])) > 0.5 * (size[0] + length) + 0.5
        for other, (length, _) in zip(poses, sizes, strict=True)
    )
