"""The graphs of a bundle as thin PyTorch modules, and their contracts: names, shapes, units.

Every size that may vary is named by a letter in the contract; the same letter is the same size within a graph:

    A  targets      N  agents in the scene, or points      T  horizons       R x C  raster rows and columns
    B  maps (agents x horizons, flattened)                 S  stop lines, or nodes in x       E  edges in y
    U, V  edges of a grid in x and y                       M  samples
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from hcnaf_models import density, flow, normal, planar, sampling
from hcnaf_models.config import ConditionConfig, PomConfig
from hcnaf_models.geometry import pose_of
from hcnaf_models.model import Hcnaf
from hcnaf_models.pom import PomHyperNet
from hcnaf_models.raster import crop_raster
from hcnaf_models.spec import FlowSpec
from hcnaf_runtime.manifest import GraphName
from hcnaf_runtime.manifest import Tensor as Contract


@dataclass(frozen=True)
class Graph:
    """One graph to export: `module` takes the tensors of `inputs` by name and returns those of `outputs`."""

    name: GraphName
    module: nn.Module
    inputs: tuple[Contract, ...]
    outputs: tuple[Contract, ...]

    @property
    def file(self) -> str:
        return f"{self.name}.onnx"


class FlowGraph(nn.Module):
    """theta [B, P], points [B, N, D] -> log_prob [B, N], z [B, N, D], log_det [B, N] (summed over D)."""

    def __init__(self, spec: FlowSpec) -> None:
        super().__init__()
        self.spec = spec

    def forward(self, theta: Tensor, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        if self.spec.dims == 2:
            return density.density(self.spec, theta, points, shipped_log_interval)
        image = flow.forward(self.spec, theta, points)
        return flow.log_prob_terms(self.spec, image).sum(-1), image.z, image.log_dz.sum(-1)


class MarginalCdfGraph(nn.Module):
    """theta [B, P], x [B, K] -> F_1(x) [B, K]."""

    def __init__(self, spec: FlowSpec) -> None:
        super().__init__()
        self.spec = spec

    def forward(self, theta: Tensor, x: Tensor) -> Tensor:
        return planar.marginal_cdf(self.spec, theta, x, shipped_fraction)


ERF_FROM = 0.1
"""Where the limits of z hold at least this much of the normal mass erf is accurate to about 1e-6; elsewhere the
stable form is run, which takes ten times as long."""

LOG_ERF_FROM = 0.005
"""The same for densities, whose logarithm erf is then accurate to 2e-5 for: a fifth of what it may differ by."""

CELLS_ERF_FROM = 0.2
"""The same for cells of a column that holds everything; a tenth of it for one that holds a tenth. Cells are off
by less than 5e-7."""


def shipped_fraction(z: Tensor) -> Tensor:
    """`planar.stable_fraction`, by erf where that is accurate enough for all of z: an `If` in the graph."""
    limits = torch.erf(z[:, -2:] * math.sqrt(0.5))
    least = (limits[:, 1] - limits[:, 0]).min() * 0.5
    # A branch may not share its input with what surrounds it (torch.cond), hence the product; it is dropped.
    F: Tensor = torch.cond(least > ERF_FROM, planar.fast_fraction, planar.stable_fraction, (z * 1.0,))
    return F


def weighed_fraction(weight: Tensor) -> planar.Fraction:
    """`shipped_fraction` for F_2 on grids whose nodes count for so much in columns, `weight` [B, S, C]; by maps.

    What erf is off by grows as the limits of z come close, and is weighed with what the node holds: where little
    is held they may be as much closer.
    """

    def fraction(z: Tensor) -> Tensor:
        at = torch.erf(z * math.sqrt(0.5))
        held = torch.clamp(at[:, -1:] - at[:, -2:-1], min=1e-30)  # [B, 1, S]
        far = ((2.0 / held) @ weight.abs()).amax(dim=(1, 2)) * CELLS_ERF_FROM >= 1.0
        F = (at - at[:, -2:-1]) / held
        mended: Tensor = torch.cond(far.any(), _mended, _left_alone, (F * 1.0, z * 1.0, far))
        return mended

    return fraction


def _mended(F: Tensor, z: Tensor, far: Tensor) -> Tensor:
    """F [B, E, S] by the stable form for the maps that are `far` [B] out."""
    which = torch.nonzero(far).squeeze(-1)
    return torch.index_copy(F, 0, which, planar.stable_fraction(torch.index_select(z, 0, which)))


def _left_alone(F: Tensor, z: Tensor, far: Tensor) -> Tensor:
    return F * 1.0


def shipped_log_interval(a: Tensor, b: Tensor) -> Tensor:
    """`normal.log_interval`, by erf where that is accurate enough for all: an `If` in the graph."""
    least = (torch.erf(b * math.sqrt(0.5)) - torch.erf(a * math.sqrt(0.5))).min() * 0.5
    log_mass: Tensor = torch.cond(
        least > LOG_ERF_FROM, density.fast_log_interval, normal.log_interval, (a * 1.0, b * 1.0)
    )
    return log_mass


class ConditionalCdfGraph(nn.Module):
    """theta [B, P], x [B, S], y [B, S, E] -> F_2(y given x) [B, S, E]."""

    def __init__(self, spec: FlowSpec) -> None:
        super().__init__()
        self.spec = spec

    def forward(self, theta: Tensor, x: Tensor, y: Tensor) -> Tensor:
        return planar.conditional_cdf(self.spec, theta, x, y, shipped_fraction)


class CellMassGraph(nn.Module):
    """theta [B,P], x [B,S], weight, doubt [B,S,C], y [B,E] -> mass [B,E-1,C], error [B,C], cdf [B,E,S]."""

    def __init__(self, spec: FlowSpec) -> None:
        super().__init__()
        self.spec = spec

    def forward(self, theta: Tensor, x: Tensor, weight: Tensor, doubt: Tensor, y: Tensor) -> planar.Cells:
        return planar.cell_mass(self.spec, theta, x, weight, doubt, y, weighed_fraction(weight))


class InverseGraph(nn.Module):
    """theta [B, P], uniform [B, M, 2] -> points [B, M, 2], log_prob [B, M], error [B, M]."""

    def __init__(self, spec: FlowSpec) -> None:
        super().__init__()
        self.spec = spec

    def forward(self, theta: Tensor, uniform: Tensor) -> sampling.Drawn:
        return sampling.planar_inverse(self.spec, theta, uniform)


class ConditionGraph(nn.Module):
    """condition [A, K] -> theta [A, 1, P]."""

    def __init__(self, hypernet: nn.Module) -> None:
        super().__init__()
        self.hypernet = hypernet

    def forward(self, condition: Tensor) -> Tensor:
        theta: Tensor = self.hypernet(condition)
        return theta


class SceneGraph(nn.Module):
    """The tensors of a scene and horizons [T] -> theta [A, T, P], pose [A, 3] (x, y, yaw, scene frame).

    All preprocessing is in here: picking the targets, hiding each from its own surroundings, the actor-centric
    frame and the raster's crop. What depends on the scene is computed once per target, whatever T.
    """

    def __init__(self, hypernet: PomHyperNet) -> None:
        super().__init__()
        self.hypernet = hypernet
        self.config = hypernet.config

    def forward(
        self,
        past: Tensor,
        size: Tensor,
        target: Tensor,
        horizons: Tensor,
        raster: Tensor | None = None,
        raster_origin: Tensor | None = None,
        raster_resolution: Tensor | None = None,
        stops: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        reference = past[target]
        pose = pose_of(reference)
        crop = None
        if raster is not None and raster_origin is not None and raster_resolution is not None:
            crop = crop_raster(
                raster.to(past.dtype) / 127.0, raster_origin, raster_resolution, pose, self.config.crop
            )
        theta: Tensor = self.hypernet(
            reference,
            size[target],
            horizons.expand(target.shape[0], -1),
            stops=None if stops is None else stops.expand(target.shape[0], -1, -1),
            crop=crop,
            **self._others(past, size, target),
        )
        return theta, pose

    def _others(self, past: Tensor, size: Tensor, target: Tensor) -> dict[str, Tensor]:
        """Everyone but the target itself (its rows are NaN), once per target."""
        if not reads_others(self.config):
            return {}
        own = torch.arange(past.shape[0], device=past.device) == target.unsqueeze(-1)  # [A, N]
        hidden = torch.full_like(past[:1, :1, :1], math.nan)
        return {
            "others": torch.where(own[:, :, None, None], hidden, past),
            "others_size": size.expand(target.shape[0], -1, -1),
        }


def reads_others(config: PomConfig) -> bool:
    """Whether the hyper-network looks at agents other than the target."""
    return config.actors != "none" or config.draw_actors


def graphs(model: Hcnaf) -> list[Graph]:
    """All graphs of a model's bundle: the hyper-network, the flow and, for D = 2, what follows from it."""
    spec = model.config.flow
    out = [_hypernet(model), _flow(spec)]
    if spec.dims == 2:
        out += [_marginal_cdf(spec), _conditional_cdf(spec), _cell_mass(spec), _inverse(spec)]
    for graph in out:
        graph.module.eval()
    return out


