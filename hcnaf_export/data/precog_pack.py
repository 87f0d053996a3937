"""PRECOG-CARLA files packed into arrays that can be read at random, by several processes.

An overhead pixel is one byte: the count of returns, 0 to 25, in the five low bits, and the channels above, below
and higher in one bit each. That is all a released file holds of it; a release of 900 kB a file becomes 40 kB.
`python -m hcnaf_export.data.precog_pack` packs the files named in a Job on standard input.
"""

from __future__ import annotations

import sys
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from hcnaf_export.data.precog import LIDAR_CHANNELS, Episode, read_episode, right_handed
from hcnaf_runtime.errors import DataError, HcnafError
from hcnaf_runtime.npz import write_npz

HITS = 25
"""Returns per pixel that a file counts, at most."""

OVERHEAD = "overhead.npy"

_BITS = (5, 6, 7)


class Job(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Files to pack into `folder`, whose first one is episode number `first` of the split."""

    files: tuple[str, ...]
    folder: str
    first: int
    shape: tuple[int, int, int, int]


def shape_of(episode: Episode) -> tuple[int, int, int, int]:
    """Cars beside the player, past rows, future rows, pixels: what all files of a set must agree in."""
    past, future = episode.agent_pasts.shape, len(episode.player_future)
    return past[0], len(episode.player_past), future, len(episode.overhead_features)


def pack(job: Job) -> None:
    """Write the job's rows of `overhead.npy` and `tracks-FIRST.npz`.

    Raises:
        DataError: a file that is broken, or unlike the set's first in its numbers of cars, rows or pixels; the
            message names it.
    """
    overhead = np.load(Path(job.folder) / OVERHEAD, mmap_mode="r+")
    pasts, futures, yaws, names = [], [], [], []
    for number, file in enumerate(job.files, start=job.first):
        episode = read_episode(file)
        if shape_of(episode) != tuple(job.shape):
            raise DataError(
                f"{file} has (other cars, past rows, future rows, pixels) {shape_of(episode)}, the first file of "
                f"its split {tuple(job.shape)}; move it elsewhere"
            )
        past, future, yaw = right_handed(episode)
        overhead[number] = packed(episode.overhead_features)
        pasts.append(past)
        futures.append(future)
        yaws.append(yaw)
        names.append(episode.episode or Path(file).stem)
    overhead.flush()
    content = {"past": np.stack(pasts), "future": np.stack(futures), "yaw": np.stack(yaws)}
    write_npz(Path(job.folder) / f"tracks-{job.first:08d}.npz", {**content, "episode": np.array(names)})


def packed(overhead: NDArray[np.float64]) -> NDArray[np.uint8]:
    """[y right, x, 4] of a file as uint8 [y left, x]."""
    value = np.clip(overhead[::-1], 0.0, 1.0)
    byte = np.rint(HITS * value[..., 0]).astype(np.uint8)
    for channel, bit in enumerate(_BITS, start=1):
        byte |= (value[..., channel] >= 0.5).astype(np.uint8) << bit
    return byte


def tables(channels: tuple[str, ...]) -> NDArray[np.int8]:
    """int8 [C, 256]: what a packed byte is worth in each channel of a scene's raster (value / 127)."""
    byte = np.arange(256)
    hits = np.rint(127.0 * np.minimum(byte & 31, HITS) / HITS)
    rows = [hits, *(127.0 * (byte >> bit & 1) for bit in _BITS)]
    return np.stack([rows[LIDAR_CHANNELS.index(name)] for name in channels]).astype(np.int8)


def main() -> int:
    """Pack the Job on standard input; a failure is one line on standard error and exit code 2."""
    try:
        pack(msgspec.json.decode(sys.stdin.buffer.read(), type=Job))
    except (HcnafError, msgspec.DecodeError) as error:
        sys.stderr.write(f"{error}\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
