"""What a training step sees of the windows: horizons, noise drawn anew, and maps that fall short.

A batch follows from the seed, the step and the windows alone, so that a resumed run sees the same batches.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hcnaf_export.data.tracks import FUTURE, STEP, NoiseModel
from hcnaf_export.recipe import Windows
from hcnaf_export.training.share import WHOLE, Share
from hcnaf_export.training.windows import Int, Perception, PomBatch, WindowPool
from hcnaf_models.geometry import pose_of
from hcnaf_models.raster import pixel_centres

Float = NDArray[np.float32]


class WindowSampler:
    """Batches of training windows.

    Args:
        pool: the windows.
        settings: horizons, draws and augmentations.
        noise: the recording's noise, from the data set's manifest.
        batch: windows in a batch.
        seed: everything random follows from it and the step.
    """

    def __init__(self, pool: WindowPool, settings: Windows, noise: NoiseModel, batch: int, seed: int) -> None:
        self.pool, self.settings, self.noise = pool, settings, noise
        self.perception = Perception(noise)
        self.size, self.seed = min(batch, len(pool)), seed
        self.per_epoch = len(pool) // self.size
        self._order: tuple[int, Int] = (-1, np.zeros(0, np.int64))

    def batch(self, step: int, share: Share = WHOLE) -> PomBatch:
        """The batch of a step, counted from 0; an epoch visits every window at most once.

        Of a share, what is drawn at random is drawn for the whole batch, and the rest is done for the share alone.
        """
        index = self._windows(step)
        rng = np.random.default_rng((self.seed, 1, step))
        rows = self.pool.rows(index, self.settings.shift, rng)
        if self.settings.redraw:
            present = rows.past >= 0
            past = self.perception.draw(self.pool.truth[rows.past], present, rng)
        else:
            past = self.pool.recorded(rows)
        past[rng.random(len(index)) < self.settings.lone, 1:] = np.nan
        horizons = self._horizons(len(index), rng)
        points = self._labels(rows.now, horizons, rng)
        mine = share.of(len(index))
        batch = self.pool.batch(index[mine], past[mine], horizons[mine], points[mine])
        if batch.crop is not None:
            self._shorten(batch.crop, pose_of(batch.reference), rng, share)
        return batch

    def _windows(self, step: int) -> Int:
        epoch, place = divmod(step, self.per_epoch)
        known, order = self._order  # read at once: several threads may make batches
        if known != epoch:
            order = np.random.default_rng((self.seed, 0, epoch)).permutation(len(self.pool))
            self._order = (epoch, order)
        return order[place * self.size : (place + 1) * self.size]

    def _horizons(self, B: int, rng: np.random.Generator) -> Float:
        """[B, Q], uniform over (0, longest]: one in each of Q equal parts, so that every window sees all of it."""
        Q = self.settings.horizons
        parts = np.arange(Q) + 1.0 - rng.random((B, Q))
        return (self.pool.config.horizon / Q * parts).astype(np.float32)

    def _labels(self, now: Int, horizons: Float, rng: np.random.Generator) -> Float:
        """True positions between two rows, with `draws` draws of label noise: [B, Q, M, 2]."""
        position = np.clip(horizons / STEP, 0.0, FUTURE)
        before = np.minimum(np.floor(position), FUTURE - 1).astype(np.int64)
        rows = now[:, None] + before
        share = (position - before)[..., None].astype(np.float32)
        truth = (1.0 - share) * self.pool.truth[rows, :2] + share * self.pool.truth[rows + 1, :2]
        shape = (*truth.shape[:2], self.settings.draws, 2)
        noise = np.float32(self.noise.label) * rng.standard_normal(shape, dtype=np.float32)
        return np.asarray(truth[:, :, None] + noise, np.float32)

    def _shorten(self, crop: Tensor, pose: Tensor, rng: np.random.Generator, share: Share) -> None:
        """Take away maps, channels, and what lies outside a vehicle's own map window; in place."""
        channels, B = self.pool.config.channels, share.parts * len(crop)
        mine = share.of(B)
        for name in self.settings.optional:
            if name in channels:
                lost = torch.from_numpy((rng.random(B) < self.settings.no_channel)[mine])
                crop[lost, channels.index(name)] = 0.0
        short = rng.random(B) < self.settings.short_map
        where = np.zeros((B, 2))
        where[short] = rng.random((np.count_nonzero(short), 2))
        short, where = short[mine], where[mine]
        for i in np.flatnonzero(short):
            crop[i] *= self._near(pose[i : i + 1], where[i : i + 1])[0]
        gone = rng.random(B) < self.settings.no_map
        crop[torch.from_numpy(gone[mine]), :-1] = 0.0
        crop[torch.from_numpy((gone & (rng.random(B) < 0.5))[mine])] = 0.0

    def _near(self, pose: Tensor, uniform: NDArray[np.float64]) -> Tensor:
        """1 within `map_reach` of a point at most `map_shift` away (squares), [B, 1, rows, columns].

        The point follows from uniform [B, 2].
        """
        radius = self.settings.map_shift * np.sqrt(uniform[:, 0])
        angle = 2.0 * np.pi * uniform[:, 1]
        shift = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1).astype(np.float32)
        centre = pose[:, :2] + torch.from_numpy(shift)
        x, y = pixel_centres(self.pool.config.crop, pose)
        c, s = torch.cos(pose[:, 2, None]), torch.sin(pose[:, 2, None])
        start = pose[:, :2] - centre
        # Pixel (i, j) lies at start + x_j (c, s) + y_i (-s, c): a row term plus a column term per axis.
        right = (start[:, :1] - s * y)[:, :, None] + (c * x)[:, None, :]
        up = (start[:, 1:] + c * y)[:, :, None] + (s * x)[:, None, :]
        reach = self.settings.map_reach
        near = (right.abs_() <= reach) & (up.abs_() <= reach)
        return near.to(pose.dtype).unsqueeze(1)


class FixedWindows:
    """Windows as recorded, scored at fixed horizons: what validation and test use.

    Args:
        pool: the windows.
        horizons: s, multiples of the recording's step.
        limit: at most so many windows, spread evenly over the pool; 0 for all.
        batch: windows in a batch.
    """

    def __init__(self, pool: WindowPool, horizons: tuple[float, ...], limit: int = 0, batch: int = 256) -> None:
        self.pool, self.horizons, self.size = pool, horizons, batch
        count = min(limit or len(pool), len(pool))
        self.index: Int = (np.arange(count) * len(pool)) // count

    def __len__(self) -> int:
        return -(-len(self.index) // self.size)

    def batch(self, number: int) -> PomBatch:
        """Batch `number`: histories and labels as recorded."""
        index = self.index[number * self.size : (number + 1) * self.size]
        rows = self.pool.rows(index)
        steps = np.rint(np.array(self.horizons) / STEP).astype(np.int64)
        horizons = np.broadcast_to(np.asarray(self.horizons, np.float32), (len(index), len(steps))).copy()
        labels = self.pool.label[rows.now[:, None] + steps]
        return self.pool.batch(index, self.pool.recorded(rows), horizons, labels[:, :, None])
