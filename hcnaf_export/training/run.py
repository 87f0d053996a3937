"""A training run: recipe and data in, a run directory out.

RUN/
  recipe.toml      the recipe as used, defaults included
  metrics.jsonl    one JSON object per line: progress and validations
  checkpoint.pt    the state to resume from, replaced every minute
  model.pt         the best weights by validation (`hcnaf_export.checkpoint`)
  last.pt          the last weights, in the same format
"""

from __future__ import annotations

import datetime
import os
import platform
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hcnaf_export.baselines import build
from hcnaf_export.checkpoint import save_checkpoint
from hcnaf_export.recipe import (
    MnistRecipe,
    PlanarRecipe,
    PomRecipe,
    PrecogRecipe,
    Recipe,
    ToyRecipe,
    TrackRecipe,
    to_toml,
)
from hcnaf_export.training.distributed import SOLO, Team, team
from hcnaf_export.training.eth_ucy import TrackTask
from hcnaf_export.training.loop import Loop, Progress, Task
from hcnaf_export.training.pom import PomTask
from hcnaf_export.training.precision import check_precision
from hcnaf_export.training.precog import PrecogTask
from hcnaf_export.training.prefetch import loaders
from hcnaf_export.training.state import RunState
from hcnaf_export.training.threads import threads as torch_threads
from hcnaf_export.training.toy import ToyTask
from hcnaf_models.model import Hcnaf
from hcnaf_runtime._version import __version__
from hcnaf_runtime.errors import CheckpointError, RecipeError


@dataclass(frozen=True)
class TrainingResult:
    """How a run ended.

    Attributes:
        out: the run directory.
        finished: False if interrupted; `resume` goes on from there.
        step: steps done. seconds: training time, resumed runs together. bad: steps left out.
        scores: validation scores of the best weights, empty if there was none.
    """

    out: Path
    finished: bool
    step: int
    seconds: float
    bad: int
    scores: dict[str, float]


