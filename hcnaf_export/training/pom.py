"""Learning occupancy forecasts: windows in, negative log-likelihood out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hcnaf_export.data.tracks import FUTURE, STEP, Dataset
from hcnaf_export.recipe import PomRecipe
from hcnaf_export.training.loop import to_device
from hcnaf_export.training.sampling import FixedWindows, WindowSampler
from hcnaf_export.training.share import WHOLE, Share
from hcnaf_export.training.windows import PomBatch, WindowPool
from hcnaf_models import fused
from hcnaf_models.config import PomConfig
from hcnaf_models.mlp import Head
from hcnaf_models.model import Hcnaf
from hcnaf_models.pom import PomHyperNet
from hcnaf_runtime.errors import RecipeError

FUSED_FROM = 32
"""Hidden units from which the derivative that is written out is faster than the automatic one."""

VALIDATION_HORIZONS = (0.5, 1.0, 2.0, 3.0, 4.0)


class PomTask:
    """`Task` of a POM recipe on a data set. Scores: nats per m² at each validation horizon, and their mean."""

    def __init__(self, recipe: PomRecipe, data: Path, device: torch.device) -> None:
        config, settings = recipe.model, recipe.windows
        _check(config)
        dataset = Dataset(data)
        self.device = device
        pool = WindowPool(dataset.split("train"), config, settings.neighbours)
        noise = dataset.manifest.noise
        self.sampler = WindowSampler(pool, settings, noise, recipe.optimiser.batch, recipe.seed)
        horizons = tuple(t for t in VALIDATION_HORIZONS if t <= config.horizon) or (config.horizon,)
        held_out = WindowPool(dataset.split("val"), config, settings.neighbours)
        self.held_out = FixedWindows(held_out, horizons, settings.validation)
        self.examples = self.sampler.size
        self.facts: dict[str, Any] = {
            "data": dataset.directory.name,
            "data_seed": dataset.manifest.seed,
            "windows": len(pool),
            "optional_channels": [
                c for c in config.channels if c in settings.optional and settings.no_channel > 0.0
            ],
            "networks": len(pool.maps) or None,
            "nll_floor": dataset.manifest.nll_floor,
        }

    def batch(self, step: int, share: Share = WHOLE) -> PomBatch:
        """Training windows of a step."""
        return self.sampler.batch(step, share)

    def loss(self, model: Hcnaf, batch: PomBatch) -> Tensor:
        """Mean over windows, horizons and draws, nats per m²."""
        return loss(model, batch)

    def validate(self, model: Hcnaf) -> dict[str, float]:
        """Mean NLL of the recorded labels of held-out networks."""
        values = score(model, self.held_out, self.device).mean(axis=0)
        scores = {f"{t:g} s": float(v) for t, v in zip(self.held_out.horizons, values, strict=True)}
        return scores | {"mean": float(values.mean())}


def log_prob(model: Hcnaf, batch: PomBatch) -> Tensor:
    """log p of a batch's points, [B, Q, M] in nats per m²."""
    return model.log_prob(theta_of(model, batch), batch.points)


def loss(model: Hcnaf, batch: PomBatch) -> Tensor:
    """Mean of -log p over windows, horizons and draws, nats per m²."""
    head = model.head
    if isinstance(head, Head) and head.spec.hidden >= FUSED_FROM:
        theta = theta_of(model, batch).flatten(0, 1)
        return -fused.log_prob(head.spec, theta, batch.points.flatten(0, 1)).mean()
    return -log_prob(model, batch).mean()


def theta_of(model: Hcnaf, batch: PomBatch) -> Tensor:
    """theta [B, Q, P] of a batch's windows and horizons."""
    hypernet = model.hypernet
    assert isinstance(hypernet, PomHyperNet)
    theta: Tensor = hypernet(
        batch.reference,
        batch.reference_size,
        batch.horizons,
        others=batch.others,
        others_size=batch.others_size,
        stops=batch.stops,
        crop=batch.crop,
    )
    return theta


@torch.no_grad()
def score(model: Hcnaf, windows: FixedWindows, device: torch.device) -> np.ndarray[Any, np.dtype[np.float64]]:
    """NLL of each window and horizon, [W, Q] in nats per m², of a model in evaluation mode."""
    parts = [
        -log_prob(model, to_device(windows.batch(i), device)).mean(dim=-1).double().cpu().numpy()
        for i in range(len(windows))
    ]
    return np.concatenate(parts)


def _check(config: PomConfig) -> None:
    if config.horizon > FUTURE * STEP + 1e-6:
        raise RecipeError(
            f"model.horizon is {config.horizon} s, tracks have {FUTURE * STEP:g} s of future; lower it"
        )
