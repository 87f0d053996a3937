"""Scores of densities of digit images, and samples as a picture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray

from hcnaf_export.data.mnist import CLASSES, SIDE, Images, bits_per_pixel, pictures
from hcnaf_export.reproduce.figure import DOTS_PER_INCH
from hcnaf_export.reproduce.gaussians import marginal
from hcnaf_export.reproduce.record import Figure, Row
from hcnaf_export.training.threads import threads as torch_threads
from hcnaf_export.wide_export import load_wide
from hcnaf_models.wide import WideFlow
from hcnaf_models.wide_inverse import inverse
from hcnaf_runtime.bundle import Bundle
from hcnaf_runtime.npz import atomic
from hcnaf_runtime.session import Session, Settings

Array = NDArray[np.float64]

NUMBERS = 1 << 21
"""Hidden units that are held at once, whatever the number of images: 8 MiB for each array of them."""

SAMPLES = 10
"""Of each class in the picture."""


class ImageDensity(Protocol):
    """Anything with a density of images under each class."""

    def log_prob(self, x: NDArray[np.float32]) -> Array:
        """log p(x | class) [K, N] of logits [N, D], nats."""


@dataclass(frozen=True)
class BundleScores:
    """The density of an exported bundle, through onnxruntime: a class and some images at a time."""

    theta: NDArray[np.float32]
    flow: Session
    images: int

    @classmethod
    def of(cls, path: Path, threads: int) -> BundleScores:
        """The bundle at a path; its hyper-network runs once, here."""
        bundle = Bundle.open(path)
        sizes = bundle.manifest.flow
        classes = np.eye(CLASSES, dtype=np.float32)
        theta = bundle.session("hypernet", Settings(threads)).run(["theta"], {"condition": classes})[0]
        images = max(1, NUMBERS // (sizes.dims * sizes.hidden))
        return cls(theta[:, 0], bundle.session("flow", Settings(threads)), images)

    def log_prob(self, x: NDArray[np.float32]) -> Array:
        """log p(x | class) [K, N] of logits [N, D], nats."""
        out = np.empty((len(self.theta), len(x)))
        for start in range(0, len(x), self.images):
            part = slice(start, start + self.images)
            for k in range(len(self.theta)):
                feeds = {"theta": self.theta[k : k + 1], "points": x[None, part]}
                out[k, part] = self.flow.run(["log_prob"], feeds)[0][0]
        return out


class ImageScore(msgspec.Struct, frozen=True):
    """What a model scores on images, with standard errors over them.

    Attributes:
        nll, nll_error: mean of -log sum_y p(x | y) / K, nats in logit space.
        bits, bits_error: the same per pixel of 256 grey levels.
        wrong: share of images whose likeliest class is not theirs, percent.
        log_prob: log p(x | y) under the true classes, mean.
    """

    nll: float
    nll_error: float
    bits: float
    bits_error: float
    wrong: float
    log_prob: float

    def row(self, model: str, paper: dict[str, float], on: str = "test images") -> Row:
        """A row of the record; `paper` by name of the figure."""
        values = {
            "NLL (nats)": (self.nll, self.nll_error),
            "bits per pixel": (self.bits, self.bits_error),
            "wrong class (%)": (self.wrong, None),
        }
        return Row(model, on, {name: Figure(*value, paper.get(name)) for name, value in values.items()})


def score(model: ImageDensity, x: NDArray[np.float32], labels: NDArray[np.int64]) -> ImageScore:
    """Score a model on logits [N, D] with classes [N]."""
    by_class = model.log_prob(x)
    total = marginal(by_class)
    bits = bits_per_pixel(total, x)
    root = len(x) ** 0.5
    return ImageScore(
        nll=float(-total.mean()),
        nll_error=float(total.std(ddof=1)) / root,
        bits=float(bits.mean()),
        bits_error=float(bits.std(ddof=1)) / root,
        wrong=float(100.0 * (by_class.argmax(0) != labels).mean()),
        log_prob=float(by_class[labels, np.arange(len(x))].mean()),
    )


@dataclass(frozen=True)
class ModelScores:
    """The density of a checkpoint in PyTorch."""

    model: WideFlow
    images: int = 100

    @torch.no_grad()
    def log_prob(self, x: NDArray[np.float32]) -> Array:
        """log p(x | class) [K, N] of logits [N, D], nats."""
        theta = self.model.theta(torch.eye(self.model.config.classes))
        parts = torch.split(torch.from_numpy(x).unsqueeze(0), self.images, dim=1)
        rows = [torch.cat([self.model.log_prob(one, part) for part in parts], dim=1) for one in theta.unsqueeze(1)]
        return torch.cat(rows).double().numpy()


def differences(bundle: Path, checkpoint: Path, x: NDArray[np.float32], threads: int) -> float:
    """The largest |log p| of a bundle minus that of its checkpoint, over images and classes, nats."""
    with torch_threads(threads):
        expected = ModelScores(load_wide(checkpoint).model).log_prob(x)
    return float(np.abs(BundleScores.of(bundle, threads).log_prob(x) - expected).max())


def draw(path: Path, model: WideFlow, real: Images, seed: int) -> None:
    """Write a picture of samples of each class (rows), beside real images of it."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Canvas

    figure = Canvas(figsize=(8.0, 4.4), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    panels = {"samples": (left, pictures(_samples(model, seed))), "test images": (right, _some(real))}
    for title, (axes, images) in panels.items():
        axes.imshow(_sheet(images), cmap="gray_r", vmin=0.0, vmax=1.0)
        axes.set_title(title, fontsize=10)
        axes.set_axis_off()
    with atomic(path) as stream:
        figure.savefig(stream, format="png", dpi=DOTS_PER_INCH)


def _samples(model: WideFlow, seed: int) -> Array:
    """Logits [K SAMPLES, D], class by class."""
    config = model.config
    uniform = np.random.default_rng((seed, 6)).random((config.classes, SAMPLES, config.flow.dims))
    theta = model.theta(torch.eye(config.classes))
    x = inverse(config, list(model.first), list(model.second), theta, torch.from_numpy(uniform))
    out: Array = x.flatten(0, 1).numpy()
    return out


def _some(real: Images) -> NDArray[Any]:
    """The first SAMPLES images of each class, blank where there are fewer."""
    out = np.zeros((CLASSES * SAMPLES, SIDE, SIDE))
    for k in range(CLASSES):
        some = real.pixels[real.labels == k][:SAMPLES].reshape(-1, SIDE, SIDE) / 255.0
        out[k * SAMPLES : k * SAMPLES + len(some)] = some
    return out


def _sheet(images: NDArray[Any]) -> NDArray[Any]:
    """[CLASSES SAMPLES, 28, 28] as one picture, a row per class."""
    grid = images.reshape(CLASSES, SAMPLES, SIDE, SIDE).transpose(0, 2, 1, 3)
    out: NDArray[Any] = grid.reshape(CLASSES * SIDE, SAMPLES * SIDE)
    return out
