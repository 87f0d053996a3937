"""A checkpoint as a predictor, through PyTorch."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from hcnaf_export.baselines import label_steps
from hcnaf_export.checkpoint import Checkpoint
from hcnaf_export.data.tracks import TrackSet
from hcnaf_export.evaluation.capabilities import Float, Float32, Int, Windows
from hcnaf_export.evaluation.predictors import TOLERANCE, cell_of, seed_of
from hcnaf_export.evaluation.torch_plane import TorchPlane
from hcnaf_export.training.loop import to_device
from hcnaf_export.training.pom import score, theta_of
from hcnaf_export.training.sampling import FixedWindows
from hcnaf_export.training.windows import PomBatch, WindowPool
from hcnaf_models import planar
from hcnaf_models.config import PomConfig
from hcnaf_models.geometry import pose_of
from hcnaf_models.mlp import Head
from hcnaf_runtime import frames
from hcnaf_runtime.cells import masses
from hcnaf_runtime.errors import CheckpointError, HorizonError
from hcnaf_runtime.grid import Grid
from hcnaf_runtime.plane import Window

NEIGHBOURS = 32
"""Others given to a checkpoint, nearest first; it picks those it reads."""

BATCH = 64
"""Windows whose samples are drawn together."""


@runtime_checkable
class DistributionHead(Protocol):
    """A density head with distribution functions."""

    def cdf(self, theta: Tensor, x: Tensor) -> Tensor:
        """F_1(x) and F_2(y given x) [..., N, 2] for theta [..., P] and x [..., N, 2] (m)."""


class CheckpointPredictor:
    """A checkpoint, in batches through PyTorch: fast, and the yardstick of the bundle.

    It draws with any head of `hcnaf_models.heads`, transforms with HCNAF and any `DistributionHead`, and maps with
    HCNAF. See `capabilities` for what the methods give.

    Raises:
        CheckpointError: not a model of occupancy forecasts.
    """

    draws = True

    def __init__(self, checkpoint: Checkpoint, name: str = "checkpoint", device: str = "cpu") -> None:
        if not isinstance(checkpoint.config, PomConfig):
            raise CheckpointError(
                f"the checkpoint is of kind {checkpoint.config.kind}, tracks need a model of kind pom"
            )
        self.name, self.config, self.device = name, checkpoint.config, torch.device(device)
        self.model = checkpoint.model.to(self.device)

    @property
    def transforms(self) -> bool:
        """Whether the head has distribution functions."""
        return isinstance(self.model.head, Head | DistributionHead)

    @property
    def maps(self) -> bool:
        """Whether the head is HCNAF's."""
        return isinstance(self.model.head, Head)

    def nll(self, tracks: TrackSet, windows: Windows, horizons: Sequence[float]) -> Float:
        """See `Predictor.nll`."""
        return score(self.model, self._fixed(tracks, windows, horizons), self.device)

    @torch.no_grad()
    def paths(self, tracks: TrackSet, windows: Windows, horizons: Sequence[float], count: int) -> Float:
        """See `Sampler.paths`."""
        parts = []
        for some, batch, theta in self.batches(tracks, windows, horizons):
            uniform = self.uniform(some, (1, count)).expand(-1, len(horizons), -1, -1)
            local = self.model.head.sample(theta, uniform).transpose(1, 2).double().cpu().numpy()
            poses = pose_of(batch.reference).double().cpu().numpy()
            parts.append(np.stack([frames.to_scene(p, pose) for p, pose in zip(local, poses, strict=True)]))
        return np.concatenate(parts)

    @torch.no_grad()
    def drawn_log_prob(self, tracks: TrackSet, windows: Windows, horizons: Sequence[float], count: int) -> Float32:
        """See `Drawer.drawn_log_prob`."""
        parts = []
        for some, _, theta in self.batches(tracks, windows, horizons):
            points = self.model.head.sample(theta, self.uniform(some, (len(horizons), count)))
            parts.append(self.model.log_prob(theta, points).cpu().numpy())
        return np.concatenate(parts)

    @torch.no_grad()
    def pit(self, tracks: TrackSet, windows: Windows, horizons: Sequence[float]) -> Float:
        """See `Transformer.pit`."""
        found = [
            self._cdf(theta, batch.points)[:, :, 0].double().cpu().numpy()
            for _, batch, theta in self.batches(tracks, windows, horizons)
        ]
        return np.concatenate(found)

    @torch.no_grad()
    def cells(
        self, tracks: TrackSet, windows: Windows, horizons: Sequence[float], grid: Grid
    ) -> tuple[Float32, Int]:
        """See `Mapper.cells`. Cells are exact up to TOLERANCE."""
        head = self.model.head
        assert isinstance(head, Head)
        plane, window = TorchPlane(head.spec, self.device), Window(grid.x_edges, grid.y_edges)
        mass, where = [], []
        for _, batch, theta in self.batches(tracks, windows, horizons):
            found = masses(plane, theta.flatten(0, 1).cpu().numpy(), window, TOLERANCE).mass
            mass.append(found.reshape(*theta.shape[:2], grid.height, grid.width))
            where.append(cell_of(batch.points[:, :, 0].double().cpu().numpy(), grid))
        return np.concatenate(mass), np.concatenate(where)

    def _cdf(self, theta: Tensor, x: Tensor) -> Tensor:
        head = self.model.head
        if isinstance(head, DistributionHead):
            return head.cdf(theta, x)
        assert isinstance(head, Head)
        flat, points = theta.flatten(0, 1), x.flatten(0, 1)
        first = planar.marginal_cdf(head.spec, flat, points[..., 0])
        second = planar.conditional_cdf(head.spec, flat, points[..., 0], points[..., 1:])
        return torch.unflatten(torch.stack([first, second[..., 0]], dim=-1), 0, theta.shape[:2])

    def _fixed(
        self, tracks: TrackSet, windows: Windows, horizons: Sequence[float], batch: int = 256
    ) -> FixedWindows:
        label_steps(horizons)
        if max(horizons) > self.config.horizon + 1e-6:
            raise HorizonError(
                f"horizon {max(horizons):g} s, the model was trained up to {self.config.horizon:g} s; ask for less"
            )
        pool = WindowPool([replace(tracks, windows=windows)], self.config, NEIGHBOURS)
        return FixedWindows(pool, tuple(horizons), batch=batch)

    def batches(
        self, tracks: TrackSet, windows: Windows, horizons: Sequence[float]
    ) -> Iterator[tuple[Windows, PomBatch, Tensor]]:
        """Windows [B, 2], their batch and theta [B, Q, P], a few at a time."""
        fixed = self._fixed(tracks, windows, horizons, BATCH)
        for k in range(len(fixed)):
            batch = to_device(fixed.batch(k), self.device)
            yield windows[k * BATCH : (k + 1) * BATCH], batch, theta_of(self.model, batch)

    def uniform(self, windows: Windows, shape: tuple[int, ...]) -> Tensor:
        """In (0, 1), [B, *shape, uniforms]: the same for a window whatever other windows there are."""
        full = (*shape, self.model.head.uniforms)
        drawn = [np.random.default_rng(seed_of(w)).random(full) for w in windows]
        highest = 1.0 - 2.0**-24
        return torch.from_numpy(np.stack(drawn).clip(1e-30, highest).astype(np.float32)).to(self.device)
