"""What a smaller precision costs: in nats where forecasts are, in cell mass, in total variation, and in bytes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from hcnaf_export.forecast import ColumnMassGraph
from hcnaf_export.probes import SEED, reach
from hcnaf_export.tolerances import MOST_NATS
from hcnaf_models import flow, planar
from hcnaf_models.spec import FlowSpec
from hcnaf_runtime.errors import ParityError
from hcnaf_runtime.manifest import Precision

Array = npt.NDArray[Any]

POINTS = 64
"""Points drawn from each forecast."""
MOST_MAPS = 96
"""Forecasts compared, evenly over those given."""
_HALVINGS = 48
_FAR = 1e4  # m from the location: nothing is farther


def measure(
    spec: FlowSpec, before: Sequence[Array], after: Sequence[Array], window: Array | None
) -> dict[str, Any]:
    """The cost of `after` against `before`, both theta [..., P] of the same forecasts.

    Args:
        spec: the flow's sizes.
        before, after: theta of the float32 and of the other hyper-network, scene by scene.
        window: edges [2, E] in x and y of the maps compared (m); None: 100 cells around each forecast.

    Returns:
        `nats` (mean and largest |change of log p| at points drawn from the forecasts), for D = 2 `cell_mass`
        (largest change of a cell) and `total_variation` (mean and largest, of maps), and how many `maps` it was.
    """
    a, b = (torch.from_numpy(_some(spec, thetas)) for thetas in (before, after))
    with torch.no_grad():
        points = _draw(spec, a)
        nats = (flow.log_prob(spec, a, points) - flow.log_prob(spec, b, points)).abs()
        cost: dict[str, Any] = {"maps": len(a), "points": nats.numel()}
        cost["nats"] = {"mean": float(nats.mean()), "max": float(nats.max())}
        if spec.dims == 2:
            cost |= _maps(spec, a, b, window)
    return cost


def require(precision: Precision, cost: Mapping[str, Any]) -> None:
    """Raise ParityError where the cost is that of a failure, not of rounding."""
    limit, mean = MOST_NATS.get(precision, np.inf), cost["nats"]["mean"]
    if not mean <= limit:
        raise ParityError(
            f"precision {precision} changes log p by {mean:.3g} nats on average, expected at most {limit:g}; "
            "no bundle was written; choose a higher precision"
        )


def sizes(folder: Path) -> dict[str, int]:
    """Bytes of each graph in `folder` and of all of them."""
    found = {file.name: file.stat().st_size for file in sorted(folder.glob("*.onnx"))}
    return found | {"graphs": sum(found.values())}


def _some(spec: FlowSpec, thetas: Sequence[Array]) -> Array:
    every = np.concatenate([theta.reshape(-1, spec.parameters) for theta in thetas])
    chosen = np.unique(np.linspace(0, len(every) - 1, MOST_MAPS).astype(int))
    return np.ascontiguousarray(every[chosen])


def _draw(spec: FlowSpec, theta: Tensor) -> Tensor:
    """Points [B, POINTS, D]: drawn from the forecasts for D = 2, around them otherwise."""
    generator = torch.Generator().manual_seed(SEED)
    B = len(theta)
    location, scale = (torch.from_numpy(v).to(theta.dtype) for v in reach(spec, theta.numpy()))
    if spec.dims != 2:
        return location[:, None] + scale[:, None] * torch.randn(B, POINTS, spec.dims, generator=generator)
    u = torch.rand(B, POINTS, 2, generator=generator)
    x = _invert(lambda x: planar.marginal_cdf(spec, theta, x), u[..., 0], location[:, :1])

    def conditional(y: Tensor) -> Tensor:
        return planar.conditional_cdf(spec, theta, x, y.unsqueeze(-1)).squeeze(-1)

    return torch.stack([x, _invert(conditional, u[..., 1], location[:, 1:])], dim=-1)


def _invert(F: Callable[[Tensor], Tensor], u: Tensor, centre: Tensor) -> Tensor:
    """Where the distribution function reaches the share `u` of all it reaches, by bisection."""
    low, high = (centre + far + torch.zeros_like(u) for far in (-_FAR, _FAR))
    start, end = F(low), F(high)
    goal = start + u * (end - start)
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        below = F(middle) < goal
        low, high = torch.where(below, middle, low), torch.where(below, high, middle)
    return 0.5 * (low + high)


def _maps(spec: FlowSpec, a: Tensor, b: Tensor, window: Array | None) -> dict[str, Any]:
    location, scale = reach(spec, a.numpy())
    cell, variation = 0.0, []
    columns = ColumnMassGraph(spec, planar.stable_fraction)
    for k in range(len(a)):
        around = location[k][:, None] + scale[k][:, None] * np.linspace(-5.0, 5.0, 101)
        x, y = torch.from_numpy(np.asarray(around if window is None else window, np.float32))
        one, other = (columns(theta[k : k + 1], x[:-1], x[1:], y) for theta in (a, b))
        away = (one - other).abs()
        outside = (one.sum() - other.sum()).abs()  # what moved between the window and the rest
        cell = max(cell, float(away.max()))
        variation.append(0.5 * float(away.sum() + outside))
    return {
        "cell_mass": {"max": cell},
        "total_variation": {"mean": float(np.mean(variation)), "max": float(np.max(variation))},
    }
