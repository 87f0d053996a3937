"""Toy 1 (paper, section 5.1, table 1): one model for n x n Gaussians, n = 2, 5, 10."""

from __future__ import annotations

from hcnaf_export.data.toys import ToyOne
from hcnaf_export.reproduce import figure, peers, toys
from hcnaf_export.reproduce.record import Clock, Record, Request, Row
from hcnaf_runtime.measure import machine

PAPER = {"AAF": (6.056, 5.289, 5.087), "NAF": (3.775, 3.865, 4.176), "HCNAF": (3.896, 3.966, 4.278)}
"""The paper's NLL for n = 2, 5, 10, nats, on 10,000 samples (standard error 0.01)."""

MOST_KL, MOST_ERROR, MOST_KL_QUICK = 0.005, 0.001, 0.1
SAMPLES, SAMPLES_QUICK = 1_000_000, 50_000
VIEW = figure.View(-6.5, 6.5)

NOTES = (
    "KL is the mean of log p - log q over the samples; NLL - H(p) is the same divergence with the exact entropy "
    "(quadrature) subtracted, and has the standard error of the NLL.",
    "The paper's NAF row lies 9 to 12 of its standard errors below the entropy, where no density can be; it was "
    "measured on something else.",
    "AAF and NAF are as zuko makes them, at the paper's learning rate. HCNAF's first layer starts with slopes "
    "that suit many modes (see the recipe), so what separates it from NAF is not the architecture alone.",
)


def run(request: Request, with_peers: bool = True) -> Record:
    """Train, export, score and draw. AAF and NAF are left out of quick runs, and on request.

    Raises:
        Stopped: the training was interrupted.
        MissingExtraError: matplotlib or zuko is not installed.
    """
    figure.check_matplotlib()
    with_peers = with_peers and not request.quick
    if with_peers:
        peers.check_zuko()
    toy, clock = ToyOne(), Clock()
    recipe = toys.recipe_for("toy1-quick" if request.quick else "toy1", request.seed)
    bundle, trained = toys.make_bundle(recipe, request.out, request, clock, density_only=request.quick)
    model = toys.BundleDensity.of(bundle, toy, request.threads)
    samples = SAMPLES_QUICK if request.quick else SAMPLES
    with clock("evaluation"):
        found = toys.scores(toy, model, toy.seen, samples, request.seed)
    with clock("figure"):
        _draw(toy, model, request)
    steps, batch = recipe.optimiser.steps, recipe.optimiser.batch
    settings = {"seed": request.seed, "samples": samples, "recipe": recipe.name, "training_seconds": trained}
    settings |= {"steps": steps, "batch_per_class": batch}
    rows = [s.row("HCNAF", paper) for s, paper in zip(found, PAPER["HCNAF"], strict=True)]
    if with_peers:
        rows = _peer_rows(toy, steps, batch, samples, request, clock) + rows
        settings["peers"] = "one model per class; steps and batch per class as ours; not tuned"
    most, error = (MOST_KL_QUICK, None) if request.quick else (MOST_KL, MOST_ERROR)
    return Record(
        experiment="toy1",
        about="n x n Gaussians, n = 2, 5, 10: one HCNAF for all three, one AAF and one NAF (zuko) for each.",
        quick=request.quick,
        settings=settings,
        machine=machine(request.threads),
        rows=tuple(rows),
        bounds=tuple(toys.bounds(found, "of", most, error)),
        seconds=clock.seconds,
        notes=NOTES,
    )


def _peer_rows(toy: ToyOne, steps: int, batch: int, samples: int, request: Request, clock: Clock) -> list[Row]:
    rows = []
    for kind in peers.KINDS:
        with clock(f"training {kind}"):
            model = peers.train_peers(kind, toy, steps, batch, request.seed, request.threads, request.say)
        with clock("evaluation"):
            found = toys.scores(toy, model, toy.seen, samples, request.seed)
        rows += [s.row(f"{kind} (zuko)", paper) for s, paper in zip(found, PAPER[kind], strict=True)]
    return rows


def _draw(toy: ToyOne, model: toys.BundleDensity, request: Request) -> None:
    target = figure.Target(toy)
    rows = [
        [figure.panel(f"{n} x {n}, {who}", density, [i], VIEW) for i, n in enumerate(toy.sides)]
        for who, density in (("target", target), ("HCNAF", model))
    ]
    figure.draw(request.out / "figure.png", "Toy 1: one model, three conditions", rows, VIEW)
