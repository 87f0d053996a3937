"""forecast.onnx: a scene to its maps in one session run, put together from hypernet.onnx and one traced map.

    scene, horizons --hypernet--> theta [A, T, P] --Scan over the A T maps--> mass [A, T, rows, columns]

The Scan holds one map's arrays [columns, H, rows] at a time, whatever the number of agents and horizons.

Each column has one node, its centre, weighted by the column's increment of F_1:

    mass[j, i] = (F_1(x_{i+1}) - F_1(x_i)) (F_2(y_{j+1} | c_i) - F_2(y_j | c_i)),    c_i = (x_i + x_{i+1}) / 2

Columns and the window's mass are therefore exact in x; within a column F_2 is taken as that of its centre, which
is the error against refined maps: small where F_2 hardly changes across a cell, not where a cell is wider than
the distribution.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import onnx
import torch
from onnx import helper
from torch import Tensor, nn

from hcnaf_export.graphs import Graph, SceneGraph, edges, graphs, shipped_fraction
from hcnaf_export.onnx_file import finish, trace
from hcnaf_models import planar
from hcnaf_models.model import Hcnaf
from hcnaf_models.spec import FlowSpec
from hcnaf_runtime.manifest import Tensor as Contract

_BODY = "map/"
_OWN = "forecast/"
_END = np.iinfo(np.int64).max


class ColumnMassGraph(nn.Module):
    """theta [B, P], columns from left [S] to right [S], y_edges [V] (m) -> mass [B, V - 1, S], a node per column.

    Adjoining columns: `left` without its first is `right` without its last. They are two arrays because a size of
    U - 1 stops the tracer, which asks what a single edge would mean.
    """

    def __init__(self, spec: FlowSpec, fraction: planar.Fraction = shipped_fraction) -> None:
        super().__init__()
        self.spec, self.fraction = spec, fraction

    def forward(self, theta: Tensor, left: Tensor, right: Tensor, y_edges: Tensor) -> Tensor:
        B = theta.shape[0]
        F_1 = planar.marginal_cdf(self.spec, theta, torch.cat([left, right[-1:]]).expand(B, -1))
        share = torch.clamp(F_1[:, 1:] - F_1[:, :-1], min=0.0)
        x, y = (0.5 * (left + right)).expand(B, -1), y_edges.expand(B, -1)
        F_2 = planar.grid_cdf(self.spec, theta, x, y, self.fraction)  # [B, V, S]
        increments = torch.clamp(F_2[:, 1:] - F_2[:, :-1], min=0.0)
        return increments * share.unsqueeze(1)


class ForecastGraph(nn.Module):
    """The scene graph, then a map at a time: mass [A, T, V - 1, U - 1], window_mass [A, T], pose [A, 3]."""

    def __init__(self, scene: SceneGraph) -> None:
        super().__init__()
        self.scene = scene
        self.columns = ColumnMassGraph(scene.config.flow)

    def forward(self, x_edges: Tensor, y_edges: Tensor, **scene: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        theta, pose = self.scene(**scene)
        A, T, P = theta.shape
        maps = [self.columns(one, x_edges[:-1], x_edges[1:], y_edges) for one in theta.reshape(-1, 1, P)]
        mass = torch.cat(maps).reshape(A, T, len(y_edges) - 1, len(x_edges) - 1)
        return mass, mass.sum((-1, -2)), pose


def all_graphs(model: Hcnaf) -> list[Graph]:
    """The graphs of a model's bundle: `graphs`, and for scenes forecast.onnx."""
    parts = graphs(model)
    return [*parts, forecast_graph(parts[0])] if isinstance(parts[0].module, SceneGraph) else parts


def forecast_graph(hypernet: Graph) -> Graph:
    """The contract of forecast.onnx for the `hypernet` of a scene."""
    scene = hypernet.module
    assert isinstance(scene, SceneGraph)
    pose = next(t for t in hypernet.outputs if t.name == "pose")
    text = "probability of each cell, agent's frame; one node per column, at its centre: exact sums over columns"
    outputs = (
        _contract("mass", ["A", "T", "V-1", "U-1"], text),
        _contract("window_mass", ["A", "T"], "probability of the window: the sum of mass"),
        pose,
    )
    return Graph("forecast", ForecastGraph(scene).eval(), (*hypernet.inputs, *edges()), outputs)


def _contract(name: str, shape: list[int | str], description: str) -> Contract:
    return Contract(name=name, dtype="float32", shape=shape, unit="", description=description)


