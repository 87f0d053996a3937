"""What a bundle says of itself: the manifest, and its essentials as each graph's metadata_props."""

from __future__ import annotations

import datetime
import hashlib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hcnaf_export.graphs import Graph
from hcnaf_export.onnx_file import IR_VERSION, OPSET
from hcnaf_export.parity import ONNXRUNTIME_MIN, contract
from hcnaf_models.config import ConditionConfig, ModelConfig, PomConfig
from hcnaf_runtime import __version__
from hcnaf_runtime import manifest as m

HYPERNET_IN = ("hypernet", "forecast")
"""The graphs that hold the hyper-network."""


def metadata(
    name: str, graph: Graph, config: ModelConfig, optional: Sequence[str], precision: m.Precision = "fp32"
) -> dict[str, str]:
    """The manifest's essentials as text, so that a program needs no JSON. Lists are joined by commas."""
    flow = config.flow
    facts: dict[str, Any] = {
        "format": m.FORMAT,
        "version": __version__,
        "name": name,
        "kind": config.kind,
        "graph": graph.name,
        "dims": flow.dims,
        "layers": flow.layers,
        "hidden": flow.hidden,
        "parameters": flow.parameters,
        "support": flow.support,
        "weight_norm": flow.weight_norm,
        "precision": precision if graph.name in HYPERNET_IN else "fp32",
        "inputs": ",".join(t.name for t in graph.inputs),
        "outputs": ",".join(t.name for t in graph.outputs),
    }
    if isinstance(config, PomConfig):
        facts |= {
            "history": config.history,
            "step": config.step,
            "horizon_min": 0.0,
            "horizon_max": config.horizon,
            "channels": ",".join(config.channels),
            "optional_channels": ",".join(optional),
            "stops": int(config.stops),
        }
    elif isinstance(config, ConditionConfig):
        facts |= {"condition_size": config.size, "condition_names": ",".join(condition_names(config))}
    return {f"hcnaf.{key}": str(value) for key, value in facts.items()}


def manifest(
    name: str,
    config: ModelConfig,
    graphs: Sequence[Graph],
    files: Mapping[str, m.File],
    *,
    rows: Sequence[m.ParityRow],
    training: Mapping[str, Any],
    scores: Mapping[str, Any],
    precision: m.Precision = "fp32",
    precision_cost: Mapping[str, Any] | None = None,
) -> m.Manifest:
    """The manifest of a bundle whose other `files` are complete."""
    flow = config.flow
    return m.Manifest(
        name=name,
        version=__version__,
        created=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        kind="pom" if isinstance(config, PomConfig) else "condition",
        flow=m.Flow(
            dims=flow.dims,
            layers=flow.layers,
            hidden=flow.hidden,
            support=flow.support,
            weight_norm=flow.weight_norm,
            parameters=flow.parameters,
        ),
        graphs={graph.name: contract(graph) for graph in graphs},
        opset=OPSET,
        ir_version=IR_VERSION,
        onnxruntime_min=ONNXRUNTIME_MIN,
        files=dict(files),
        parity=list(rows),
        training=plain(training),
        scores=plain(scores),
        precision=precision,
        precision_cost=plain(precision_cost or {}),
        **_input(config, optional_channels(config, training)),
    )


def _input(config: ModelConfig, optional: Sequence[str]) -> dict[str, Any]:
    """The part of the manifest that says what the hyper-network needs."""
    if isinstance(config, ConditionConfig):
        return {"condition": m.ConditionContract(size=config.size, names=list(condition_names(config)))}
    assert isinstance(config, PomConfig)  # see `exportable`
    scene = m.SceneContract(
        step=config.step,
        history=config.history,
        channels=list(config.channels),
        optional_channels=list(optional),
        stops=config.stops,
    )
    return {"scene": scene, "horizons": m.HorizonRange(min=0.0, max=config.horizon)}


def condition_names(config: ConditionConfig) -> tuple[str, ...]:
    """The names of a condition's numbers, c1 .. cK where it has none."""
    return config.names or tuple(f"c{k + 1}" for k in range(config.size))


def optional_channels(config: ModelConfig, training: Mapping[str, Any]) -> tuple[str, ...]:
    """Raster channels that training dropped at random and that may therefore be absent, in the graph's order."""
    if not isinstance(config, PomConfig):
        return ()
    dropped = training.get("optional_channels") or ()
    return tuple(c for c in config.channels if c in dropped)


def fingerprint(path: Path) -> m.File:
    """Hash and size of a finished file."""
    with path.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    return m.File(sha256=digest, bytes=path.stat().st_size)


def plain(value: Any) -> Any:
    """Training facts and scores as JSON can hold them: str keys, lists, None for what is not finite."""
    if isinstance(value, Mapping):
        return {str(key): plain(v) for key, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, (str, int, float, bool)) or value is None else str(value)
