"""Made-up digits: seven-segment displays with jitter, as a stand-in where MNIST's files are not at hand.

They have the form of MNIST (28 x 28 grey levels, ten classes, a black background), so that everything that is done
with MNIST can be tried on them in seconds. They say nothing about how well a model learns handwriting.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hcnaf_export.data.mnist import CLASSES, PIXELS, SIDE, Images, Mnist

_SEGMENTS = ("abcdef", "bc", "abged", "abgcd", "fgbc", "afgcd", "afgedc", "abc", "abcdefg", "abcfgd")
"""Lit segments of 0 to 9: a top, b and c right, d bottom, e and f left, g middle."""

_ENDS = {
    "a": ((0, 0), (1, 0)),
    "b": ((1, 0), (1, 1)),
    "c": ((1, 1), (1, 2)),
    "d": ((0, 2), (1, 2)),
    "e": ((0, 1), (0, 2)),
    "f": ((0, 0), (0, 1)),
    "g": ((0, 1), (1, 1)),
}
"""Both ends of a segment in a box 1 wide and 2 high, y down."""


def segments(seed: int, train: int, validation: int, test: int) -> Mnist:
    """Three sets of made-up digits, of so many images each."""
    sizes = (train, validation, test)
    return Mnist(*(_images(np.random.default_rng((seed, k)), size) for k, size in enumerate(sizes)))


def _images(rng: np.random.Generator, count: int) -> Images:
    labels = rng.integers(0, CLASSES, count)
    pixels = np.stack([_digit(rng, int(label)) for label in labels])
    return Images(pixels.reshape(count, PIXELS), labels.astype(np.int64))


def _digit(rng: np.random.Generator, label: int) -> NDArray[np.uint8]:
    """A digit of random place, size, slant, stroke and brightness."""
    y, x = np.mgrid[:SIDE, :SIDE].astype(np.float64)
    scale, slant = rng.uniform(6.0, 8.0), rng.uniform(-0.2, 0.3)
    left, top = 14.0 - 0.5 * scale + rng.normal(0.0, 0.7), 14.0 - scale + rng.normal(0.0, 0.7)
    distance = np.full((SIDE, SIDE), np.inf)
    for name in _SEGMENTS[label]:
        ends = [np.array([left + scale * (u + slant * (1 - v)), top + scale * v]) for u, v in _ENDS[name]]
        distance = np.minimum(distance, _to_segment(x, y, ends[0], ends[1]))
    ink = np.clip(rng.uniform(1.0, 2.0) - distance, 0.0, 1.0) * rng.uniform(180.0, 255.0)
    return ink.astype(np.uint8)


def _to_segment(
    x: NDArray[np.float64], y: NDArray[np.float64], a: NDArray[np.float64], b: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Distance of every pixel to the line from a to b."""
    along = b - a
    share = np.clip(((x - a[0]) * along[0] + (y - a[1]) * along[1]) / (along @ along), 0.0, 1.0)
    out: NDArray[np.float64] = np.hypot(x - a[0] - share * along[0], y - a[1] - share * along[1])
    return out
