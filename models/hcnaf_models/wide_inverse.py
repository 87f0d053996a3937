r"""Samples of a wide flow: x = F^-1(u), dimension by dimension, all samples at once.

Once x_<d is known, z_d = c_d + sum_j v_dj tanh(w_dj y_d + c_dj) rises with y_d = x_d - m_d. Its target is the
image of u_d under the truncated base, so it has a solution for every u in (0, 1), which bisection cannot miss: the
bracket runs from where all units are saturated below to where all are above. In float64, so that a steep z_d is
resolved.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from hcnaf_models.quantile import truncated_quantile
from hcnaf_models.wide import Factors, factors
from hcnaf_models.wide_config import WideConfig

SATURATED = 20.0
"""tanh differs from 1 by 1e-17 here."""

HALVINGS = 50
"""Of the bracket: what is left of it is 1e-15 of its width."""


@torch.no_grad()
def inverse(
    config: WideConfig, W_1: Sequence[Tensor], W_2: Sequence[Tensor], theta: Tensor, uniform: Tensor
) -> Tensor:
    """Samples x [B, N, D] for u [B, N, D] in (0, 1) under theta [B, P] (`normalised` support); float64."""
    B, N, D = uniform.shape
    H = config.flow.hidden
    f = Factors(*(p.unsqueeze(1).double() for p in factors(config, theta)))
    y, h = (torch.zeros(B, N, size, dtype=torch.float64) for size in (D, D * H))
    for (a, b), first, second in zip(config.cuts, W_1, W_2, strict=True):
        first, second = first.double(), second.double()
        for d in range(a, b):
            rows = first[(d - a) * H : (d - a + 1) * H, :d]
            inner = f.r_1[..., d, :] * ((y[..., :d] * f.k_1[..., :d]) @ rows.T) + f.B_1[..., d, :]
            outer = f.r_2[..., d] * (h[..., : d * H] @ second[d - a, : d * H]) + f.B_2[..., d]
            v = f.v[..., d, :].expand_as(inner)
            total = v.sum(-1)
            z = truncated_quantile(uniform[..., d].double(), outer - total, outer + total)
            y[..., d] = solve(f.w[..., d, :], v, inner, z - outer)
            units = torch.tanh(f.w[..., d, :] * y[..., d : d + 1] + inner)
            h[..., d * H : (d + 1) * H] = units * f.k_2[..., d, :]
    return y + f.m


def solve(w: Tensor, v: Tensor, c: Tensor, target: Tensor) -> Tensor:
    """y [...] with sum_j v_j tanh(w_j y + c_j) = target [...], for c, v > 0 [..., H] and w > 0 that broadcasts."""
    low, high = ((-SATURATED - c) / w).amin(-1), ((SATURATED - c) / w).amax(-1)
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        above = (v * torch.tanh(w * middle.unsqueeze(-1) + c)).sum(-1) > target
        low, high = torch.where(above, low, middle), torch.where(above, middle, high)
    return 0.5 * (low + high)
