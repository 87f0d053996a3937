"""Hyper-network heads, and the MLP hyper-network for vector conditions."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from hcnaf_models import flow
from hcnaf_models.config import ConditionConfig
from hcnaf_models.emission import Emission, bounded, initial_raw
from hcnaf_models.inverse import inverse
from hcnaf_models.spec import FlowSpec

LOCATION_BOUND = 6.0
LOG_SCALE_BOUND = 5.0
SLOPE_BOUND = 20.0


class Head(nn.Module):
    """features [..., R] -> theta [..., P].

    Weights start at zero and the bias at a standard initialisation, so that theta starts independent of the
    condition (Beck et al. 2023; Chang et al. 2020). The emitted location and scale are bounded: m within
    6 base scales of the anchor, s within a factor e^5 of the base scale, slopes within 20 scales per scale.
    """

    def __init__(self, spec: FlowSpec, features: int, slope: float = 1.5) -> None:
        super().__init__()
        self.spec, self.uniforms = spec, spec.dims
        self.emission = Emission(spec)
        self.weights = nn.Linear(features, spec.raw)
        self.units = nn.Linear(features, spec.units)
        nn.init.zeros_(self.weights.weight)
        nn.init.zeros_(self.units.weight)
        nn.init.zeros_(self.units.bias)
        with torch.no_grad():
            self.weights.bias.copy_(initial_raw(spec, slope=slope))

    def forward(self, features: Tensor, anchor: Tensor, spread: Tensor) -> Tensor:
        """theta, with the location `anchor` [..., D] and scale `spread` [..., D] (natural units) to start from."""
        D, units = self.spec.dims, self.units(features)
        location, scale = units_of(units[..., : 2 * D], anchor, spread)
        slope = bounded(units[..., 2 * D :], SLOPE_BOUND) if self.spec.shear else None
        theta: Tensor = self.emission(self.weights(features), location, scale, slope)
        return theta

    def log_prob(self, theta: Tensor, x: Tensor) -> Tensor:
        """log p(x | theta) [..., N] for theta [..., P] and x [..., N, D]: nats per unit of x to the D (eq. 1)."""
        return flow.log_prob(self.spec, theta, x)

    def sample(self, theta: Tensor, uniform: Tensor) -> Tensor:
        """Samples [..., N, D] for uniform [..., N, D] in (0, 1)."""
        return inverse(self.spec, theta, uniform).x


def units_of(raw: Tensor, anchor: Tensor, spread: Tensor) -> tuple[Tensor, Tensor]:
    """Location and scale [..., D] from raw [..., 2 D], bounded around `anchor` and `spread` [..., D]."""
    shift, log_scale = raw.chunk(2, dim=-1)
    location = anchor + spread * bounded(shift, LOCATION_BOUND)
    return location, spread * torch.exp(bounded(log_scale, LOG_SCALE_BOUND))


class ConditionHyperNet(nn.Module):
    """condition [A, K] -> theta [A, 1, P]."""

    def __init__(self, config: ConditionConfig) -> None:
        super().__init__()
        self.config = config
        self.body = mlp(config.size, config.hidden)
        self.head = Head(config.flow, (config.size, *config.hidden)[-1], config.slope)

    def forward(self, condition: Tensor) -> Tensor:
        features = self.body(condition).unsqueeze(-2)
        flat = torch.zeros_like(features[..., :1]).expand(*features.shape[:-1], self.config.flow.dims)
        theta: Tensor = self.head(features, flat + self.config.location, flat + self.config.scale)
        return theta


def mlp(features: int, widths: tuple[int, ...]) -> nn.Sequential:
    """Linear and ReLU for each width."""
    layers: list[nn.Module] = []
    for width in widths:
        layers += [nn.Linear(features, width), nn.ReLU()]
        features = width
    return nn.Sequential(*layers)
