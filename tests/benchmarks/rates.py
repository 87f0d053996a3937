"""How fast this machine multiplies matrices and takes tanh, through onnxruntime, at the shapes the maps use."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
import onnxruntime

from hcnaf_runtime.measure import latency

Array = npt.NDArray[np.float32]

CHAIN = 8
"""Operations in a row, so that the cost of a call does not count."""
NUMBERS = (1 << 17, 1 << 18, 1 << 20)
"""Sizes of the arrays: from half a MiB, which stays in cache, to four."""
EDGES = 202


def session(nodes: Sequence[Any], shape: Sequence[int], weights: Array | None, threads: int) -> Any:
    """A session on a graph that takes `h0` of `shape` through `nodes` to `h<CHAIN>`."""
    info = onnx.helper.make_tensor_value_info
    tensors = [] if weights is None else [onnx.numpy_helper.from_array(weights, "W")]
    graph = onnx.helper.make_graph(
        list(nodes), "rate", [info("h0", 1, list(shape))], [info(f"h{CHAIN}", 1, list(shape))], tensors
    )
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 18)], ir_version=8)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads  # spinning is left on: this is the most the machine can do
    return onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])


def rate(
    nodes: Sequence[Any], start: Array, weights: Array | None, work: float, threads: int, seconds: float
) -> float:
    """Units of `work` per second, by the median call."""
    run = session(nodes, start.shape, weights, threads)
    return work / latency(lambda _: run.run(None, {"h0": start}), lambda: None, seconds).median


def gemm(H: int, threads: int, seconds: float) -> dict[str, float]:
    """Operations per second of products with an H x H matrix, by shape; the best of several sizes each."""
    rng = np.random.default_rng(0)
    found: dict[str, list[float]] = {"W h": [], "h W": [], "W h, one per column": []}
    node = onnx.helper.make_node
    left = [node("MatMul", ["W", f"h{k}"], [f"h{k + 1}"]) for k in range(CHAIN)]
    right = [node("MatMul", [f"h{k}", "W"], [f"h{k + 1}"]) for k in range(CHAIN)]
    for numbers in NUMBERS:
        n, s = max(1, numbers // H), max(1, numbers // (H * EDGES))
        W = rng.normal(scale=H**-0.5, size=(H, H)).astype(np.float32)
        each = np.repeat(W[None], s, axis=0)
        for name, nodes, shape, weights in (
            ("W h", left, (H, n), W),
            ("h W", right, (n, H), W),
            ("W h, one per column", left, (s, H, EDGES), each),
        ):
            start = rng.normal(size=shape).astype(np.float32)
            found[name].append(rate(nodes, start, weights, 2.0 * CHAIN * H * start.size, threads, seconds))
    return {name: max(rates) for name, rates in found.items()}


def tanh(threads: int, seconds: float) -> float:
    """tanh per second, the best of several sizes."""
    nodes = [onnx.helper.make_node("Tanh", [f"h{k}"], [f"h{k + 1}"]) for k in range(CHAIN)]
    rng = np.random.default_rng(0)
    starts = [rng.normal(size=numbers).astype(np.float32) for numbers in NUMBERS]
    return max(rate(nodes, h, None, float(CHAIN * h.size), threads, seconds) for h in starts)