def trace_map(spec: FlowSpec) -> onnx.ModelProto:
    """`ColumnMassGraph` as ONNX."""
    theta = _contract("theta", ["B", spec.parameters], "")
    left, right = _contract("left", ["S"], ""), _contract("right", ["S"], "")
    mass = _contract("mass", ["B", "V-1", "S"], "")
    inputs = (theta, left, right, edges()[1])
    return trace(Graph("forecast", ColumnMassGraph(spec).eval(), inputs, (mass,)), {})


def compose(
    graph: Graph, hypernet: onnx.ModelProto, one_map: onnx.ModelProto, metadata: Mapping[str, str]
) -> onnx.ModelProto:
    """forecast.onnx from hypernet.onnx, of any precision, and the traced map."""
    body = _body(one_map.graph)
    model = onnx.ModelProto()
    model.CopyFrom(hypernet)
    model.graph.node.extend(_assembly(body))
    for name, value in {"start": [0], "minus": [-1], "one": [1], "cells": [2, 3], "end": [_END]}.items():
        constant = onnx.numpy_helper.from_array(np.array(value, np.int64), _OWN + name)
        model.graph.initializer.append(constant)
    del model.graph.input[:], model.graph.output[:]
    model.graph.input.extend(_value(t) for t in graph.inputs)
    model.graph.output.extend(_value(t) for t in graph.outputs)
    finish(model, graph, metadata)
    return model


def _assembly(body: onnx.GraphProto) -> Iterator[onnx.NodeProto]:
    """theta [A, T, P] to A T rows [1, P], a map each, and back."""

    def node(op: str, inputs: list[str], output: str, **attributes: Any) -> onnx.NodeProto:
        return helper.make_node(op, inputs, [output], name=f"{_OWN}{op}_{output.removeprefix(_OWN)}", **attributes)

    yield node("Shape", ["theta"], _OWN + "sizes", start=0, end=2)  # [A, T]
    yield node("Shape", ["theta"], _OWN + "P", start=2, end=3)
    yield node("Concat", [_OWN + "minus", _OWN + "one", _OWN + "P"], _OWN + "rows", axis=0)
    yield node("Reshape", ["theta", _OWN + "rows"], _OWN + "thetas")  # [A T, 1, P]
    yield node("Slice", ["x_edges", _OWN + "start", _OWN + "minus"], _OWN + "left")
    yield node("Slice", ["x_edges", _OWN + "one", _OWN + "end"], _OWN + "right")
    yield node("Scan", [_OWN + "thetas"], _OWN + "maps", num_scan_inputs=1, body=body)  # [A T, 1, V - 1, U - 1]
    yield node("Shape", [_OWN + "maps"], _OWN + "window", start=2, end=4)
    yield node("Concat", [_OWN + "sizes", _OWN + "window"], _OWN + "shape", axis=0)
    yield node("Reshape", [_OWN + "maps", _OWN + "shape"], "mass")
    yield node("ReduceSum", ["mass", _OWN + "cells"], "window_mass", keepdims=0)


def _body(one_map: onnx.GraphProto) -> onnx.GraphProto:
    """The traced map as a Scan's body: it takes theta [1, P] and sees the grid in the graph around it."""
    body = onnx.GraphProto()
    body.CopyFrom(one_map)
    _rename(body, {"left": _OWN + "left", "right": _OWN + "right", "y_edges": "y_edges"})
    theta = next(v for v in body.input if v.name == _BODY + "theta")
    kept = onnx.ValueInfoProto()
    kept.CopyFrom(theta)
    kept.type.tensor_type.shape.dim[0].dim_value = 1
    del body.input[:]
    body.input.append(kept)
    body.output[0].type.tensor_type.shape.dim[0].dim_value = 1
    body.name = _BODY + "body"
    return body


def _rename(graph: onnx.GraphProto, outer: Mapping[str, str]) -> None:
    """Put a prefix before every name in `graph` and its branches, and give those in `outer` the name there."""

    def new(name: str) -> str:
        return outer.get(name, _BODY + name) if name else name

    for value in (*graph.input, *graph.output, *graph.initializer, *graph.value_info):
        value.name = new(value.name)
    for node in graph.node:
        node.name = _BODY + node.name
        node.input[:] = [new(name) for name in node.input]
        node.output[:] = [new(name) for name in node.output]
        for attribute in node.attribute:
            if attribute.HasField("g"):
                _rename(attribute.g, outer)


def _value(contract: Contract) -> onnx.ValueInfoProto:
    kind = helper.np_dtype_to_tensor_dtype(np.dtype(contract.dtype))
    value: onnx.ValueInfoProto = helper.make_tensor_value_info(contract.name, kind, contract.shape)
    return value
