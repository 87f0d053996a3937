"""PRECOG-CARLA as released: a folder of episodes, packed once and then read at random.

    ROOT/{train,val,test}/ma*.json ── precog_pack, once ──> CACHE/{overhead.npy, tracks.npz} ──> EpisodeSet

Parsing a file takes some 25 ms, a batch of packed episodes far less, so a split is packed at its first use: into
ROOT/.hcnaf if that can be written, else into the user's cache folder. Names, sizes and dates of the files decide
whether a cache still fits. The overhead channels stay on the disk (40 kB an episode) and are mapped into memory.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from hcnaf_export.data.manifest import Split
from hcnaf_export.data.precog import histories, read_episode
from hcnaf_export.data.precog_pack import OVERHEAD, Job, pack, shape_of
from hcnaf_runtime.errors import DataError
from hcnaf_runtime.npz import read_npz, write_npz

Float32 = NDArray[np.float32]
Int64 = NDArray[np.int64]

PATTERN = "ma*.json"

_VERSION = "hcnaf-precog-1"
_CHUNK = 200
"""Files a process packs before it ends; fewer files are packed in this one."""

_TRACKS = ("past", "future", "yaw", "episode")


@dataclass(frozen=True, eq=False, kw_only=True)
class EpisodeSet:
    """Episodes of one split: n of them, player and M other cars, P past rows (the last is now), F future rows.

    Attributes:
        past: float32 [n, 1 + M, P, 5], x, y, sin(yaw), cos(yaw), speed in the right-handed frame of the player
            now (m, m/s); the player first.
        future: float32 [n, 1 + M, F, 2] in that frame; row 0 is one step after now.
        overhead: uint8 [n, H, W] packed channels, row 0 the rightmost (see `precog_pack.tables`).
        cluster: int64 [n], equal for scenes of one drive.
        step: seconds between rows.
        name: of the folder.
    """

    past: Float32
    future: Float32
    overhead: NDArray[np.uint8]
    cluster: Int64
    step: float
    name: str

    def __len__(self) -> int:
        return len(self.past)


def is_precog(root: Path) -> bool:
    """Whether a directory is laid out as PRECOG-CARLA is released."""
    folders = [Path(root) / split for split in ("train", "val", "test")]
    return any(folder.is_dir() and next(folder.glob(PATTERN), None) is not None for folder in folders)


def episode_files(root: Path, split: Split) -> list[Path]:
    """The episodes of a split in the order of their names. Raises DataError if there are none."""
    files = sorted((Path(root) / split).glob(PATTERN))
    if not files:
        raise DataError(f"{Path(root) / split} has no {PATTERN}; expected PRECOG-CARLA as DIR/{split}/{PATTERN}")
    return files


def load_episodes(root: Path, split: Split, step: float, *, jobs: int | None = None) -> EpisodeSet:
    """A split, packed if it is not yet.

    Args:
        root: holds `train`, `val` and `test`.
        split: of them.
        step: seconds between the rows of a file; the files do not say (see `hcnaf_export.data.precog`).
        jobs: processes that pack; None for one per CPU.

    Raises:
        DataError: no such folder, or a file that is broken or unlike the others; the message names it.
    """
    files = episode_files(root, split)
    folder = _cache(Path(root), split, files, jobs or len(os.sched_getaffinity(0)))
    content = read_npz(folder / "tracks.npz", DataError)
    _, cluster = np.unique(content["episode"], return_inverse=True)
    return EpisodeSet(
        past=histories(content["past"], content["yaw"], step).astype(np.float32),
        future=content["future"].astype(np.float32),
        overhead=np.load(folder / OVERHEAD, mmap_mode="r"),
        cluster=cluster.astype(np.int64),
        step=step,
        name=Path(root).resolve().name,
    )


def _cache(root: Path, split: Split, files: list[Path], jobs: int) -> Path:
    """The folder of the packed split, made if need be; it appears only when it is whole."""
    base = _writable(root)
    folder = base / f"{split}-{_digest(files)}"
    with (base / f"{split}.lock").open("w") as lock:
        # Processes that train together all come here: one packs, the others wait for it.
        fcntl.flock(lock, fcntl.LOCK_EX)
        if folder.is_dir():
            return folder
        with tempfile.TemporaryDirectory(prefix=f"{split}-", dir=base) as scratch:
            made = Path(scratch) / "made"
            made.mkdir()
            _pack_all(files, made, jobs)
            made.rename(folder)
    return folder


def _writable(root: Path) -> Path:
    home = os.environ.get("XDG_CACHE_HOME", "")
    own = (Path(home) if home else Path.home() / ".cache") / "hcnaf" / "precog"
    for base in (root / ".hcnaf", own):
        try:
            base.mkdir(parents=True, exist_ok=True)
            if os.access(base, os.W_OK):
                return base
        except OSError:
            continue
    raise DataError(f"neither {root / '.hcnaf'} nor {own} can be written; packed episodes need one of them")


def _digest(files: list[Path]) -> str:
    told = hashlib.sha256(_VERSION.encode())
    for file in files:
        stat = file.stat()
        told.update(f"{file.resolve()}\0{stat.st_size}\0{stat.st_mtime_ns}\n".encode())
    return told.hexdigest()[:16]


def _pack_all(files: list[Path], folder: Path, jobs: int) -> None:
    shape = shape_of(read_episode(files[0]))
    side = shape[-1]
    np.lib.format.open_memmap(  # type: ignore[no-untyped-call]
        folder / OVERHEAD, mode="w+", dtype=np.uint8, shape=(len(files), side, side)
    ).flush()
    names = [str(file) for file in files]
    work = [
        Job(tuple(names[first : first + _CHUNK]), str(folder), first, shape)
        for first in range(0, len(files), _CHUNK)
    ]
    if len(work) == 1:
        pack(work[0])
    else:
        _run(work, jobs)
    parts = [read_npz(path, DataError) for path in sorted(folder.glob("tracks-*.npz"))]
    write_npz(folder / "tracks.npz", {name: np.concatenate([p[name] for p in parts]) for name in _TRACKS})
    for path in folder.glob("tracks-*.npz"):
        path.unlink()


def _run(work: list[Job], jobs: int) -> None:
    with ThreadPoolExecutor(max_workers=jobs) as pool:
        try:
            for _ in pool.map(_work, work):
                pass
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _work(job: Job) -> None:
    command = [sys.executable, "-m", "hcnaf_export.data.precog_pack"]
    done = subprocess.run(command, input=msgspec.json.encode(job), capture_output=True, check=False)
    if done.returncode != 0:
        said = done.stderr.decode(errors="replace").strip().splitlines() or [f"exit {done.returncode}"]
        raise DataError(said[-1])
