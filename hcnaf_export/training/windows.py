"""Training windows: from track sets to batches of tensors, all windows of a batch at once.

    list[TrackSet] ── WindowPool ──> rows of every window ── batch(indices) ──> PomBatch

All track sets are laid one after the other, and the rows that a window touches are looked up once, when the
pool is made: a batch is then a few gathers, some noise, and one crop of the map per network.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hcnaf_export.data.tracks import FUTURE, STEP, NoiseModel, TrackSet
from hcnaf_models.config import PomConfig
from hcnaf_models.geometry import pose_of
from hcnaf_models.pom import to_target_frame
from hcnaf_models.raster import crop_raster
from hcnaf_runtime.errors import DataError

Int = NDArray[np.int64]
Float = NDArray[np.float32]

_CHUNK = 2048


class PomBatch(NamedTuple):
    """What `PomHyperNet` takes, and the points to score. States and poses in the network's frame."""

    reference: Tensor  # [B, T, 5]
    reference_size: Tensor  # [B, 2]
    horizons: Tensor  # [B, Q], s
    others: Tensor  # [B, N, T, 5], NaN where not observed
    others_size: Tensor  # [B, N, 2]
    stops: Tensor | None  # [B, S, 3], NaN padded
    crop: Tensor | None  # [B, C + 1, rows, columns]
    points: Tensor  # [B, Q, M, 2], labels in the target's frame


class Rows(NamedTuple):
    """Row numbers in the pool's arrays of the agents of some windows, the target first."""

    past: Int  # [B, 1 + N, T], -1 where absent
    now: Int  # [B], the target's row now; its future rows follow it


class WindowPool:
    """All windows of some track sets, ready to be drawn from.

    Args:
        sets: track sets of one split.
        config: the model's configuration: history length, raster channels, crop, stop lines.
        neighbours: how many of the nearest others a window holds.

    Raises:
        DataError: no windows, a raster channel the model reads is missing, or another time step.
    """

    def __init__(self, sets: Sequence[TrackSet], config: PomConfig, neighbours: int) -> None:
        _check(sets, config)
        self.config = config
        base = np.cumsum([0] + [len(s.truth) for s in sets])
        self.truth = np.concatenate([s.truth for s in sets])
        self.observed = np.concatenate([s.observed for s in sets])
        self.label = np.concatenate([s.label for s in sets])
        self.seen = np.concatenate([s.seen for s in sets])
        self.set = np.repeat(np.arange(len(sets)), [len(s.windows) for s in sets])
        self.step = np.concatenate([s.windows[:, 1] for s in sets])
        parts = [_agents(s, int(b), neighbours) for s, b in zip(sets, base, strict=False)]
        self.spans = np.concatenate([spans for spans, _ in parts])
        self.size = np.concatenate([size for _, size in parts])
        self.maps = [_map_of(s, config) for s in sets] if config.channels else []
        self.lines = _stop_lines(sets) if config.stops else None

    def __len__(self) -> int:
        return len(self.set)

    def rows(self, index: Int, shift: int = 0, rng: np.random.Generator | None = None) -> Rows:
        """The rows of some windows [B], each moved in time by up to `shift` steps where the track allows."""
        now, first, last = self.spans[index].astype(np.int64).transpose(2, 0, 1)  # [B, 1 + N] each
        if shift and rng is not None:
            T = self.config.history
            low = np.maximum(-shift, first[:, 0] + T - 1 - now[:, 0])
            high = np.minimum(shift, last[:, 0] - FUTURE - now[:, 0])
            now = now + rng.integers(low, high + 1)[:, None]
        past = now[..., None] + np.arange(1 - self.config.history, 1)
        known = (past >= first[..., None]) & (past <= last[..., None])
        return Rows(np.where(known, past, -1), now[:, 0])

    def recorded(self, rows: Rows) -> Float:
        """Histories as recorded: [B, 1 + N, T, 5], NaN where not observed."""
        return states(self.observed[rows.past], (rows.past >= 0) & self.seen[rows.past])

    def batch(self, index: Int, past: Float, horizons: Float, points: Float) -> PomBatch:
        """Tensors of some windows.

        Args:
            index: [B] windows.
            past: [B, 1 + N, T, 5] histories, the target first.
            horizons: [B, Q] s.
            points: [B, Q, M, 2] labels in the network's frame.
        """
        agents = torch.from_numpy(past)
        size = torch.from_numpy(self.size[index])
        reference = agents[:, 0]
        return PomBatch(
            reference,
            size[:, 0],
            torch.from_numpy(horizons),
            agents[:, 1:],
            size[:, 1:],
            None if self.lines is None else self.lines[torch.from_numpy(self.set[index])],
            self.crop(index, pose_of(reference)) if self.maps else None,
            to_target_frame(torch.from_numpy(points), reference),
        )

    def crop(self, index: Int, pose: Tensor) -> Tensor:
        """The map around each pose [B, 3]: [B, C + 1, rows, columns]."""
        crop = self.config.crop
        out = pose.new_empty(len(index), len(self.config.channels) + 1, crop.rows, crop.columns)
        which = self.set[index]
        for s in np.unique(which):
            mine = torch.from_numpy(np.flatnonzero(which == s))
            raster, origin, resolution = self.maps[s]
            out[mine] = crop_raster(raster, origin, resolution, pose[mine], crop)
        return out


