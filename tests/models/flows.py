"""Random flows for the law tests."""

from __future__ import annotations

import torch
from torch import Tensor

from hcnaf_models import FlowSpec
from hcnaf_models.emission import Emission, initial_raw

SPECS = [
    FlowSpec(dims=1, layers=1, hidden=4),
    FlowSpec(dims=2, layers=2, hidden=20),
    FlowSpec(dims=2, layers=3, hidden=20, weight_norm="row"),
    FlowSpec(dims=2, layers=1, hidden=8, weight_norm="frobenius"),
    FlowSpec(dims=2, layers=3, hidden=100),
    FlowSpec(dims=3, layers=2, hidden=5, support="paper"),
    FlowSpec(dims=5, layers=2, hidden=3, weight_norm="row"),
    FlowSpec(dims=2, layers=2, hidden=6, weight_norm="row-gain"),
]


def name(spec: FlowSpec) -> str:
    return f"D{spec.dims}L{spec.layers}H{spec.hidden}-{spec.weight_norm}-{spec.support}"


def random_theta(spec: FlowSpec, seed: int, *, roughness: float = 0.5, scale: float = 2.0) -> Tensor:
    """theta [P] in float64 around the standard initialisation, located near 1."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        emission = Emission(spec).double()
        raw = (initial_raw(spec) + roughness * torch.randn(spec.raw)).double()
        location = torch.full((spec.dims,), 1.0, dtype=torch.float64)
        return emission(raw, location, torch.full_like(location, scale)).detach()
