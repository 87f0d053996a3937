"""PRECOG-CARLA's layout on a small scale, without a simulator: cars on circles that all stay to the end."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np

from hcnaf_export.data.precog_write import episodes
from hcnaf_export.data.tracks import TrackSet
from tests.export import synthetic

ROWS = 120


def traffic(seed: int = 0, count: int = 8) -> TrackSet:
    """Tracks that begin together and last ten seconds and more; windows where an episode fits."""
    made = synthetic.tracks(seed, count=count, rows=ROWS)
    windows = [(i, step) for i in range(count) for step in range(18, ROWS - 80, 3)]
    return replace(made, track_step=np.zeros(count, np.int32), windows=np.array(windows, np.int32))


def write(root: Path, counts: tuple[int, int, int] = (6, 3, 3)) -> Path:
    """`root` with so many episodes of each split."""
    for seed, (split, count) in enumerate(zip(("train", "val", "test"), counts, strict=True)):
        (root / split).mkdir(parents=True)
        for k, record in enumerate(episodes(traffic(seed), count, np.random.default_rng(seed))):
            (root / split / f"ma_datum_{k:08d}.json").write_bytes(msgspec.json.encode(record))
    return root
