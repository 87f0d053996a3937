"""Learning where pedestrians go from where they went: ETH/UCY windows in, negative log-likelihood out."""

from __future__ import annotations

import os
import shutil
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hcnaf_export.data.eth_ucy import OBSERVED, PREDICTED, STEP, TEST, Windows, split
from hcnaf_export.recipe import PedestrianTracks, TrackRecipe
from hcnaf_export.training.loop import to_device
from hcnaf_export.training.share import WHOLE, Share
from hcnaf_models.config import HistoryConfig
from hcnaf_models.geometry import to_frame
from hcnaf_models.history import HistoryHyperNet, pose_of_track
from hcnaf_models.model import Hcnaf
from hcnaf_runtime.errors import RecipeError

Float = NDArray[np.float32]

HORIZONS = tuple(round(STEP * (k + 1), 1) for k in range(PREDICTED))
"""Seconds ahead of a window's future rows."""

LEAST_ROUGHNESS = 0.003
"""Least standard deviation of annotation noise that is added (m)."""

_PART = 512


class TrackBatch(NamedTuple):
    """Histories around their last position, and labels in the frame of each history."""

    history: Tensor  # [B, 8, 2], m
    horizons: Tensor  # [B, Q], s
    points: Tensor  # [B, Q, 2], m


class TrackTask:
    """`Task` of a pedestrian recipe. Scores: nats per m² at each horizon and their mean, on held-out recordings.

    Every step draws windows and some of their horizons at random, mirrors half of them, stretches them and adds
    noise to the labels.

    Raises:
        RecipeError: an unknown split, or a model that reads other windows.
        DataError: recordings that are missing or bad.
    """

    def __init__(self, recipe: TrackRecipe, data: Path, device: torch.device) -> None:
        settings = recipe.tracks
        _check(recipe.model, settings)
        validation = [name for name in settings.validation if name not in TEST[settings.split]]
        parts = split(data, settings.split, validation=validation)
        if not len(parts.validation):
            raise RecipeError(
                f"tracks.validation is {list(settings.validation)}, nothing is left of it beside what "
                f"{settings.split} is tested on; name a recording with windows"
            )
        self.settings, self.device, self.seed = settings, device, recipe.seed
        self.size = recipe.optimiser.batch
        self.examples = self.size * settings.horizons
        self.history, self.future = centred(parts.train)
        self.held_out = parts.validation
        self.facts: dict[str, Any] = {
            "data": f"ETH/UCY without {settings.split}",
            "windows": len(parts.train),
            "validation_windows": len(parts.validation),
        }
        self._loss: Callable[[Hcnaf, TrackBatch], Tensor] = _loss
        if settings.compile and _compiler():
            torch.compiler.reset()  # compiled code of earlier models counts against a limit
            self._loss = torch.compile(_loss, dynamic=False)

    def batch(self, step: int, share: Share = WHOLE) -> TrackBatch:
        """Training windows of a step."""
        rng = np.random.default_rng((self.seed, 1, step))
        chosen = rng.integers(len(self.history), size=self.size)
        rows = np.argsort(rng.random((self.size, PREDICTED)), axis=1)[:, : self.settings.horizons]
        future = np.take_along_axis(self.future[chosen], rows[..., None], axis=1)
        track = np.concatenate([self.history[chosen], future], axis=1) * self._stretch(rng) + self._rough(rng)
        return share.cut(track_batch(track[:, :OBSERVED], rows, track[:, OBSERVED:], self.settings.noise, rng))

    def _stretch(self, rng: np.random.Generator) -> NDArray[np.float64]:
        """Factors [B, 1, 2] that scale tracks and mirror half of them."""
        size = np.exp(rng.uniform(-self.settings.stretch, self.settings.stretch, (self.size, 1, 1)))
        return size * np.where(rng.random((self.size, 1, 1)) < 0.5, [1.0, 1.0], [1.0, -1.0])

    def _rough(self, rng: np.random.Generator) -> NDArray[np.float64]:
        """Annotation noise [B, 8 + Q, 2] (m), none for half of the tracks."""
        most = self.settings.roughness
        if not most:
            return np.zeros((self.size, 1, 1))
        spread = np.exp(rng.uniform(np.log(LEAST_ROUGHNESS), np.log(most), (self.size, 1, 1)))
        spread *= rng.random((self.size, 1, 1)) < 0.5
        return np.asarray(spread * rng.normal(size=(self.size, OBSERVED + self.settings.horizons, 2)))

    def loss(self, model: Hcnaf, batch: TrackBatch) -> Tensor:
        """Mean over windows and horizons, nats per m²."""
        with warnings.catch_warnings():
            # Of what the compiler finds in code that it traces around.
            warnings.filterwarnings("ignore", category=UserWarning, module=r"torch\._dynamo")
            return self._loss(model, batch)

    def validate(self, model: Hcnaf) -> dict[str, float]:
        """Mean NLL of held-out recordings, whose labels carry the same noise each time."""
        values = score(model, self.held_out, noise=self.settings.noise).mean(axis=0)
        scores = {f"{t:g} s": float(v) for t, v in zip(HORIZONS, values, strict=True)}
        return scores | {"mean": float(values.mean())}


