"""Scenes of a data set as inputs of a hyper-network: some to fix ranges on, others to measure the cost on."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hcnaf_export.data.tracks import Dataset, TrackSet
from hcnaf_export.probes import Feeds
from hcnaf_runtime.errors import DataError
from hcnaf_runtime.inputs import scene_feeds
from hcnaf_runtime.manifest import Manifest
from hcnaf_runtime.scene import Scene

SCENES = 64
"""How many scenes are read, half to calibrate and half to measure."""
TARGETS = 2
HORIZONS = (0.25, 0.5, 1.0)
"""Shares of the longest horizon that forecasts are compared at."""


def scenes(data: Path, count: int = SCENES) -> list[Scene]:
    """About `count` scenes of the split "val", evenly over its windows. Raises DataError if there are none."""
    sets = [tracks for tracks in Dataset(data).split("val") if len(tracks.windows)]
    if not sets:
        raise DataError(f"{data}: no windows in the split 'val', expected some to calibrate on; simulate more")
    return [scene for tracks in sets for scene in _some(tracks, -(-count // len(sets)))]


def _some(tracks: TrackSet, count: int) -> list[Scene]:
    chosen = np.unique(np.linspace(0, len(tracks.windows) - 1, count).astype(int))
    return [tracks.scene(int(t), int(s), max_targets=TARGETS) for t, s in tracks.windows[chosen]]


def feeds(manifest: Manifest, found: Sequence[Scene]) -> tuple[list[Feeds], list[Feeds]]:
    """Inputs of the hyper-network for `found`: every other to calibrate on, the rest to measure on.

    Raises SceneError where the scenes are not what the model was trained for.
    """
    assert manifest.horizons is not None
    horizons = np.array([share * manifest.horizons.max for share in HORIZONS], np.float32)
    names = [tensor.name for tensor in manifest.graphs["hypernet"].inputs]
    every = [scene_feeds(manifest, scene, horizons).tensors for scene in found]
    picked = [{name: tensors[name] for name in names} for tensors in every]
    return picked[::2], picked[1::2] or picked
