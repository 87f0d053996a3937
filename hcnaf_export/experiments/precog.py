"""Does lidar help? Two models of PRECOG-CARLA's player on the same episodes, and their paired differences.

    RUN/model.pt, TWIN/model.pt ── evaluate_episodes_checkpoint ──> Scores each, and TWIN - RUN per episode

Both score the same labels with the same noise, so that the difference is far more certain than either score.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from hcnaf_export.checkpoint import Checkpoint, load_checkpoint
from hcnaf_export.data.manifest import Split
from hcnaf_export.evaluation.extra_nats import PROTOCOLS
from hcnaf_export.evaluation.precog import EpisodeScores, evaluate_episodes_checkpoint
from hcnaf_export.evaluation.progress import Report
from hcnaf_export.evaluation.scores import Scores
from hcnaf_export.evaluation.spread import mean_and_error
from hcnaf_runtime.errors import CheckpointError

_FACTS = ("recipe", "data", "windows", "seed", "steps", "seconds", "weights_of_step", "label_noise", "date")


class Difference(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Twin minus model, a positive number where the model is better.

    Attributes:
        measure: `nll` (nats per m² and step) or the protocol of extra nats (per dimension).
        horizons: s. rows: mean difference at each. errors: their standard errors.
        mean: over the horizons. mean_error: its standard error.
    """

    measure: str
    horizons: tuple[float, ...]
    rows: tuple[float, ...]
    errors: tuple[float, ...]
    mean: float
    mean_error: float


class Comparison(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Two models' scores on one split, how each was trained, and their paired differences."""

    model: Scores
    twin: Scores
    differences: tuple[Difference, ...]
    training: dict[str, dict[str, Any]]

    def as_dict(self) -> dict[str, Any]:
        """Plain data, fit for JSON."""
        plain: dict[str, Any] = msgspec.to_builtins(self)
        return plain


def compare(
    run: Path, twin: Path, data: Path, split: Split = "test", *, device: str = "cpu", report: Report | None = None
) -> Comparison:
    """Score two runs (directories of `hcnaf train`) on the same episodes.

    Raises:
        CheckpointError: a run without a model, or two models whose rows differ.
        DataError: episodes that are missing or broken.
    """
    loaded = [load_checkpoint(folder / "model.pt") for folder in (run, twin)]
    halves = [
        evaluate_episodes_checkpoint(c, data, split, device=device, report=_half(report, k))
        for k, c in enumerate(loaded)
    ]
    model, other = halves
    if model.nll.shape != other.nll.shape:
        raise CheckpointError(f"{run} and {twin} forecast other rows; compare runs of one horizon and time step")
    training = {name: _facts(c) for name, c in zip(("model", "twin"), loaded, strict=True)}
    return Comparison(model.scores, other.scores, differences(model, other), training)


def differences(model: EpisodeScores, twin: EpisodeScores) -> tuple[Difference, ...]:
    """Twin minus model of the plain NLL and of each protocol's extra nats, paired by episode."""
    names = ("nll", *(f"extra nats, {p.name}" for p in PROTOCOLS))
    horizons = tuple(row.horizon for row in model.scores.rows)
    gain = twin.nll - model.nll
    return tuple(
        _difference(name, horizons, values if k == 0 else values / 2.0, model.cluster)
        for k, (name, values) in enumerate(zip(names, gain, strict=True))
    )


def _difference(
    name: str, horizons: tuple[float, ...], values: NDArray[np.float64], cluster: NDArray[np.int64]
) -> Difference:
    rows, errors = mean_and_error(values, cluster)
    mean, error = mean_and_error(values.mean(axis=1, keepdims=True), cluster)
    return Difference(
        name, horizons, tuple(rows.tolist()), tuple(errors.tolist()), float(mean[0]), float(error[0])
    )


def _facts(checkpoint: Checkpoint) -> dict[str, Any]:
    known = {name: checkpoint.training[name] for name in _FACTS if name in checkpoint.training}
    return {**known, "validation": checkpoint.scores.get("validation")}


def _half(report: Report | None, number: int) -> Report | None:
    return None if report is None else lambda share: report(0.5 * (number + share))
