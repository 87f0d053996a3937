"""MNIST's files and MAF's protocol: preprocessing against its definition, and files that are not what they say."""

import gzip
import math
import struct
from pathlib import Path

import numpy as np
import pytest

from hcnaf_export.data import mnist
from hcnaf_export.data.segments import segments
from hcnaf_runtime.errors import DataError

RNG = np.random.default_rng(0)


def idx(array: np.ndarray) -> bytes:
    head = struct.pack(f">{1 + array.ndim}I", 0x0800 + array.ndim, *array.shape)
    return head + array.astype(np.uint8).tobytes()


def write(folder: Path, train: int = 10_003, test: int = 4, packed: bool = True) -> None:
    for prefix, count in (("train", train), ("t10k", test)):
        pixels, labels = np.zeros((count, 28, 28), np.uint8), np.arange(count) % 10
        pixels[:, 0, 1] = np.arange(count) % 251
        for name, array in ((f"{prefix}-images-idx3-ubyte", pixels), (f"{prefix}-labels-idx1-ubyte", labels)):
            content = idx(array)
            path = folder / (f"{name}.gz" if packed else name)
            path.write_bytes(gzip.compress(content, 1) if packed else content)


def test_the_logit_is_that_of_the_definition():
    pixels = RNG.integers(0, 256, (50, 784)).astype(np.uint8)
    noise = RNG.random((50, 784))
    s = 1e-6 + (1 - 2e-6) * (pixels + noise) / 256
    assert np.allclose(mnist.logits(pixels, noise), np.log(s / (1 - s)), rtol=2e-6, atol=1e-6)


@pytest.mark.parametrize(("pixel", "noise", "s"), [(0, 0.0, 1e-6), (255, 1.0, 1 - 1e-6)])
def test_the_ends_of_the_interval_are_exact(pixel, noise, s):
    x = mnist.logits(np.full((1, 3), pixel, np.uint8), np.full((1, 3), noise))
    assert np.allclose(x, math.log(s) - math.log1p(-s), rtol=1e-6)


def test_noise_is_fresh_and_stays_inside_its_grey_level():
    pixels = RNG.integers(0, 256, (20, 784)).astype(np.uint8)
    draws = [mnist.dequantise(pixels, np.random.default_rng(k)) for k in (0, 1)]
    assert not np.allclose(*draws)
    for x in draws:
        s = 1.0 / (1.0 + np.exp(-x.astype(np.float64)))
        level = 256.0 * (s - 1e-6) / (1.0 - 2e-6)
        assert np.all(level > pixels - 1e-4)
        assert np.all(level < pixels + 1.0 + 1e-4)


def test_the_log_jacobian_is_the_derivative_of_the_logit():
    u = RNG.uniform(0.001, 0.999, (5, 784))

    def logit(v):
        s = mnist.ALPHA + (1 - 2 * mnist.ALPHA) * v
        return np.log(s) - np.log1p(-s)

    step = 1e-7
    numeric = np.log((logit(u + step) - logit(u - step)) / (2 * step)).sum(-1)
    assert np.allclose(mnist.log_jacobian(logit(u)), numeric, rtol=1e-6)


def test_a_uniform_density_of_pixels_takes_eight_bits():
    x = mnist.dequantise(RNG.integers(0, 256, (7, 784)).astype(np.uint8), RNG)
    log_prob = -mnist.log_jacobian(x)  # u is uniform on (0, 1)^784
    assert np.allclose(mnist.bits_per_pixel(log_prob, x), 8.0, atol=1e-12)


def test_a_density_twice_as_high_takes_a_bit_less():
    x = mnist.dequantise(RNG.integers(0, 256, (2, 784)).astype(np.uint8), RNG)
    bits = mnist.bits_per_pixel(-mnist.log_jacobian(x) + 784 * math.log(2.0), x)
    assert np.allclose(bits, 7.0, atol=1e-12)


def test_pictures_undo_the_logit():
    pixels = RNG.integers(0, 256, (3, 784)).astype(np.uint8)
    grey = mnist.pictures(mnist.logits(pixels, np.full(pixels.shape, 0.5)))
    assert np.allclose(grey.reshape(3, -1) * 256 - 0.5, pixels, atol=1e-3)


@pytest.mark.parametrize("packed", [True, False])
def test_the_last_ten_thousand_are_held_out(tmp_path, packed):
    write(tmp_path, packed=packed)
    data = mnist.load(tmp_path)
    assert [len(s) for s in (data.train, data.validation, data.test)] == [3, 10_000, 4]
    assert data.train.pixels.shape == (3, 784)
    assert data.train.pixels[:, 1].tolist() == [0, 1, 2]
    assert data.validation.labels[0] == 3
    assert data.test.labels.tolist() == [0, 1, 2, 3]


def image_file(folder: Path, content: bytes) -> Path:
    path = folder / "t10k-images-idx3-ubyte"
    path.write_bytes(content)
    return path


GOOD = idx(np.zeros((2, 28, 28)))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "idx header"),
        (GOOD[:10], "idx header"),
        (idx(np.zeros((2, 28, 27))), "idx header"),
        (idx(np.zeros(2)), "idx header"),
        (GOOD[:-1], "1567 bytes, its header says 1568"),
        (GOOD + b"x", "at least 1569 bytes"),
        (struct.pack(">4I", 0x803, 4_000_000_000, 28, 28), "announces 4000000000 items"),
    ],
)
def test_files_that_are_not_what_they_say_are_refused(tmp_path, content, message):
    with pytest.raises(DataError, match=message):
        mnist.read_idx(image_file(tmp_path, content), (28, 28))


@pytest.mark.parametrize("content", [b"no gzip", gzip.compress(GOOD)[:40], gzip.compress(GOOD)[:-9]])
def test_damaged_archives_are_refused(tmp_path, content):
    path = tmp_path / "t10k-images-idx3-ubyte.gz"
    path.write_bytes(content)
    with pytest.raises(DataError, match="cannot be read"):
        mnist.read_idx(path, (28, 28))


def test_what_does_not_fit_together_is_refused(tmp_path):
    with pytest.raises(DataError, match="has neither train-images"):
        mnist.load(tmp_path)
    write(tmp_path, train=10_000)
    with pytest.raises(DataError, match="more than the 10000 that are held out"):
        mnist.load(tmp_path)
    (tmp_path / "t10k-labels-idx1-ubyte.gz").write_bytes(gzip.compress(idx(np.arange(5))))
    with pytest.raises(DataError, match="4 images and 5 labels"):
        mnist.load(tmp_path)
    (tmp_path / "t10k-labels-idx1-ubyte.gz").write_bytes(gzip.compress(idx(np.array([0, 1, 2, 10]))))
    with pytest.raises(DataError, match="label 10"):
        mnist.load(tmp_path)


def test_made_up_digits_follow_from_the_seed_and_differ_by_class():
    one, two = segments(3, 40, 5, 6), segments(3, 40, 5, 6)
    assert [len(s) for s in (one.train, one.validation, one.test)] == [40, 5, 6]
    assert np.array_equal(one.train.pixels, two.train.pixels)
    assert not np.array_equal(one.train.pixels, segments(4, 40, 5, 6).train.pixels)
    ink = [segments(5, 200, 1, 1).train.pixels[segments(5, 200, 1, 1).train.labels == k].mean() for k in (1, 8)]
    assert ink[1] > 2.0 * ink[0]
