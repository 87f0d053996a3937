"""Argoverse 2 motion-forecasting scenarios: read one, cut its tracks at "now", turn it into a scene.

A scenario is a parquet file of tracks (11 s at 10 Hz: 50 observed steps, 60 to forecast) with its vector map
as JSON beside it, both in the city's right-handed frame. Needs pyarrow and Pillow, of the extra `data`.
"""

from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hcnaf_export.data.argoverse2_map import CHANNELS, VectorMap, draw, read_map
from hcnaf_export.data.resample import states
from hcnaf_runtime.errors import DataError, MissingExtraError
from hcnaf_runtime.scene import KINDS, Scene

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Targets = Literal["scored", "focal", "vehicles"]

STEP = 0.1
"""Seconds between the steps of a scenario."""

OBJECTS: dict[str, tuple[str, tuple[float, float]]] = {
    "vehicle": ("vehicle", (4.6, 1.9)),
    "bus": ("vehicle", (12.0, 2.9)),
    "pedestrian": ("pedestrian", (0.7, 0.7)),
    "cyclist": ("cyclist", (1.8, 0.7)),
    "motorcyclist": ("cyclist", (2.2, 0.8)),
    "riderless_bicycle": ("cyclist", (1.8, 0.7)),
    "static": ("static", (1.0, 1.0)),
    "background": ("static", (1.0, 1.0)),
    "construction": ("static", (1.0, 1.0)),
    "unknown": ("unknown", (1.0, 1.0)),
}
"""Scene kind, length and width (m) by object type. The scenarios have no boxes: these are typical ones."""

_FOCAL, _SCORED = 3, 2
_MAX_STEPS = 10_000
_COLUMNS = {
    "track_id": "O", "object_type": "O", "object_category": "i8", "timestep": "i8", "position_x": "f8",
    "position_y": "f8", "heading": "f8", "velocity_x": "f8", "velocity_y": "f8",
}  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class Scenario:
    """One scenario: N tracks over S steps in the city's frame.

    Attributes:
        track_ids: N names; the recording vehicle is "AV".
        object_types: N keys of `OBJECTS`.
        categories: int64 [N]: 0 fragment, 1 not scored, 2 scored, 3 focal.
        state: float64 [N, S, 5]: x, y, sin(heading), cos(heading), speed; NaN where not observed.
        map: the vector map.
    """

    track_ids: tuple[str, ...]
    object_types: tuple[str, ...]
    categories: NDArray[np.int64]
    state: Array
    map: VectorMap


def read_scenario(path: str | PathLike[str]) -> Scenario:
    """Read a `scenario_*.parquet`, or the only one of a directory, with the map beside it.

    Raises:
        DataError: files that are missing, ambiguous or not of this format.
        MissingExtraError: pyarrow is not installed.
    """
    tracks, map_file = _locate(Path(path))
    column = _columns(tracks)
    ids, first, row = np.unique(column["track_id"].astype(str), return_index=True, return_inverse=True)
    step = column["timestep"]
    if len(step) == 0 or step.min() < 0 or step.max() >= _MAX_STEPS:
        raise DataError(
            f"{tracks}: no usable time steps; expected rows numbered from 0 (a scenario has 110 steps)"
        )
    types = tuple(str(kind) for kind in column["object_type"][first])
    unknown = sorted(set(types) - set(OBJECTS))
    if unknown:
        raise DataError(f"{tracks}: object type '{unknown[0]}'; expected one of {', '.join(OBJECTS)}")
    position = np.stack([column["position_x"], column["position_y"]], axis=1)
    speed = np.hypot(column["velocity_x"], column["velocity_y"])
    state = np.full((len(ids), int(step.max()) + 1, 5), np.nan)
    state[row, step] = states(position, column["heading"], speed)
    return Scenario(
        track_ids=tuple(ids.tolist()),
        object_types=types,
        categories=column["object_category"][first],
        state=state,
        map=read_map(map_file),
    )


def to_scene(
    scenario: Scenario,
    *,
    now_step: int = 49,
    history: int = 10,
    targets: Targets = "scored",
    radius: float = 80.0,
    resolution: float = 0.5,
) -> Scene:
    """Turn a scenario into a scene: the city's axes, the origin at the focal agent's position now.

    Agent 0 is the focal track; then come all tracks seen in the history that are a target or within `radius`
    of one, nearest to the focal track first. The raster covers `radius` around every target. The ground truth
    is everything recorded after now (6 s at the default `now_step`), NaN where a track was lost.

    Args:
        scenario: as read by `read_scenario`.
        now_step: the step that is "now"; 49 is the last observed one of the benchmark.
        history: rows of history, 0.1 s apart, ending at now; rows before the recording are NaN.
        targets: the focal track and the scored vehicles, the focal track alone, or every vehicle within
            `radius` of it; in any case only those observed now.
        radius: metres around every target within which other agents and the map are kept.
        resolution: metres per raster pixel.

    Raises:
        DataError: `now_step` outside the recording, no row of history, or a focal track that is not observed
            now.
    """
    steps = scenario.state.shape[1]
    if not (0 <= now_step < steps and 1 <= history <= 1000 and 0.0 < resolution <= radius < np.inf):
        raise DataError(
            f"step {now_step} of {steps}, {history} rows, radius {radius} m, resolution {resolution} m; "
            "expected a step of the recording, 1-1000 rows and 0 < resolution <= radius"
        )
    focal = _focal(scenario, now_step)
    city = scenario.state[focal, now_step, :2]
    state = scenario.state - np.concatenate([city, np.zeros(3)])
    past = _rows(state, now_step - history + 1, now_step + 1)
    wanted = _wanted(scenario, past[:, -1, :2], focal, targets, radius)
    kept = _nearby(past, wanted, focal, radius)
    boxes = [OBJECTS[scenario.object_types[i]] for i in kept]
    seats = past[wanted, -1, :2]
    low, high = seats.min(axis=0) - radius, seats.max(axis=0) + radius
    return Scene(
        past=past[kept].astype(np.float32),
        size=np.array([size for _, size in boxes], dtype=np.float32),
        kind=np.array([KINDS.index(kind) for kind, _ in boxes], dtype=np.uint8),
        target=np.flatnonzero(wanted[kept]),
        raster=draw(scenario.map, city + low, city + high, resolution),
        channels=CHANNELS,
        origin=low.astype(np.float32),
        resolution=resolution,
        step=STEP,
        frame="city-local",
        future=state[kept, now_step + 1 :, :2].astype(np.float32) if now_step + 1 < steps else None,
    )


