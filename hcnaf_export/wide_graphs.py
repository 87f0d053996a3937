"""The graphs of a wide flow's bundle (`hcnaf_models.wide`): the contracts of a `condition` bundle, no new ones.

    hypernet.onnx   condition [A, K], one-hot -> theta [A, 1, P]: gains, diagonals and biases of each class
    flow.onnx       theta [B, P], points [B, N, D] -> log_prob, z, log_det; holds the shared matrices

No file holds a set of weights per class, so each stays far below the 2 GiB that one file may have.
"""

from __future__ import annotations

from torch import Tensor, nn

from hcnaf_export.graphs import Graph
from hcnaf_models.flow import log_prob_terms
from hcnaf_models.wide import WideFlow
from hcnaf_runtime.manifest import Tensor as Contract


class WideHypernetGraph(nn.Module):
    """condition [A, K] -> theta [A, 1, P]."""

    def __init__(self, model: WideFlow) -> None:
        super().__init__()
        self.model = model

    def forward(self, condition: Tensor) -> Tensor:
        return self.model.theta(condition).unsqueeze(1)


class WideFlowGraph(nn.Module):
    """theta [B, P], points [B, N, D] -> log_prob [B, N], z [B, N, D], log_det [B, N] (summed over D)."""

    def __init__(self, model: WideFlow) -> None:
        super().__init__()
        self.model = model

    def forward(self, theta: Tensor, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        image = self.model(theta, points)
        return log_prob_terms(self.model.config.flow, image).sum(-1), image.z, image.log_dz.sum(-1)


def wide_graphs(model: WideFlow) -> list[Graph]:
    """The hyper-network and the flow."""
    config = model.config
    D, P = config.flow.dims, config.parameters
    theta = "what of the flow's weights depends on the condition, ready to multiply"
    condition = _tensor("condition", ["A", config.classes], "", "one-hot class per row")
    points = _tensor("points", ["B", "N", D], "", "points, in the units of the training data")
    hypernet = Graph(
        "hypernet", WideHypernetGraph(model).eval(), (condition,), (_tensor("theta", ["A", 1, P], "", theta),)
    )
    outputs = (
        _tensor("log_prob", ["B", "N"], "nat", "log p(x)"),
        _tensor("z", ["B", "N", D], "", "image under the flow, standard normal"),
        _tensor("log_det", ["B", "N"], "nat", "log |det dz/dx|"),
    )
    flow = Graph("flow", WideFlowGraph(model).eval(), (_tensor("theta", ["B", P], "", theta), points), outputs)
    return [hypernet, flow]


def _tensor(name: str, shape: list[int | str], unit: str, description: str) -> Contract:
    return Contract(name=name, dtype="float32", shape=shape, unit=unit, description=description)
