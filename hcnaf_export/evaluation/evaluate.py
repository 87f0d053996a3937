"""Scoring a predictor on a split, next to the constant-velocity baseline and the floor."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hcnaf_export.baselines import ConstantVelocityGaussian
from hcnaf_export.checkpoint import Checkpoint, load_checkpoint
from hcnaf_export.data.tracks import FUTURE, HISTORY, Dataset, Split, TrackSet
from hcnaf_export.evaluation.predictors import BundlePredictor, CheckpointPredictor, Predictor
from hcnaf_export.evaluation.scores import Scores, summarise
from hcnaf_export.training.toy import Divergence, evaluate_toy, toy_of
from hcnaf_models.config import ConditionConfig
from hcnaf_runtime.errors import CheckpointError, DataError
from hcnaf_runtime.forecaster import Forecaster

HORIZONS = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0)

Report = Callable[[float], None]
"""Told the fraction done, in [0, 1]."""


def evaluate(
    predictor: Predictor,
    dataset: Dataset,
    split: Split = "test",
    *,
    horizons: Sequence[float] = HORIZONS,
    limit: int = 0,
    report: Report | None = None,
) -> Scores:
    """NLL of the recorded labels per horizon, with standard errors over scenes.

    Windows of one network within one window's length (5 s) see the same traffic: they form a cluster, and errors
    are computed over clusters. What differs from network to network is not in the errors.

    Args:
        predictor: what to score.
        dataset: of `hcnaf simulate`; the baseline is fitted on its training split.
        split: which networks to score on.
        horizons: s, multiples of the recording's step.
        limit: score at most so many windows, spread evenly; 0 for all.
        report: told how far it is.

    Raises:
        DataError: a split that is missing, cannot be read or has no windows.
        HorizonError: a horizon without labels, or beyond what the predictor knows.
    """
    horizons = tuple(float(t) for t in horizons)
    baseline = ConstantVelocityGaussian.fit(dataset.split("train"), horizons)
    sets = dataset.split(split)
    chosen = [_spread(s, limit, len(sets)) for s in sets]
    total, done = sum(len(w) for w in chosen), 0
    if not total:
        raise DataError(f"split {split} of {dataset.directory} has no windows to score; simulate some")
    scored, compared, clusters = [], [], []
    for i, (tracks, windows) in enumerate(zip(sets, chosen, strict=True)):
        for part in np.array_split(windows, max(1, len(windows) // 250)):
            scored.append(predictor.nll(tracks, part, horizons))
            done += len(part)
            if report:
                report(done / total)
        compared.append(baseline.nll(tracks, windows, horizons))
        clusters.append(i * 10**6 + windows[:, 1].astype(np.int64) // (HISTORY + FUTURE))
    return summarise(
        horizons,
        np.concatenate(scored),
        np.concatenate(compared),
        np.concatenate(clusters),
        predictor=predictor.name,
        data=dataset.directory.name,
        split=split,
        floor=dataset.manifest.nll_floor,
    )


def evaluate_checkpoint(
    checkpoint: Path | Checkpoint,
    data: Path,
    split: Split = "test",
    *,
    horizons: Sequence[float] = HORIZONS,
    limit: int = 0,
    device: str = "cpu",
    report: Report | None = None,
) -> Scores:
    """`evaluate` of a `model.pt` through PyTorch. Raises CheckpointError too."""
    loaded = checkpoint if isinstance(checkpoint, Checkpoint) else load_checkpoint(checkpoint)
    predictor = CheckpointPredictor(loaded, device=device)
    return evaluate(predictor, Dataset(data), split, horizons=horizons, limit=limit, report=report)


def evaluate_bundle(
    bundle: Path | None,
    data: Path,
    split: Split = "test",
    *,
    horizons: Sequence[float] = HORIZONS,
    limit: int = 0,
    threads: int | None = None,
    report: Report | None = None,
) -> Scores:
    """`evaluate` of a bundle through the runtime, one by one; None is the embedded one. Raises BundleError too."""
    predictor = BundlePredictor(Forecaster(bundle, threads=threads))
    return evaluate(predictor, Dataset(data), split, horizons=horizons, limit=limit, report=report)


def evaluate_toy_checkpoint(
    checkpoint: Path | Checkpoint, *, samples: int = 100_000, seed: int = 1
) -> list[Divergence]:
    """KL to the known density for each condition of a toy's `model.pt`, on samples it was not trained on.

    Raises:
        CheckpointError: not a checkpoint, or not of a toy.
    """
    loaded = checkpoint if isinstance(checkpoint, Checkpoint) else load_checkpoint(checkpoint)
    task = loaded.training.get("task")
    if not isinstance(loaded.config, ConditionConfig) or task not in ("toy1", "toy2"):
        raise CheckpointError(
            f"the checkpoint was trained on {task!r}, expected toy1 or toy2; use evaluate_checkpoint"
        )
    return evaluate_toy(loaded.model, toy_of(task), samples=samples, seed=seed)


def _spread(tracks: TrackSet, limit: int, sets: int) -> NDArray[np.int32]:
    """At most about limit / sets windows of a track set, evenly taken."""
    W = len(tracks.windows)
    count = min(W, -(-limit // sets)) if limit else W
    return tracks.windows[(np.arange(count) * W) // max(count, 1)]
