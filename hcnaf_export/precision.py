"""The hyper-network with smaller weights. The flow keeps float32: its accuracy is the promise of the maps.

    fp16   weights are stored as float16 and cast to float32 when the graph is loaded: half the bytes, float32
           arithmetic, no float16 kernels needed.
    int8   matrices are int8 and meet activations that are quantised as they come (dynamic); convolutions are int8
           with ranges of activations fixed on calibration scenes (static); what else is large is fp16.

Int8 weights use 7 bits: processors without VNNI add pairs of 8-bit products in 16 bits, which would saturate and
give other forecasts there than here. Layers of few weights stay as they are (the heads of location and scale among
them), and so do LSTMs, which have int8 kernels outside the ONNX standard only.

References:
    onnxruntime, Quantize ONNX models (reduce_range on AVX2 and AVX512 without VNNI).
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import onnx
from onnx import helper, numpy_helper

from hcnaf_export.probes import Feeds
from hcnaf_models.config import ModelConfig, PomConfig
from hcnaf_runtime.errors import InputError
from hcnaf_runtime.manifest import Precision

LEAST_HALVED = 1024
"""Arrays of fewer numbers stay float32: there is nothing to gain."""
LEAST_INT8 = 4096
"""Layers of fewer weights are not made int8."""

_WEIGHTED = {"Conv", "MatMul", "Gemm", "LSTM", "Add"}
_LARGEST_HALF = float(np.finfo(np.float16).max)
_PREPARED = "onnx.quant.pre_process"


def check(config: ModelConfig, precision: Precision, calibration: Path | None) -> None:
    """Raise InputError where `precision` lacks the calibration data it needs, or data are given for nothing."""
    has_scenes = isinstance(config, PomConfig)
    if calibration is not None and (precision == "fp32" or not has_scenes):
        what = "precision fp32" if precision == "fp32" else "a model without scenes"
        raise InputError(f"calibration data were given, {what} needs none; leave out --calibration")
    if calibration is None and precision == "int8" and has_convolutions(config):
        raise InputError(
            "precision int8 without calibration data, convolutions need some to fix the range of what they see; "
            "give a data set of `hcnaf simulate` as --calibration, or choose fp16"
        )


def has_convolutions(config: ModelConfig) -> bool:
    """Whether the hyper-network reads images."""
    return isinstance(config, PomConfig) and bool(config.channels)


def convert(hypernet: onnx.ModelProto, precision: Precision, calibration: Sequence[Feeds]) -> onnx.ModelProto:
    """`hypernet` in another precision; `calibration` are inputs to fix ranges on."""
    model = onnx.ModelProto()
    model.CopyFrom(hypernet)
    if precision == "int8":
        model = _int8(model, calibration)
    if precision != "fp32":
        _halve(model.graph)
    onnx.checker.check_model(model, full_check=True)
    return model


def _halve(graph: onnx.GraphProto) -> None:
    """Store large weights as float16, each with a Cast that gives it its name back."""
    readers = _readers(graph)
    casts = []
    for weight in graph.initializer:
        if not _halvable(weight, readers.get(weight.name, set())):
            continue
        name, small = weight.name, weight.name + ".fp16"
        values = numpy_helper.to_array(weight).astype(np.float16)
        weight.CopyFrom(numpy_helper.from_array(values, small))
        casts.append(helper.make_node("Cast", [small], [name], name=f"{name}.cast", to=onnx.TensorProto.FLOAT))
    nodes = [*casts, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)


def _halvable(weight: onnx.TensorProto, readers: set[str]) -> bool:
    """Large float32 numbers within what float16 holds, that only layers read or that lose nothing by it."""
    if weight.data_type != onnx.TensorProto.FLOAT or int(np.prod(weight.dims)) < LEAST_HALVED:
        return False
    values = numpy_helper.to_array(weight)
    if np.abs(values).max() > _LARGEST_HALF:
        return False
    return readers <= _WEIGHTED or bool(np.array_equal(values.astype(np.float16), values))


def _readers(graph: onnx.GraphProto) -> dict[str, set[str]]:
    """By name, the operators that read it."""
    found: dict[str, set[str]] = {}
    for node in graph.node:
        for name in node.input:
            found.setdefault(name, set()).add(node.op_type)
    return found


def _int8(model: onnx.ModelProto, calibration: Sequence[Feeds]) -> onnx.ModelProto:
    """Static for convolutions, dynamic for matrices."""
    from onnxruntime import quantization  # takes a second to import
    from onnxruntime.quantization.onnx_model import ONNXModel

    ONNXModel(model).replace_gemm_with_matmul()  # it is done in any case, and names the nodes anew
    matrices, convolutions = (_large(model.graph, kinds) for kinds in ({"MatMul"}, {"Conv"}))
    _mark_prepared(model)
    common = {
        "per_channel": True,
        "reduce_range": True,
        "weight_type": quantization.QuantType.QInt8,
    }
    with tempfile.TemporaryDirectory() as folder, _quiet():
        path = Path(folder) / "int8.onnx"
        if convolutions:
            quantization.quantize_static(
                model,
                path,
                _Reader(calibration),
                quant_format=quantization.QuantFormat.QDQ,
                op_types_to_quantize=["Conv"],
                nodes_to_quantize=convolutions,
                activation_type=quantization.QuantType.QUInt8,
                **common,
            )
            model = onnx.load(path)
            _mark_prepared(model)
        if matrices:
            quantization.quantize_dynamic(
                model,
                path,
                op_types_to_quantize=["MatMul"],
                nodes_to_quantize=matrices,
                **common,
            )
            model = onnx.load(path)
    _standard_only(model)
    return model


class _Reader:
    """Calibration inputs one after the other, as onnxruntime wants them."""

    def __init__(self, feeds: Sequence[Feeds]) -> None:
        self._rest: Iterator[Feeds] = iter(feeds)

    def get_next(self) -> Feeds | None:
        return next(self._rest, None)


def _large(graph: onnx.GraphProto, kinds: set[str]) -> list[str]:
    """Names of the nodes of these kinds whose weights are worth making int8."""
    sizes = {t.name: int(np.prod(t.dims)) for t in graph.initializer}
    return [n.name for n in graph.node if n.op_type in kinds and sizes.get(n.input[1], 0) >= LEAST_INT8]


def _mark_prepared(model: onnx.ModelProto) -> None:
    """Exported graphs are already folded and shaped; without the mark onnxruntime asks for it in the log."""
    helper.set_model_props(model, {_PREPARED: "onnxruntime.quant"})


def _standard_only(model: onnx.ModelProto) -> None:
    """Drop the mention of operators outside the ONNX standard, none of which is used."""
    standard = [o for o in model.opset_import if o.domain in ("", "ai.onnx")]
    del model.opset_import[:]
    model.opset_import.extend(standard)


@contextmanager
def _quiet() -> Iterator[None]:
    """onnxruntime's quantiser advises through the root logger, on its own internals."""
    root = logging.getLogger()

    def above(record: logging.LogRecord) -> bool:
        return record.levelno >= logging.ERROR

    root.addFilter(above)
    try:
        yield
    finally:
        root.removeFilter(above)
