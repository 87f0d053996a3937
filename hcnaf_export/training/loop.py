"""The training loop, the same for every task.

task.batch(step) ──> task.loss(model, batch) ──> clipped AdamW step ──> average ──> validation, best kept
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from hcnaf_export.recipe import Optimiser, Recipe
from hcnaf_export.training.distributed import SOLO, Team
from hcnaf_export.training.interrupt import Interrupt
from hcnaf_export.training.journal import Journal
from hcnaf_export.training.precision import Precision
from hcnaf_export.training.prefetch import Prefetch
from hcnaf_export.training.share import WHOLE, Share
from hcnaf_export.training.state import RunState
from hcnaf_models.model import Hcnaf
from hcnaf_runtime.errors import TrainingError

SAVE_EVERY = 45.0
"""Seconds between two savings of the run's state."""

REPORT_EVERY = 2.0
"""Seconds between two progress reports."""


class Task(Protocol):
    """What is learnt: batches that follow from the step alone, a loss, and a score."""

    examples: int
    """Examples in a batch, for the speed that is reported."""

    facts: dict[str, Any]
    """What a model card says about the data."""

    def batch(self, step: int, share: Share = WHOLE) -> Any:
        """The batch of a step, or a process's share of it, on the CPU."""

    def loss(self, model: Hcnaf, batch: Any) -> Tensor:
        """The mean negative log-likelihood, nats."""

    def validate(self, model: Hcnaf) -> dict[str, float]:
        """Scores of a model in evaluation mode, lower is better; `mean` decides which weights are best."""


@dataclass(frozen=True)
class Progress:
    """How far a run is. `loss` is an average over about the last hundred steps; `scores` the last validation."""

    step: int
    steps: int
    loss: float
    rate: float
    """Examples per second."""
    left: float
    """Seconds until the end, about."""
    bad: int
    scores: dict[str, float] | None


Report = Callable[[Progress], None]


