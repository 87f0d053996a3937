"""What both toys share: train by a recipe, export, and score the bundle where the density is known."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from hcnaf_export.data.toys import Toy
from hcnaf_export.export import export_bundle
from hcnaf_export.recipe import ToyRecipe, read_recipe
from hcnaf_export.reproduce.record import Bound, Clock, Figure, Request, Row, Stopped
from hcnaf_export.training.loop import Progress
from hcnaf_export.training.run import run_training
from hcnaf_export.training.toy import name_of
from hcnaf_runtime import Condition, Forecaster

Array = NDArray[np.float64]

PART = 1 << 16
"""Samples that are scored at once."""


class Density(Protocol):
    """Anything with a density under numbered conditions."""

    def log_prob(self, index: int, x: Array) -> Array:
        """log p [N] at points [N, 2] under condition `index`, nats."""


@dataclass(frozen=True)
class BundleDensity:
    """The density of an exported bundle, through onnxruntime."""

    forecaster: Forecaster
    conditions: NDArray[np.float32]

    @classmethod
    def of(cls, bundle: Path, toy: Toy, threads: int) -> BundleDensity:
        """The bundle at a path, for the conditions of a toy."""
        return cls(Forecaster(bundle, threads), toy.conditions())

    def log_prob(self, index: int, x: Array) -> Array:
        """log p [N] at points [N, 2], nats."""
        condition = Condition(self.conditions[index : index + 1])
        return np.asarray(self.forecaster.log_prob(condition, x.astype(np.float32))[0, 0], np.float64)


class Score(msgspec.Struct, frozen=True):
    """What a model scores under one condition, on independent samples of it: nats, with standard errors.

    Attributes:
        index: the condition. name: what it is called.
        nll, nll_error: mean of -log q.
        gap: nll minus the exact entropy; its standard error is that of the nll.
        kl, kl_error: mean of log p - log q, the same divergence with far less chance in it.
    """

    index: int
    name: str
    nll: float
    nll_error: float
    gap: float
    kl: float
    kl_error: float

    def row(self, model: str, paper_nll: float | None = None, paper_kl: float | None = None) -> Row:
        """A row of the record."""
        figures = {
            "NLL (nats)": Figure(self.nll, self.nll_error, paper_nll),
            "NLL - H(p)": Figure(self.gap, self.nll_error),
            "KL (nats)": Figure(self.kl, self.kl_error, paper_kl),
        }
        return Row(model, self.name, figures)


def score(toy: Toy, model: Density, index: int, samples: int, seed: int) -> Score:
    """Score a model on so many samples of one condition, which no training has seen."""
    rng = np.random.default_rng((seed, 3, index))
    total, squares = np.zeros(2), np.zeros((2, 2))
    for start in range(0, samples, PART):
        x = toy.sample(rng, index, min(PART, samples - start))
        log_q = model.log_prob(index, x)
        values = np.stack([-log_q, toy.log_prob(index, x) - log_q])
        total += values.sum(axis=1)
        squares += values @ values.T
    mean = total / samples
    error = np.sqrt(np.maximum(squares.diagonal() / samples - mean**2, 0.0) / (samples - 1))
    gap = float(mean[0] - toy.entropy(index))
    nll, kl = float(mean[0]), float(mean[1])
    return Score(index, name_of(toy, index), nll, float(error[0]), gap, kl, float(error[1]))


def scores(toy: Toy, model: Density, indices: Iterable[int], samples: int, seed: int) -> list[Score]:
    """`score` of several conditions."""
    return [score(toy, model, index, samples, seed) for index in indices]


def recipe_for(name: str, seed: int) -> ToyRecipe:
    """A shipped toy recipe with another seed."""
    recipe = read_recipe(name)
    assert isinstance(recipe, ToyRecipe)
    return msgspec.structs.replace(recipe, seed=seed)


def make_bundle(
    recipe: ToyRecipe, folder: Path, request: Request, clock: Clock, *, density_only: bool
) -> tuple[Path, float]:
    """Train and export into `folder`, or take up what is there. The bundle, and the seconds of training.

    `density_only` as in `export_bundle`: scores need no more, and it saves time.

    Raises:
        Stopped: the training was interrupted.
        CheckpointError: `folder` has a run already, and `request.resume` is off.
    """

    def tell(p: Progress) -> None:
        validation = f", KL {p.scores['mean']:.4f}" if p.scores else ""
        request.say(f"{folder.name}: step {p.step}/{p.steps}, loss {p.loss:.4f}{validation}, {p.left:.0f} s left")

    run = folder / "run"
    with clock("training"):
        resume = request.resume and (run / "checkpoint.pt").is_file()
        result = run_training(recipe, None, run, resume=resume, threads=request.threads, progress=tell)
    if not result.finished:
        raise Stopped(run)
    request.say(f"{folder.name}: exporting")
    with clock("export"):
        bundle = folder / "bundle"
        export_bundle(run / "model.pt", bundle, force=request.resume, density_only=density_only)
    return bundle, result.seconds


def bounds(found: Sequence[Score], what: str, most: float, most_error: float | None = None) -> list[Bound]:
    """One bound per score on its KL, and on its standard error if `most_error` is given."""
    out = [Bound(f"KL {what} {s.name}", s.kl, most) for s in found]
    if most_error is not None:
        out += [Bound(f"standard error of KL {what} {s.name}", s.kl_error, most_error) for s in found]
    return out


def mean_bound(found: Sequence[Score], what: str, most: float) -> Bound:
    """A bound on the mean KL over several conditions."""
    return Bound(f"mean KL, {what}", float(np.mean([s.kl for s in found])), most)
