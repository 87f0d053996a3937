"""Scoring forecasts of PRECOG-CARLA's players: NLL and extra nats, through PyTorch or through a bundle.

The labels are recorded without noise, so that the plain NLL of a car that stands has no lower bound and depends on
the noise a model was trained with; compare models by the extra nats of the protocol they were trained for.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from hcnaf_export.checkpoint import Checkpoint
from hcnaf_export.data.manifest import Split
from hcnaf_export.data.precog import read_episode, to_scene
from hcnaf_export.data.precog_set import EpisodeSet, episode_files, load_episodes
from hcnaf_export.evaluation.extra_nats import PROTOCOLS, SEED, summarise_extra_nats
from hcnaf_export.evaluation.progress import Report, Stages
from hcnaf_export.evaluation.scores import Scores, summarise
from hcnaf_export.training.loop import to_device
from hcnaf_export.training.pom import log_prob
from hcnaf_export.training.precog import BATCH, EpisodeBatches, check_model
from hcnaf_models.config import PomConfig
from hcnaf_runtime.errors import CheckpointError, DataError, HorizonError
from hcnaf_runtime.forecaster import Forecaster

Float = NDArray[np.float64]
Int = NDArray[np.int64]

NllOf = Callable[[Int, Int, Float], Float]
"""Episodes [B], future rows [Q] and points [B, Q, M, 2] (m, player's frame) to -log p [B, Q, M] in nats per m²."""

_LOG_2PI = float(np.log(2.0 * np.pi))


@dataclass(frozen=True)
class EpisodeScores:
    """Scores, and what they are means of.

    Attributes:
        scores: means and standard errors; scenes of one drive are taken as dependent.
        nll: [1 + protocols, W, Q], -log p of the labels as recorded and as each of `PROTOCOLS` perturbs them.
        episode: [W] numbers of the episodes in their split. cluster: [W], equal for scenes of one drive.
    """

    scores: Scores
    nll: Float
    episode: Int
    cluster: Int


def evaluate_episodes_checkpoint(
    checkpoint: Checkpoint,
    root: Path,
    split: Split = "test",
    *,
    horizons: Sequence[float] | None = None,
    limit: int = 0,
    device: str = "cpu",
    report: Report | None = None,
) -> EpisodeScores:
    """Score a `model.pt` on episodes.

    Args:
        checkpoint: of a recipe with the task `precog`, or of another whose model reads the same.
        root: a folder of PRECOG-CARLA episodes.
        split: of them.
        horizons: s, multiples of the model's time step; all rows up to its horizon if None.
        limit: score at most so many episodes, evenly taken; 0 for all.
        device: of the model.
        report: told how far it is, from 0 to 1.

    Raises:
        CheckpointError: not a model of occupancy forecasts.
        RecipeError: a model that reads what episodes do not have.
        DataError: files that are missing or broken, or too short for the model.
        HorizonError: a horizon without labels, or beyond what the model knows.
    """
    config = checkpoint.config
    if not isinstance(config, PomConfig):
        raise CheckpointError(f"the checkpoint is of kind {config.kind}, episodes need a model of kind pom")
    check_model(config)
    place = torch.device(device)
    model = checkpoint.model.to(place)
    episodes = load_episodes(root, split, config.step)
    pool = EpisodeBatches(episodes, config)

    @torch.no_grad()
    def nll(index: Int, rows: Int, points: Float) -> Float:
        batch = pool.batch(index, np.tile(rows, (len(index), 1)), points)
        return np.asarray(-log_prob(model, to_device(batch, place)).double().cpu().numpy())

    rows = _rows(horizons, config.step, config.horizon, episodes)
    return _evaluate(nll, "checkpoint", episodes, root, split, rows, limit, report)


def evaluate_episodes_bundle(
    bundle: Path | None,
    root: Path,
    split: Split = "test",
    *,
    horizons: Sequence[float] | None = None,
    limit: int = 0,
    threads: int | None = None,
    report: Report | None = None,
) -> EpisodeScores:
    """Score a bundle on episodes, on the path a vehicle takes: each file read, made a scene and forecast.

    Args and errors as for `evaluate_episodes_checkpoint`. Raises BundleError too.
    """
    forecaster = Forecaster(bundle, threads=threads)
    manifest = forecaster.bundle.manifest
    if manifest.scene is None or manifest.horizons is None:
        raise DataError("the bundle reads no scenes; expected one of kind pom")
    step, history = manifest.scene.step, manifest.scene.history
    files = episode_files(root, split)
    episodes = load_episodes(root, split, step)

    def nll(index: Int, rows: Int, points: Float) -> Float:
        times = [float(t) for t in _times(rows, step)]
        found = []
        for number, where in zip(index, points, strict=True):
            scene = to_scene(read_episode(files[number]), step=step, history=history, target_step=step)
            found.append(-forecaster.log_prob(scene, where[None], times)[0])
        return np.asarray(np.stack(found), dtype=np.float64)

    rows = _rows(horizons, step, manifest.horizons.max, episodes)
    return _evaluate(nll, "bundle", episodes, root, split, rows, limit, report)


def _evaluate(
    nll: NllOf,
    name: str,
    episodes: EpisodeSet,
    root: Path,
    split: Split,
    rows: Int,
    limit: int,
    report: Report | None,
) -> EpisodeScores:
    count = min(limit or len(episodes), len(episodes))
    index = (np.arange(count) * len(episodes)) // count
    points = _points(episodes, rows)[index]
    stages, found = Stages(report, count), []
    for first in range(0, count, BATCH):
        part = slice(first, first + BATCH)
        found.append(nll(index[part], rows, points[part]))
        stages.done(len(points[part]))
    values, cluster = np.moveaxis(np.concatenate(found), -1, 0), episodes.cluster[index]
    times = tuple(float(t) for t in _times(rows, episodes.step))
    train = load_episodes(root, "train", episodes.step)
    scores = summarise(
        times,
        values[0],
        constant_velocity(train, rows).nll_of(_errors(episodes, rows)[index]),
        cluster,
        predictor=name,
        data=episodes.name,
        split=split,
        floor=None,
        extra_nats=tuple(
            summarise_extra_nats(times, moved, cluster, protocol, 0.0)
            for protocol, moved in zip(PROTOCOLS, values[1:], strict=True)
        ),
    )
    return EpisodeScores(scores, values, index, cluster)


@dataclass(frozen=True, eq=False)
class _ConstantVelocity:
    """The baseline of `hcnaf_export.baselines`, on episodes: variances [Q, 2] along and across, m²."""

    variance: Float

    def nll_of(self, errors: Float) -> Float:
        """-log p [W, Q] in nats per m² from errors [W, Q, 2] (m)."""
        return np.asarray((0.5 * (errors**2 / self.variance + np.log(self.variance) + _LOG_2PI)).sum(axis=-1))


def constant_velocity(train: EpisodeSet, rows: Int) -> _ConstantVelocity:
    """A Gaussian around (v t, 0) per future row [Q], with the training split's mean squares."""
    return _ConstantVelocity(np.square(_errors(train, rows)).mean(axis=0))


def _errors(episodes: EpisodeSet, rows: Int) -> Float:
    """Label minus (v t, 0): [n, Q, 2], m."""
    ahead = episodes.past[:, 0, -1, 4, None] * _times(rows, episodes.step)
    label = episodes.future[:, 0, rows].astype(np.float64)
    return label - np.stack([ahead, np.zeros_like(ahead)], axis=-1)


def _points(episodes: EpisodeSet, rows: Int) -> Float:
    """Labels [n, Q, 1 + protocols, 2]: as recorded, and as each protocol perturbs them, the same each time."""
    label = episodes.future[:, 0].astype(np.float64)
    rng = np.random.default_rng((SEED, len(label)))
    noise = rng.standard_normal((len(PROTOCOLS), *label.shape))
    moved = [label, *(label + p.sigma * n for p, n in zip(PROTOCOLS, noise, strict=True))]
    return np.stack(moved, axis=2)[:, rows]


def _times(rows: Int, step: float) -> Float:
    return np.round(step * (rows + 1.0), 6)


def _rows(horizons: Sequence[float] | None, step: float, longest: float, episodes: EpisodeSet) -> Int:
    """Future rows [Q] of horizons (s)."""
    most = min(int(np.floor(longest / step + 1e-6)), episodes.future.shape[2])
    if horizons is None:
        return np.arange(most)
    rows = np.rint(np.asarray(horizons) / step).astype(np.int64) - 1
    if (np.abs((rows + 1) * step - horizons) > 1e-6).any() or (rows < 0).any() or (rows >= most).any():
        raise HorizonError(
            f"horizons are {list(horizons)} s, this model has labels at multiples of {step:g} s up to "
            f"{most * step:g} s; choose those"
        )
    return rows
