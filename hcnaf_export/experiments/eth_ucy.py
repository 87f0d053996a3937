"""ETH/UCY pedestrians, leave one scene out: HCNAF and its baselines on the same encoder and the same budget.

    OUT/cells/SPLIT-MODEL-SEED/   a training run (see `training.run`) and, once it is scored, scores.npz
    OUT/record.json, README.md, nll.png   made from all cells (`eth_ucy_report`)

Every model trains by one recipe, in which only the head differs: the same windows in the same order, the same
number of steps. The weights that score best on whole held-out recordings are kept; recordings that are tested on
choose nothing. A cell that is done is not done again, one that was interrupted goes on.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray

from hcnaf_export.baselines.tracks import TrackGaussian
from hcnaf_export.data.eth_ucy import PREDICTED, TEST, Windows, split
from hcnaf_export.evaluation.paths import score_paths
from hcnaf_export.experiments.cells import train_cell
from hcnaf_export.recipe import TrackRecipe, read_recipe
from hcnaf_export.training.eth_ucy import batches, score, theta_of
from hcnaf_export.training.loop import Progress
from hcnaf_models.config import HeadKind
from hcnaf_models.model import Hcnaf
from hcnaf_runtime.npz import write_npz

Float = NDArray[np.float64]

MODELS: tuple[HeadKind, ...] = ("hcnaf", "mixture", "affine", "spline")
CONSTANT_VELOCITY = "constant velocity"

NOISE = 0.01
"""Standard deviation of the noise on labels in the second protocol (m)."""

PATHS = 20
SAMPLED = 1000
"""Windows per split whose samples are scored, evenly taken."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What to run.

    Attributes:
        data: folder of the recordings. out: folder to write to, or to go on in.
        splits, models, seeds: the grid.
        recipe: of every cell; its split, head and seed are replaced.
        minutes: a limit to the training time of a cell beside the recipe's steps; 0 for none.
        threads: of PyTorch.
    """

    data: Path
    out: Path
    splits: Sequence[str] = tuple(TEST)
    models: Sequence[HeadKind] = MODELS
    seeds: Sequence[int] = (0,)
    recipe: TrackRecipe = field(default_factory=lambda: shipped_recipe())
    minutes: float = 0.0
    threads: int | None = None


@dataclass(frozen=True, eq=False)
class CellScores:
    """Scores of one model on the test windows of one split, in the order of the windows.

    Attributes:
        nll: [W, 12] of recorded labels, nats per m². noisy: of labels with `NOISE`.
        min_ade, min_fde: [S] of the best of `PATHS` sampled paths of some windows (m); `sampled` [S] are their
            numbers.
        facts: of the training: steps, seconds (wall time), cpu_seconds (since it was last resumed, compilation
            included) and validation score.
    """

    nll: Float
    noisy: Float
    min_ade: Float
    min_fde: Float
    sampled: NDArray[np.int64]
    facts: dict[str, Any]


def shipped_recipe() -> TrackRecipe:
    """The recipe `eth-ucy`."""
    recipe = read_recipe("eth-ucy")
    assert isinstance(recipe, TrackRecipe)
    return recipe


def cells(plan: Plan) -> list[tuple[str, HeadKind, int]]:
    """Split, model and seed of every cell, in the order they are run."""
    return [(s, m, seed) for seed in plan.seeds for s in plan.splits for m in plan.models]


def cell_recipe(plan: Plan, split_name: str, model: HeadKind, seed: int) -> TrackRecipe:
    """The plan's recipe with the split, the head and the seed of a cell."""
    replace = msgspec.structs.replace
    recipe = plan.recipe
    settings = msgspec.to_builtins(recipe.model) | {"head": model}
    return replace(
        recipe,
        name=f"eth-ucy-{split_name}-{model}",
        model=msgspec.convert(settings, type(recipe.model)),
        tracks=replace(recipe.tracks, split=split_name),
        optimiser=replace(recipe.optimiser, minutes=plan.minutes or recipe.optimiser.minutes),
        seed=seed,
    )


