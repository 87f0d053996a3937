"""Episodes in PRECOG-CARLA's layout from simulated traffic: `hcnaf simulate --format precog`.

    SimSettings ── simulate ──> TrackSets ── windows ──> OUT/{train,val,test}/ma_datum_*.json

The files have the fields, shapes, units and handedness of the released ones and one field more, `source`, which
says that they are simulated and that their overhead channels are rendered. The networks are CARLA's towns if they
are given (`--train-net Town01.net.xml`).
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from hcnaf_export.data.precog_overhead import HITS, PIXELS_PER_METER, REACH, Surroundings
from hcnaf_export.data.sim.generate import SPLITS, Progress, simulate
from hcnaf_export.data.sim.settings import SimSettings
from hcnaf_export.data.tracks import STEP as ROW
from hcnaf_export.data.tracks import Dataset, Split, TrackSet
from hcnaf_runtime.errors import DataError

Float = NDArray[np.float64]

STEP = 0.2
"""Seconds between the rows of an episode."""

PAST = 10
"""Rows up to now."""

FUTURE = 40
"""Rows after now (8 s)."""

ACTORS = 4
"""Cars beside the player."""

SURPLUS = 3
"""Windows are simulated so many times as often as wanted: those without ten seconds of track fall out."""

BLOCK = 10.0
"""Seconds of one network that share an episode's name: their scenes see the same traffic."""

SOURCE = (
    "simulated by hcnaf with SUMO, not recorded in CARLA; overhead_features are rendered from road geometry and "
    "vehicle boxes, no lidar was simulated"
)

_EVERY = round(STEP / ROW)


def simulate_precog(
    out: Path, settings: SimSettings | None = None, progress: Progress | None = None
) -> dict[Split, int]:
    """Simulate episodes. The same settings and SUMO version give the same files.

    Args:
        out: directory to make; it appears only when everything is done.
        settings: what to simulate; its windows are the episodes of each split. The noise is not used: the release
            has none.
        progress: called with a line of text and the fraction done.

    Returns:
        Episodes of each split.

    Raises:
        DataError: `out` exists and is not an empty directory, a network cannot be driven on, or the traffic has
            too few windows of ten seconds.
        MissingExtraError: SUMO or Pillow is not installed.
    """
    settings, out = settings or SimSettings(), Path(out)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise DataError(f"{out} already exists; expected a new directory, choose another or remove it")
    wanted = {f"{split}_windows": SURPLUS * settings.windows(split) for split in SPLITS}
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{out.name}-", dir=out.parent) as scratch:
        dataset = simulate(Path(scratch) / "tracks", msgspec.structs.replace(settings, **wanted), progress)
        folder = Path(scratch) / "episodes"
        counts = {split: _write_split(folder / split, dataset, split, settings) for split in SPLITS}
        (folder / "SOURCE.txt").write_text(SOURCE + ".\n", encoding="utf-8")
        if out.exists():
            out.rmdir()
        folder.rename(out)
    return counts


def _write_split(folder: Path, dataset: Dataset, split: Split, settings: SimSettings) -> int:
    folder.mkdir(parents=True)
    sets, count = dataset.split(split), settings.windows(split)
    rng = np.random.default_rng((settings.seed, 3, SPLITS.index(split)))
    made = 0
    for k, tracks in enumerate(sets):
        share = count * (k + 1) // len(sets) - count * k // len(sets)
        for record in episodes(tracks, share, rng):
            (folder / f"ma_datum_{made:08d}.json").write_bytes(msgspec.json.encode(record))
            made += 1
    return made


