"""Scoring a predictor on a split, next to the constant-velocity baseline and the floor."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hcnaf_export.baselines import ConstantVelocityGaussian, labels
from hcnaf_export.checkpoint import Checkpoint, load_checkpoint
from hcnaf_export.data.tracks import FUTURE, HISTORY, Dataset, Split, TrackSet
from hcnaf_export.evaluation import paths
from hcnaf_export.evaluation.predictors import BundlePredictor, CheckpointPredictor, Predictor, Sampler
from hcnaf_export.evaluation.scores import Scores, summarise
from hcnaf_export.training.toy import Divergence, evaluate_toy, toy_of
from hcnaf_models.config import ConditionConfig
from hcnaf_runtime.errors import CheckpointError, DataError
from hcnaf_runtime.forecaster import Forecaster

HORIZONS = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0)

SAMPLED = 400
"""Windows whose samples are scored, unless told otherwise."""

Report = Callable[[float], None]
"""Told the fraction done, in [0, 1]."""


def evaluate(
    predictor: Predictor,
    dataset: Dataset,
    split: Split = "test",
    *,
    horizons: Sequence[float] = HORIZONS,
    limit: int = 0,
    samples: int = SAMPLED,
    report: Report | None = None,
) -> Scores:
    """NLL of the recorded labels per horizon, with standard errors over scenes; and scores of samples.

    Windows of one network within one window's length (5 s) see the same traffic: they form a cluster, and errors
    are computed over clusters. What differs from network to network is not in the errors.

    Args:
        predictor: what to score.
        dataset: of `hcnaf simulate`; the baseline is fitted on its training split.
        split: which networks to score on.
        horizons: s, multiples of the recording's step.
        limit: score at most so many windows, spread evenly; 0 for all.
        samples: score the samples of at most so many of these windows (see `paths`); 0 for none. Predictors that
            draw none have no such scores.
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
        clusters.append(_clusters(i, windows))
    return summarise(
        horizons,
        np.concatenate(scored),
        np.concatenate(compared),
        np.concatenate(clusters),
        predictor=predictor.name,
        data=dataset.directory.name,
        split=split,
        floor=dataset.manifest.nll_floor,
        samples=_sample_scores(predictor, sets, chosen, horizons, samples),
    )


def _sample_scores(
    predictor: Predictor,
    sets: Sequence[TrackSet],
    chosen: Sequence[NDArray[np.int32]],
    horizons: tuple[float, ...],
    limit: int,
) -> paths.SampleScores | None:
    """Scores of paths on a part of the windows `chosen`, if any are asked for and the predictor draws them."""
    if not limit or not isinstance(predictor, Sampler) or not predictor.draws:
        return None
    found, clusters = [], []
    for i, (tracks, windows) in enumerate(zip(sets, chosen, strict=True)):
        some = _some(windows, limit, len(sets))
        if len(some):
            drawn = predictor.paths(tracks, some, horizons, paths.DRAWS)
            found.append(paths.score_paths(drawn, labels(tracks, some, horizons)))
            clusters.append(_clusters(i, some))
    return paths.summarise_paths(horizons, paths.joined(found), np.concatenate(clusters))


def _clusters(number: int, windows: NDArray[np.int32]) -> NDArray[np.int64]:
    """Which windows of track set `number` see the same traffic."""
    return number * 10**6 + windows[:, 1].astype(np.int64) // (HISTORY + FUTURE)


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
    samples: int = SAMPLED,
    threads: int | None = None,
    report: Report | None = None,
) -> Scores:
    """`evaluate` of a bundle through the runtime, one by one; None is the embedded one. Raises BundleError too."""
    predictor = BundlePredictor(Forecaster(bundle, threads=threads))
    return evaluate(
        predictor, Dataset(data), split, horizons=horizons, limit=limit, samples=samples, report=report
    )


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
    """At most about limit / sets windows of a track set, evenly taken; all for 0."""
    return _some(tracks.windows, limit, sets) if limit else tracks.windows


def _some(windows: NDArray[np.int32], limit: int, sets: int) -> NDArray[np.int32]:
    """At most about limit / sets of the windows, evenly taken."""
    W = len(windows)
    count = min(W, -(-limit // sets))
    return windows[(np.arange(count) * W) // max(count, 1)]
