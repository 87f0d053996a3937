"""The flow written as published: dense masked weights in float64, log-sum-exp log-determinant, eq. 8-14.

A slow, independent yardstick for tests and benchmarks; nothing that ships uses it.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from hcnaf_models.flow import split, strictly_lower
from hcnaf_models.spec import FlowSpec


def dense_weight(spec: FlowSpec, diagonal: Tensor, lower: Tensor) -> Tensor:
    """The block lower-triangular W of one layer, [D H_out, D H_in] (eq. 9)."""
    D, H_out, H_in = diagonal.shape
    own = torch.eye(D, dtype=diagonal.dtype)[:, None, :, None] * diagonal[:, :, None, :]
    W = own.reshape(D * H_out, D * H_in)
    return W + strictly_lower(spec, lower) if D > 1 else W


def forward_and_log_det(spec: FlowSpec, theta: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    """z [N, D] and log dz_d/dx_d [N, D] for one theta [P] and points x [N, D], in float64."""
    location, stack = split(spec, theta.double())
    x = x.double() - location
    h, log_t = x, torch.zeros(*x.shape, 1, dtype=torch.float64)  # log_t: [N, D, H_in]
    for k, layer in enumerate(stack, start=1):
        W = dense_weight(spec, layer.diagonal, layer.lower)
        a = h @ W.T + layer.bias.reshape(-1)
        log_W = torch.log(layer.diagonal)  # [D, H_out, H_in]
        log_t = torch.logsumexp(log_W + log_t.unsqueeze(-2), dim=-1)
        if k == len(stack):
            return a, log_t.squeeze(-1)
        log_slope = 2.0 * (math.log(2.0) - a - torch.nn.functional.softplus(-2.0 * a))
        log_t = log_t + log_slope.reshape(*log_t.shape)
        h = torch.tanh(a)
    raise AssertionError("a flow has at least two layers")


def log_prob_published(spec: FlowSpec, theta: Tensor, x: Tensor) -> Tensor:
    """log N(z; 0, I) + sum_d log dz_d/dx_d [N], the published density (`paper` support), in float64."""
    z, log_dz = forward_and_log_det(spec, theta, x)
    base = -0.5 * z * z - 0.5 * math.log(2.0 * math.pi)
    return (base + log_dz).sum(-1)
