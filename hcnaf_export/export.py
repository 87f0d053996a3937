"""From a checkpoint to a bundle: graphs, parity, golden outputs, card and manifest, all or nothing."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from hcnaf_export import card, describe, golden, parity
from hcnaf_export.checkpoint import Checkpoint, load_checkpoint
from hcnaf_export.graphs import graphs
from hcnaf_export.onnx_file import write_onnx
from hcnaf_runtime import manifest as manifests
from hcnaf_runtime.errors import BundleError
from hcnaf_runtime.manifest import ParityRow
from hcnaf_runtime.npz import write_npz

Progress = Callable[[str, int, int], None]
"""Called before each step with its name, its number from 0, and how many there are."""


@dataclass(frozen=True)
class ExportResult:
    """What was exported: the parity table, where it is and its size in bytes."""

    rows: tuple[ParityRow, ...]
    path: Path
    bytes: int


def export_bundle(
    checkpoint: Path, out: Path, *, force: bool = False, progress: Progress | None = None
) -> ExportResult:
    """Write the bundle of `checkpoint` to the directory `out`; all of it appears, or nothing.

    With `force` a bundle that is already there is replaced once the new one is complete.

    Raises:
        CheckpointError: the checkpoint is not ours or does not fit.
        BundleError: `out` is taken, or cannot be written.
        ParityError: a graph does not agree with PyTorch.
    """
    out = Path(out).absolute()
    _check_target(out, force)
    loaded = load_checkpoint(Path(checkpoint))
    with _replacing(out) as folder:
        rows = _write(loaded, folder, out.name, progress or (lambda *_: None))
    return ExportResult(rows, out, sum(f.stat().st_size for f in out.iterdir()))


def _write(loaded: Checkpoint, folder: Path, name: str, progress: Progress) -> tuple[ParityRow, ...]:
    model, config, training = loaded.model, loaded.config, loaded.training
    parts = graphs(model)
    steps = len(parts) + 2
    optional = describe.optional_channels(config, training)
    for k, graph in enumerate(parts):
        progress(graph.file, k, steps)
        write_onnx(graph, folder / graph.file, describe.metadata(name, graph, config, optional))
    progress("parity", steps - 2, steps)
    rows = parity.compare(model, parts, folder)
    parity.require(rows)
    progress("golden outputs and manifest", steps - 1, steps)
    write_npz(folder / golden.FILE, golden.golden(model, parts))
    _write_texts(loaded, folder, name, rows)
    return tuple(rows)


def _write_texts(loaded: Checkpoint, folder: Path, name: str, rows: list[ParityRow]) -> None:
    """The card, then the manifest that names it with all the others."""

    def manifest() -> manifests.Manifest:
        files = {f.name: describe.fingerprint(f) for f in sorted(folder.iterdir())}
        return describe.manifest(
            name,
            loaded.config,
            graphs(loaded.model),
            files,
            rows=rows,
            training=loaded.training,
            scores=loaded.scores,
        )

    (folder / card.FILE).write_text(card.card(manifest()), encoding="utf-8")
    (folder / manifests.FILE).write_bytes(manifests.encode(manifest()))


def _check_target(out: Path, force: bool) -> None:
    """Refuse to overwrite: anything without `force`, and what is no bundle even with it."""
    if not out.exists():
        return
    if not out.is_dir():
        raise BundleError(f"{out} is a file, expected a directory to write a bundle to; choose another")
    if not any(out.iterdir()):
        return
    if not force:
        raise BundleError(f"{out} is not empty; choose another directory, or --force to replace a bundle")
    if not (out / manifests.FILE).is_file():
        raise BundleError(
            f"{out} holds no {manifests.FILE}, so it is not a bundle to replace; choose another directory"
        )


@contextmanager
def _replacing(out: Path) -> Iterator[Path]:
    """A new directory beside `out` that takes its place when the block ends without an error."""
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out.parent))
    except OSError as e:
        raise BundleError(f"{out} cannot be written ({e.strerror or e}); choose another directory") from e
    try:
        yield folder
        folder.chmod(0o755)  # mkdtemp makes directories that only their owner reads
        _swap(folder, out)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _swap(folder: Path, out: Path) -> None:
    """Move `folder` to `out`; what was there is put back if that fails, and removed if not."""
    if not out.exists():
        os.rename(folder, out)
        return
    aside = Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out.parent))
    os.rename(out, aside / "old")
    try:
        os.rename(folder, out)
    except BaseException:
        os.rename(aside / "old", out)
        raise
    finally:
        shutil.rmtree(aside, ignore_errors=True)