def _tensor(name: str, shape: str, unit: str, description: str, dtype: str = "float32") -> Contract:
    """`shape` as words: a number is fixed, anything else names a size that varies."""
    sizes = [int(word) if word.isdigit() else word for word in shape.split()]
    return Contract(name=name, dtype=dtype, shape=sizes, unit=unit, description=description)


def edges() -> tuple[Contract, Contract]:
    """The edges of a grid's columns and rows."""
    text = "cell edges, ascending, in the frame of theta"
    return _tensor("x_edges", "U", "m", text), _tensor("y_edges", "V", "m", text)


def _theta(spec: FlowSpec, lead: str = "B") -> Contract:
    return _tensor("theta", f"{lead} {spec.parameters}", "", "the flow's parameters, ready to multiply")


def _hypernet(model: Hcnaf) -> Graph:
    hypernet = model.hypernet
    if isinstance(hypernet, PomHyperNet):
        return _scene(hypernet)
    config = model.config
    assert isinstance(config, ConditionConfig)
    condition = _tensor("condition", f"A {config.size}", "", "one condition per row")
    return Graph("hypernet", ConditionGraph(hypernet), (condition,), (_theta(config.flow, "A 1"),))


def _scene(hypernet: PomHyperNet) -> Graph:
    config = hypernet.config
    inputs = [
        _tensor("past", f"N {config.history} 5", "m, m, 1, 1, m/s", "x, y, sin, cos, speed; NaN: not observed"),
        _tensor("size", "N 2", "m", "length and width of each box"),
        _tensor("target", "A", "", "which agents to forecast", "int64"),
        _tensor("horizons", "T", "s", "when to forecast"),
    ]
    if config.channels:
        inputs += [
            _tensor("raster", f"{len(config.channels)} R C", "1/127", "map, row 0 at the lowest y", "int8"),
            _tensor("raster_origin", "2", "m", "the raster's lower-left corner, scene frame"),
            _tensor("raster_resolution", "1", "m", "size of a pixel"),
        ]
    if config.stops:
        inputs.append(_tensor("stops", "S 3", "m, m, rad", "x, y and yaw of the traffic that must stop"))
    pose = _tensor("pose", "A 3", "m, m, rad", "x, y, yaw of each target now, scene frame")
    return Graph("hypernet", SceneGraph(hypernet), tuple(inputs), (_theta(config.flow, "A T"), pose))


