"""A cell as it ships: exported, and timed by the runtime alone on this machine."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import msgspec

from hcnaf_export.experiments.occupancy import Plan, cell_folder
from hcnaf_export.export import export_bundle
from hcnaf_runtime.bench import Bench
from hcnaf_runtime.bundle import embedded_scenes
from hcnaf_runtime.forecaster import Forecaster
from hcnaf_runtime.scene import Scene

FILE = "bundle.json"
SECONDS = 2.0
"""Time given to each case."""


class BundleFacts(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An exported model.

    Attributes:
        bytes: of the whole bundle. hypernet, flow: of these two graphs, which answer with log-densities.
        theta_ms: the hyper-network for 1 agent and 20 horizons. dense_ms: an exact dense map, of 20 in a call.
        forecast_ms: a whole certified forecast of 1 agent and 20 horizons.
        threads: the runtime's.
    """

    bytes: int
    hypernet: int
    flow: int
    theta_ms: float
    dense_ms: float
    forecast_ms: float
    threads: int

    HEAD: ClassVar[tuple[str, ...]] = (
        "bundle (MB)",
        "hyper-network (MB)",
        "theta (ms)",
        "dense map (ms)",
        "certified forecast (ms)",
    )

    def row(self) -> tuple[str, ...]:
        """As text, under HEAD."""
        sizes = (f"{size / 1e6:.2f}" for size in (self.bytes, self.hypernet))
        times = (f"{time:.2f}" for time in (self.theta_ms, self.dense_ms, self.forecast_ms))
        return (*sizes, *times)


def run_bundle(plan: Plan, cell: str, seed: int, threads: int = 2) -> None:
    """Export a cell that is trained to its folder `bundle` and time that, unless it is done.

    Times mean something on an idle machine only, and beside each other.

    Raises:
        ParityError: a graph does not agree with PyTorch.
    """
    folder = cell_folder(plan.out, cell, seed)
    if (folder / FILE).is_file():
        return
    if not (folder / "bundle").is_dir():
        export_bundle(folder / "model.pt", folder / "bundle")
    (folder / FILE).write_bytes(msgspec.json.encode(measure_bundle(folder / "bundle", threads)))


def measure_bundle(bundle: Path, threads: int, seconds: float = SECONDS) -> BundleFacts:
    """Sizes of a bundle's files and times of its answers."""
    scenes = {name: Scene.load(path) for name, path in embedded_scenes().items()}
    bench = Bench(Forecaster(bundle, threads=threads), scenes, seconds=seconds)
    rows = {row.name: row for row in bench.rows(("hypernet", "dense", "forecast"))}

    def per_map(name: str) -> float:
        return 1e3 * rows[name].per_map

    asked = "1 agent x 20 horizons"
    return BundleFacts(
        bytes=sum(f.stat().st_size for f in bundle.iterdir()),
        hypernet=(bundle / "hypernet.onnx").stat().st_size,
        flow=(bundle / "flow.onnx").stat().st_size,
        theta_ms=per_map(f"hyper-network, {asked}"),
        dense_ms=per_map(f"dense maps after theta, {asked}"),
        forecast_ms=20.0 * per_map(f"whole forecast, certified, {asked}"),
        threads=threads,
    )


def load_bundle(folder: Path) -> BundleFacts | None:
    """What `run_bundle` found for a cell, if it was run."""
    path = folder / FILE
    return msgspec.json.decode(path.read_bytes(), type=BundleFacts) if path.is_file() else None
