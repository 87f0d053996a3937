"""The density as published: eager float32 PyTorch, log-determinants by log-sum-exp over [N, H, H] (eq. 8-14).

`hcnaf_models.reference` is the same in float64, for tests of accuracy.
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from hcnaf_models.flow import Layer, split
from hcnaf_models.reference import dense_weight
from hcnaf_models.spec import FlowSpec

MOST = 1 << 26
"""Numbers in the widest tensor, 256 MiB; more points than that allows are taken in parts."""


def log_prob(spec: FlowSpec, theta: Tensor, x: Tensor) -> Tensor:
    """log p [N] under theta [P] at x [N, D] (`paper` support)."""
    location, stack = split(spec, theta)
    h = x - location
    log_t = torch.zeros(*x.shape, 1)
    for k, layer in enumerate(stack, start=1):
        a = h @ dense_weight(spec, layer.diagonal, layer.lower).T + layer.bias.reshape(-1)
        log_t = torch.logsumexp(torch.log(layer.diagonal) + log_t.unsqueeze(-2), dim=-1)  # over [N, D, H, H]
        if k <= spec.layers:
            log_slope = 2.0 * (math.log(2.0) - a - torch.nn.functional.softplus(-2.0 * a))
            log_t = log_t + log_slope.reshape(log_t.shape)
            h = torch.tanh(a)
    base = -0.5 * a * a - 0.5 * math.log(2.0 * math.pi)
    return (base + log_t.squeeze(-1)).sum(-1)


def log_prob_each(spec: FlowSpec, theta: Tensor, x: Tensor) -> Tensor:
    """The same with weights of its own for every point, as the code released with the paper has it.

    There a map is a batch of points, each with its own condition: whole matrices are held for each, masked,
    and multiplied one by one. What the hyper-network would add to that is left out.
    """
    location, stack = split(spec, theta)
    h = x - location
    log_t: Tensor | None = None
    for k, layer in enumerate(stack, start=1):
        own, below = _masks(layer)
        raw = dense_weight(spec, torch.log(layer.diagonal), layer.lower).expand(len(x), *own.shape)
        w = torch.exp(raw) * own + raw * below
        blocks = raw[own.bool().expand(raw.shape)].reshape(len(x), *layer.diagonal.shape)
        a = torch.matmul(w, h.unsqueeze(-1)).squeeze(-1) + layer.bias.reshape(-1)
        log_t = blocks if log_t is None else torch.logsumexp(blocks + log_t.unsqueeze(-2), dim=-1)
        if k <= spec.layers:
            log_slope = 2.0 * (math.log(2.0) - a - torch.nn.functional.softplus(-2.0 * a))
            log_t = log_t.reshape(len(x), spec.dims, -1) + log_slope.reshape(len(x), spec.dims, -1)
            h = torch.tanh(a)
    assert log_t is not None
    base = -0.5 * a * a - 0.5 * math.log(2.0 * math.pi)
    return (base + log_t.squeeze(-1)).sum(-1)


def _masks(layer: Layer) -> tuple[Tensor, Tensor]:
    """1 on the blocks of the diagonal, and below them: [D H_out, D H_in] each."""
    D, rows, columns = layer.diagonal.shape
    own = torch.block_diag(*torch.ones(D, rows, columns))
    below = torch.kron(torch.ones(D, D).tril(-1), torch.ones(rows, columns))
    return own, below


def in_parts(function: Callable[[Tensor], Tensor], spec: FlowSpec, x: Tensor) -> Tensor:
    """`function` over x [N, D] in equal parts that keep the widest tensor within MOST."""
    parts = math.ceil(len(x) * spec.dims * spec.hidden**2 / MOST)
    return torch.cat([function(part) for part in x.chunk(max(1, parts))])
