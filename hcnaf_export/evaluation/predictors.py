"""Things that give densities to the labels of windows: a bundle, a checkpoint (and `hcnaf_export.baselines`)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray

from hcnaf_export.baselines import label_steps, labels
from hcnaf_export.checkpoint import Checkpoint
from hcnaf_export.data.tracks import TrackSet
from hcnaf_export.training.pom import score
from hcnaf_export.training.sampling import FixedWindows
from hcnaf_export.training.windows import WindowPool
from hcnaf_models.config import PomConfig
from hcnaf_runtime.errors import CheckpointError, HorizonError
from hcnaf_runtime.forecaster import Forecaster
from hcnaf_runtime.scene import Scene

Float = NDArray[np.float64]
Windows = NDArray[np.int32]

NEIGHBOURS = 32
"""Others given to a checkpoint, nearest first; it picks those it reads."""


class Predictor(Protocol):
    """A conditional density of future positions."""

    @property
    def name(self) -> str:
        """What it is called in tables."""

    def nll(self, tracks: TrackSet, windows: Windows, horizons: Sequence[float]) -> Float:
        """-log p of the recorded labels (nats per m²), [W, Q], of windows [W, 2] (track, step) at horizons (s)."""


@runtime_checkable
class Sampler(Protocol):
    """What can draw paths too."""

    @property
    def draws(self) -> bool:
        """Whether this one can."""

    def paths(self, tracks: TrackSet, windows: Windows, horizons: Sequence[float], count: int) -> Float:
        """`count` paths per window [W, count, Q, 2] (m, the network's frame), horizons coupled by quantiles."""


class BundlePredictor:
    """An exported bundle on the path a vehicle takes: one `Scene` per window, its ego the only target.

    The scene is what `TrackSet.scene` makes of it: agents within 60 m, the map within 80 m.
    """

    def __init__(self, forecaster: Forecaster, name: str = "bundle") -> None:
        self.forecaster, self.name = forecaster, name

    def nll(self, tracks: TrackSet, windows: Windows, horizons: Sequence[float]) -> Float:
        """See `Predictor.nll`."""
        points = labels(tracks, windows, horizons)
        out = np.empty((len(windows), len(horizons)))
        for i, (scene, centre) in enumerate(_scenes(tracks, windows)):
            local = (points[i] - centre)[None, :, None, :]
            out[i] = -self.forecaster.log_prob(scene, local, horizons, frame="scene")[0, :, 0]
        return out

    @property
    def draws(self) -> bool:
        """See `Sampler.draws`: bundles from before there were samples cannot."""
        return "inverse" in self.forecaster.bundle.manifest.graphs

    def paths(self, tracks: TrackSet, windows: Windows, horizons: Sequence[float], count: int) -> Float:
        """See `Sampler.paths`. A window's draws are the same whatever other windows are scored."""
        out = np.empty((len(windows), count, len(horizons), 2))
        for i, (scene, centre) in enumerate(_scenes(tracks, windows)):
            track, step = windows[i].tolist()
            seed = track * 1_000_003 + step
            made = self.forecaster.trajectories(scene, count, horizons, seed, "scene")
            out[i] = made.points[0].transpose(1, 0, 2) + centre
        return out


def _scenes(tracks: TrackSet, windows: Windows) -> Iterator[tuple[Scene, Float]]:
    """Each window's scene with its ego the only target, and where the scene's origin is in the network's frame."""
    for track, step in windows.tolist():
        centre = tracks.observed[tracks.rows(track, step), :2].astype(np.float64)
        yield tracks.scene(track, step, max_targets=1), centre


class CheckpointPredictor:
    """A checkpoint, in batches through PyTorch: fast, and the yardstick of the bundle.

    Raises:
        CheckpointError: not a model of occupancy forecasts.
    """

    def __init__(self, checkpoint: Checkpoint, name: str = "checkpoint", device: str = "cpu") -> None:
        if not isinstance(checkpoint.config, PomConfig):
            raise CheckpointError(
                f"the checkpoint is of kind {checkpoint.config.kind}, tracks need a model of kind pom"
            )
        self.name, self.config, self.device = name, checkpoint.config, torch.device(device)
        self.model = checkpoint.model.to(self.device)

    def nll(self, tracks: TrackSet, windows: Windows, horizons: Sequence[float]) -> Float:
        """See `Predictor.nll`."""
        label_steps(horizons)
        if max(horizons) > self.config.horizon + 1e-6:
            raise HorizonError(
                f"horizon {max(horizons):g} s, the model was trained up to {self.config.horizon:g} s; ask for less"
            )
        pool = WindowPool([replace(tracks, windows=windows)], self.config, NEIGHBOURS)
        return score(self.model, FixedWindows(pool, tuple(horizons)), self.device)