def run_training(
    recipe: Recipe,
    data: Path | None,
    out: Path,
    *,
    resume: bool = False,
    device: str = "cpu",
    threads: int | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> TrainingResult:
    """Train by a recipe; in a process that torchrun started, together with the others it started.

    Of several processes the leader alone uses `out` and `progress`; the result is the same in all but for the
    scores, which only the leader has.

    Args:
        recipe: what to train and how.
        data: a data set of `hcnaf simulate` for POM recipes, the ETH/UCY recordings for pedestrians, the idx files
            of MNIST; toys need none.
        out: the run directory; must be new or empty unless `resume`.
        resume: go on from `out`, exactly where it stopped (the same batches in the same order).
        device: `cpu`, `cuda` or `cuda:N`.
        threads: CPU threads of torch while training; None leaves them as they are.
        progress: told every few seconds, and after each validation.

    Raises:
        RecipeError: data missing, a device that is not there or not enough of them, a precision that the device
            does not have, or a batch that the processes cannot share evenly.
        DataError: the data set cannot be read or lacks what the model reads.
        CheckpointError: nothing to resume from, a run of another recipe, or `out` is not empty.
        TrainingError: training diverged.
    """
    place = _device(device)
    check_precision(recipe.optimiser.precision, place)
    with team(place) as crew, torch_threads(threads):
        crew.share.of(recipe.optimiser.batch)
        crew.lead(lambda: check_target(out, resume))
        if isinstance(recipe, MnistRecipe):
            from hcnaf_export.training.mnist import run_mnist  # which builds on this module

            return run_mnist(recipe, data, out, resume=resume, team=crew, progress=progress)
        task = make_task(recipe, data, crew.device)
        state = RunState.start(_fresh(recipe).to(crew.device), recipe.optimiser)
        return carry_out(task, state, recipe, out, resume=resume, team=crew, progress=progress)


def carry_out(
    task: Task,
    state: RunState,
    recipe: Recipe,
    out: Path,
    *,
    resume: bool = False,
    team: Team = SOLO,
    progress: Callable[[Progress], None] | None = None,
) -> TrainingResult:
    """Train from `state`, or from where the run in `out` stopped, and write what a run leaves."""

    def prepare() -> bytes | None:
        if resume:
            return (out / "checkpoint.pt").read_bytes()
        out.mkdir(parents=True, exist_ok=True)  # only now: bad data leaves no directory behind
        (out / "recipe.toml").write_text(to_toml(recipe), encoding="utf-8")
        return None

    if (content := team.lead(prepare)) is not None:
        state.restore(out / "checkpoint.pt", recipe, content)
    threads = loaders(team.device)
    finished = Loop(
        task, state, recipe, out, device=team.device, report=progress, team=team, loaders=threads
    ).run()
    about = facts(recipe, state, task, team.device) | team.facts
    team.lead(lambda: write_models(state, recipe, out, about))
    return TrainingResult(out, finished, state.step, state.seconds, state.bad, state.best)


def make_task(
    recipe: PlanarRecipe, data: Path | None, device: torch.device
) -> PomTask | PrecogTask | ToyTask | TrackTask:
    """The task of a recipe. Raises RecipeError if it needs data and none was given."""
    if isinstance(recipe, ToyRecipe):
        return ToyTask(recipe, device)
    if data is None:
        source = {PomRecipe: "make one with hcnaf simulate", TrackRecipe: "download ETH/UCY"}.get(
            type(recipe), "download PRECOG-CARLA, or make one with hcnaf simulate --format precog"
        )
        raise RecipeError(f"recipe {recipe.name} needs a data set; {source} and give it as --data")
    if isinstance(recipe, PrecogRecipe):
        return PrecogTask(recipe, data, device)
    return PomTask(recipe, data, device) if isinstance(recipe, PomRecipe) else TrackTask(recipe, data, device)


def check_target(out: Path, resume: bool) -> None:
    """See that the run directory is free, or that there is something to resume. Raises CheckpointError."""
    if resume:
        if not (out / "checkpoint.pt").is_file():
            raise CheckpointError(f"{out} has no checkpoint.pt to resume from; start the run without resume")
        return
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise CheckpointError(f"{out} is not empty; resume it, or choose a new directory")


def _fresh(recipe: PlanarRecipe) -> Hcnaf:
    """A model that follows from the recipe's seed; torch's generator is left as it was."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(recipe.seed)
        return build(recipe.model)


def write_models(state: RunState, recipe: Recipe, out: Path, facts: dict[str, Any]) -> None:
    last: dict[str, Tensor] = state.average.model.state_dict()
    best = state.best_weights or last
    at = state.best_step if state.best_weights else state.step
    save_checkpoint(
        out / "model.pt", recipe.model, best, {**facts, "weights_of_step": at}, {"validation": state.best}
    )
    save_checkpoint(out / "last.pt", recipe.model, last, {**facts, "weights_of_step": state.step}, {})


def facts(recipe: Recipe, state: RunState, task: Task, device: torch.device) -> dict[str, Any]:
    """What a model card says about how the weights came about."""
    return {
        "recipe": recipe.name,
        "task": recipe.task,
        "seed": recipe.seed,
        "steps": state.step,
        "seconds": round(state.seconds, 1),
        "examples_per_step": task.examples,
        "bad_steps": state.bad,
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "machine": f"{platform.machine()} {platform.system()}, {os.cpu_count()} CPU, {device}",
        "versions": {"hcnaf": __version__, "torch": str(torch.__version__), "numpy": str(np.__version__)},
        **task.facts,
    }


def _device(name: str) -> torch.device:
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise RecipeError(f"device is {name!r}, expected cpu, cuda or cuda:N") from error
    if device.type == "cuda" and not torch.cuda.is_available():
        raise RecipeError(f"device is {name!r}, but torch sees no CUDA device here; use cpu")
    return device
