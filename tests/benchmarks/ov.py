"""The exported graphs in onnxruntime and in OpenVINO, fed the same arrays."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tests.benchmarks.density import Density, centres, window

Feeds = dict[str, npt.NDArray[np.float32]]


def feeds(density: Density, graph: str) -> tuple[Feeds, str]:
    """What `graph` (flow or cell_mass) takes for one 200 x 200 map, one node per column; and its main output."""
    theta = density.theta.numpy()[None]
    if graph == "flow":
        return {"theta": theta, "points": centres()[None]}, "log_prob"
    grid = window()
    x = (grid.x_edges[1:] + grid.x_edges[:-1]) / 2
    increments = np.diff(density.forecaster.flow.marginal_cdf(theta, grid.x_edges[None])[0])
    weight, y = np.diag(increments)[None], grid.y_edges[None]
    return {"theta": theta, "x": x[None], "weight": weight, "doubt": 0.0 * weight, "y": y}, "mass"


def in_onnxruntime(density: Density, graph: Any) -> Callable[[], Any]:
    """A call of `graph` with the runtime's own settings."""
    given, output = feeds(density, graph)
    session = density.forecaster.bundle.session(graph, density.threads)
    return lambda: session.run([output], given)[0]


def in_openvino(density: Density, graph: str) -> Callable[[], Any]:
    """A call of `graph` in float32, as many threads, for latency."""
    import openvino

    given, output = feeds(density, graph)
    settings = {
        "PERFORMANCE_HINT": "LATENCY",
        "INFERENCE_NUM_THREADS": density.threads,
        "INFERENCE_PRECISION_HINT": "f32",
    }
    path: Path = density.folder / f"{graph}.onnx"
    request = openvino.Core().compile_model(str(path), "CPU", settings).create_infer_request()
    return lambda: request.infer(given)[output].copy()
