"""Trainings of the MNIST experiment: one model, the trend over sizes, and a few steps in the paper's size."""

from __future__ import annotations

import dataclasses
import statistics
import time
from pathlib import Path
from typing import Any

import msgspec

from hcnaf_export.data.mnist import Mnist
from hcnaf_export.recipe import MnistRecipe, read_recipe
from hcnaf_export.reproduce.record import Clock, Figure, Request, Row, Stopped
from hcnaf_export.training.loop import Progress
from hcnaf_export.training.mnist import MnistTask, fresh, start, train_mnist
from hcnaf_export.training.state import RunState
from hcnaf_export.training.threads import threads as torch_threads
from hcnaf_export.wide_export import load_wide
from hcnaf_runtime.measure import memory, reset_peak

TREND, TREND_STEPS = (2, 4, 8, 16), 200
"""Hidden units per pixel of the trend over sizes, and how long each is trained."""

PAPER_STEPS = 4
"""Steps in the paper's size that are timed."""


def recipe_for(name: str, seed: int, hidden: int | None = None) -> MnistRecipe:
    """A shipped recipe with another seed, and other hidden units."""
    recipe = read_recipe(name)
    assert isinstance(recipe, MnistRecipe)
    model = recipe.model
    if hidden is not None:
        model = dataclasses.replace(model, flow=dataclasses.replace(model.flow, hidden=hidden))
        name = f"{name}-H{hidden}"
    return msgspec.structs.replace(recipe, name=name, seed=seed, model=model)


def title(recipe: MnistRecipe) -> str:
    """What a model of the recipe is called in tables."""
    spec = recipe.model.flow
    return f"HCNAF, L = {spec.layers}, H = {spec.hidden}"


def train(recipe: MnistRecipe, data: Mnist, run: Path, request: Request, clock: Clock) -> float:
    """Train into `run`, or go on with it. The seconds of training, resumed runs together. Raises Stopped."""

    def tell(p: Progress) -> None:
        validation = f", validation {p.scores['mean']:.1f}" if p.scores else ""
        request.say(
            f"{recipe.name}: step {p.step}/{p.steps}, loss {p.loss:.1f}{validation} nats, "
            f"{p.rate:.0f} images/s, {p.left:.0f} s left"
        )

    with clock(f"training {recipe.name}"):
        resume = request.resume and (run / "checkpoint.pt").is_file()
        result = train_mnist(recipe, data, run, resume=resume, threads=request.threads, progress=tell)
    if not result.finished:
        raise Stopped(run)
    return round(result.seconds, 1)


def trend(data: Mnist, request: Request, clock: Clock) -> list[Row]:
    """A row for each size, after the same few steps: the trend, not what a size can do."""
    rows = []
    for hidden in TREND:
        recipe = recipe_for("mnist-small", request.seed, hidden)
        schedule = {"steps": TREND_STEPS, "minutes": 0.0, "validate_every": TREND_STEPS}
        recipe = msgspec.structs.replace(recipe, optimiser=msgspec.structs.replace(recipe.optimiser, **schedule))
        run = request.out / f"trend-H{hidden}"
        spent = train(recipe, data, run, request, clock)
        loaded = load_wide(run / "model.pt")
        figures = {
            "NLL given class (nats)": Figure(loaded.scores["validation"]["mean"]),
            "shared weights (million)": Figure(recipe.model.shared / 1e6),
            "training (s)": Figure(spent),
        }
        rows.append(Row(f"{title(recipe)}, {TREND_STEPS} steps", "validation images", figures))
    return rows


def paper_size(data: Mnist, request: Request, clock: Clock) -> dict[str, Any]:
    """Time and memory of a few steps in the paper's size."""
    recipe = recipe_for("mnist", request.seed)
    request.say(f"{recipe.name}: {PAPER_STEPS} steps")
    reset_peak()
    before = memory()
    with clock("steps in the paper's size"), torch_threads(request.threads):
        state = start(fresh(recipe, data.train), recipe.optimiser)
        task = MnistTask(msgspec.structs.replace(recipe, validation=1), data.train, data.validation)
        seconds = [_step(task, state, number) for number in range(PAPER_STEPS)]
    after = memory()
    return {
        "hidden": recipe.model.flow.hidden,
        "batch": recipe.optimiser.batch,
        "shared_weights": recipe.model.shared,
        "emitted_per_class": recipe.model.parameters,
        "seconds_per_step": round(statistics.median(seconds), 2),
        "memory_mib": (after.peak - before.resident) >> 20 if before and after else None,
    }


def _step(task: MnistTask, state: RunState, number: int) -> float:
    batch = task.batch(number)
    begin = time.perf_counter()
    state.optimiser.zero_grad(set_to_none=True)
    task.loss(state.model, batch).backward()  # type: ignore[no-untyped-call]
    state.optimiser.step()
    state.average.update(state.model)
    return time.perf_counter() - begin
