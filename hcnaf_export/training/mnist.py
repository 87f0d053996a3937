"""Learning the density of MNIST's images under their class, by the protocol of `hcnaf_export.data.mnist`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from torch import Tensor

from hcnaf_export.data.mnist import Images, Mnist, dequantise, load
from hcnaf_export.recipe import MnistRecipe, Optimiser
from hcnaf_export.training.average import Average
from hcnaf_export.training.distributed import SOLO, Team
from hcnaf_export.training.loop import Progress
from hcnaf_export.training.run import TrainingResult, carry_out, check_target
from hcnaf_export.training.share import WHOLE, Share
from hcnaf_export.training.state import RunState
from hcnaf_export.training.threads import threads as torch_threads
from hcnaf_models.model import Hcnaf
from hcnaf_models.wide import WideFlow
from hcnaf_models.wide_loss import mean_nll
from hcnaf_runtime.errors import RecipeError

_PART = 500
"""Images that a validation holds at once."""


class ImageBatch(NamedTuple):
    """Logits of some images and their classes."""

    x: Tensor  # float32 [N, D]
    labels: Tensor  # int64 [N]


class MnistTask:
    """`Task` of an MNIST recipe. Batches go through the training images in a new order every epoch, with new
    noise.

    Scores: the mean negative log-likelihood of validation images under their class, nats.
    """

    def __init__(self, recipe: MnistRecipe, train: Images, validation: Images) -> None:
        if len(train) < recipe.optimiser.batch:
            raise RecipeError(f"batch is {recipe.optimiser.batch}, there are {len(train)} training images")
        self.train, self.seed, self.examples = train, recipe.seed, recipe.optimiser.batch
        self.drop = recipe.drop
        some = validation.part(slice(0, recipe.validation))
        self.validation = _batch(some, np.random.default_rng((self.seed, 3)))
        self.facts: dict[str, Any] = {"data": "MNIST", "images": len(train), "validation_images": len(some)}
        self._epoch, self._order = -1, np.zeros(0, np.int64)

    def batch(self, step: int, share: Share = WHOLE) -> ImageBatch:
        """Follows from the seed and the step. What does not fill a batch at an epoch's end is left out."""
        epoch, place = divmod(step, len(self.train) // self.examples)
        if epoch != self._epoch:
            order = np.random.default_rng((self.seed, 1, epoch)).permutation(len(self.train))
            self._epoch, self._order = epoch, order
        index = self._order[place * self.examples : (place + 1) * self.examples]
        some = Images(self.train.pixels[index], self.train.labels[index])
        return share.cut(_batch(some, np.random.default_rng((self.seed, 2, step))))

    def loss(self, model: Any, batch: ImageBatch) -> Tensor:
        """Mean negative log-likelihood, nats per image in logit space."""
        return nll(model, batch, self.drop)

    @torch.no_grad()
    def validate(self, model: Any) -> dict[str, float]:
        """Each class, and all validation images."""
        x, labels = self.validation
        parts = zip(torch.split(x, _PART), torch.split(labels, _PART), strict=True)
        total = sum(float(nll(model, ImageBatch(*part))) * len(part[1]) for part in parts)
        return {"mean": total / len(labels)}


def nll(model: WideFlow, batch: ImageBatch, drop: float = 0.0) -> Tensor:
    """-mean log p(x | class) in nats."""
    x, labels = batch
    classes = torch.eye(model.config.classes, dtype=x.dtype, device=x.device)
    return mean_nll(model.config, list(model.first), list(model.second), model.theta(classes), labels, x, drop)


def fresh(recipe: MnistRecipe, train: Images) -> WideFlow:
    """A model whose units start at the quantiles of the first training images."""
    if recipe.model.flow.dims != train.pixels.shape[1]:
        raise RecipeError(
            f"model.flow.dims is {recipe.model.flow.dims}, images have {train.pixels.shape[1]} pixels"
        )
    model = WideFlow(recipe.model)
    rng = np.random.default_rng((recipe.seed, 0))
    model.fit_units(torch.from_numpy(dequantise(train.pixels[: recipe.units], rng)))
    return model


def start(model: WideFlow, settings: Optimiser) -> RunState:
    """A run at its beginning. Weight decay is for the shared matrices: gains and diagonals must not shrink."""
    shared = [*model.first, *model.second]
    mine = {id(p) for p in shared}
    groups = [
        {"params": shared, "weight_decay": settings.weight_decay},
        {"params": [p for p in model.parameters() if id(p) not in mine], "weight_decay": 0.0},
    ]
    optimiser = torch.optim.AdamW(groups, lr=settings.learning_rate, betas=(0.9, 0.99), fused=True)
    # The loop asks nothing of a model but what every module has.
    as_model = cast("Hcnaf", model)
    return RunState(as_model, Average(as_model, settings.average), optimiser)


def train_mnist(
    recipe: MnistRecipe,
    data: Mnist,
    out: Path,
    *,
    resume: bool = False,
    threads: int | None = None,
    team: Team = SOLO,
    progress: Callable[[Progress], None] | None = None,
) -> TrainingResult:
    """Train by a recipe on the CPU; the run directory is that of `hcnaf_export.training.run`.

    Raises:
        RecipeError: sizes that do not fit the images.
        CheckpointError: nothing to resume from, a run of another recipe, or `out` is not empty.
        TrainingError: training diverged.
    """
    team.lead(lambda: check_target(out, resume))
    task = MnistTask(recipe, data.train, data.validation)
    state = start(fresh(recipe, data.train), recipe.optimiser)
    with torch_threads(threads):
        return carry_out(task, state, recipe, out, resume=resume, team=team, progress=progress)


def run_mnist(
    recipe: MnistRecipe,
    data: Path | None,
    out: Path,
    *,
    team: Team,
    resume: bool = False,
    progress: Callable[[Progress], None] | None = None,
) -> TrainingResult:
    """`train_mnist` on the idx files in the directory `data`.

    Raises:
        RecipeError: no data, or a device other than the CPU, besides what `train_mnist` raises.
        DataError: the files cannot be read.
    """
    if data is None:
        raise RecipeError(
            f"recipe {recipe.name} needs the four idx files of MNIST; give their directory as --data"
        )
    if team.device.type != "cpu":
        raise RecipeError(f"device is {team.device}, recipe {recipe.name} trains on the CPU; leave it out")
    return train_mnist(recipe, load(data), out, resume=resume, team=team, progress=progress)


def _batch(images: Images, rng: np.random.Generator) -> ImageBatch:
    return ImageBatch(torch.from_numpy(dequantise(images.pixels, rng)), torch.from_numpy(images.labels))