class Perception:
    """The recorded noise model, drawn anew: an augmentation with the statistics of the recording."""

    def __init__(self, noise: NoiseModel) -> None:
        self.scale = np.array([noise.position, noise.position, noise.yaw, noise.speed], np.float32)
        self.drop = noise.drop
        self.gap = max(noise.drop_length, 1.0)

    def draw(self, truth: Float, present: NDArray[np.bool_], rng: np.random.Generator) -> Float:
        """Histories [B, 1 + N, T, 5] from truth [B, 1 + N, T, 4]; the target (agent 0) is seen now."""
        noisy = truth + self.scale * rng.standard_normal(truth.shape, dtype=np.float32)
        noisy[..., 3] = np.maximum(noisy[..., 3], 0.0)
        return states(noisy, present & self._seen(present.shape, rng))

    def _seen(self, shape: tuple[int, ...], rng: np.random.Generator) -> NDArray[np.bool_]:
        """A stationary two-state Markov chain, run backwards from now (it is reversible)."""
        u = rng.random(shape, dtype=np.float32)
        seen = np.ones(shape, bool)
        if self.drop <= 0.0:
            return seen
        lose, find = self.drop / ((1.0 - self.drop) * self.gap), 1.0 / self.gap
        seen[:, 1:, -1] = u[:, 1:, -1] >= self.drop
        for t in range(shape[-1] - 2, -1, -1):
            seen[..., t] = np.where(seen[..., t + 1], u[..., t] >= lose, u[..., t] < find)
        return seen


def states(values: Float, known: NDArray[np.bool_]) -> Float:
    """x, y, yaw, speed [..., 4] -> x, y, sin, cos, speed [..., 5], NaN where not known."""
    x, y, yaw, speed = np.moveaxis(values, -1, 0)
    out = np.stack([x, y, np.sin(yaw), np.cos(yaw), speed], axis=-1)
    out[~known] = np.nan
    return out


def _agents(tracks: TrackSet, base: int, neighbours: int) -> tuple[NDArray[np.int32], Float]:
    """The target and its neighbours: rows in the pool now, first and last of their tracks [W, 1 + N, 3], and sizes
    [W, 1 + N, 2]. Where there is no neighbour its track is empty (first > last)."""
    spans, sizes = [], []
    for i in range(0, len(tracks.windows), _CHUNK):
        track, step = tracks.windows[i : i + _CHUNK].astype(np.int64).T
        others = tracks.neighbours(track, step, neighbours, seen_only=False)
        agents = np.concatenate([track[:, None], others], axis=1)
        known = agents >= 0
        now = tracks.rows(agents, step[:, None])
        first, last = tracks.track_start[agents], tracks.track_start[agents + 1] - 1
        span = np.stack([now, first, last], axis=-1) + base
        spans.append(np.where(known[..., None], span, [0, 0, -1]).astype(np.int32))
        sizes.append(np.where(known[..., None], tracks.size[agents], 1.0).astype(np.float32))
    return np.concatenate(spans), np.concatenate(sizes)


def _map_of(tracks: TrackSet, config: PomConfig) -> tuple[Tensor, Tensor, Tensor]:
    """The raster (float32 in [-1, 1], the model's channels), its origin and resolution."""
    planes = [tracks.channels.index(name) for name in config.channels]
    origin, resolution = torch.tensor(tracks.origin), torch.tensor([tracks.resolution])
    return torch.from_numpy(tracks.raster[planes]).float() / 127.0, origin, resolution


def _stop_lines(sets: Sequence[TrackSet]) -> Tensor:
    """[sets, S, 3], NaN padded."""
    longest = max(1, *(len(s.stops) for s in sets))
    padded = [np.pad(s.stops, ((0, longest - len(s.stops)), (0, 0)), constant_values=np.nan) for s in sets]
    return torch.from_numpy(np.stack(padded))


def _check(sets: Sequence[TrackSet], config: PomConfig) -> None:
    if not sum(len(s.windows) for s in sets):
        raise DataError("no windows to read; simulate a data set with windows in this split")
    if abs(config.step - STEP) > 1e-6 or any(abs(s.step - config.step) > 1e-6 for s in sets):
        raise DataError(f"tracks are {STEP} s apart, the model's history step is {config.step} s; make them equal")
    for s in sets:
        missing = sorted(set(config.channels) - set(s.channels))
        if missing:
            raise DataError(f"{s.name} has no raster channel {missing[0]!r}, it has {', '.join(s.channels)}")
