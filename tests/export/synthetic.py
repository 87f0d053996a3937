"""A small data set made on the spot: cars on circles of different radii, so that there is something to learn."""

from pathlib import Path

import msgspec
import numpy as np

from hcnaf_export.data.tracks import FUTURE, HISTORY, STEP, Manifest, NoiseModel, SetEntry, TrackSet
from hcnaf_models.config import MAP_CHANNELS

NOISE = NoiseModel(position=0.1, yaw=0.02, speed=0.2, drop=0.1, drop_length=2.0, label=0.1)


def tracks(seed=0, count=12, rows=70, noise=NOISE, name="made"):
    """Tracks on circles, each present for `rows` steps from its own first one."""
    rng = np.random.default_rng(seed)
    first = rng.integers(0, 120, count).astype(np.int32)
    speed = rng.uniform(3.0, 10.0, count)
    turn = rng.uniform(-0.3, 0.3, count)
    time = STEP * np.arange(rows)
    yaw = rng.uniform(-np.pi, np.pi, count)[:, None] + turn[:, None] * time
    velocity = speed[:, None, None] * np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)
    place = rng.uniform(30.0, 90.0, (count, 1, 2)) + np.cumsum(velocity, axis=1) * STEP
    state = np.concatenate(
        [place, yaw[..., None], np.broadcast_to(speed[:, None, None], (count, rows, 1))], axis=-1
    )
    truth = state.reshape(-1, 4).astype(np.float32)
    scale = [noise.position, noise.position, noise.yaw, noise.speed]
    seen = rng.random(len(truth)) >= noise.drop
    windows = [(i, int(first[i]) + now) for i in range(count) for now in range(HISTORY - 1, rows - FUTURE, 2)]
    windows = [(i, s) for i, s in windows if seen[i * rows + s - first[i]]]
    return TrackSet(
        truth=truth,
        observed=(truth + rng.normal(size=truth.shape) * scale).astype(np.float32),
        seen=seen,
        label=(truth[:, :2] + noise.label * rng.normal(size=(len(truth), 2))).astype(np.float32),
        track_start=np.arange(count + 1) * rows,
        track_step=first,
        size=rng.uniform([3.5, 1.6], [6.0, 2.2], (count, 2)).astype(np.float32),
        kind=np.ones(count, np.uint8),
        parked=np.zeros(count, bool),
        raster=rng.integers(-127, 128, (len(MAP_CHANNELS), 240, 300)).astype(np.int8),
        channels=MAP_CHANNELS,
        origin=np.array([-10.0, 5.0], np.float32),
        resolution=0.5,
        stops=np.array([[50.0, 50.0, 0.3]], np.float32),
        windows=np.array(windows, np.int32),
        name=name,
    )


def write(directory: Path) -> Path:
    """A data set of two training networks and one of each other split."""
    directory.mkdir(parents=True)
    splits = {"train": (1, 2), "val": (3,), "test": (4,)}
    entries = {}
    for split, seeds in splits.items():
        entries[split] = []
        for seed in seeds:
            made = tracks(seed, name=f"{split}-{seed}")
            made.save(directory / f"{made.name}.npz")
            size = {"windows": len(made.windows), "tracks": made.count, "rows": len(made.truth)}
            entries[split].append(SetEntry(file=f"{made.name}.npz", network="circles", **size))
    manifest = Manifest(
        format="hcnaf-tracks", version=1, seed=0, splits=entries, noise=NOISE, nll_floor=NOISE.label_entropy,
        step=STEP, history=HISTORY, future=FUTURE, settings={}, software={},
    )  # fmt: skip
    (directory / "dataset.json").write_bytes(msgspec.json.encode(manifest))
    return directory
