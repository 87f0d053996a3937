"""Density heads: what an encoder's features become, behind one interface.

    features [..., R], anchor and spread [..., 2] --head--> theta [..., P] --log_prob, sample--> nats per m², m

`hcnaf` is the flow of this package (`hcnaf_models.mlp.Head`), `mixture` a mixture density network. Every head
works on u = (x - m) / s with a location m and a scale s per dimension that it emits from the same anchor and
spread, within the same bounds; theta begins with them. A model names its head in its configuration; which
encoder feeds it does not matter.

References:
    Bishop, Mixture density networks, 1994.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Protocol

import torch
from torch import Tensor, nn

from hcnaf_models.config import HeadKind
from hcnaf_models.mlp import Head, units_of
from hcnaf_models.spec import FlowSpec

COMPONENTS = 6
"""Gaussians in a mixture."""

LOG_SPREAD_BOUND = 6.0
LOG_2PI = math.log(2.0 * math.pi)


class DensityHead(Protocol):
    """A family of conditional densities over the plane."""

    uniforms: int
    """Uniform numbers that one sample takes."""

    units: nn.Linear
    """Emits location and scale."""

    def __call__(self, features: Tensor, anchor: Tensor, spread: Tensor) -> Tensor:
        """theta [..., P] from features [..., R], with location and scale [..., 2] (m) to start from."""
        ...

    def log_prob(self, theta: Tensor, x: Tensor) -> Tensor:
        """log p(x | theta) [..., N] in nats per m², for theta [..., P] and x [..., N, 2] (m)."""
        ...

    def sample(self, theta: Tensor, uniform: Tensor) -> Tensor:
        """Samples [..., N, 2] (m) for uniform [..., N, uniforms] in (0, 1)."""
        ...


class HeadMaker(Protocol):
    """Makes the head of a kind."""

    def __call__(self, kind: HeadKind, spec: FlowSpec, features: int) -> nn.Module:
        """A `DensityHead` over so many features; `spec` is the flow's, for heads that have one."""
        ...


def make_head(kind: HeadKind, spec: FlowSpec, features: int) -> nn.Module:
    """The heads that need PyTorch alone. Raises ValueError for the others (`hcnaf_export.baselines` has them)."""
    if kind == "hcnaf":
        return Head(spec, features)
    if kind == "mixture":
        return MixtureHead(features)
    raise ValueError(
        f"head {kind!r} is a baseline; expected hcnaf or mixture, or build with hcnaf_export.baselines"
    )


class UnitsHead(nn.Module, ABC):
    """Location and scale in front of theta; the rest is the subclass's."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.units = nn.Linear(features, 4)
        nn.init.zeros_(self.units.weight)
        nn.init.zeros_(self.units.bias)

    def forward(self, features: Tensor, anchor: Tensor, spread: Tensor) -> Tensor:
        """See `DensityHead`."""
        location, scale = units_of(self.units(features), anchor, spread)
        return torch.cat([location, scale, self.emit(features)], dim=-1)

    def log_prob(self, theta: Tensor, x: Tensor) -> Tensor:
        """See `DensityHead`."""
        location, scale, rest = torch.split(theta, [2, 2, theta.shape[-1] - 4], dim=-1)
        u = (x - location.unsqueeze(-2)) / scale.unsqueeze(-2)
        return self.unit_log_prob(rest, u) - torch.log(scale).sum(-1, keepdim=True)

    def sample(self, theta: Tensor, uniform: Tensor) -> Tensor:
        """See `DensityHead`."""
        location, scale, rest = torch.split(theta, [2, 2, theta.shape[-1] - 4], dim=-1)
        return location.unsqueeze(-2) + scale.unsqueeze(-2) * self.unit_sample(rest, uniform)

    @abstractmethod
    def emit(self, features: Tensor) -> Tensor:
        """What theta holds after location and scale."""

    @abstractmethod
    def unit_log_prob(self, rest: Tensor, u: Tensor) -> Tensor:
        """log p(u) [..., N] for u [..., N, 2]."""

    @abstractmethod
    def unit_sample(self, rest: Tensor, uniform: Tensor) -> Tensor:
        """u [..., N, 2]."""


class MixtureHead(UnitsHead):
    """A mixture of `COMPONENTS` Gaussians with full covariances.

    In u: weights softmax(logits), means, and Cholesky factors [[exp a, 0], [b, exp c]] with a, c within 6 of 0.
    """

    uniforms = 3

    def __init__(self, features: int) -> None:
        super().__init__(features)
        self.weights = nn.Linear(features, 6 * COMPONENTS)
        nn.init.zeros_(self.weights.weight)
        with torch.no_grad():
            bias = torch.zeros(6, COMPONENTS)
            bias[1:3] = 0.5 * torch.randn(2, COMPONENTS)
            bias[3:5] = torch.linspace(-1.5, 0.5, COMPONENTS)
            self.weights.bias.copy_(bias.flatten())

    def emit(self, features: Tensor) -> Tensor:
        """logits, means, logarithms of the factors' diagonals and b, six numbers each."""
        raw: Tensor = self.weights(features)
        return raw

    def unit_log_prob(self, rest: Tensor, u: Tensor) -> Tensor:
        """See `UnitsHead`."""
        logits, m_1, m_2, a, c, b = self._parts(rest)
        z_1 = (u[..., :1] - m_1) * torch.exp(-a)
        z_2 = (u[..., 1:] - m_2 - b * z_1) * torch.exp(-c)
        terms = torch.log_softmax(logits, dim=-1) - 0.5 * (z_1 * z_1 + z_2 * z_2) - a - c - LOG_2PI
        return torch.logsumexp(terms, dim=-1)

    def unit_sample(self, rest: Tensor, uniform: Tensor) -> Tensor:
        """See `UnitsHead`. The first number chooses the component."""
        logits, *others = self._parts(rest)
        edges = torch.cumsum(torch.softmax(logits, dim=-1), dim=-1)
        chosen = (edges < uniform[..., :1]).sum(-1, keepdim=True).clamp(max=COMPONENTS - 1)
        shape = (*uniform.shape[:-1], COMPONENTS)
        m_1, m_2, a, c, b = (torch.gather(v.expand(shape), -1, chosen) for v in others)
        z = torch.special.ndtri(uniform[..., 1:].clamp(1e-7, 1.0 - 1e-7))
        x = m_1 + torch.exp(a) * z[..., :1]
        return torch.cat([x, m_2 + b * z[..., :1] + torch.exp(c) * z[..., 1:]], dim=-1)

    @staticmethod
    def _parts(rest: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
        """logits, m_1, m_2, a, c, b, each [..., 1, COMPONENTS]."""
        parts = rest.reshape(*rest.shape[:-1], 1, 6, COMPONENTS)
        logits, m_1, m_2, a, c, b = parts.unbind(-2)
        bound = LOG_SPREAD_BOUND
        return logits, m_1, m_2, bound * torch.tanh(a / bound), bound * torch.tanh(c / bound), b
