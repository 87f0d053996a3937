"""golden.npz: inputs and PyTorch's outputs of every graph, to re-check a bundle on a vehicle without torch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from hcnaf_export.graphs import Graph
from hcnaf_export.parity import run_torch
from hcnaf_export.probes import SEED, Feeds, SceneSetting, conditions, flow_feeds, scene
from hcnaf_export.tolerances import GOLDEN_FACTOR, tolerance
from hcnaf_models.config import ConditionConfig
from hcnaf_models.model import Hcnaf

Array = npt.NDArray[Any]

FILE = "golden.npz"
MAPS = 2
SETTING = SceneSetting(agents=5, targets=2, horizons=(1.0, 3.0), raster=(64, 80), stops=2, dropped=0.2)


def golden(model: Hcnaf, graphs: Sequence[Graph]) -> dict[str, Array]:
    """Arrays `in.<graph>.<input>`, `out.<graph>.<output>` and `tol.<graph>.<output>` (a number each)."""
    hypernet, *others = graphs
    feeds = _hypernet_feeds(model)
    arrays = _entries(hypernet, feeds)
    spec = model.config.flow
    theta = arrays["out.hypernet.theta"].reshape(-1, spec.parameters)[:MAPS]
    for graph in others:
        arrays |= _entries(graph, flow_feeds(graph.name, spec, theta))
    return arrays


def _hypernet_feeds(model: Hcnaf) -> Feeds:
    rng = np.random.default_rng(SEED)
    if isinstance(model.config, ConditionConfig):
        return conditions(model.config, rng)["typical"]
    return scene(model.config, SETTING, rng)


def _entries(graph: Graph, feeds: Feeds) -> dict[str, Array]:
    arrays = {f"in.{graph.name}.{name}": value for name, value in feeds.items()}
    for contract, value in zip(graph.outputs, run_torch(graph, feeds), strict=True):
        limit = GOLDEN_FACTOR * tolerance(graph.name, contract.name).limit
        arrays[f"out.{graph.name}.{contract.name}"] = value
        arrays[f"tol.{graph.name}.{contract.name}"] = np.array(limit)
    return arrays