def episodes(tracks: TrackSet, count: int, rng: np.random.Generator) -> Iterator[dict[str, Any]]:
    """`count` episodes of a network, drawn from its windows.

    Raises:
        DataError: fewer windows have ten seconds of track and four others as long.
    """
    order = rng.permutation(len(tracks.windows))
    surroundings = Surroundings(tracks)
    for i in order:
        if count <= 0:
            return
        track, step = (int(v) for v in tracks.windows[i])
        chosen = agents_of(tracks, track, step)
        if chosen is not None:
            yield _record(tracks, surroundings, chosen, step, rng)
            count -= 1
    if count:
        raise DataError(
            f"{tracks.name} has {count} episodes of {STEP * (PAST + FUTURE - 1):g} s too few; "
            "simulate more --seconds or ask for fewer --windows"
        )


def agents_of(tracks: TrackSet, track: int, step: int) -> NDArray[np.int64] | None:
    """The player and the nearest others, int64 [1 + ACTORS]; None without ten seconds of track of all of them.

    Parked cars are no actors: the overhead channels show them.
    """
    present = tracks.agents_at(step)
    first = tracks.rows(present, step - _EVERY * (PAST - 1))
    last = tracks.rows(present, step + _EVERY * FUTURE)
    whole = present[(first >= 0) & (last >= 0) & ~tracks.parked[present]]
    if track not in whole:
        return None
    others = whole[whole != track]
    place = tracks.truth[tracks.rows(others, step), :2] - tracks.truth[tracks.rows(track, step), :2]
    nearest = others[np.argsort(np.hypot(*place.T), kind="stable")[:ACTORS]]
    return np.append(track, nearest) if len(nearest) == ACTORS else None


def _record(
    tracks: TrackSet, surroundings: Surroundings, agents: NDArray[np.int64], step: int, rng: np.random.Generator
) -> dict[str, Any]:
    """One episode: the player first in `agents` [1 + ACTORS]."""
    wanted = step + _EVERY * np.arange(1 - PAST, FUTURE + 1)
    state = tracks.truth[tracks.rows(agents[:, None], wanted)].astype(np.float64)
    pose = state[0, PAST - 1, :3]
    local = _left_handed(state[..., :2], pose)
    now = state[:, PAST - 1]
    others = tracks.agents_at(step)
    others = others[others != agents[0]]
    away = tracks.truth[tracks.rows(others, step), :2] - pose[:2]
    others = others[np.hypot(*away.T) < 2.0 * REACH]
    boxes = np.concatenate([tracks.truth[tracks.rows(others, step), :3], tracks.size[others]], axis=1)
    return {
        "player_past": local[0, :PAST].tolist(),
        "agent_pasts": local[1:, :PAST].tolist(),
        "player_future": local[0, PAST:].tolist(),
        "agent_futures": local[1:, PAST:].tolist(),
        "overhead_features": surroundings.channels(pose, boxes.astype(np.float64), rng).tolist(),
        "player_transform": _transform(now[0]).tolist(),
        "agent_transforms": [_transform(agent).tolist() for agent in now[1:]],
        "lidar_params": {
            "pixels_per_meter": PIXELS_PER_METER,
            "hist_max_per_pixel": HITS,
            "meters_max": round(REACH),
            "val_obstacle": 1.0,
        },
        "episode": f"{tracks.name}_{int(step * ROW // BLOCK):04d}",
        "frame": step,
        "player_yaw": 0.0,
        "agent_yaws": (-np.degrees(now[1:, 2] - pose[2])).tolist(),
        "source": SOURCE,
    }


def _left_handed(position: Float, pose: Float) -> Float:
    """Positions [..., 2] of the network in the player's left-handed frame, [..., 3] with z = 0."""
    d = position - pose[:2]
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    x, left = cos * d[..., 0] + sin * d[..., 1], cos * d[..., 1] - sin * d[..., 0]
    return np.stack([x, -left, np.zeros_like(x)], axis=-1)


def _transform(state: Float) -> Float:
    """[4, 4] pose of a car in a left-handed world: the network with y turned over."""
    cos, sin = np.cos(-state[2]), np.sin(-state[2])
    pose = np.eye(4)
    pose[:2, :2] = [[cos, -sin], [sin, cos]]
    pose[:2, 3] = state[0], -state[1]
    return pose
