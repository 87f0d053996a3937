"""PyTorch against onnxruntime: every graph of a bundle and every output, over structured and edge inputs.

Both sides of a flow graph get the same float32 theta. The row `path` follows a forecast instead: each side feeds
its own theta to its own flow. Sessions are those of the runtime, with its settings.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from hcnaf_export.graphs import Graph
from hcnaf_export.probes import Feeds, flow_cases, flow_feeds, forecast_feeds, hypernet_feeds
from hcnaf_export.tolerances import UNITS, Tolerance, tolerance
from hcnaf_models import flow
from hcnaf_models.model import Hcnaf
from hcnaf_models.spec import FlowSpec
from hcnaf_runtime.errors import ParityError
from hcnaf_runtime.flow import MISSED
from hcnaf_runtime.manifest import Graph as GraphContract
from hcnaf_runtime.manifest import ParityRow
from hcnaf_runtime.session import Session, Settings

Array = npt.NDArray[Any]
ONNXRUNTIME_MIN = "1.20"
_THREADS = 1


def contract(graph: Graph) -> GraphContract:
    """The graph as the manifest names it."""
    return GraphContract(file=graph.file, inputs=list(graph.inputs), outputs=list(graph.outputs))


def open_graph(graph: Graph, folder: Path) -> Session:
    return Session(folder / graph.file, contract(graph), Settings(_THREADS), ONNXRUNTIME_MIN)


def run_torch(graph: Graph, feeds: Feeds) -> list[Array]:
    """The graph's outputs from PyTorch, in float32."""
    with torch.no_grad():
        result = graph.module(**{name: torch.from_numpy(value) for name, value in feeds.items()})
    return [v.numpy() for v in (result if isinstance(result, tuple) else (result,))]


def compare(model: Hcnaf, graphs: Sequence[Graph], folder: Path) -> list[ParityRow]:
    """One row per graph and output for the .onnx files in `folder`. Differences do not raise: see `require`."""
    spec, by_name = model.config.flow, {str(g.name): g for g in graphs}
    scenes = hypernet_feeds(model)
    trained = {name: run_torch(by_name["hypernet"], feeds)[0] for name, feeds in scenes.items()}
    rows: list[ParityRow] = []
    for graph in graphs:
        if graph.name == "forecast":
            cases = forecast_feeds(scenes)
        else:
            cases = scenes if graph.name == "hypernet" else flow_cases(graph.name, spec, trained)
        if graph.name == "inverse":
            rows += compare_samples(spec, graph, folder, list(cases.values()))
        else:
            rows += compare_graph(graph, folder, list(cases.values()), spec.hidden)
    return [*rows, _path(model, by_name, folder, scenes)]


def compare_graph(graph: Graph, folder: Path, cases: Sequence[Feeds], hidden: int = UNITS) -> list[ParityRow]:
    """One row per output of one graph, over `cases`, for a flow of so many `hidden` units."""
    session, names = open_graph(graph, folder), [t.name for t in graph.outputs]
    expected = [run_torch(graph, feeds) for feeds in cases]
    found = [session.run(names, feeds) for feeds in cases]
    outputs = zip(names, zip(*found, strict=True), zip(*expected, strict=True), strict=True)
    return [
        row(graph.name, name, list(zip(a, b, strict=True)), tolerance(graph.name, name, hidden))
        for name, a, b in outputs
    ]


def compare_samples(spec: FlowSpec, graph: Graph, folder: Path, cases: Sequence[Feeds]) -> list[ParityRow]:
    """The rows of graph `inverse`, used as its contract says: what comes with a large error is drawn again alone.

    Points count where float32 determines PyTorch's (`_determined`); all have to come with as small an error.
    Densities are compared at onnxruntime's points: where a flow is steep, what float32 leaves open of a point
    moves its density by more than the two programs differ.
    """
    session, names = open_graph(graph, folder), [t.name for t in graph.outputs]
    pairs: dict[str, list[tuple[Array, Array]]] = {name: [] for name in names}
    for feeds in cases:
        expected = dict(zip(names, draw(lambda f: run_torch(graph, f), feeds), strict=True))
        found = dict(zip(names, draw(lambda f: session.run(names, f), feeds), strict=True))
        expected["log_prob"] = _log_densities(spec, feeds["theta"], found["points"]).sum(-1)
        there = expected["points"]
        counts = _determined(_log_densities(spec, feeds["theta"], there), there)[..., None]
        expected["points"] = np.where(counts, there, found["points"])
        for name in names:
            pairs[name].append((found[name], expected[name]))
    return [row(graph.name, name, pairs[name], tolerance(graph.name, name)) for name in names]