def convert_argoverse2(path: str | PathLike[str], *, targets: Targets = "scored") -> Scene:
    """A scenario as a scene with 10 rows of history at 0.1 s; see `read_scenario` and `to_scene`."""
    return to_scene(read_scenario(path), targets=targets)


def _focal(scenario: Scenario, now_step: int) -> int:
    found = np.flatnonzero(scenario.categories == _FOCAL)
    if len(found) != 1:
        raise DataError(f"scenario with {len(found)} focal tracks; expected one of category {_FOCAL}")
    if not np.isfinite(scenario.state[found[0], now_step, 0]):
        raise DataError(
            f"focal track {scenario.track_ids[found[0]]} is not observed at step {now_step}; choose another"
        )
    return int(found[0])


def _rows(state: Array, start: int, stop: int) -> Array:
    """state[:, start:stop], with NaN rows for steps before the recording."""
    missing = np.full((len(state), max(0, -start), state.shape[2]), np.nan)
    return np.concatenate([missing, state[:, max(0, start) : stop]], axis=1)


def _wanted(scenario: Scenario, now: Array, focal: int, targets: Targets, radius: float) -> Mask:
    """Which of the N tracks to forecast, given their positions [N, 2] now (the focal one's is the origin)."""
    vehicle = np.array([OBJECTS[kind][0] == "vehicle" for kind in scenario.object_types])
    chosen: Mask = np.zeros(len(now), dtype=bool)
    if targets == "scored":
        chosen = vehicle & (scenario.categories == _SCORED)
    elif targets == "vehicles":
        chosen = vehicle & (np.hypot(*now.T) <= radius)
    chosen &= np.isfinite(now[:, 0])
    chosen[focal] = True
    return chosen


def _nearby(past: Array, wanted: Mask, focal: int, radius: float) -> NDArray[np.int64]:
    """Tracks last seen within the radius of a target: the focal one, then by distance to it."""
    seen = np.isfinite(past[..., 0])
    last = past.shape[1] - 1 - np.argmax(seen[:, ::-1], axis=1)
    where = past[np.arange(len(past)), last, :2]
    gap = np.linalg.norm(where[:, None] - where[None, wanted], axis=2).min(axis=1)
    distance = np.where(np.arange(len(past)) == focal, -1.0, np.hypot(*where.T))
    order = np.argsort(distance, kind="stable")
    return np.asarray(order[gap[order] <= radius])


def _locate(path: Path) -> tuple[Path, Path]:
    """The scenario and its map: the one that shares its id, or else the only one beside it."""
    tracks = _only(path, "scenario_*.parquet") if path.is_dir() else path
    if not tracks.is_file():
        raise DataError(f"{tracks}: no such file; expected a scenario_*.parquet or its directory")
    named = tracks.with_name(f"log_map_archive_{tracks.stem.removeprefix('scenario_')}.json")
    return tracks, named if named.is_file() else _only(tracks.parent, "log_map_archive_*.json")


def _only(folder: Path, pattern: str) -> Path:
    found = sorted(folder.glob(pattern))
    if len(found) != 1:
        raise DataError(f"{folder}: {len(found)} files {pattern}; expected one, of an Argoverse 2 scenario")
    return found[0]


def _columns(path: Path) -> dict[str, NDArray[Any]]:
    arrow, parquet = _pyarrow()
    try:
        table = parquet.read_table(path, columns=list(_COLUMNS))
        column = {name: table[name].to_numpy().astype(dtype) for name, dtype in _COLUMNS.items()}
    except (arrow.ArrowException, OSError, KeyError, TypeError, ValueError) as error:
        reason = " ".join(str(error).split())[:200]
        raise DataError(
            f"{path}: no Argoverse 2 scenario ({reason}); expected columns {', '.join(_COLUMNS)}"
        ) from error
    for name, dtype in _COLUMNS.items():
        if dtype == "f8" and not np.isfinite(column[name]).all():
            raise DataError(f"{path}: values in `{name}` that are not finite; expected numbers")
    return column


def _pyarrow() -> tuple[ModuleType, ModuleType]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise MissingExtraError(
            'Argoverse 2 scenarios need pyarrow, which is not installed; run: pip install "hcnaf[data]"'
        ) from error
    return pyarrow, pyarrow.parquet
