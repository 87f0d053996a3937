"""The density everyone is timed on: a random flow, spread over the window, as PyTorch, bundle and points."""

import hashlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

import hcnaf_export
import hcnaf_models
from hcnaf_export import describe
from hcnaf_export.graphs import graphs
from hcnaf_export.onnx_file import write_onnx
from hcnaf_models.config import ConditionConfig
from hcnaf_models.model import Hcnaf, build
from hcnaf_models.spec import FlowSpec
from hcnaf_runtime import Bundle, Condition, Forecaster, Grid
from hcnaf_runtime import manifest as manifests

SIDE = 100.0
"""Width of the window (m)."""
SPREAD = 12.0
"""Base scale (m): the density then fills most of the window."""
JITTER = 0.3


@dataclass(frozen=True)
class Density:
    """One flow, its bundle in `folder`, and a forecaster on it."""

    spec: FlowSpec
    folder: Path
    threads: int

    @classmethod
    def make(cls, L: int, H: int, folder: Path, threads: int) -> "Density":
        """Build and export the flow, unless `folder` has it already."""
        found = cls(FlowSpec(layers=L, hidden=H), folder / f"L{L}-H{H}", threads)
        if not (found.folder / manifests.FILE).is_file():
            export(random_model(found.spec), found.folder)
        return found

    @cached_property
    def forecaster(self) -> Forecaster:
        return Forecaster(Bundle.open(self.folder), self.threads)

    def condition(self, maps: int = 1, scale: float = 1.0) -> Condition:
        """Conditions of so many different maps, all about `scale` times as wide as the base."""
        values = np.log(scale) + np.linspace(-0.1, 0.1, maps + 2)[1:-1]
        return Condition(values[:, None].astype(np.float32))

    @cached_property
    def theta(self) -> Tensor:
        """[P]: the weights of a single map."""
        return torch.from_numpy(self.forecaster.theta(self.condition()).values[0, 0].copy())


def random_model(spec: FlowSpec, seed: int = 0) -> Hcnaf:
    """A flow at its initialisation plus jitter; the condition is the log of its scale and bends it a little."""
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        torch.manual_seed(seed)
        model = build(ConditionConfig(flow=spec, size=1, hidden=(), scale=SPREAD))
        head = model.hypernet.head
        head.weights.bias.add_(JITTER * torch.randn_like(head.weights.bias))
        head.weights.weight.normal_(0.0, JITTER)
        head.units.weight[spec.dims :] = 1.0
    return model.eval().requires_grad_(False)


def source() -> str:
    """A name that changes with everything the exported graphs depend on."""
    rooms = [Path(module.__file__ or "").parent for module in (hcnaf_models, hcnaf_export)]
    files = [*sorted(rooms[0].glob("*.py")), rooms[1] / "graphs.py", rooms[1] / "onnx_file.py", Path(__file__)]
    digest = hashlib.sha256(torch.__version__.encode())
    for file in files:
        digest.update(file.read_bytes())
    return digest.hexdigest()[:12]


def export(model: Hcnaf, folder: Path) -> None:
    """The bundle of a model without the parity report, which takes longer than the rest."""
    folder.mkdir(parents=True, exist_ok=True)
    parts = [graph for graph in graphs(model) if graph.name != "inverse"]  # takes longest, and is not timed here
    for graph in parts:
        write_onnx(graph, folder / graph.file, {})
    files = {graph.file: describe.fingerprint(folder / graph.file) for graph in parts}
    manifest = describe.manifest("random", model.config, parts, files, rows=[], training={}, scores={})
    (folder / manifests.FILE).write_bytes(manifests.encode(manifest))


def window(cells: int = 200) -> Grid:
    """So many cells each way over the window about the origin."""
    return Grid(cells, cells, SIDE / cells).at(-SIDE / 2, -SIDE / 2)


def centres(cells: int = 200) -> npt.NDArray[np.float32]:
    """[N, 2]: the cells' centres (m)."""
    return window(cells).centres.reshape(-1, 2)
