"""From a trained wide flow to a bundle: graphs, parity, golden outputs, card and manifest, all or nothing."""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from hcnaf_export import card, describe, golden
from hcnaf_export.checkpoint import read_content
from hcnaf_export.export import ExportResult, check_target, replacing
from hcnaf_export.graphs import Graph
from hcnaf_export.onnx_file import IR_VERSION, OPSET, write_onnx
from hcnaf_export.parity import ONNXRUNTIME_MIN, contract, open_graph, require, row, run_torch
from hcnaf_export.tolerances import GOLDEN_FACTOR, Tolerance
from hcnaf_export.wide_graphs import wide_graphs
from hcnaf_models.wide import WideFlow
from hcnaf_models.wide_config import WideConfig, from_dict
from hcnaf_models.wide_inverse import inverse
from hcnaf_runtime import __version__
from hcnaf_runtime import manifest as m
from hcnaf_runtime.errors import CheckpointError, InputError
from hcnaf_runtime.npz import write_npz

Array = npt.NDArray[Any]
Feeds = dict[str, Array]

POINTS = 2
"""Samples of each class that the graphs are compared at."""

SEED = 20_200_614

TOLERANCES = {
    ("hypernet", "theta"): Tolerance(1e-6, 1.0, "one product with a one-hot vector, then exp"),
    ("flow", "log_prob"): Tolerance(1e-3, 2000.0, "nats; a sum over D terms, each of a sum over as many weights"),
    ("flow", "z"): Tolerance(1e-3, 1.0, "a sum over up to D H units"),
    ("flow", "log_det"): Tolerance(1e-3, 2000.0, "nats; a sum over D logarithms"),
}
"""By graph and output, as in `hcnaf_export.tolerances`."""


@dataclass(frozen=True)
class WideCheckpoint:
    """A trained wide flow, in evaluation mode, and how it came about."""

    model: WideFlow
    training: dict[str, Any]
    scores: dict[str, Any]


