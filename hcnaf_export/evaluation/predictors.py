"""An exported bundle as a predictor (`checkpoint_predictor` and `hcnaf_export.baselines` have others)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from hcnaf_export.baselines import labels
from hcnaf_export.data.tracks import TrackSet
from hcnaf_export.evaluation.capabilities import Float, Float32, Int, Windows
from hcnaf_export.evaluation.capabilities import Predictor as Predictor
from hcnaf_export.evaluation.capabilities import Sampler as Sampler
from hcnaf_runtime import frames
from hcnaf_runtime.forecaster import Forecaster
from hcnaf_runtime.grid import Grid
from hcnaf_runtime.scene import Scene

TOLERANCE = 1e-4
"""Of a cell's mass: reliability tells nothing finer."""


class BundlePredictor:
    """An exported bundle on the path a vehicle takes: one `Scene` per window, its ego the only target.

    The scene is what `TrackSet.scene` makes of it: agents within 60 m, the map within 80 m. Samples are the same
    whatever other windows are scored. See `capabilities` for what the methods give.
    """

    def __init__(self, forecaster: Forecaster, name: str = "bundle") -> None:
        self.forecaster, self.name = forecaster, name

    @property
    def draws(self) -> bool:
        """Bundles from before there were samples cannot."""
        return self._has("inverse")

    @property
    def transforms(self) -> bool:
        """Flows of two dimensions can."""
        return self._has("marginal_cdf", "conditional_cdf")

    @property
    def maps(self) -> bool:
        """Flows of two dimensions can."""
        return self._has("cell_mass")

    def nll(self, tracks: TrackSet, windows: Windows, horizons: Sequence[float]) -> Float:
        """See `Predictor.nll`."""
        points = labels(tracks, windows, horizons)
        out = np.empty((len(windows), len(horizons)))
        for i, (scene, centre) in enumerate(_scenes(tracks, windows)):
            local = (points[i] - centre)[None, :, None, :]
            out[i] = -self.forecaster.log_prob(scene, local, horizons, frame="scene")[0, :, 0]
        return out

    def paths(self, tracks: TrackSet, windows: Windows, horizons: Sequence[float], count: int) -> Float:
        """See `Sampler.paths`."""
        out = np.empty((len(windows), count, len(horizons), 2))
        for i, (scene, centre) in enumerate(_scenes(tracks, windows)):
            made = self.forecaster.trajectories(scene, count, horizons, seed_of(windows[i]), "scene")
            out[i] = made.points[0].transpose(1, 0, 2) + centre
        return out

    def drawn_log_prob(self, tracks: TrackSet, windows: Windows, horizons: Sequence[float], count: int) -> Float32:
        """See `Drawer.drawn_log_prob`."""
        drawn = [
            self.forecaster.sample(scene, count, horizons, seed_of(window)).log_prob[0]
            for window, (scene, _) in zip(windows, _scenes(tracks, windows), strict=True)
        ]
        return np.stack(drawn)

    def pit(self, tracks: TrackSet, windows: Windows, horizons: Sequence[float]) -> Float:
        """See `Transformer.pit`."""
        out = np.empty((len(windows), len(horizons), 2))
        for i, (scene, points) in enumerate(self._labelled(tracks, windows, horizons)):
            out[i] = self.forecaster.cdf(scene, points[None, :, None], horizons)[0, :, 0]
        return out

    def cells(
        self, tracks: TrackSet, windows: Windows, horizons: Sequence[float], grid: Grid
    ) -> tuple[Float32, Int]:
        """See `Mapper.cells`. Cells are exact up to TOLERANCE."""
        mass = np.empty((len(windows), len(horizons), grid.height, grid.width), np.float32)
        where = np.empty((len(windows), len(horizons)), np.int64)
        for i, (scene, points) in enumerate(self._labelled(tracks, windows, horizons)):
            mass[i] = self.forecaster.pom(scene, grid, horizons, tolerance=TOLERANCE).mass[0]
            where[i] = cell_of(points, grid)
        return mass, where

    def _has(self, *graphs: str) -> bool:
        return set(graphs) <= set(self.forecaster.bundle.manifest.graphs)

    def _labelled(
        self, tracks: TrackSet, windows: Windows, horizons: Sequence[float]
    ) -> Iterator[tuple[Scene, Float]]:
        """Each window's scene, and its labels [Q, 2] in the agent's frame (m)."""
        points = labels(tracks, windows, horizons)
        for i, (scene, centre) in enumerate(_scenes(tracks, windows)):
            yield scene, frames.to_agent(points[i] - centre, self.forecaster.theta(scene, horizons).pose[0])


def cell_of(points: Float, grid: Grid) -> Int:
    """The cell of `grid` that holds each of `points` [..., 2] (m): row-major, -1 where none does."""
    column, row = np.moveaxis(np.floor((points - grid.corners[0]) / grid.resolution).astype(np.int64), -1, 0)
    inside = (column >= 0) & (column < grid.width) & (row >= 0) & (row < grid.height)
    return np.where(inside, row * grid.width + column, -1)


def _scenes(tracks: TrackSet, windows: Windows) -> Iterator[tuple[Scene, Float]]:
    """Each window's scene with its ego the only target, and where the scene's origin is in the network's frame."""
    for track, step in windows.tolist():
        centre = tracks.observed[tracks.rows(track, step), :2].astype(np.float64)
        yield tracks.scene(track, step, max_targets=1), centre


def seed_of(window: Windows) -> int:
    """What a window's draws follow from."""
    track, step = window.tolist()
    return int(track * 1_000_003 + step)