def track_batch(
    history: NDArray[Any], rows: NDArray[np.int64], future: NDArray[Any], noise: float, rng: np.random.Generator
) -> TrackBatch:
    """Histories [B, 8, 2], future rows [B, Q] and their positions [B, Q, 2] in one frame as a batch.

    Labels get noise of so many metres.
    """
    past = torch.from_numpy(history.astype(np.float32))
    labels = torch.from_numpy((future + noise * rng.normal(size=future.shape)).astype(np.float32))
    points = to_frame(labels, pose_of_track(past).unsqueeze(1))
    return TrackBatch(past, torch.from_numpy(np.asarray(HORIZONS, dtype=np.float32)[rows]), points)


def log_prob(model: Hcnaf, batch: TrackBatch) -> Tensor:
    """log p of a batch's points [B, Q] in nats per m²."""
    return model.log_prob(theta_of(model, batch), batch.points.unsqueeze(2)).squeeze(-1)


def theta_of(model: Hcnaf, batch: TrackBatch) -> Tensor:
    """theta [B, Q, P] of a batch."""
    hypernet = model.hypernet
    assert isinstance(hypernet, HistoryHyperNet)
    theta: Tensor = hypernet(batch.history, batch.horizons)
    return theta


def batches(windows: Windows, *, noise: float = 0.0, seed: int = 0) -> Iterator[TrackBatch]:
    """All windows in order, at all horizons, with the same noise each time."""
    rng = np.random.default_rng(seed)
    history, future = centred(windows)
    for i in range(0, len(windows), _PART):
        part = slice(i, i + _PART)
        rows = np.tile(np.arange(PREDICTED), (len(history[part]), 1))
        yield track_batch(history[part], rows, future[part], noise, rng)


@torch.no_grad()
def score(model: Hcnaf, windows: Windows, *, noise: float = 0.0, seed: int = 0) -> NDArray[np.float64]:
    """NLL of every window and horizon [W, 12] in nats per m², of a model in evaluation mode.

    Labels carry noise of so many metres, the same for every model.
    """
    device = next(model.parameters()).device
    parts = [
        -log_prob(model, to_device(batch, device)).double().cpu().numpy()
        for batch in batches(windows, noise=noise, seed=seed)
    ]
    return np.concatenate(parts) if parts else np.zeros((0, PREDICTED))


def centred(windows: Windows) -> tuple[Float, Float]:
    """Histories [W, 8, 2] and futures [W, 12, 2] (m) around the last observed positions."""
    now = windows.history[:, -1:]
    return windows.history - now, windows.future - now


def _compiler() -> bool:
    return any(shutil.which(name) for name in (os.environ.get("CXX", ""), "g++", "clang++"))


def _loss(model: Hcnaf, batch: TrackBatch) -> Tensor:
    return -log_prob(model, batch).mean()


def _check(config: HistoryConfig, settings: PedestrianTracks) -> None:
    if settings.split not in TEST:
        raise RecipeError(f"tracks.split is {settings.split!r}, expected one of {', '.join(TEST)}")
    found = config.history, config.step, config.horizon
    if found != (OBSERVED, STEP, HORIZONS[-1]):
        raise RecipeError(
            f"model.history, step and horizon are {found}, ETH/UCY has {(OBSERVED, STEP, HORIZONS[-1])}; use those"
        )
