"""Conditional MNIST (paper, section 5.3): the density of an image under its digit, by MAF's protocol."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from hcnaf_export.data.mnist import CLASSES, Mnist, dequantise, load
from hcnaf_export.data.segments import segments
from hcnaf_export.recipe import MnistRecipe
from hcnaf_export.reproduce import figure
from hcnaf_export.reproduce.digits import BundleScores, differences, draw, score
from hcnaf_export.reproduce.gaussians import Gaussians
from hcnaf_export.reproduce.histograms import Histograms
from hcnaf_export.reproduce.record import Bound, Clock, Record, Request, Row
from hcnaf_export.reproduce.sizes import paper_size, recipe_for, title, train, trend
from hcnaf_export.wide_export import export_wide, load_wide
from hcnaf_runtime.errors import InputError
from hcnaf_runtime.measure import machine, memory

PAPER = {"NLL (nats)": 975.9, "bits per pixel": 1.29}
"""The paper's HCNAF, L = 1, H = 38."""

GAUSSIAN = 1344.7
"""Test score of a Gaussian per class as MAF's authors report it (standard error 1.8), nats."""

MADE_MOG = 1030.3
"""The best of MAF's table: MADE with mixtures of Gaussians, nats."""

MOST_AWAY = 5.0
MOST_PARITY = 1e-3
COMPARED = 1000
"""Test images at which the bundle is compared with PyTorch."""

STAND_IN = (3000, 300, 500)
"""Made-up images for training, validation and test in quick runs without data."""
LEAST_GAIN_QUICK = 60.0
"""Nats by which a quick run must beat the histogram of each class and pixel, which no model without working
couplings between pixels can."""

NOTES = (
    "The score is -log sum_y p(x | y) / 10 in logit space, over all test images with one draw of the noise; its "
    "standard error is that over images. Bits per pixel undo the logit.",
    "MAF's authors report 1344.7 nats for a Gaussian per class, 1092.3 for MAF-MoG (5) and 1030.3 for MADE-MoG.",
    "Weights below the diagonal are shared by the classes up to a gain per row and column, which the "
    "hyper-network emits with the diagonals and biases; the paper's hyper-network emits them all.",
)
NOTES_QUICK = ("A quick run is a test of the code: its figures say nothing about the model.",)


def run(request: Request, with_trend: bool = True) -> Record:
    """Train, export, score and draw. The trend over sizes is left out of quick runs, and on request.

    Raises:
        Stopped: a training was interrupted.
        InputError: no data, or data that are not MNIST.
        MissingExtraError: matplotlib is not installed.
    """
    figure.check_matplotlib()
    data, recipe = _data(request), recipe_for("mnist-quick" if request.quick else "mnist-small", request.seed)
    clock, settings, with_trend = Clock(), _settings(recipe, data, request), with_trend and not request.quick
    if with_trend:  # first: memory that is held already would be taken again, and not be counted
        settings["paper_size"] = paper_size(data, request, clock)
    bundle, settings["training_seconds"] = make_bundle(recipe, data, request.out, request, clock)
    rows, bounds = _scores(recipe, data, bundle, request, clock)
    settings["peak_memory_mib"] = _peak()
    if not request.quick:
        _add_gaussian(rows, bounds, data, request, clock)
    with clock("figure"):
        model = load_wide(request.out / "run" / "model.pt").model
        draw(request.out / "figure.png", model, data.test, request.seed)
    if with_trend:
        rows += trend(data, request, clock)
    return Record(
        experiment="mnist",
        about="Images of handwritten digits under their class, D = 784: one HCNAF, simpler densities beside it.",
        quick=request.quick,
        settings=settings,
        machine=machine(request.threads),
        rows=tuple(rows),
        bounds=tuple(bounds),
        seconds=clock.seconds,
        notes=NOTES_QUICK if request.quick else NOTES,
    )


def _scores(
    recipe: MnistRecipe, data: Mnist, bundle: Path, request: Request, clock: Clock
) -> tuple[list[Row], list[Bound]]:
    """The bundle and independent pixels on all test images."""
    x = _test_images(data, request)
    request.say("test images through onnxruntime")
    with clock("evaluation"):
        found = score(BundleScores.of(bundle, request.threads), x, data.test.labels)
        worst = differences(bundle, request.out / "run" / "model.pt", x[:COMPARED], request.threads)
        pixels = score(Histograms.fit(data.train), x, data.test.labels)
    rows = [
        found.row(title(recipe), {} if request.quick else PAPER),
        pixels.row("independent pixels per class", {}),
    ]
    bounds = [Bound("onnxruntime against PyTorch, nats per image", worst, MOST_PARITY)]
    if request.quick:
        bounds.append(Bound("NLL, minus that of independent pixels", found.nll - pixels.nll, -LEAST_GAIN_QUICK))
    else:
        bounds.append(Bound("NLL, MADE-MoG's being 1030.3", found.nll, MADE_MOG))
    return rows, bounds


def _test_images(data: Mnist, request: Request) -> NDArray[np.float32]:
    """Logits of all test images, with one draw of the noise for all that is scored."""
    return dequantise(data.test.pixels, np.random.default_rng((request.seed, 4)))


def _add_gaussian(rows: list[Row], bounds: list[Bound], data: Mnist, request: Request, clock: Clock) -> None:
    """The Gaussian per class, whose published score pins the protocol."""
    request.say("Gaussian per class")
    x = _test_images(data, request)
    with clock("Gaussian per class"):
        known = dequantise(data.train.pixels, np.random.default_rng((request.seed, 5)))
        gaussian = score(Gaussians.fit(known, data.train.labels, CLASSES), x, data.test.labels)
    rows.insert(1, gaussian.row("Gaussian per class", {"NLL (nats)": GAUSSIAN}))
    away = abs(gaussian.nll - GAUSSIAN)
    bounds.append(Bound("Gaussian per class, away from the published score", away, MOST_AWAY))


def make_bundle(
    recipe: MnistRecipe, data: Mnist, folder: Path, request: Request, clock: Clock
) -> tuple[Path, float]:
    """Train and export into `folder`, or take up what is there. The bundle, and the seconds of training.

    Raises:
        Stopped: the training was interrupted.
        CheckpointError: `folder` has a run already, and `request.resume` is off.
    """
    seconds = train(recipe, data, folder / "run", request, clock)
    request.say(f"{recipe.name}: exporting")
    with clock("export"):
        bundle = export_wide(folder / "run" / "model.pt", folder / "bundle", force=request.resume).path
    return bundle, seconds


def _data(request: Request) -> Mnist:
    if request.data is not None:
        data = load(request.data)
        return _few(data) if request.quick else data
    if not request.quick:
        raise InputError("mnist needs the four idx files of MNIST; give their directory as --data")
    return segments(request.seed, *STAND_IN)


def _few(data: Mnist) -> Mnist:
    """As many real images as a quick run has made-up ones."""
    sets = (data.train, data.validation, data.test)
    return Mnist(*(images.part(slice(0, size)) for images, size in zip(sets, STAND_IN, strict=True)))


def _settings(recipe: MnistRecipe, data: Mnist, request: Request) -> dict[str, Any]:
    config = recipe.model
    return {
        "seed": request.seed,
        "recipe": msgspec.to_builtins(recipe),
        "data": "MNIST" if request.data is not None else "made-up digits",
        "images": {"train": len(data.train), "validation": len(data.validation), "test": len(data.test)},
        "shared_weights": config.shared,
        "emitted_per_class": config.parameters,
    }


def _peak() -> int | None:
    """MiB of this process at most, so far."""
    usage = memory()
    return usage.peak >> 20 if usage else None
