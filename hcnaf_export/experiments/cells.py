"""What all experiments do with their cells: train them, and put their scores together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hcnaf_export.checkpoint import Checkpoint, load_checkpoint
from hcnaf_export.recipe import Recipe
from hcnaf_export.training.loop import Progress
from hcnaf_export.training.run import run_training

Float = NDArray[np.float64]


def train_cell(
    recipe: Recipe, data: Path, folder: Path, threads: int | None, report: Callable[[Progress], None] | None
) -> tuple[Checkpoint, dict[str, Any]] | None:
    """Train the model of a cell, or go on with it. Returns it with its steps, seconds (wall time) and validation
    score, or None if interrupted.

    Raises:
        RecipeError, DataError, CheckpointError, TrainingError: see `run_training`.
    """
    interrupted = (folder / "checkpoint.pt").is_file()
    result = run_training(recipe, data, folder, resume=interrupted, threads=threads, progress=report)
    if not result.finished:
        return None
    facts = {
        "steps": result.step,
        "seconds": round(result.seconds, 1),
        "validation": result.scores.get("mean"),
    }
    return load_checkpoint(folder / "model.pt"), facts


def over_seeds(cells: Sequence[object], field: str) -> Float:
    """The mean of an array of scores over the seeds of a cell."""
    return np.asarray(np.mean([getattr(cell, field) for cell in cells], axis=0))


def band(
    ax: Any,
    seconds: Sequence[float],
    values: Sequence[float],
    errors: Sequence[float],
    *,
    label: str,
    color: Any,
    width: float = 1.5,
) -> None:
    """A line over seconds ahead with its standard error around it."""
    v, e = np.asarray(values), np.asarray(errors)
    ax.plot(seconds, v, label=label, lw=width, color=color)
    ax.fill_between(seconds, v - e, v + e, alpha=0.15, color=color, lw=0)
