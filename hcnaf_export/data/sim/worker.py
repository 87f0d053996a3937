"""One network, one process: `python -m hcnaf_export.data.sim.worker` with a Task as JSON on standard input.

libsumo keeps one simulation per process and writes to the process's streams; a child of its own keeps both away
from the caller. A failure is one line on standard error and exit code 2.
"""

import sys
import tempfile
from pathlib import Path

import msgspec
import numpy as np

from hcnaf_export.data.manifest import SetEntry
from hcnaf_export.data.raster import MAP_CHANNELS
from hcnaf_export.data.sim import recording as rec
from hcnaf_export.data.sim.roadmap import draw, read_roadmap
from hcnaf_export.data.sim.settings import SimSettings
from hcnaf_export.data.sim.streets import StreetPlan, build_streets
from hcnaf_export.data.sim.traffic import run_traffic
from hcnaf_export.data.tracks import TrackSet
from hcnaf_runtime.errors import HcnafError

VEHICLE = 1
"""Index of "vehicle" in `hcnaf_runtime.scene.KINDS`."""


class Task(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One network to simulate.

    Attributes:
        name: of the set and, with `.npz`, of its file.
        seeds: entropy of everything random in it.
        net: a given network file, or None to generate one of `layout` and `junction`.
        windows: how many to choose.
        settings: of the data set.
        folder: where the file goes.
    """

    name: str
    seeds: tuple[int, ...]
    net: str | None
    layout: str
    junction: str
    windows: int
    settings: SimSettings
    folder: str


def simulate_network(task: Task) -> SetEntry:
    """Simulate one network and write its track set.

    Raises:
        DataError: a network that cannot be built, read or driven on.
        MissingExtraError: SUMO or Pillow is not installed.
    """
    streams = np.random.default_rng(list(task.seeds)).spawn(4)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        plan = StreetPlan(task.layout, task.junction)
        net = Path(task.net) if task.net else build_streets(plan, folder, streams[0])
        roads = read_roadmap(net)
        recording = run_traffic(net, roads, task.settings, folder, streams[1])
    canvas = draw(roads, task.settings.resolution)
    parked = rec.park(roads, canvas, task.settings, streams[2])
    tracks = rec.join(rec.cut_tracks(recording), parked)
    track_set = _observe(task, tracks, streams[3]) | {
        "raster": canvas.to_int8(),
        "channels": MAP_CHANNELS,
        "origin": canvas.origin.astype(np.float32),
        "resolution": canvas.resolution,
        "stops": roads.stops[:, :3].astype(np.float32),
        "name": task.name,
    }
    made = TrackSet(**track_set)  # type: ignore[arg-type]
    made.save(Path(task.folder) / f"{task.name}.npz")
    network = Path(task.net).name if task.net else plan.label
    return SetEntry(f"{task.name}.npz", network, len(made.windows), made.count, len(made.truth))


def _observe(task: Task, tracks: rec.Tracks, rng: np.random.Generator) -> dict[str, object]:
    noise = task.settings.noise
    truth = rec.on_grid(tracks.state)
    seen = rec.detections(len(truth), noise, rng)
    return {
        "truth": truth,
        "observed": rec.perceive(truth, noise, rng),
        "seen": seen,
        "label": rec.on_grid(truth[:, :2] + noise.label * rng.normal(size=(len(truth), 2))),
        "track_start": tracks.start.astype(np.int64),
        "track_step": tracks.step.astype(np.int32),
        "size": tracks.size.astype(np.float32),
        "kind": np.full(len(tracks.step), VEHICLE, np.uint8),
        "parked": tracks.parked,
        "windows": rec.choose_windows(tracks, seen, task.windows, task.settings, rng),
    }


def main() -> int:
    """Read a Task, simulate, leave its SetEntry as `NAME.json` beside the set."""
    try:
        task = msgspec.json.decode(sys.stdin.buffer.read(), type=Task)
        entry = simulate_network(task)
    except (HcnafError, msgspec.DecodeError) as error:
        sys.stderr.write(f"{error}\n")
        return 2
    (Path(task.folder) / f"{task.name}.json").write_bytes(msgspec.json.encode(entry))
    return 0


if __name__ == "__main__":
    sys.exit(main())
