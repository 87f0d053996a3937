"""One PyTorch module to one checked .onnx file: opset 18, IR version at most 10, every named size dynamic."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import onnx
import torch
from onnx_ir.passes.common import CommonSubexpressionEliminationPass
from onnxscript.optimizer import fold_constants, remove_unused_nodes
from onnxscript.rewriter import RewriteRuleSet, rewrite
from onnxscript.rewriter.rules.common import materialize_reshape_shape_rule, no_op_transpose_rule
from torch import Tensor
from torch.export import Dim

from hcnaf_export.graphs import Graph
from hcnaf_runtime.manifest import Tensor as Contract

OPSET = 18
IR_VERSION = 10
# torch.export treats sizes 0 and 1 as constants: examples are larger, and all sizes differ.
EXAMPLE_SIZES = {"A": 2, "N": 4, "T": 3, "R": 9, "C": 6, "S": 5, "B": 10, "K": 7, "E": 8, "V": 11, "M": 96}
# mass has E - 1 rows, or V - 1; a bound of 3 keeps torch.export from asking what one row would mean. So does that
# of 24 for the stragglers of `hcnaf_models.sampling`, at least two at each level. The exported graphs have no such
# bounds, and the tests run them with E = 2 and M = 1.
_LEAST = {"E": 3, "V": 3, "M": 24}


def write_onnx(graph: Graph, path: Path, metadata: Mapping[str, str]) -> None:
    """Trace `graph` and write it as a single file with `metadata` in its metadata_props, checked by onnx."""
    save(trace(graph, metadata), path)


def save(model: onnx.ModelProto, path: Path) -> None:
    """Write `model` as a single file, checked by onnx."""
    onnx.checker.check_model(model, full_check=True)
    onnx.save_model(model, str(path))


def trace(graph: Graph, metadata: Mapping[str, str]) -> onnx.ModelProto:
    """`graph` as ONNX with `metadata` in its metadata_props."""
    inputs = {t.name: example(t) for t in graph.inputs}
    sizes = {name: Dim(name, min=_LEAST.get(name, 2)) for t in graph.inputs for name in _named(t)}
    shapes = {t.name: {i: sizes[s] for i, s in enumerate(t.shape) if isinstance(s, str)} for t in graph.inputs}
    with torch.no_grad(), _quiet():
        program = torch.export.export(
            graph.module,
            (),
            inputs,
            dynamic_shapes=shapes,
            strict=False,
            prefer_deferred_runtime_asserts_over_guards=True,  # it cannot see that M // 8 + 1 is at most M
        )
        exported = torch.onnx.export(
            program,
            dynamo=True,
            opset_version=OPSET,
            external_data=False,
            input_names=list(inputs),
            output_names=[t.name for t in graph.outputs],
            verbose=False,
            optimize=False,  # takes longer than all the rest, and onnxruntime does the same on loading
        )
        if exported is None:
            raise RuntimeError("torch.onnx.export returned no program")
        _tidy(exported.model)
    model = exported.model_proto
    finish(model, graph, metadata)
    return model


def example(tensor: Contract) -> Tensor:
    """An input of the contract's shape for tracing; only its sizes and type matter."""
    shape = [EXAMPLE_SIZES[s] if isinstance(s, str) else s for s in tensor.shape]
    if tensor.dtype == "int64":
        return torch.arange(shape[0])
    return torch.ones(shape, dtype=getattr(torch, tensor.dtype))


def _tidy(model: Any) -> None:
    """Fold constants and what shapes are computed from, merge what is computed twice, drop what is not used."""
    rewrite(model, RewriteRuleSet([materialize_reshape_shape_rule, no_op_transpose_rule]))
    fold_constants(model)
    CommonSubexpressionEliminationPass()(model)
    remove_unused_nodes(model)


def _named(tensor: Contract) -> list[str]:
    return [s for s in tensor.shape if isinstance(s, str)]


def finish(model: onnx.ModelProto, graph: Graph, metadata: Mapping[str, str]) -> None:
    """Name what a reader of the file sees, drop the tracer's notes, and hold the IR version."""
    model.ir_version = min(model.ir_version, IR_VERSION)
    model.graph.name = graph.name
    _strip(model.graph)
    del model.metadata_props[:]
    onnx.helper.set_model_props(model, dict(metadata))
    values = [*model.graph.input, *model.graph.output]
    for value, contract in zip(values, (*graph.inputs, *graph.outputs), strict=True):
        dims = value.type.tensor_type.shape.dim
        for dim, size in zip(dims, contract.shape, strict=True):
            dim.Clear()
            dim.MergeFrom(_dimension(size))


def _strip(graph: onnx.GraphProto) -> None:
    """Drop the tracer's notes (places in its source files, shapes) from a graph and its branches."""
    graph.ClearField("doc_string")
    del graph.value_info[:], graph.metadata_props[:]
    for value in (*graph.input, *graph.output, *graph.initializer):
        del value.metadata_props[:]
    for node in graph.node:
        node.ClearField("doc_string")
        del node.metadata_props[:]
        for attribute in node.attribute:
            if attribute.HasField("g"):
                _strip(attribute.g)


def _dimension(size: int | str) -> Any:
    if isinstance(size, int):
        return onnx.TensorShapeProto.Dimension(dim_value=size)
    return onnx.TensorShapeProto.Dimension(dim_param=size)


@contextmanager
def _quiet() -> Iterator[None]:
    """The exporter's remarks on its own internals (deprecated calls, no torchvision) help nobody here."""
    log = logging.getLogger("torch.onnx._internal.exporter._registration")
    before = log.level
    log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", category=FutureWarning)
            warnings.filterwarnings("ignore", category=DeprecationWarning)
            warnings.filterwarnings("ignore", message="# The axis name", category=UserWarning)
            warnings.filterwarnings("ignore", message="The tensor attribute.*lstm", category=UserWarning)
            yield
    finally:
        log.setLevel(before)
