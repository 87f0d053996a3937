"""MNIST: the four idx files, and the protocol of MAF (Papamakarios et al. 2017) for densities of its images.

    pixel 0 .. 255  --+ U[0, 1), / 256-->  u in (0, 1)  --logit(ALPHA + (1 - 2 ALPHA) u)-->  x in R^784

The last 10,000 training images are the validation set. Pixels are row by row from the upper left, as in the files.
"""

from __future__ import annotations

import gzip
import math
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
import numpy.typing as npt

from hcnaf_runtime.errors import DataError

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Bytes = npt.NDArray[np.uint8]

ALPHA = 1e-6
"""Keeps the logit finite; the protocol's value for MNIST."""

SIDE = 28
PIXELS = SIDE * SIDE
CLASSES = 10
VALIDATION = 10_000
"""Images at the end of the training files that are held out."""

_MOST = 1_000_000
"""A file that claims more images than this is refused before memory is taken."""
_FILES = {"train": "train", "test": "t10k"}


@dataclass(frozen=True, eq=False)
class Images:
    """`pixels` uint8 [N, 784] and `labels` int64 [N], 0 to 9."""

    pixels: Bytes
    labels: npt.NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.labels)

    def part(self, index: slice) -> Images:
        """Some of them (views)."""
        return Images(self.pixels[index], self.labels[index])


@dataclass(frozen=True, eq=False)
class Mnist:
    """The three sets of the protocol: 50,000, 10,000 and 10,000 images."""

    train: Images
    validation: Images
    test: Images


def load(folder: Path) -> Mnist:
    """The data in `folder`: `train-images-idx3-ubyte`, `train-labels-idx1-ubyte` and `t10k-...`, plain or .gz.

    Raises:
        DataError: a file is missing, damaged, of other sizes than MNIST's, or the sets are too small to be cut.
    """
    both, test = (_images(Path(folder), prefix) for prefix in _FILES.values())
    if len(both) <= VALIDATION:
        raise DataError(
            f"{folder} has {len(both)} training images, expected more than the {VALIDATION} that are held out"
        )
    return Mnist(both.part(slice(0, -VALIDATION)), both.part(slice(-VALIDATION, None)), test)


def _images(folder: Path, prefix: str) -> Images:
    pixels = read_idx(_find(folder, f"{prefix}-images-idx3-ubyte"), (SIDE, SIDE))
    labels = read_idx(_find(folder, f"{prefix}-labels-idx1-ubyte"), ())
    if len(pixels) != len(labels):
        raise DataError(f"{folder}: {len(pixels)} images and {len(labels)} labels of {prefix}; fetch them again")
    if labels.max(initial=0) >= CLASSES:
        raise DataError(f"{folder}: label {labels.max()} among those of {prefix}, expected 0 to {CLASSES - 1}")
    return Images(pixels.reshape(-1, PIXELS), labels.astype(np.int64))


def _find(folder: Path, name: str) -> Path:
    for path in (folder / name, folder / f"{name}.gz"):
        if path.is_file():
            return path
    raise DataError(f"{folder} has neither {name} nor {name}.gz; give the directory of MNIST's four idx files")


def read_idx(path: Path, shape: tuple[int, ...]) -> Bytes:
    """The bytes of an idx file [N, *shape], gzipped if its name ends in .gz. Raises DataError for anything else.

    The header is checked before the content is read, and no more is unpacked than it announces.
    """
    try:
        with gzip.open(path, "rb") if path.suffix == ".gz" else path.open("rb") as stream:
            count = _header(stream, path, shape)
            size = count * math.prod(shape)
            content = stream.read(size + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise DataError(f"{path} cannot be read ({error}); fetch it again") from error
    if len(content) != size:
        at_least = "at least " if len(content) > size else ""
        raise DataError(f"{path} holds {at_least}{len(content)} bytes, its header says {size}; fetch it again")
    return np.frombuffer(content, np.uint8).reshape(count, *shape)


def _header(stream: IO[bytes] | gzip.GzipFile, path: Path, shape: tuple[int, ...]) -> int:
    """The number of items, from a header that says bytes and `shape`."""
    length = 4 + 4 * (1 + len(shape))
    raw = stream.read(length)
    head = np.frombuffer(raw[: len(raw) // 4 * 4], ">u4").tolist()
    expected = [0x0800 + 1 + len(shape), *shape]
    if len(raw) != length or [head[0], *head[2:]] != expected:
        raise DataError(f"{path} starts with {head}, expected the idx header {expected[0]}, count, {expected[1:]}")
    if head[1] > _MOST:
        raise DataError(f"{path} announces {head[1]} items, more than {_MOST}; expected MNIST")
    return int(head[1])


def logits(pixels: Bytes, noise: Float64) -> Float32:
    """x [N, 784] from pixels and noise in [0, 1) of the same shape.

    In float64 from both ends of the interval: white pixels lie where 1 - u is a few thousandths, or less.
    """
    u = (pixels + noise) / 256.0
    rest = ((255 - pixels.astype(np.float64)) + (1.0 - noise)) / 256.0
    scale = 1.0 - 2.0 * ALPHA
    x: Float32 = (np.log(ALPHA + scale * u) - np.log(ALPHA + scale * rest)).astype(np.float32)
    return x


def dequantise(pixels: Bytes, rng: np.random.Generator) -> Float32:
    """`logits` with fresh noise."""
    return logits(pixels, rng.random(pixels.shape))


def log_jacobian(x: npt.NDArray[np.floating]) -> Float64:
    """sum_d log |dx_d / du_d| [N] for x [N, D] = logit(ALPHA + (1 - 2 ALPHA) u), by x itself."""
    wide = x.astype(np.float64)
    inner = np.logaddexp(0.0, wide) + np.logaddexp(0.0, -wide)  # -log(s (1 - s)), s = sigmoid(x)
    total: Float64 = inner.sum(-1) + wide.shape[-1] * math.log1p(-2.0 * ALPHA)
    return total


def bits_per_pixel(log_prob: Float64, x: npt.NDArray[np.floating]) -> Float64:
    """Bits [N] per pixel of 256 grey levels, from log p(x) [N] in nats: the logit undone."""
    bits: Float64 = -(log_prob + log_jacobian(x)) / (x.shape[-1] * math.log(2.0)) + 8.0
    return bits


def pictures(x: npt.NDArray[np.floating]) -> Float64:
    """Grey levels [N, 28, 28] in [0, 1] of logits [N, 784]."""
    u = (1.0 / (1.0 + np.exp(-x.astype(np.float64))) - ALPHA) / (1.0 - 2.0 * ALPHA)
    return np.clip(u, 0.0, 1.0).reshape(-1, SIDE, SIDE)
