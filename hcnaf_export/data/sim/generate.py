"""A whole data set: every network of every split, simulated by worker processes, and the manifest."""

import importlib.metadata
import importlib.util
import subprocess
import sys
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import get_args

import msgspec

from hcnaf_export.data.manifest import FORMAT, VERSION, Manifest, SetEntry, Split
from hcnaf_export.data.sim.settings import SimSettings
from hcnaf_export.data.sim.streets import JUNCTIONS, LAYOUTS
from hcnaf_export.data.sim.worker import Task
from hcnaf_export.data.tracks import FUTURE, HISTORY, STEP, Dataset
from hcnaf_runtime.errors import DataError, MissingExtraError

SPLITS: tuple[Split, ...] = get_args(Split)

Progress = Callable[[str, float], None]
"""Told after each network: what was made, and the fraction of the work done in [0, 1]."""


def simulate(out: Path, settings: SimSettings | None = None, progress: Progress | None = None) -> Dataset:
    """Simulate a data set. The same settings and SUMO version give the same arrays, whatever `jobs` is.

    Args:
        out: directory to make; it appears only when everything is done.
        settings: what to simulate; the defaults if None.
        progress: called after each network with a line of text and the fraction done.

    Returns:
        The data set, ready to read.

    Raises:
        DataError: `out` exists and is not an empty directory, or a network cannot be built, read or driven on.
        MissingExtraError: SUMO or Pillow is not installed.
    """
    settings = settings or SimSettings()
    out = Path(out)
    _check(out, settings)
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{out.name}-", dir=out.parent) as scratch:
        folder = Path(scratch) / "data"
        folder.mkdir()
        tasks = [(split, task) for split in SPLITS for task in plan_tasks(split, settings, folder)]
        entries = _run(tasks, settings.jobs, progress)
        manifest = _manifest(settings, entries)
        (folder / "dataset.json").write_bytes(msgspec.json.format(msgspec.json.encode(manifest), indent=2))
        if out.exists():
            out.rmdir()
        folder.rename(out)
    return Dataset(out)


def plan_tasks(split: Split, settings: SimSettings, folder: Path) -> list[Task]:
    """One task per network of a split: layouts and junction rules in turn, so that all combinations occur."""
    count, shift = settings.networks(split), SPLITS.index(split)
    return [
        Task(
            name=f"{split}-{i:02d}",
            seeds=(settings.seed, shift, i),
            net=str(Path(settings.nets(split)[i]).resolve()) if settings.nets(split) else None,
            layout=LAYOUTS[(i + shift) % len(LAYOUTS)],
            junction=JUNCTIONS[(i + 2 * shift) % len(JUNCTIONS)],
            windows=settings.windows(split) * (i + 1) // count - settings.windows(split) * i // count,
            settings=settings,
            folder=str(folder),
        )
        for i in range(count)
    ]


def missing_module() -> str | None:
    """The first module of the extra `sim` that is not installed, None if all are."""
    return next((name for name in ("libsumo", "sumo", "PIL") if importlib.util.find_spec(name) is None), None)


def _check(out: Path, settings: SimSettings) -> None:
    absent = missing_module()
    if absent:
        raise MissingExtraError(
            f'the simulator needs {absent}, which is not installed; run: pip install "hcnaf[sim]"'
        )
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise DataError(f"{out} already exists; expected a new directory, choose another or remove it")
    needed = (HISTORY + FUTURE) * STEP
    if settings.seconds < needed or settings.jobs < 1:
        raise DataError(
            f"seconds is {settings.seconds} and jobs {settings.jobs}; expected at least {needed} s and 1 job"
        )


def _run(tasks: list[tuple[Split, Task]], jobs: int, progress: Progress | None) -> dict[Split, list[SetEntry]]:
    entries: dict[Split, list[SetEntry]] = {split: [] for split in SPLITS}
    with ThreadPoolExecutor(max_workers=jobs) as pool:
        made = pool.map(_work, [task for _, task in tasks])
        try:
            for done, ((split, _), entry) in enumerate(zip(tasks, made, strict=True), start=1):
                entries[split].append(entry)
                if progress:
                    line = f"{entry.file}: {entry.network}, {entry.tracks} tracks, {entry.windows} windows"
                    progress(line, done / len(tasks))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return entries


def _work(task: Task) -> SetEntry:
    command = [sys.executable, "-m", "hcnaf_export.data.sim.worker"]
    done = subprocess.run(command, input=msgspec.json.encode(task), capture_output=True, check=False)
    note = Path(task.folder) / f"{task.name}.json"
    if done.returncode != 0 or not note.exists():
        said = (done.stderr.decode(errors="replace").strip().splitlines() or [f"exit {done.returncode}"])[-1]
        raise DataError(f"simulating {task.name} failed: {said}")
    entry = msgspec.json.decode(note.read_bytes(), type=SetEntry)
    note.unlink()
    return entry


def _manifest(settings: SimSettings, entries: dict[Split, list[SetEntry]]) -> Manifest:
    return Manifest(
        format=FORMAT,
        version=VERSION,
        seed=settings.seed,
        splits=entries,
        noise=settings.noise,
        nll_floor=settings.noise.label_entropy,
        step=STEP,
        history=HISTORY,
        future=FUTURE,
        settings=msgspec.to_builtins(settings),
        software={name: importlib.metadata.version(name) for name in ("eclipse-sumo", "libsumo", "numpy")},
    )