class Loop:
    """One run of a task, from wherever its state is to the end of the recipe.

    Args:
        task: what is learnt.
        state: model, average, optimiser and counters.
        recipe: the schedule, and what is recorded.
        out: the run directory, for `checkpoint.pt` and `metrics.jsonl`.
        device: of the model.
        report: told how far it is, every few seconds and after each validation.
        team: the processes that train together; the leader alone validates, writes and reports.
        loaders: threads that make batches.
    """

    def __init__(
        self,
        task: Task,
        state: RunState,
        recipe: Recipe,
        out: Path,
        *,
        device: torch.device,
        report: Report | None = None,
        team: Team = SOLO,
        loaders: int = 1,
    ) -> None:
        self.task, self.state, self.recipe, self.out = task, state, recipe, out
        self.settings: Optimiser = recipe.optimiser
        self.device, self.report, self.team, self.loaders = device, report, team, loaders
        self.precision = Precision(self.settings.precision, device)
        self.precision.state = state.scaler
        self.objective = team.objective(state.model, task.loss)
        self.journal = Journal(out / "metrics.jsonl")
        self.loss, self.scores = math.nan, None if not state.best else state.best
        self._mark = self._saved = self._reported = time.monotonic()
        self._counted, self._validated = state.step, -1
        self.rate = 0.0

    def run(self) -> bool:
        """Train to the end. Returns False if interrupted, with the state saved.

        Raises:
            TrainingError: several bad steps in a row.
        """
        state, stop = self.state, False
        with (
            Interrupt() as interrupt,
            self.precision.lowered(state.model),
            Prefetch(self._batch, state.step, self.settings.steps, self.loaders) as batches,
        ):
            for batch in batches:
                self._step(batch)
                self._housekeeping()
                state.seconds, stop = self.team.agree(state.seconds, interrupt.requested)
                if stop or self.share >= 1.0:
                    break
        if stop and self.share < 1.0:
            self._save()
            return False
        if self._validated != state.step:
            self._validate()
        self._save()
        return True

    @property
    def share(self) -> float:
        """How much of the run is done, by steps or by time, whichever is more."""
        spent = self.state.seconds / (60.0 * self.settings.minutes) if self.settings.minutes else 0.0
        return max(self.state.step / self.settings.steps, spent)

    def _batch(self, step: int) -> Any:
        return self.task.batch(step) if self.team.size == 1 else self.task.batch(step, self.team.share)

    def _step(self, batch: Any) -> None:
        state = self.state
        units_only = state.step < self.settings.units_first
        highest = self.settings.units_rate if units_only else self.settings.learning_rate
        rate = highest * schedule(self.settings, state.step, self.share)
        for group in state.optimiser.param_groups:
            group["lr"] = rate
        state.model.train()
        state.optimiser.zero_grad(set_to_none=True)
        loss = self.objective(to_device(batch, self.device))
        self.precision.backward(loss, state.optimiser)
        if units_only:
            _keep_units(state.model)
        norm = torch.nn.utils.clip_grad_norm_(state.model.parameters(), self.settings.clip)
        value = self.team.mean(loss)
        good = bool(torch.isfinite(norm)) and math.isfinite(value)
        state.step += 1
        self.precision.step(state.optimiser, good)
        if not good:
            self._count_bad()
            return
        if self.team.leads:
            state.average.update(state.model)
        state.bad_in_a_row = 0
        self.loss = value if math.isnan(self.loss) else self.loss + 0.02 * (value - self.loss)

    def _count_bad(self) -> None:
        """The step is left out; several in a row mean that the weights are lost."""
        self.state.bad += 1
        self.state.bad_in_a_row += 1
        if self.state.bad_in_a_row >= self.settings.patience:
            raise TrainingError(
                f"loss or gradient was not finite for {self.state.bad_in_a_row} steps up to step "
                f"{self.state.step}; lower learning_rate (now {self.settings.learning_rate})"
            )

    def _housekeeping(self) -> None:
        now = time.monotonic()
        self.state.seconds += now - self._mark
        self._mark = now
        if not self.team.leads:
            return
        if self.state.step % self.settings.validate_every == 0:
            self._validate()
        if now - self._saved > SAVE_EVERY:
            self._save()
        if now - self._reported > REPORT_EVERY:
            self._tell(now)

    def _tell(self, now: float) -> None:
        steps = self.state.step - self._counted
        self.rate = steps * self.task.examples / max(now - self._reported, 1e-9)
        self._reported, self._counted = now, self.state.step
        self.journal.write(
            step=self.state.step, seconds=round(self.state.seconds, 1), loss=self.loss, rate=round(self.rate, 1)
        )
        self._announce()

    def _announce(self) -> None:
        if self.report:
            state = self.state
            left = state.seconds * (1.0 - self.share) / max(self.share, 1e-9)
            self.report(
                Progress(state.step, self.settings.steps, self.loss, self.rate, left, state.bad, self.scores)
            )

    def _validate(self) -> None:
        """Score the average; its weights are copied if they are the best so far."""
        if not self.team.leads:
            return
        state = self.state
        self.scores, self._validated = self.task.validate(state.average.model), state.step
        self.journal.write(step=state.step, seconds=round(state.seconds, 1), validation=self.scores)
        mean = self.scores["mean"]
        if math.isfinite(mean) and (not state.best or mean < state.best["mean"]):
            state.best, state.best_step = dict(self.scores), state.step
            weights = state.average.model.state_dict()
            state.best_weights = {name: value.detach().cpu().clone() for name, value in weights.items()}
        self._announce()
        # Time spent here counts as the run's, but not as the speed of its steps.
        now = time.monotonic()
        self.state.seconds += now - self._mark
        self._mark = self._reported = now
        self._counted = state.step

    def _save(self) -> None:
        if not self.team.leads:
            return
        self.state.scaler = self.precision.state
        self.state.save(self.out / "checkpoint.pt", self.recipe)
        self._saved = time.monotonic()


def schedule(settings: Optimiser, step: int, share: float) -> float:
    """The learning rate as a share of the highest: linear warm-up, then half a cosine down to `final`."""
    warm = min(1.0, (step + 1) / max(settings.warm_up, 1))
    cosine = 0.5 * (1.0 + math.cos(math.pi * min(share, 1.0)))
    return warm * (settings.final + (1.0 - settings.final) * cosine)


def _keep_units(model: Hcnaf) -> None:
    """Drop all gradients but those of the location and the scale."""
    units = {id(p) for p in model.head.units.parameters()}
    for p in model.parameters():
        if id(p) not in units:
            p.grad = None


def to_device(batch: Any, device: torch.device) -> Any:
    """A named tuple of tensors on a device."""
    if device.type == "cpu":
        return batch
    return type(batch)(*(v if v is None else v.to(device, non_blocking=True) for v in batch))
