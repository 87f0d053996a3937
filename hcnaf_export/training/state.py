"""Everything a run needs to go on exactly where it was: one file, replaced as a whole."""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from hcnaf_export.recipe import Optimiser, Recipe, from_plain, to_plain
from hcnaf_export.training.average import Average
from hcnaf_models.model import Hcnaf
from hcnaf_runtime.errors import CheckpointError

FORMAT = 1


@dataclass
class RunState:
    """Model, average, optimiser and counters of a run. Batches follow from the seed and `step` alone."""

    model: Hcnaf
    average: Average[Hcnaf]
    optimiser: torch.optim.Optimizer
    step: int = 0
    seconds: float = 0.0
    bad: int = 0
    bad_in_a_row: int = 0
    best: dict[str, float] = field(default_factory=dict)
    best_step: int = -1
    best_weights: dict[str, Tensor] = field(default_factory=dict)
    scaler: dict[str, Any] = field(default_factory=dict)
    """Of mixed precision, where it has one."""

    @classmethod
    def start(cls, model: Hcnaf, settings: Optimiser) -> RunState:
        """A run at its beginning."""
        decayed = [p for p in model.parameters() if p.dim() > 1]
        plain = [p for p in model.parameters() if p.dim() <= 1]
        groups = [
            {"params": decayed, "weight_decay": settings.weight_decay},
            {"params": plain, "weight_decay": 0.0},
        ]
        optimiser = torch.optim.AdamW(groups, lr=settings.learning_rate, betas=(0.9, 0.99), fused=True)
        return cls(model, Average(model, settings.average), optimiser)

    def save(self, path: Path, recipe: Recipe) -> None:
        """Replace the file at `path`."""
        counters = {name: getattr(self, name) for name in _COUNTERS}
        content = {
            "producer": "hcnaf",
            "format": FORMAT,
            "kind": "run",
            "recipe": to_plain(recipe),
            "model": self.model.state_dict(),
            "average": self.average.model.state_dict(),
            "averaged": self.average.count,
            "optimiser": self.optimiser.state_dict(),
            "best_weights": self.best_weights,
            "scaler": self.scaler,
            **counters,
        }
        replace(path, content)

    def restore(self, path: Path, recipe: Recipe, content: bytes | None = None) -> None:
        """Take over the file that `save` wrote; with `content`, what another process read from it.

        Raises:
            CheckpointError: unreadable, not a run's state, or of another recipe.
        """
        try:
            source = path if content is None else BytesIO(content)
            found = torch.load(source, map_location="cpu", weights_only=True)
            same = from_plain(found["recipe"]) == recipe
        except Exception as error:
            raise CheckpointError(f"{path} is not the state of a run; remove it and start again") from error
        if found.get("format") != FORMAT or not same:
            raise CheckpointError(f"{path} belongs to another recipe; resume with the run's own recipe.toml")
        self.model.load_state_dict(found["model"])
        self.average.model.load_state_dict(found["average"])
        self.average.count = found["averaged"]
        self.optimiser.load_state_dict(found["optimiser"])
        self.scaler = found.get("scaler", {})  # runs of older versions have none
        for name in (*_COUNTERS, "best_weights"):
            setattr(self, name, found[name])


_COUNTERS = ("step", "seconds", "bad", "bad_in_a_row", "best", "best_step")


def replace(path: Path, content: dict[str, Any]) -> None:
    """torch.save to `path`, all of it or nothing."""
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}-")
    try:
        with os.fdopen(handle, "wb") as file:
            torch.save(content, file)
        Path(name).replace(path)
    finally:
        Path(name).unlink(missing_ok=True)
