"""golden.npz: inputs and PyTorch's outputs of every graph, to re-check a bundle on a vehicle without torch."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hcnaf_export.describe import HYPERNET_IN
from hcnaf_export.graphs import Graph
from hcnaf_export.parity import open_graph, run_torch
from hcnaf_export.probes import SEED, Feeds, SceneSetting, conditions, edges, flow_feeds, scene
from hcnaf_export.tolerances import GOLDEN_FACTOR, GOLDEN_INT8, UNITS, tolerance
from hcnaf_models.config import ConditionConfig, PomConfig
from hcnaf_models.model import Hcnaf
from hcnaf_runtime.manifest import Precision

Array = npt.NDArray[Any]

FILE = "golden.npz"
MAPS = 2
SETTING = SceneSetting(agents=5, targets=2, horizons=(1.0, 3.0), raster=(64, 80), stops=2, dropped=0.2)


def golden(
    model: Hcnaf, graphs: Sequence[Graph], converted: Path | None = None, precision: Precision = "fp32"
) -> dict[str, Array]:
    """Arrays `in.<graph>.<input>`, `out.<graph>.<output>` and `tol.<graph>.<output>` (a number each).

    Where the hyper-network is of another precision, what it gives is what the graphs in `converted` give.
    """
    hypernet, *others = graphs
    inputs = _hypernet_feeds(model)
    arrays = _entries(hypernet, inputs, converted, precision)
    spec = model.config.flow
    theta = arrays["out.hypernet.theta"].reshape(-1, spec.parameters)[:MAPS]
    for graph in others:
        if graph.name in HYPERNET_IN:
            arrays |= _entries(graph, inputs | edges(), converted, precision)
        else:
            arrays |= _entries(graph, flow_feeds(graph.name, spec, theta), hidden=spec.hidden)
    return arrays


def _hypernet_feeds(model: Hcnaf) -> Feeds:
    rng = np.random.default_rng(SEED)
    if isinstance(model.config, ConditionConfig):
        return conditions(model.config, rng)["typical"]
    assert isinstance(model.config, PomConfig)  # see `exportable`
    return scene(model.config, SETTING, rng)


def _entries(
    graph: Graph,
    feeds: Feeds,
    converted: Path | None = None,
    precision: Precision = "fp32",
    hidden: int = UNITS,
) -> dict[str, Array]:
    arrays = {f"in.{graph.name}.{name}": value for name, value in feeds.items()}
    names = [tensor.name for tensor in graph.outputs]
    found = open_graph(graph, converted).run(names, feeds) if converted else run_torch(graph, feeds)
    for name, value in zip(names, found, strict=True):
        limit = GOLDEN_FACTOR * tolerance(graph.name, name, hidden).limit
        arrays[f"out.{graph.name}.{name}"] = value
        arrays[f"tol.{graph.name}.{name}"] = np.array(max(limit, GOLDEN_INT8 if precision == "int8" else 0.0))
    return arrays
