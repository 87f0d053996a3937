"""Learning the toy distributions, whose densities are known: the score is the divergence itself."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from hcnaf_export.data.toys import Toy, ToyOne, ToyTwo, even
from hcnaf_export.recipe import ToyRecipe
from hcnaf_export.training.share import WHOLE, Share
from hcnaf_models import fused
from hcnaf_models.model import Hcnaf
from hcnaf_runtime.errors import RecipeError


class ToyBatch(NamedTuple):
    """Samples of every seen condition, spread evenly (`data.toys.even`)."""

    condition: Tensor  # [A, K]
    points: Tensor  # [A, N, 2]


class Divergence(NamedTuple):
    """KL(p | model) of one condition in nats, estimated on fresh samples, with its standard error."""

    name: str
    seen: bool
    kl: float
    error: float


class ToyTask:
    """`Task` of a toy recipe. Scores: KL per seen condition in nats, and their mean."""

    def __init__(self, recipe: ToyRecipe, device: torch.device) -> None:
        self.toy = toy_of(recipe.task)
        conditions = self.toy.conditions()
        if recipe.model.size != conditions.shape[1]:
            raise RecipeError(
                f"model.size is {recipe.model.size}, {recipe.task} has conditions of {conditions.shape[1]}"
            )
        self.device = device
        self.conditions = torch.from_numpy(conditions[list(self.toy.seen)])
        self.seed, self.draws, self.validation = recipe.seed, recipe.optimiser.batch, recipe.samples.validation
        self.examples = self.draws * len(self.toy.seen)
        self.facts: dict[str, Any] = {"data": recipe.task}

    def batch(self, step: int, share: Share = WHOLE) -> ToyBatch:
        """Fresh samples of every seen condition, of which a share has its part."""
        rng = np.random.default_rng((self.seed, 1, step))
        points = np.stack([self.toy.quantiles(i, even(rng, self.draws)) for i in self.toy.seen])
        return ToyBatch(self.conditions, torch.from_numpy(points[:, share.of(self.draws)].astype(np.float32)))

    def loss(self, model: Hcnaf, batch: ToyBatch) -> Tensor:
        """Mean negative log-likelihood, nats."""
        theta = model.hypernet(batch.condition).squeeze(1)
        return -fused.log_prob(model.config.flow, theta, batch.points).mean()

    def validate(self, model: Hcnaf) -> dict[str, float]:
        """KL of every seen condition: the unseen ones are no one's to choose by."""
        rows = evaluate_toy(
            model, self.toy, samples=self.validation, seed=self.seed, device=self.device, seen_only=True
        )
        scores = {row.name: row.kl for row in rows}
        return scores | {"mean": float(np.mean([row.kl for row in rows]))}


def toy_of(task: str) -> Toy:
    """The distribution of a toy task."""
    toys: dict[str, type[ToyOne] | type[ToyTwo]] = {"toy1": ToyOne, "toy2": ToyTwo}
    if task not in toys:
        raise RecipeError(f"task is {task!r}, expected one of {', '.join(sorted(toys))}")
    return toys[task]()


@torch.no_grad()
def evaluate_toy(
    model: Hcnaf,
    toy: Toy,
    *,
    samples: int = 100_000,
    seed: int = 0,
    device: torch.device | None = None,
    seen_only: bool = False,
) -> list[Divergence]:
    """KL(p | model) = E_p[log p - log model] per condition, on `samples` fresh samples each.

    The mean of the difference varies far less than the mean NLL, whose entropy would then be subtracted.
    """
    conditions = torch.from_numpy(toy.conditions()).to(device)
    out = []
    for i in toy.seen if seen_only else (*toy.seen, *toy.unseen):
        x = toy.sample(np.random.default_rng((seed, 2, i)), i, samples)
        theta = model.hypernet(conditions[i : i + 1])[0]
        parts = torch.split(torch.from_numpy(x.astype(np.float32)).to(device), 20_000)
        log_q = torch.cat([model.log_prob(theta, part.unsqueeze(0))[0] for part in parts]).double().cpu()
        difference = toy.log_prob(i, x) - log_q.numpy()
        error = float(difference.std(ddof=1)) / samples**0.5
        out.append(Divergence(name_of(toy, i), i in toy.seen, float(difference.mean()), error))
    return out


def name_of(toy: Toy, index: int) -> str:
    """What a condition is called."""
    if isinstance(toy, ToyOne):
        return f"n = {toy.sides[index]}"
    if isinstance(toy, ToyTwo):
        x, y = toy.centres()[index]
        return f"({x:g}, {y:g})"
    return str(index)
