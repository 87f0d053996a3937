r"""A flow of many dimensions with one hidden layer, conditioned on a class: z = f(x; theta_c), x in R^D.

With the notation of `hcnaf_models.flow`, L = 1 and D in the hundreds (an image), the weights below the diagonal
are too many to be emitted for every class: D^2 H numbers. So the hyper-network emits factors of them:

    a = r_1 * (W_1 (k_1 * y)) + B_1 + w y_d         y = x - m          [N, D, H]   (own path: w_dj > 0)
    z = r_2 * (W_2 (k_2 * h)) + B_2 + sum_j v_dj h_dj   h = tanh(a)    [N, D]      (own path: v_dj > 0)

W_1 [D H, D] and W_2 [D, D H] hold blocks below the diagonal only and are shared; theta_c is the rest: m, the gains
k and r, the diagonals w and v, the biases B. Every class thus has weights W_c = diag(r_c) W diag(k_c) of its own
(the relaxed weight sharing of hyper-networks for recurrent nets), and a batch of mixed classes needs one matrix
product per layer, not one per class. The location m is the same for all; x's scale is folded into w and k_1.

The matrices are cut into stripes of neighbouring dimensions: a stripe's rows reach up to its own last column, so
that about half the work and memory of the full product is left, and only the triangle at its end is masked.

With c_d all of z_d but its own path, the limits of z_d are z_d(+-) = c_d +- sum_j v_dj, and

    log p(x) = sum_d [ log phi(z_d) + log dz_d/dx_d - log(Phi(z_d(+)) - Phi(z_d(-))) ]

References:
    Oh & Valois, HCNAF, CVPR 2020 (section 5.3: conditional MNIST). Ha, Dai, Le, HyperNetworks, ICLR 2017.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor, nn

from hcnaf_models.flow import Image, log_prob_terms
from hcnaf_models.wide_config import WideConfig


class Factors(NamedTuple):
    """theta cut into its parts: [..., D] or [..., D, H], where units come in blocks of H per dimension."""

    m: Tensor  # location
    k_1: Tensor  # gains of x on its way to later dimensions, 1 / scale included
    r_1: Tensor  # gains of what comes from earlier dimensions, per hidden unit
    w: Tensor  # W_1's diagonal blocks, positive
    B_1: Tensor
    k_2: Tensor  # gains of h on its way to later dimensions
    v: Tensor  # W_2's diagonal blocks, positive
    r_2: Tensor
    B_2: Tensor


_PER_UNIT = ("r_1", "w", "B_1", "k_2", "v")


def factors(config: WideConfig, theta: Tensor) -> Factors:
    """The parts of theta [..., P] (views)."""
    D, H = config.flow.dims, config.flow.hidden
    parts = zip(Factors._fields, torch.split(theta, list(config.groups), dim=-1), strict=True)
    return Factors(*(p.reshape(*p.shape[:-1], D, H) if name in _PER_UNIT else p for name, p in parts))


@lru_cache(maxsize=64)
def below_diagonal(n: int, out: int, into: int) -> Tensor:
    """What is left of the last block [out n, into n] of a stripe of n: ones where the row's dimension comes after
    the column's. Not to be changed: it is kept."""
    lower = torch.ones(n, n).tril(-1)
    return lower.repeat_interleave(out, 0).repeat_interleave(into, 1)


def product(config: WideConfig, matrix: Sequence[Tensor], v: Tensor, into: int) -> Tensor:
    """W v for v [..., D into] and the stripes of W, each [out n, into b]: [..., D out]."""
    return torch.cat([v[..., : into * b] @ s.T for (_, b), s in zip(config.cuts, matrix, strict=True)], dim=-1)


def forward(config: WideConfig, W_1: Sequence[Tensor], W_2: Sequence[Tensor], theta: Tensor, x: Tensor) -> Image:
    """z, its log-derivative and limits, each [B, N, D], for x [B, N, D] under theta [B, P]."""
    D, H = config.flow.dims, config.flow.hidden
    f = Factors(*(p.unsqueeze(1) for p in factors(config, theta)))
    y = x - f.m
    heard = product(config, W_1, y * f.k_1, 1).reshape(*x.shape[:-1], D, H)
    a = f.r_1 * heard + f.B_1 + f.w * y.unsqueeze(-1)
    h = torch.tanh(a)
    c = f.r_2 * product(config, W_2, (h * f.k_2).flatten(-2), H) + f.B_2
    total = f.v.sum(-1)
    return Image(c + (f.v * h).sum(-1), log_slope(f.w * f.v, a), c - total, c + total)


