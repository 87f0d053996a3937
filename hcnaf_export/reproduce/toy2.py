"""Toy 2 (paper, section 5.1, table 2): a Gaussian around its condition, at centres seen in training and not."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hcnaf_export.data.toys import ToyTwo
from hcnaf_export.reproduce import figure, toys
from hcnaf_export.reproduce.record import Bound, Clock, Figure, Record, Request, Row
from hcnaf_runtime.measure import machine

PAPER_NLL = {"seen": 1.489, "unseen": 1.552}
PAPER_KL = {"seen": 0.037, "unseen": 0.100}
"""Nats; the entropy is 1.452."""

MOST_KL = {"seen": 0.01, "unseen": 0.05}
MOST_KL_QUICK = {"seen": 0.1, "unseen": 0.2}
SEEDS = 3
SAMPLES, SAMPLES_QUICK = 50_000, 5_000
VIEW = figure.View(1.0, 15.0)

NOTES = (
    "KL is the mean of log p - log q over the samples; NLL - H(p) is the same divergence with the exact entropy "
    "(1.4516) subtracted, and has the standard error of the NLL.",
    "Means are over the listed conditions; their standard errors are those of the samples.",
)


def run(request: Request) -> Record:
    """Train, export and score for three seeds from the request's on (quick: for that alone), and draw the first.

    Raises:
        Stopped: a training was interrupted.
        MissingExtraError: matplotlib is not installed.
    """
    figure.check_matplotlib()
    toy, clock = ToyTwo(), Clock()
    recipe = toys.recipe_for("toy2-quick" if request.quick else "toy2", request.seed)
    samples = SAMPLES_QUICK if request.quick else SAMPLES
    seeds = range(request.seed, request.seed + (1 if request.quick else SEEDS))
    rows: list[Row] = []
    bounds: list[Bound] = []
    for seed in seeds:
        folder, recipe = request.out / f"seed-{seed}", toys.recipe_for(recipe.name, seed)
        bundle, _ = toys.make_bundle(recipe, folder, request, clock, density_only=True)
        model = toys.BundleDensity.of(bundle, toy, request.threads)
        with clock("evaluation"):
            found = _score(toy, model, samples, seed, MOST_KL_QUICK if request.quick else MOST_KL)
        rows += found[0]
        bounds += found[1]
        if seed == request.seed:
            _draw(toy, model, request)
    settings = {"seeds": list(seeds), "samples_per_condition": samples, "recipe": recipe.name}
    settings |= {"steps": recipe.optimiser.steps, "batch_per_condition": recipe.optimiser.batch}
    return Record(
        experiment="toy2",
        about="A Gaussian of sigma 0.5 around its condition; trained at five centres, tested at all nine.",
        quick=request.quick,
        settings=settings,
        machine=machine(request.threads),
        rows=tuple(rows),
        bounds=tuple(bounds),
        seconds=clock.seconds,
        notes=NOTES,
    )


def _score(
    toy: ToyTwo, model: toys.Density, samples: int, seed: int, most: dict[str, float]
) -> tuple[list[Row], list[Bound]]:
    """A row per condition and per mean, and a bound per mean."""
    rows: list[Row] = []
    bounds: list[Bound] = []
    for part, indices in (("seen", toy.seen), ("unseen", toy.unseen)):
        found = toys.scores(toy, model, indices, samples, seed)
        rows += [*(s.row(f"seed {seed}") for s in found), _mean(found, seed, part)]
        bounds.append(toys.mean_bound(found, f"{part} conditions, seed {seed}", most[part]))
    return rows, bounds


def _mean(found: Sequence[toys.Score], seed: int, part: str) -> Row:
    """The mean over conditions, whose samples are independent."""

    def mean(values: list[float]) -> float:
        return float(np.mean(values))

    def error(errors: list[float]) -> float:
        return float(np.sqrt(np.sum(np.square(errors)))) / len(errors)

    nll_error = error([s.nll_error for s in found])
    figures = {
        "NLL (nats)": Figure(mean([s.nll for s in found]), nll_error, PAPER_NLL[part]),
        "NLL - H(p)": Figure(mean([s.gap for s in found]), nll_error),
        "KL (nats)": Figure(mean([s.kl for s in found]), error([s.kl_error for s in found]), PAPER_KL[part]),
    }
    return Row(f"seed {seed}", f"mean, {part}", figures)


def _draw(toy: ToyTwo, model: toys.BundleDensity, request: Request) -> None:
    target = figure.Target(toy)
    rows = [
        [figure.panel(f"{who}, {part}", density, indices, VIEW) for part, indices in parts]
        for who, density in (("target", target), ("HCNAF", model))
        for parts in [(("seen in training", toy.seen), ("unseen", toy.unseen))]
    ]
    figure.draw(request.out / "figure.png", "Toy 2: conditions seen and unseen", rows, VIEW)