def load_wide(path: Path) -> WideCheckpoint:
    """The model of a `model.pt` that an MNIST recipe wrote. Nothing in the file is executed.

    Raises:
        CheckpointError: missing, not ours, of another kind, or with weights that do not fit its configuration.
    """
    content = read_content(path)
    try:
        model = WideFlow(from_dict(content["config"]))
        model.load_state_dict(content["state"])
    except (KeyError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        reason = " ".join(str(error).split())[:300]
        raise CheckpointError(
            f"{path}: not the checkpoint of a wide flow ({reason}); train mnist again"
        ) from error
    model.eval().requires_grad_(False)
    return WideCheckpoint(model, dict(content.get("training", {})), dict(content.get("scores", {})))


def export_wide(
    checkpoint: Path, out: Path, *, force: bool = False, precision: m.Precision = "fp32"
) -> ExportResult:
    """Write the bundle of `checkpoint` to the directory `out`; all of it appears, or nothing.

    The graphs are compared with PyTorch at samples of the flow itself: points like those it has learnt.

    Raises:
        CheckpointError: the checkpoint is not ours or does not fit.
        BundleError: `out` is taken, or cannot be written.
        InputError: a precision other than fp32: nearly all weights are the flow's, which is always float32.
        ParityError: a graph does not agree with PyTorch.
    """
    if precision != "fp32":
        raise InputError(f"precision is {precision}, a wide flow has fp32 only; leave it out")
    out = Path(out).absolute()
    check_target(out, force)
    loaded = load_wide(Path(checkpoint))
    graphs, name = wide_graphs(loaded.model), str(loaded.training.get("recipe") or out.name)
    feeds = probes(loaded.model, graphs[0])
    with replacing(out) as folder:
        rows = []
        for graph in graphs:
            write_onnx(graph, folder / graph.file, _metadata(name, graph, loaded.model.config))
            rows += _compare(graph, folder, feeds[graph.name])
        require(rows)
        write_npz(folder / golden.FILE, _golden(graphs, feeds))
        _texts(folder, name, loaded, graphs, rows)
    files = {f.name: f.stat().st_size for f in sorted(out.iterdir())}
    return ExportResult(tuple(rows), out, sum(files.values()), files)


def probes(model: WideFlow, hypernet: Graph) -> dict[str, Feeds]:
    """Inputs of both graphs: every class, and samples of it."""
    config = model.config
    condition = np.eye(config.classes, dtype=np.float32)
    theta = run_torch(hypernet, {"condition": condition})[0].reshape(config.classes, -1)
    uniform = np.random.default_rng(SEED).random((config.classes, POINTS, config.flow.dims))
    x = inverse(config, list(model.first), list(model.second), torch.from_numpy(theta), torch.from_numpy(uniform))
    return {
        "hypernet": {"condition": condition},
        "flow": {"theta": theta, "points": x.numpy().astype(np.float32)},
    }


def _compare(graph: Graph, folder: Path, feeds: Feeds) -> list[m.ParityRow]:
    names = [t.name for t in graph.outputs]
    found, expected = open_graph(graph, folder).run(names, feeds), run_torch(graph, feeds)
    return [
        row(graph.name, name, [(a, b)], TOLERANCES[graph.name, name])
        for name, a, b in zip(names, found, expected, strict=True)
    ]


def _golden(graphs: list[Graph], feeds: dict[str, Feeds]) -> dict[str, Array]:
    """Arrays as `hcnaf_export.golden` names them, for the first two classes."""
    arrays: dict[str, Array] = {}
    for graph in graphs:
        some = {name: value[: golden.MAPS] for name, value in feeds[graph.name].items()}
        arrays |= {f"in.{graph.name}.{name}": value for name, value in some.items()}
        for tensor, value in zip(graph.outputs, run_torch(graph, some), strict=True):
            limit = TOLERANCES[graph.name, tensor.name].limit
            arrays[f"out.{graph.name}.{tensor.name}"] = value
            arrays[f"tol.{graph.name}.{tensor.name}"] = np.array(GOLDEN_FACTOR * limit)
    return arrays


def _metadata(name: str, graph: Graph, config: WideConfig) -> dict[str, str]:
    facts: dict[str, Any] = {
        "format": m.FORMAT,
        "version": __version__,
        "name": name,
        "kind": "condition",
        "graph": graph.name,
        **_flow(config),
        "condition_size": config.classes,
        "condition_names": ",".join(_names(config)),
        "inputs": ",".join(t.name for t in graph.inputs),
        "outputs": ",".join(t.name for t in graph.outputs),
    }
    return {f"hcnaf.{key}": str(value) for key, value in facts.items()}


def _flow(config: WideConfig) -> dict[str, Any]:
    """Sizes; P is the length of theta, which here is what depends on the class."""
    spec = config.flow
    return {
        "dims": spec.dims,
        "layers": spec.layers,
        "hidden": spec.hidden,
        "support": spec.support,
        "weight_norm": spec.weight_norm,
        "parameters": config.parameters,
    }


def _names(config: WideConfig) -> list[str]:
    return list(config.names or (f"c{k + 1}" for k in range(config.classes)))


def _texts(folder: Path, name: str, loaded: WideCheckpoint, graphs: list[Graph], rows: list[m.ParityRow]) -> None:
    """The card, then the manifest that names it with all the others."""
    training = loaded.training | {"shared_weights": loaded.model.config.shared}

    def manifest() -> m.Manifest:
        files = {f.name: describe.fingerprint(f) for f in sorted(folder.iterdir())}
        return _manifest(name, loaded.model.config, graphs, files, rows, training, loaded.scores)

    (folder / card.FILE).write_text(card.card(manifest()), encoding="utf-8")
    (folder / m.FILE).write_bytes(m.encode(manifest()))


def _manifest(
    name: str,
    config: WideConfig,
    graphs: list[Graph],
    files: Mapping[str, m.File],
    rows: list[m.ParityRow],
    training: Mapping[str, Any],
    scores: Mapping[str, Any],
) -> m.Manifest:
    return m.Manifest(
        name=name,
        version=__version__,
        created=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        kind="condition",
        flow=m.Flow(**_flow(config)),
        graphs={graph.name: contract(graph) for graph in graphs},
        opset=OPSET,
        ir_version=IR_VERSION,
        onnxruntime_min=ONNXRUNTIME_MIN,
        files=dict(files),
        condition=m.ConditionContract(size=config.classes, names=_names(config)),
        parity=rows,
        training=describe.plain(training),
        scores=describe.plain(scores),
    )
