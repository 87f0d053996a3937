"""PRECOG-CARLA episodes: read one, turn it into a scene.

An episode is one JSON file in a left-handed frame (x forward, y to the right, ego at "now"); a scene is
right-handed, so y, yaw and the rows of the raster are flipped. The file says nothing about its time step, and
the data set's own documents disagree: 0.2 s in one place (2 s of past, 8 s of future), 0.1 s in another. Here
0.2 s is the default, and the cars of a genuine episode agree with it: read at 0.1 s they would brake with
8 m/s^2 and turn at 70 degrees per second.
"""

import math
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from hcnaf_export.data.resample import headings, resample, speeds, states
from hcnaf_runtime.errors import DataError
from hcnaf_runtime.scene import KINDS, Scene

Array = NDArray[np.float64]
Targets = Literal["player", "all"]

LIDAR_CHANNELS = ("lidar_hits", "lidar_above", "lidar_below", "lidar_higher")
"""The raster's channels: hits / 25 clipped; points above ground, below it and higher up (0 or 1)."""

CAR_SIZE = (4.6, 1.9)
"""Length and width (m) given to every car: the episodes have no boxes."""

_LARGEST = 1e6


@dataclass(frozen=True, eq=False, kw_only=True)
class Episode:
    """One PRECOG-CARLA file as it stands: left-handed, metres; P past rows (the last is now), F future rows,
    M cars beside the player.

    Attributes:
        player_past: [P, 3] and
        player_future: [F, 3] ego positions; future row 0 is one step after now.
        agent_pasts: [M, P, 3] and
        agent_futures: [M, F, 3] positions of the other cars.
        overhead_features: [rows, cols, 4], index [y][x], in [0, 1].
        player_transform: [4, 4] and
        agent_transforms: [M, 4, 4] poses in the simulator's world.
        agent_yaws: [M] degrees relative to the player, clockwise, not wrapped; None if the file has none.
        pixels_per_meter: of the overhead features.
        meters_max: half the width the overhead features cover.
        episode: the drive it is taken from; scenes of one drive see the same traffic. Empty if the file has none.
    """

    player_past: Array
    player_future: Array
    agent_pasts: Array
    agent_futures: Array
    overhead_features: Array
    player_transform: Array
    agent_transforms: Array
    agent_yaws: Array | None
    pixels_per_meter: float
    meters_max: float
    episode: str = ""


def read_episode(path: str | PathLike[str]) -> Episode:
    """Read and check one episode file (`ma_datum_*.json`).

    Raises:
        DataError: a file that cannot be read, is not JSON, or has a field that is missing, of another shape
            or out of range; the message names the file and the field.
    """
    record = _decode(Path(path))
    try:
        return _episode(record)
    except DataError as error:
        raise DataError(f"{path}: {error}") from error


def _episode(record: dict[str, Any]) -> Episode:
    past = _field(record, "player_past", (None, 3))
    future = _field(record, "player_future", (None, 3))
    if len(past) < 2 or len(future) < 1:
        raise DataError(
            f"episode with {len(past)} `player_past` and {len(future)} `player_future` rows; "
            "expected at least 2 and 1"
        )
    pasts = _field(record, "agent_pasts", (None, len(past), 3))
    count = len(pasts)
    scale, reach = _lidar(record)
    pixels = round(2.0 * reach * scale)
    return Episode(
        player_past=past,
        player_future=future,
        agent_pasts=pasts,
        agent_futures=_field(record, "agent_futures", (count, len(future), 3)),
        overhead_features=_field(record, "overhead_features", (pixels, pixels, len(LIDAR_CHANNELS))),
        player_transform=_pose(record, "player_transform"),
        agent_transforms=_field(record, "agent_transforms", (count, 4, 4)),
        agent_yaws=_field(record, "agent_yaws", (count,)) if "agent_yaws" in record else None,
        pixels_per_meter=scale,
        meters_max=reach,
        episode=str(record.get("episode", "")),
    )


