"""Learning from PRECOG-CARLA episodes: where the player will be, from five cars' pasts and overhead channels.

The model and the loss are those of `pom`; only where batches come from differs. The player is the target, so the
scene's frame is the target's, and the overhead channels need no turning: with the recipe's window of 200 x 200
pixels of 0.5 m they go to the encoder as they are.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import grid_sample

from hcnaf_export.data.precog import CAR_SIZE, LIDAR_CHANNELS
from hcnaf_export.data.precog_pack import tables
from hcnaf_export.data.precog_set import EpisodeSet, load_episodes
from hcnaf_export.recipe import PrecogRecipe
from hcnaf_export.training.loop import to_device
from hcnaf_export.training.pom import log_prob
from hcnaf_export.training.share import WHOLE, Share
from hcnaf_export.training.windows import PomBatch
from hcnaf_models.config import PomConfig
from hcnaf_models.model import Hcnaf
from hcnaf_models.raster import pixel_centres
from hcnaf_runtime.errors import DataError, RecipeError

Float = NDArray[np.float64]
Int = NDArray[np.int64]

BATCH = 64
"""Episodes scored at a time: their overhead channels are what takes memory."""


class EpisodeBatches:
    """Batches of tensors from episodes, for a model.

    Args:
        episodes: one split.
        config: of the model: history, step, horizon, channels and crop.

    Raises:
        DataError: episodes too short for the model, or with fewer channels than it reads.
    """

    def __init__(self, episodes: EpisodeSet, config: PomConfig) -> None:
        _check(episodes, config)
        self.episodes, self.config = episodes, config
        self.past = torch.from_numpy(episodes.past[:, :, -config.history :].copy())
        self.steps = label_rows(config)
        self.labels = episodes.future[:, 0].astype(np.float64)
        self.table = tables(config.channels) if config.channels else None

    def __len__(self) -> int:
        return len(self.episodes)

    def batch(self, index: Int, rows: Int, points: Float) -> PomBatch:
        """Tensors of some episodes [B] at future rows [B, Q], with points [B, Q, M, 2] (m, player's frame)."""
        past = self.past[torch.from_numpy(index)]
        size = torch.tensor(CAR_SIZE).expand(*past.shape[:2], 2)
        horizons = self.config.step * (rows + 1.0)
        return PomBatch(
            past[:, 0],
            size[:, 0],
            torch.from_numpy(horizons.astype(np.float32)),
            past[:, 1:],
            size[:, 1:],
            None,
            self.crop(index),
            torch.from_numpy(points.astype(np.float32)),
        )

    def crop(self, index: Int) -> Tensor | None:
        """What the encoder sees of each episode: [B, C + 1, rows, columns], the last plane 1 inside it."""
        if self.table is None:
            return None
        # In order, so that a mapped file is read forwards.
        order = np.argsort(index)
        packed = np.empty((len(index), *self.episodes.overhead.shape[1:]), np.uint8)
        for place in order:
            packed[place] = self.episodes.overhead[index[place]]
        planes = np.stack([channel.take(packed) for channel in self.table], axis=1)
        return _window(torch.from_numpy(planes).float() / 127.0, self.config)


def label_rows(config: PomConfig) -> int:
    """How many future rows lie within the model's horizon."""
    return int(np.floor(config.horizon / config.step + 1e-6))


def horizons_of(config: PomConfig) -> tuple[float, ...]:
    """Seconds ahead of those rows."""
    return tuple(round(config.step * (k + 1), 6) for k in range(label_rows(config)))


class PrecogTask:
    """`Task` of a PRECOG recipe. Scores: nats per m² of labels with the recipe's noise, some rows and the mean.

    Raises:
        RecipeError: a model that reads what episodes do not have.
        DataError: files that are missing or broken, or too short for the model.
    """

    def __init__(self, recipe: PrecogRecipe, data: Path, device: torch.device) -> None:
        config, self.settings = recipe.model, recipe.episodes
        check_model(config)
        self.device, self.seed = device, recipe.seed
        train = load_episodes(data, "train", config.step)
        self.pool = EpisodeBatches(train, config)
        self.held_out = EpisodeBatches(load_episodes(data, "val", config.step), config)
        self.size = min(recipe.optimiser.batch, len(self.pool))
        self.examples = self.size
        self.per_epoch = len(self.pool) // self.size
        self._order: tuple[int, Int] = (-1, np.zeros(0, np.int64))
        self.facts: dict[str, Any] = {
            "data": train.name,
            "windows": len(self.pool),
            "label_noise": self.settings.noise,
            "time_step": config.step,
        }

    def batch(self, step: int, share: Share = WHOLE) -> PomBatch:
        """Training episodes of a step; of a share, what is drawn at random is drawn for the whole batch."""
        index = self._episodes(step)
        rng = np.random.default_rng((self.seed, 1, step))
        rows = self._rows(len(index), rng)
        label = self.pool.labels[index[:, None], rows][:, :, None]
        noise = rng.standard_normal((*rows.shape, self.settings.draws, 2))
        points, mine = label + self.settings.noise * noise, share.of(len(index))
        batch = self.pool.batch(index[mine], rows[mine], points[mine])
        if batch.crop is not None and self.settings.thin > 0.0:
            kept = self._kept(len(index), tuple(batch.crop.shape[2:]), rng)
            batch.crop[:, :-1] *= torch.from_numpy(kept[mine])
        return batch

    def _kept(self, B: int, pixels: tuple[int, ...], rng: np.random.Generator) -> NDArray[np.bool_]:
        """Which overhead pixels stay, [B, 1, rows, columns]."""
        lost = np.float32(self.settings.thin) * rng.random((B, 1, 1, 1), dtype=np.float32)
        return np.asarray(rng.random((B, 1, *pixels), dtype=np.float32) >= lost)

    def _episodes(self, step: int) -> Int:
        epoch, place = divmod(step, self.per_epoch)
        known, order = self._order  # read at once: several threads may make batches
        if known != epoch:
            order = np.random.default_rng((self.seed, 0, epoch)).permutation(len(self.pool))
            self._order = (epoch, order)
        return np.asarray(order[place * self.size : (place + 1) * self.size])

    def _rows(self, B: int, rng: np.random.Generator) -> Int:
        """Future rows [B, Q], one in each of Q equal parts of them."""
        Q = min(self.settings.horizons, self.pool.steps)
        return np.asarray(np.floor((np.arange(Q) + rng.random((B, Q))) * self.pool.steps / Q).astype(np.int64))

    def loss(self, model: Hcnaf, batch: PomBatch) -> Tensor:
        """Mean over episodes, rows and draws, nats per m²."""
        return -log_prob(model, batch).mean()

    def validate(self, model: Hcnaf) -> dict[str, float]:
        """Mean NLL of the validation split, with the same noise on its labels each time."""
        values = score(model, self.held_out, self.device, self.settings.noise, self.settings.validation)
        mean = values.mean(axis=0)
        times = horizons_of(self.pool.config)
        chosen = range(min(4, len(times) - 1), len(times), 5)
        return {f"{times[k]:g} s": float(mean[k]) for k in chosen} | {"mean": float(mean.mean())}


def fixed_batches(
    pool: EpisodeBatches, noise: float = 0.0, limit: int = 0, seed: int = 0
) -> Iterator[tuple[Int, PomBatch]]:
    """Episodes, evenly taken, and their batch at all rows, with the same noise (m) on labels each time."""
    count = min(limit or len(pool), len(pool))
    index = (np.arange(count) * len(pool)) // max(count, 1)
    moved = perturbed(pool, noise, seed)
    rows = np.arange(pool.steps)
    for first in range(0, count, BATCH):
        some = index[first : first + BATCH]
        yield some, pool.batch(some, np.tile(rows, (len(some), 1)), moved[some][:, :, None])


def perturbed(pool: EpisodeBatches, noise: float, seed: int) -> Float:
    """Labels [n, Q, 2] with Gaussian noise of so many metres."""
    label = pool.labels[:, : pool.steps]
    return label + noise * np.random.default_rng((seed, len(pool))).standard_normal(label.shape)


@torch.no_grad()
def score(model: Hcnaf, pool: EpisodeBatches, device: torch.device, noise: float = 0.0, limit: int = 0) -> Float:
    """NLL [W, Q] in nats per m² at all rows, of a model in evaluation mode."""
    parts = [
        -log_prob(model, to_device(batch, device))[..., 0].double().cpu().numpy()
        for _, batch in fixed_batches(pool, noise, limit)
    ]
    return np.concatenate(parts)


def check_model(config: PomConfig) -> None:
    """Refuse a model that reads what episodes do not have. Raises RecipeError."""
    unknown = sorted(set(config.channels) - set(LIDAR_CHANNELS))
    if unknown:
        raise RecipeError(f"model.channels has {unknown[0]!r}, episodes have {', '.join(LIDAR_CHANNELS)}")
    if config.stops:
        raise RecipeError("model.stops is true, episodes have no stop lines; set it to false")


def _window(planes: Tensor, config: PomConfig) -> Tensor:
    """Channels [B, C, H, W] of 50 m to all sides in the encoder's window, as `crop_raster` at pose zero."""
    crop, side = config.crop, planes.shape[-1]
    x, y = pixel_centres(crop, planes)
    unit = torch.stack([x.expand(crop.rows, -1), y.unsqueeze(-1).expand(-1, crop.columns)], dim=-1) / 50.0
    inside = (unit.abs().amax(dim=-1) <= 1.0).to(planes.dtype).expand(len(planes), 1, -1, -1)
    same = crop.behind == crop.ahead == crop.side == 50.0 and crop.rows == crop.columns == side
    if not same:
        grid = unit.expand(len(planes), -1, -1, -1)
        planes = grid_sample(planes, grid, mode="bilinear", padding_mode="zeros", align_corners=False)
    return torch.cat([planes, inside], dim=1)


def _check(episodes: EpisodeSet, config: PomConfig) -> None:
    _, _, past, _ = episodes.past.shape
    future, wanted = episodes.future.shape[2], label_rows(config)
    if past < config.history or future < wanted or wanted < 1:
        raise DataError(
            f"{episodes.name} has {past} past and {future} future rows {episodes.step:g} s apart, the model reads "
            f"{config.history} and forecasts {wanted}; lower model.history or model.horizon"
        )