def _log_densities(spec: FlowSpec, theta: Array, points: Array) -> Array:
    """log p(x_d given x_<d) [B, N, D] at `points` [B, N, D], by PyTorch."""
    with torch.no_grad():
        image = flow.forward(spec, torch.from_numpy(theta), torch.from_numpy(points))
        return flow.log_prob_terms(spec, image).numpy()


def _determined(log_p: Array, points: Array) -> npt.NDArray[np.bool_]:
    """[B, N]: whether an error of F_d of 1e-6, float32's, leaves x_d known to the tolerance of points."""
    limit = tolerance("inverse", "points")
    known = (1e-6 * np.exp(-log_p) < limit.limit * limit.scale(points)).all(axis=-1)
    return np.asarray(known, np.bool_)


def draw(run: Callable[[Feeds], list[Array]], feeds: Feeds) -> list[Array]:
    """points, log_prob and error of `inverse`, with those that miss their uniforms drawn alone."""
    outputs = [v.copy() for v in run(feeds)]
    b, i = np.nonzero(outputs[-1] > MISSED)
    if len(b):
        alone = run({"theta": feeds["theta"][b], "uniform": feeds["uniform"][b, i][:, None]})
        for whole, part in zip(outputs, alone, strict=True):
            whole[b, i] = part[:, 0]
    return outputs


def require(rows: Sequence[ParityRow]) -> None:
    """Raise ParityError if any row failed, naming the worst."""
    failed = [row for row in rows if not row.passed]
    if failed:
        worst = max(failed, key=lambda row: row.rms / row.tolerance)
        raise ParityError(
            f"{worst.graph}.{worst.output} at {worst.worst_index} is {worst.onnx:.8g} in onnxruntime and "
            f"{worst.torch:.8g} in PyTorch, expected within {worst.tolerance:g}; {len(failed)} of {len(rows)} "
            "outputs failed and no bundle was written; report it with the checkpoint"
        )


def row(graph: str, output: str, pairs: Sequence[tuple[Array, Array]], limit: Tolerance) -> ParityRow:
    """One row over (found, expected) pairs, as `hcnaf_export.tolerances` defines the error.

    `max_abs` is over the values up to the knee, `max_rel` is relative to max(1, |v*|), `rms` is of the error, and
    `worst_index` names the largest error: the number of the pair, then the index in it.
    """
    for a, b in pairs:
        if a.shape != b.shape:
            raise ParityError(
                f"{graph}.{output} has shape {a.shape}, PyTorch gives {b.shape}; no bundle was written"
            )
    errors = [limit.error(a, b) for a, b in pairs]
    case = int(np.argmax([e.max(initial=0.0) for e in errors]))
    index = np.unravel_index(int(np.argmax(errors[case])), errors[case].shape)
    found, expected = (np.concatenate([p[i].ravel() for p in pairs]).astype(np.float64) for i in (0, 1))
    error = np.concatenate([e.ravel() for e in errors])  # infinite where a value is not finite
    finite = np.isfinite(error)
    away = np.full(error.shape, np.inf)
    np.subtract(found, expected, out=away, where=finite)
    relative = np.full(error.shape, np.inf)
    np.divide(np.abs(away), np.maximum(1.0, np.abs(expected)), out=relative, where=finite)
    return ParityRow(
        graph=graph,
        output=output,
        max_abs=float(np.abs(away)[~(np.abs(expected) > limit.knee)].max(initial=0.0)),
        max_rel=float(relative.max()),
        rms=float(np.sqrt(np.mean(error**2))),
        worst_index=[case, *(int(i) for i in index)],
        torch=float(pairs[case][1][index]),
        onnx=float(pairs[case][0][index]),
        tolerance=limit.limit,
        passed=bool(error.max() <= limit.limit),
    )


def _path(model: Hcnaf, graphs: dict[str, Graph], folder: Path, scenes: dict[str, Feeds]) -> ParityRow:
    """From the hyper-network's inputs to log p, each side with its own theta."""
    spec, pairs = model.config.flow, []
    hypernet, density = open_graph(graphs["hypernet"], folder), open_graph(graphs["flow"], folder)
    for feeds in scenes.values():
        expected = run_torch(graphs["hypernet"], feeds)[0].reshape(-1, spec.parameters)
        found = hypernet.run(["theta"], feeds)[0].reshape(expected.shape)
        x = flow_feeds("flow", spec, expected)["points"]
        log_prob = run_torch(graphs["flow"], {"theta": expected, "points": x})[0]
        pairs.append((density.run(["log_prob"], {"theta": found, "points": x})[0], log_prob))
    return row("path", "log_prob", pairs, tolerance("path", "log_prob"))