def to_scene(
    episode: Episode,
    *,
    step: float = 0.2,
    history: int = 10,
    target_step: float = 0.1,
    targets: Targets = "player",
    size: tuple[float, float] = CAR_SIZE,
) -> Scene:
    """Turn an episode into a right-handed scene: agent 0 the player, the others in the file's order.

    Positions and speeds are interpolated linearly from the file's rows to `history` rows `target_step` apart,
    ending at now; rows before the recording are NaN. Headings now come from the file and turn back in time as
    the direction of motion does. The ground truth is interpolated likewise, as far as the file goes.

    Args:
        episode: as read by `read_episode`.
        step: seconds between the file's rows; the files do not say (see the module's text).
        history: rows of history to produce, 1 to 1000.
        target_step: seconds between them; the embedded model needs 10 rows at 0.1 s.
        targets: forecast the player alone, or every car.
        size: length and width of every car's box, metres.

    Raises:
        DataError: a step outside 0.01 s to 10 s, or a history of no row or of too many.
    """
    if not (0.01 <= step <= 10.0 and 0.01 <= target_step <= 10.0 and 1 <= history <= 1000):
        raise DataError(
            f"step {step} s, target step {target_step} s, {history} rows; expected 0.01-10 s and 1-1000 rows"
        )
    past, future, yaw = right_handed(episode)
    count = len(past)
    wanted = np.arange(1 - history, 1, dtype=np.float64) * target_step
    return Scene(
        past=_history(past, yaw, step, wanted),
        size=np.tile(np.asarray(size, dtype=np.float32), (count, 1)),
        kind=np.full(count, KINDS.index("vehicle"), dtype=np.uint8),
        target=np.arange(count if targets == "all" else 1, dtype=np.int64),
        raster=_raster(episode.overhead_features),
        channels=LIDAR_CHANNELS,
        origin=np.full(2, -episode.meters_max, dtype=np.float32),
        resolution=1.0 / episode.pixels_per_meter,
        step=target_step,
        frame="ego",
        future=_ground_truth(past[:, -1:], future, step, target_step),
    )


def convert_precog(
    path: str | PathLike[str], *, step: float = 0.2, targets: Targets = "player", target_step: float = 0.1
) -> Scene:
    """A PRECOG-CARLA file as a scene with 10 rows of history at `target_step`; see `read_episode`, `to_scene`."""
    return to_scene(read_episode(path), step=step, targets=targets, target_step=target_step)


def right_handed(episode: Episode) -> tuple[Array, Array, Array]:
    """Positions and headings, the player first, y to the left.

    Returns:
        past [1 + M, P, 2] and future [1 + M, F, 2] in metres; headings now [1 + M], radians counter-clockwise.
    """
    past = _flipped(np.concatenate([episode.player_past[None], episode.agent_pasts]))
    future = _flipped(np.concatenate([episode.player_future[None], episode.agent_futures]))
    return past, future, _yaws_now(episode)


def histories(past: Array, yaw_now: Array, step: float) -> Array:
    """Recorded rows as states of a scene: [..., P, 2] m and [...] rad to [..., P, 5] (x, y, sin, cos, speed)."""
    return states(past, headings(past, yaw_now, step), speeds(past, step))


def _history(past: Array, yaw_now: Array, step: float, wanted: Array) -> NDArray[np.float32]:
    times = step * np.arange(1 - past.shape[1], 1)
    yaw = headings(past, yaw_now, step)
    moving = np.concatenate([past, yaw[..., None], speeds(past, step)[..., None]], axis=-1)
    row = resample(moving, times, wanted)
    return states(row[..., :2], row[..., 2], row[..., 3]).astype(np.float32)


def _ground_truth(now: Array, future: Array, step: float, target_step: float) -> NDArray[np.float32]:
    rows = future.shape[1]
    wanted = target_step * np.arange(1, math.floor(rows * step / target_step + 1e-6) + 1)
    known = np.concatenate([now, future], axis=1)
    return resample(known, step * np.arange(rows + 1), wanted).astype(np.float32)


