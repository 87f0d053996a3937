"""Scoring a predictor on a split, next to the constant-velocity baseline and the floor."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hcnaf_export.baselines import ConstantVelocityGaussian, labels
from hcnaf_export.checkpoint import Checkpoint, load_checkpoint
from hcnaf_export.data.tracks import Dataset, Split, TrackSet
from hcnaf_export.evaluation import paths
from hcnaf_export.evaluation.calibrate import CALIBRATED, Calibration, calibrate
from hcnaf_export.evaluation.capabilities import Predictor, Sampler
from hcnaf_export.evaluation.checkpoint_predictor import CheckpointPredictor
from hcnaf_export.evaluation.extra_nats import PROTOCOLS, ExtraNats, perturbed, summarise_extra_nats
from hcnaf_export.evaluation.predictors import BundlePredictor
from hcnaf_export.evaluation.progress import Report, Stages
from hcnaf_export.evaluation.scores import Scores, summarise
from hcnaf_export.evaluation.subset import Part, cluster_of, fewer, parts
from hcnaf_export.training.toy import Divergence, evaluate_toy, toy_of
from hcnaf_models.config import ConditionConfig
from hcnaf_runtime.errors import CheckpointError, DataError
from hcnaf_runtime.forecaster import Forecaster

Float = NDArray[np.float64]

HORIZONS = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0)

SAMPLED = 400
"""Windows whose samples are scored, unless told otherwise."""


def evaluate(
    predictor: Predictor,
    dataset: Dataset,
    split: Split = "test",
    *,
    network: int | None = None,
    horizons: Sequence[float] = HORIZONS,
    limit: int = 0,
    samples: int = SAMPLED,
    calibrated: int = CALIBRATED,
    extra: bool = True,
    report: Report | None = None,
) -> Scores:
    """NLL of the recorded labels per horizon, with standard errors over scenes; extra nats, calibration, samples.

    Windows of one network within one window's length (5 s) see the same traffic: they form a cluster, and errors
    are computed over clusters. What differs from network to network is not in the errors.

    Args:
        predictor: what to score.
        dataset: of `hcnaf simulate`; the baseline is fitted on its training split.
        split: which networks to score on. network: only this one of them, counted from 0.
        horizons: s, multiples of the recording's step.
        limit: score at most about so many windows, spread evenly; 0 for all.
        samples: score the samples of at most so many of these windows (see `paths`); 0 for none. Predictors that
            draw none have no such scores.
        calibrated: measure calibration on at most so many (see `pit`, `regions`, `reliability`), as far as the
            predictor can; 0 for none.
        extra: score extra nats too (see `extra_nats`), on all the windows.
        report: told how far it is, from 0 to 1.

    Raises:
        DataError: a split or network that is missing, cannot be read or has no windows.
        HorizonError: a horizon without labels, or beyond what the predictor knows.
    """
    horizons = tuple(float(t) for t in horizons)
    baseline = ConstantVelocityGaussian.fit(dataset.split("train"), horizons)
    chosen = parts(_sets(dataset, split, network), limit)
    total = sum(len(part.windows) for part in chosen)
    if not total:
        raise DataError(f"split {split} of {dataset.directory} has no windows to score; simulate some")
    some = fewer(chosen, calibrated) if calibrated else []
    stages = Stages(report, (1 + len(PROTOCOLS) * extra) * total + 15 * sum(len(part.windows) for part in some))
    nll = _nll(predictor, chosen, horizons, stages)
    found = calibrate(predictor, some, horizons, stages) if some else Calibration()
    scores = summarise(
        horizons,
        nll,
        np.concatenate([baseline.nll(part.tracks, part.windows, horizons) for part in chosen]),
        cluster_of(chosen),
        predictor=predictor.name,
        data=dataset.directory.name,
        split=split,
        network=None if network is None else dataset.manifest.splits[split][network].network,
        floor=dataset.manifest.nll_floor,
        extra_nats=_extra(predictor, chosen, horizons, dataset.manifest.noise.label, stages) if extra else (),
        pit=found.pit,
        hdr_coverage=found.regions,
        reliability=found.reliability,
        samples=_sample_scores(predictor, fewer(chosen, samples), horizons) if samples else None,
    )
    stages.finish()
    return scores


def _sets(dataset: Dataset, split: Split, network: int | None) -> list[TrackSet]:
    """The track sets to score."""
    sets = dataset.split(split)
    if network is None:
        return sets
    if not 0 <= network < len(sets):
        raise DataError(
            f"network {network} asked for, {dataset.directory} has {len(sets)} in {split}; count from 0"
        )
    return [sets[network]]


def _nll(predictor: Predictor, chosen: Sequence[Part], horizons: tuple[float, ...], stages: Stages) -> Float:
    """-log p of the labels, [W, Q]."""
    found = []
    for part in chosen:
        found.append(predictor.nll(part.tracks, part.windows, horizons))
        stages.done(len(part.windows))
    return np.concatenate(found)


def _extra(
    predictor: Predictor, chosen: Sequence[Part], horizons: tuple[float, ...], noise: float, stages: Stages
) -> tuple[ExtraNats, ...]:
    found = []
    for protocol in PROTOCOLS:
        sets = {id(part.tracks): part.tracks for part in chosen}
        moved = {key: perturbed(tracks, protocol) for key, tracks in sets.items()}
        nll = _nll(predictor, [p._replace(tracks=moved[id(p.tracks)]) for p in chosen], horizons, stages)
        found.append(summarise_extra_nats(horizons, nll, cluster_of(chosen), protocol, noise))
    return tuple(found)


def _sample_scores(
    predictor: Predictor, some: Sequence[Part], horizons: tuple[float, ...]
) -> paths.SampleScores | None:
    """Scores of paths on some windows, if the predictor draws them."""
    if not isinstance(predictor, Sampler) or not predictor.draws:
        return None
    found = []
    for part in some:
        drawn = predictor.paths(part.tracks, part.windows, horizons, paths.DRAWS)
        found.append(paths.score_paths(drawn, labels(part.tracks, part.windows, horizons)))
    return paths.summarise_paths(horizons, paths.joined(found), cluster_of(some))


def evaluate_checkpoint(
    checkpoint: Path | Checkpoint,
    data: Path,
    split: Split = "test",
    *,
    network: int | None = None,
    horizons: Sequence[float] = HORIZONS,
    limit: int = 0,
    samples: int = SAMPLED,
    calibrated: int = CALIBRATED,
    extra: bool = True,
    device: str = "cpu",
    report: Report | None = None,
) -> Scores:
    """`evaluate` of a `model.pt` through PyTorch, as far as its head goes. Raises CheckpointError too."""
    loaded = checkpoint if isinstance(checkpoint, Checkpoint) else load_checkpoint(checkpoint)
    return evaluate(
        CheckpointPredictor(loaded, device=device),
        Dataset(data),
        split,
        network=network,
        horizons=horizons,
        limit=limit,
        samples=samples,
        calibrated=calibrated,
        extra=extra,
        report=report,
    )


def evaluate_bundle(
    bundle: Path | None,
    data: Path,
    split: Split = "test",
    *,
    network: int | None = None,
    horizons: Sequence[float] = HORIZONS,
    limit: int = 0,
    samples: int = SAMPLED,
    calibrated: int = CALIBRATED,
    extra: bool = True,
    threads: int | None = None,
    report: Report | None = None,
) -> Scores:
    """`evaluate` of a bundle through the runtime, one by one; None is the embedded one. Raises BundleError too."""
    return evaluate(
        BundlePredictor(Forecaster(bundle, threads=threads)),
        Dataset(data),
        split,
        network=network,
        horizons=horizons,
        limit=limit,
        samples=samples,
        calibrated=calibrated,
        extra=extra,
        report=report,
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