def _flow(spec: FlowSpec) -> Graph:
    D = spec.dims
    points = _tensor("points", f"B N {D}", "m", "points in the frame of theta")
    outputs = (
        _tensor("log_prob", "B N", f"nat per m^{D}", "log p(x)"),
        _tensor("z", f"B N {D}", "", "image under the flow, standard normal"),
        _tensor("log_det", "B N", f"nat per m^{D}", "log |det dz/dx|"),
    )
    return Graph("flow", FlowGraph(spec), (_theta(spec), points), outputs)


def _marginal_cdf(spec: FlowSpec) -> Graph:
    x = _tensor("x", "B K", "m", "first coordinate")
    return Graph("marginal_cdf", MarginalCdfGraph(spec), (_theta(spec), x), (_tensor("cdf", "B K", "", "F_1(x)"),))


def _conditional_cdf(spec: FlowSpec) -> Graph:
    x, y = _tensor("x", "B S", "m", "first coordinate"), _tensor("y", "B S E", "m", "second coordinate")
    cdf = _tensor("cdf", "B S E", "", "F_2(y given x)")
    return Graph("conditional_cdf", ConditionalCdfGraph(spec), (_theta(spec), x, y), (cdf,))


def _cell_mass(spec: FlowSpec) -> Graph:
    inputs = (
        _theta(spec),
        _tensor("x", "B S", "m", "nodes"),
        _tensor("weight", "B S C", "", "what each node counts for in each column"),
        _tensor("doubt", "B S C", "", "the weights minus those of a lesser rule"),
        _tensor("y", "B E", "m", "cell edges, ascending"),
    )
    outputs = (
        _tensor("mass", "B E-1 C", "", "probability of each cell"),
        _tensor(
            "error", "B C", "", "largest sum of each column with the weights of the doubt, or what was below 0"
        ),
        _tensor("cdf", "B E S", "", "F_2(y given x), as accurate as the masses need it"),
    )
    return Graph("cell_mass", CellMassGraph(spec), inputs, outputs)


def _inverse(spec: FlowSpec) -> Graph:
    uniform = _tensor("uniform", "B M 2", "", "values of F_1 and F_2, inside (0, 1)")
    outputs = (
        _tensor("points", "B M 2", "m", "the points with these values, in the frame of theta"),
        _tensor("log_prob", "B M", "nat per m^2", "log p at the points"),
        _tensor("error", "B M", "", "how far F_1 or F_2 at the points is from uniform; if far, draw these alone"),
    )
    return Graph("inverse", InverseGraph(spec), (_theta(spec), uniform), outputs)