def _yaws_now(episode: Episode) -> Array:
    """Headings at now, [1 + M] radians counter-clockwise, the player's being zero.

    In the genuine file the other cars' transforms, and the yaws taken from them, are one row late: their
    positions are those of future row 0. Such a yaw is taken back by the turn that the past shows.
    """
    relative = np.linalg.inv(episode.player_transform) @ episode.agent_transforms
    yaw = np.arctan2(relative[:, 1, 0], relative[:, 0, 0])
    if episode.agent_yaws is not None:
        yaw = np.radians(episode.agent_yaws)
    late = [_is_late(*pair) for pair in zip(relative, episode.agent_pasts, episode.agent_futures, strict=True)]
    turn = [
        _last_turn(track[:, :2]) if is_late else 0.0
        for track, is_late in zip(episode.agent_pasts, late, strict=True)
    ]
    return np.concatenate([[0.0], -(yaw - np.asarray(turn, dtype=np.float64))])


def _is_late(pose: Array, past: Array, future: Array) -> bool:
    where = pose[:2, 3]
    return bool(np.hypot(*(where - future[0, :2])) < np.hypot(*(where - past[-1, :2])))


def _last_turn(track: Array) -> float:
    """Turn (radians) between a path's last two steps; zero where they are too short to tell (0.1 m)."""
    if len(track) < 3:
        return 0.0
    (ax, ay), (bx, by) = np.diff(track[-3:], axis=0)
    if min(math.hypot(ax, ay), math.hypot(bx, by)) < 0.1:
        return 0.0
    return math.atan2(ax * by - ay * bx, ax * bx + ay * by)


def _flipped(position: Array) -> Array:
    """[..., 3] left-handed to [..., 2] right-handed."""
    return np.asarray(position[..., :2] * np.array([1.0, -1.0]))


def _raster(overhead: Array) -> NDArray[np.int8]:
    """[y right, x, C] in [0, 1] to int8 [C, y left, x]: the last row, the rightmost, becomes row 0."""
    flipped = np.moveaxis(overhead[::-1], -1, 0)
    return np.ascontiguousarray(np.rint(127.0 * np.clip(flipped, 0.0, 1.0)).astype(np.int8))


def _decode(path: Path) -> dict[str, Any]:
    try:
        record = msgspec.json.decode(path.read_bytes())
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}); expected a PRECOG-CARLA JSON file") from error
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: not valid JSON ({error}); expected a PRECOG-CARLA episode") from error
    if not isinstance(record, dict):
        raise DataError(
            f"{path}: holds a JSON {type(record).__name__}; expected a PRECOG-CARLA episode, an object"
        )
    return record


def _field(record: dict[str, Any], name: str, shape: tuple[int | None, ...]) -> Array:
    expected = "[" + ", ".join("any" if n is None else str(n) for n in shape) + "]"
    if name not in record:
        raise DataError(f"episode without `{name}`; expected numbers {expected}: is this a PRECOG-CARLA file?")
    try:
        array = np.asarray(record[name], dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DataError(f"episode with a `{name}` that is no array of numbers; expected {expected}") from error
    if array.size == 0 and shape[0] is None:
        array = array.reshape(0, *(n or 0 for n in shape[1:]))
    if array.ndim != len(shape) or any(n not in (None, m) for n, m in zip(shape, array.shape, strict=True)):
        raise DataError(f"episode with `{name}` of shape {list(array.shape)}; expected {expected}")
    if not (np.abs(array) <= _LARGEST).all():
        raise DataError(f"episode with values in `{name}` beyond {_LARGEST:g}; expected metres or degrees")
    return array


def _pose(record: dict[str, Any], name: str) -> Array:
    pose = _field(record, name, (4, 4))
    if abs(np.linalg.det(pose[:3, :3])) < 0.5:
        raise DataError(f"episode with a `{name}` that is no pose; expected a rotation and a translation")
    return pose


def _lidar(record: dict[str, Any]) -> tuple[float, float]:
    """Pixels per metre and half width (m) of the overhead features, checked before they size anything."""
    found = record.get("lidar_params")
    values = [found.get(key) for key in ("pixels_per_meter", "meters_max")] if isinstance(found, dict) else [None]
    numbers = [v for v in values if isinstance(v, int | float) and not isinstance(v, bool) and 0 < v <= 1000]
    if len(numbers) != 2:
        raise DataError(
            "episode with a bad `lidar_params`; expected `pixels_per_meter` and `meters_max` (2 and 50)"
        )
    return float(numbers[0]), float(numbers[1])
