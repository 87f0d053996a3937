"""From a checkpoint to a bundle: graphs, parity, golden outputs, card and manifest, all or nothing."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx

from hcnaf_export import calibration as calibrations
from hcnaf_export import card, cost, describe, golden, parity
from hcnaf_export import precision as precisions
from hcnaf_export.checkpoint import Checkpoint, load_checkpoint, read_content
from hcnaf_export.exportable import exportable
from hcnaf_export.forecast import all_graphs, compose, trace_map
from hcnaf_export.graphs import Graph
from hcnaf_export.onnx_file import finish, save, write_onnx
from hcnaf_export.probes import Feeds, hypernet_feeds
from hcnaf_models.config import PomConfig
from hcnaf_runtime import manifest as manifests
from hcnaf_runtime.errors import BundleError
from hcnaf_runtime.forecaster import DEFAULT_GRID
from hcnaf_runtime.manifest import ParityRow, Precision
from hcnaf_runtime.npz import write_npz
from hcnaf_runtime.scene import Scene

Progress = Callable[[str, int, int], None]
"""Called before each step with its name, its number from 0, and how many there are."""


@dataclass(frozen=True)
class ExportResult:
    """What was exported: the parity table of the float32 graphs, where it is, its size in bytes and that of each
    file, the precision, and what it costs (empty for fp32, see `hcnaf_export.cost`)."""

    rows: tuple[ParityRow, ...]
    path: Path
    bytes: int
    files: dict[str, int]
    precision: Precision = "fp32"
    cost: dict[str, Any] = field(default_factory=dict)


def export_bundle(
    checkpoint: Path,
    out: Path,
    *,
    force: bool = False,
    precision: Precision = "fp32",
    calibration: Path | None = None,
    density_only: bool = False,
    progress: Progress | None = None,
) -> ExportResult:
    """Write the bundle of `checkpoint` to the directory `out`; all of it appears, or nothing.

    With `force` a bundle that is already there is replaced once the new one is complete. `precision` is that of
    the hyper-network's weights; int8 needs the data set `calibration` where there are convolutions. Float32 graphs
    are held against PyTorch first, whatever the precision. `density_only` leaves out all graphs but the
    hyper-network and the flow: such a bundle answers with log-densities alone, and takes a fifth of the time.

    Raises:
        CheckpointError: the checkpoint is not ours or does not fit.
        BundleError: `out` is taken, or cannot be written.
        InputError: calibration data are missing, not needed, or do not fit the model.
        ParityError: a graph does not agree with PyTorch, or the precision costs too much.
    """
    if read_content(Path(checkpoint))["config"].get("kind") == "wide":
        from hcnaf_export.wide_export import export_wide  # which builds on this module

        return export_wide(checkpoint, out, force=force, precision=precision)
    out = Path(out).absolute()
    check_target(out, force)
    loaded = exportable(load_checkpoint(Path(checkpoint)))
    precisions.check(loaded.config, precision, calibration)
    scenes = calibrations.scenes(calibration) if calibration else []
    with replacing(out) as folder:
        name = str(loaded.training.get("recipe") or out.name)
        rows, paid = _Export(loaded, folder, name, precision, scenes, density_only).run(
            progress or (lambda *_: None)
        )
    files = {f.name: f.stat().st_size for f in sorted(out.iterdir())}
    return ExportResult(rows, out, sum(files.values()), files, precision, paid)


class _Export:
    """The files of one bundle, written to `folder` in the order they need each other."""

    def __init__(
        self,
        loaded: Checkpoint,
        folder: Path,
        name: str,
        precision: Precision,
        scenes: Sequence[Scene],
        density_only: bool,
    ) -> None:
        self.loaded, self.folder, self.name = loaded, folder, name
        self.precision = precision
        self.parts = all_graphs(loaded.model)[: 2 if density_only else None]
        self.optional = describe.optional_channels(loaded.config, loaded.training)
        self.one_map: onnx.ModelProto | None = None
        self.measured_on = "scenes of the split val" if scenes else "made-up inputs"
        self.calibrate, self.probe = self._feeds(scenes)

    def run(self, progress: Progress) -> tuple[tuple[ParityRow, ...], dict[str, Any]]:
        names = [*(g.file for g in self.parts), "parity", "golden outputs and manifest"]
        if self.precision != "fp32":
            names.insert(-1, f"precision {self.precision}")
        for k, graph in enumerate(self.parts):
            progress(graph.file, k, len(names))
            self._graph(graph)
        progress("parity", len(self.parts), len(names))
        rows = parity.compare(self.loaded.model, self.parts, self.folder)
        parity.require(rows)
        found: dict[str, Any] = {}
        if self.precision != "fp32":
            progress(names[-2], len(names) - 2, len(names))
            found = self._lower()
        progress(names[-1], len(names) - 1, len(names))
        converted = self.folder if self.precision != "fp32" else None
        write_npz(
            self.folder / golden.FILE, golden.golden(self.loaded.model, self.parts, converted, self.precision)
        )
        self._texts(rows, found)
        return tuple(rows), found

    def _graph(self, graph: Graph) -> None:
        if graph.name == "forecast":
            self._forecast(graph)
        else:
            write_onnx(graph, self.folder / graph.file, self._metadata(graph))

    def _forecast(self, graph: Graph) -> None:
        """From the hyper-network as it lies in the folder."""
        self.one_map = self.one_map or trace_map(self.loaded.config.flow)
        hypernet = onnx.load(self.folder / self.parts[0].file)
        save(compose(graph, hypernet, self.one_map, self._metadata(graph)), self.folder / graph.file)

    def _metadata(self, graph: Graph) -> dict[str, str]:
        return describe.metadata(self.name, graph, self.loaded.config, self.optional, self.precision)

    def _lower(self) -> dict[str, Any]:
        """The hyper-network in the precision asked for, in both graphs that hold it, and what that costs."""
        hypernet = self.parts[0]
        before, sizes = self._thetas(), cost.sizes(self.folder)
        path = self.folder / hypernet.file
        model = precisions.convert(onnx.load(path), self.precision, self.calibrate)
        finish(model, hypernet, self._metadata(hypernet))
        save(model, path)
        for graph in self.parts:
            if graph.name == "forecast":
                self._forecast(graph)
        window = None
        if isinstance(self.loaded.config, PomConfig):
            grid = DEFAULT_GRID.ahead()
            window = np.stack([grid.x_edges, grid.y_edges])
        found = cost.measure(self.loaded.config.flow, before, self._thetas(), window)
        cost.require(self.precision, found)
        return found | {"measured_on": self.measured_on, "bytes": cost.sizes(self.folder), "bytes_fp32": sizes}

    def _feeds(self, scenes: Sequence[Scene]) -> tuple[list[Feeds], list[Feeds]]:
        """Inputs to calibrate and to measure on: those of the data set, made-up ones where there is none."""
        if not scenes:
            return [], list(hypernet_feeds(self.loaded.model).values())
        unwritten = {graph.file: manifests.File(sha256="", bytes=0) for graph in self.parts}
        return calibrations.feeds(self._manifest(unwritten, [], {}), scenes)

    def _thetas(self) -> list[npt.NDArray[Any]]:
        session = parity.open_graph(self.parts[0], self.folder)
        return [session.run(["theta"], each)[0] for each in self.probe]

    def _texts(self, rows: list[ParityRow], found: dict[str, Any]) -> None:
        """The card, then the manifest that names it with all the others."""

        def manifest() -> manifests.Manifest:
            files = {f.name: describe.fingerprint(f) for f in sorted(self.folder.iterdir())}
            return self._manifest(files, rows, found)

        (self.folder / card.FILE).write_text(card.card(manifest()), encoding="utf-8")
        (self.folder / manifests.FILE).write_bytes(manifests.encode(manifest()))

    def _manifest(
        self, files: dict[str, manifests.File], rows: list[ParityRow], found: dict[str, Any]
    ) -> manifests.Manifest:
        return describe.manifest(
            self.name,
            self.loaded.config,
            self.parts,
            files,
            rows=rows,
            training=self.loaded.training,
            scores=self.loaded.scores,
            precision=self.precision,
            precision_cost=found,
        )


def check_target(out: Path, force: bool) -> None:
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
def replacing(out: Path) -> Iterator[Path]:
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