def run_cell(
    plan: Plan, split_name: str, model: HeadKind, seed: int, report: Callable[[Progress], None] | None = None
) -> bool:
    """Train and score a cell unless it is done. Returns False if interrupted.

    Raises:
        RecipeError, DataError, CheckpointError, TrainingError: see `train_cell`.
    """
    folder = cell_folder(plan.out, split_name, model, seed)
    if (folder / "scores.npz").is_file():
        return True
    recipe, start = cell_recipe(plan, split_name, model, seed), time.process_time()
    trained = train_cell(recipe, plan.data, folder, plan.threads, report)
    if trained is None:
        return False
    loaded, facts = trained
    facts["cpu_seconds"] = round(time.process_time() - start, 1)
    _save(folder / "scores.npz", score_model(loaded.model, split(plan.data, split_name).test, facts))
    return True


def score_model(model: Hcnaf, test: Windows, facts: dict[str, Any]) -> CellScores:
    """NLL in both protocols and scores of samples of a model in evaluation mode."""
    some = _some(test)
    points, truth = sample_paths(model, take(test, some))
    found = score_paths(points, truth, (PATHS,))
    return CellScores(
        score(model, test),
        score(model, test, noise=NOISE, seed=1),
        found.min_ade[:, 0],
        found.min_fde[:, 0],
        some,
        facts,
    )


def score_constant_velocity(data: Path, split_name: str, validation: Sequence[str]) -> CellScores:
    """The same of a Gaussian around constant velocity, fitted on the recordings that models train on."""
    held_out = [name for name in validation if name not in TEST[split_name]]
    parts = split(data, split_name, validation=held_out)
    gaussian, test = TrackGaussian.fit(*_arrays(parts.train)), parts.test
    some = _some(test)
    history, truth = _arrays(take(test, some))
    normal = np.random.default_rng(0).normal(size=(len(some), PATHS, 2))
    found = score_paths(gaussian.paths(history, normal), truth, (PATHS,))
    nll, noisy = (gaussian.nll(*_arrays(test, noise)) for noise in (0.0, NOISE))
    return CellScores(nll, noisy, found.min_ade[:, 0], found.min_fde[:, 0], some, {})


def _arrays(windows: Windows, noise: float = 0.0) -> tuple[Float, Float]:
    """Histories and labels in the frame of each window, all of them."""
    found = list(batches(windows, noise=noise, seed=1))
    history, points = (np.concatenate([getattr(b, name).numpy() for b in found]) for name in ("history", "points"))
    return history.astype(np.float64), points.astype(np.float64)


@torch.no_grad()
def sample_paths(model: Hcnaf, windows: Windows, seed: int = 0) -> tuple[Float, Float]:
    """Paths [W, 20, 12, 2] and labels [W, 12, 2] in the frame of each window, m.

    The horizons of a path share their uniform numbers.
    """
    generator = torch.Generator().manual_seed(seed)
    points, truth = [], []
    for batch in batches(windows):
        uniform = torch.rand(len(batch.history), 1, PATHS, model.head.uniforms, generator=generator)
        drawn = model.head.sample(theta_of(model, batch), uniform.expand(-1, PREDICTED, -1, -1))
        points.append(drawn.transpose(1, 2).double().numpy())
        truth.append(batch.points.double().numpy())
    return np.concatenate(points), np.concatenate(truth)


def cell_folder(out: Path, split_name: str, model: str, seed: int) -> Path:
    """Where a cell's run lies."""
    return out / "cells" / f"{split_name}-{model}-{seed}"


def load_cell(folder: Path) -> CellScores:
    """Scores of a cell that is done."""
    with np.load(folder / "scores.npz", allow_pickle=False) as found:
        facts = msgspec.json.decode(found["facts"].tobytes())
        arrays = {name: found[name] for name in _ARRAYS}
    return CellScores(**arrays, facts=facts)


_ARRAYS = ("nll", "noisy", "min_ade", "min_fde", "sampled")


def _save(path: Path, scores: CellScores) -> None:
    facts = np.frombuffer(msgspec.json.encode(scores.facts), dtype=np.uint8)
    write_npz(path, {name: getattr(scores, name) for name in _ARRAYS} | {"facts": facts})


def take(windows: Windows, index: NDArray[np.int64]) -> Windows:
    """Some windows, by number."""
    return Windows(**{name: getattr(windows, name)[index] for name in Windows.__annotations__})


def _some(windows: Windows) -> NDArray[np.int64]:
    count = min(SAMPLED, len(windows))
    return np.asarray((np.arange(count) * len(windows)) // max(count, 1), dtype=np.int64)