def log_slope(weight: Tensor, a: Tensor) -> Tensor:
    """log sum_j weight_j tanh'(a_j) over the last dimension, for any float32 a: the slowest decay is taken out."""
    size = torch.abs(a)
    least = size.amin(dim=-1, keepdim=True)
    e = torch.exp(-2.0 * size)
    t = weight * torch.exp(-2.0 * torch.clamp(size - least, max=30.0)) * (4.0 / (1.0 + e) ** 2)
    return torch.log(torch.clamp(t.sum(-1), min=1.2e-38)) - 2.0 * least.squeeze(-1)


class WideFlow(nn.Module):
    """The shared matrices and a hyper-network that is linear in the one-hot class.

    Starts as independent dimensions with standard units; `fit_units` starts it from data.
    """

    location: Tensor
    scale: Tensor

    def __init__(self, config: WideConfig) -> None:
        super().__init__()
        self.config = config
        D, H, K = config.flow.dims, config.flow.hidden, config.classes
        first = [torch.zeros(H * (b - a), b) for a, b in config.cuts]
        second = [torch.zeros(b - a, H * b) for a, b in config.cuts]
        self.first, self.second = nn.ParameterList(first), nn.ParameterList(second)
        self.gains = nn.ParameterList(torch.zeros(K, n) for n in (D, D * H, D * H, D))
        self.log_w, self.bias = nn.Parameter(torch.zeros(K, D, H)), nn.Parameter(torch.zeros(K, D, H))
        self.log_v = nn.Parameter(torch.full((K, D, H), math.log(2.5 / H)))
        self.shift = nn.Parameter(torch.zeros(K, D))
        self.register_buffer("location", torch.zeros(D))
        self.register_buffer("scale", torch.ones(D))
        centres = torch.linspace(-2.0, 2.0, H) if H > 1 else torch.zeros(1)
        self._spread(centres.expand(D, H), torch.full((D, H), 4.0 / H))

    @torch.no_grad()
    def fit_units(self, x: Tensor) -> None:
        """Start from points x [N, D]: units of each dimension at its quantiles, as steep as those lie close."""
        H = self.config.flow.hidden
        self.location.copy_(x.mean(0))
        self.scale.copy_(x.std(0).clamp(min=1e-6))
        u = (x - self.location) / self.scale
        levels = torch.linspace(0.0, 1.0, H + 1, dtype=u.dtype).clamp(0.005, 0.995)
        edges = torch.quantile(u, levels, dim=0)
        centres = torch.quantile(u, (torch.arange(H, dtype=u.dtype) + 0.5) / H, dim=0)
        self._spread(centres.T, (edges[1:] - edges[:-1]).T.clamp(min=0.1))

    @torch.no_grad()
    def _spread(self, centres: Tensor, widths: Tensor) -> None:
        """Own paths with steps at `centres`, `widths` wide, both [D, H] in units of the scale."""
        self.log_w.copy_(torch.log(2.0 / widths))
        self.bias.copy_(-2.0 / widths * centres)

    def theta(self, condition: Tensor) -> Tensor:
        """theta [A, P] for conditions [A, K], one-hot."""
        k_1, r_1, k_2, r_2 = (1.0 + condition @ g for g in self.gains)
        log_w, bias, log_v, shift = (
            condition @ p.flatten(1) for p in (self.log_w, self.bias, self.log_v, self.shift)
        )
        H = self.config.flow.hidden
        w = torch.exp(log_w) / self.scale.repeat_interleave(H)
        m = self.location.expand(condition.shape[0], -1)
        return torch.cat([m, k_1 / self.scale, r_1, w, bias, k_2, torch.exp(log_v), r_2, shift], dim=-1)

    def forward(self, theta: Tensor, x: Tensor) -> Image:
        """`wide.forward` with the shared matrices: x [B, N, D] under theta [B, P]."""
        return forward(self.config, list(self.first), list(self.second), theta, x)

    def log_prob(self, theta: Tensor, x: Tensor) -> Tensor:
        """log p(x | theta) [B, N] in nats per unit of x to the D."""
        return log_prob_terms(self.config.flow, self(theta, x)).sum(-1)
