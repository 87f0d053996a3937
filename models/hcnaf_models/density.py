r"""The density of a two-dimensional flow, laid out for the graph that ships.

The same numbers as `flow.forward` and `flow.log_prob_terms`, for D = 2 and with fewer and larger operations:

    arrays are [B, H, N], points along contiguous memory: a product [B, H, H] @ [B, H, N] for a point's own path,
    its two limits and its tangent each (one product of four times the width costs more: it has to be put together)
    tanh'(a) = exp(-2 |a|) (1 + |tanh a|)^2        one exponential, accurate however far a is from 0
    z_1(-), z_1(+) depend on theta alone and are computed once per map
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from hcnaf_models.normal import log_interval, log_phi
from hcnaf_models.planar import PlanarLayer, cut
from hcnaf_models.spec import FlowSpec

LogInterval = Callable[[Tensor, Tensor], Tensor]
"""log(Phi(b) - Phi(a)) of a and b."""

TINY = 1.2e-38
"""The smallest normal float32: a smaller one would be zero where denormals are flushed."""


class Density(NamedTuple):
    """What `density` returns."""

    log_prob: Tensor  # [B, N], nats per m^2
    z: Tensor  # [B, N, 2]
    log_det: Tensor  # [B, N], log dz_1/dx + log dz_2/dy


def density(spec: FlowSpec, theta: Tensor, points: Tensor, log_of_interval: LogInterval = log_interval) -> Density:
    """Log-density at points [B, N, 2] (m) under theta [B, P]."""
    m_1, m_2, stack = cut(spec, theta)
    x, y = points.transpose(-1, -2).unsqueeze(2).unbind(1)  # [B, 1, N] each
    first, contexts = _first(stack, x - m_1.unsqueeze(-1))
    second = _second(stack, y - m_2.unsqueeze(-1), contexts)
    terms = [_log_density(spec, *image, log_of_interval) for image in (first, second)]
    z = torch.cat([first[0], second[0]], dim=1).transpose(-1, -2)
    return Density((terms[0] + terms[1]).squeeze(1), z, (first[1] + second[1]).squeeze(1))


def _log_density(
    spec: FlowSpec, z: Tensor, log_dz: Tensor, limits: Tensor, log_of_interval: LogInterval
) -> Tensor:
    """log p(x_d | x_<d) [B, 1, N] from z, log dz/dx and the limits z(+), z(-) [B, 2, N or 1]."""
    plain = log_phi(z) + log_dz
    return plain if spec.support == "paper" else plain - log_of_interval(limits[:, 1:], limits[:, :1])


def _first(stack: list[PlanarLayer], u: Tensor) -> tuple[tuple[Tensor, Tensor, Tensor], list[Tensor]]:
    """z_1, log dz_1/dx [B, 1, N] and limits [B, 2, 1]; what each layer of dimension 2 takes from dimension 1."""
    ones = torch.ones_like(stack[0].B_1)
    contexts = [stack[0].W_21 @ u + stack[0].B_2]
    h, t, log_scale = _activate(stack[0].W_11 * u + stack[0].B_1, stack[0].W_11)
    limits = torch.cat([ones, -ones], dim=-1)
    for layer in stack[1:-1]:
        contexts.append(layer.W_21 @ h + layer.B_2)
        a, du = layer.W_11 @ h, layer.W_11 @ t
        limits = torch.tanh(layer.W_11 @ limits + layer.B_1)
        h, t, scale = _activate(a + layer.B_1, du)
        log_scale = log_scale + scale
    last = stack[-1]
    contexts.append(last.W_21 @ h + last.B_2)
    a, du = last.W_11 @ h, last.W_11 @ t
    ends = (last.W_11 @ limits + last.B_1).transpose(-1, -2)
    return (a + last.B_1, torch.log(torch.clamp(du, min=TINY)) + log_scale, ends), contexts


def _second(stack: list[PlanarLayer], v: Tensor, contexts: list[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """z_2, log dz_2/dy [B, 1, N] and limits [B, 2, N]."""
    h, t, log_scale = _activate(stack[0].W_22 * v + contexts[0], stack[0].W_22)
    ends: tuple[Tensor, ...] = ()  # the units at y = +-infinity, once they depend on x
    for layer, c in zip(stack[1:-1], contexts[1:-1], strict=True):
        a, du, rise, fall = _pushed(layer.W_22, h, t, ends)
        ends = torch.tanh(rise + c), torch.tanh(fall + c)
        h, t, scale = _activate(a + c, du)
        log_scale = log_scale + scale
    a, du, rise, fall = _pushed(stack[-1].W_22, h, t, ends)
    c = contexts[-1]
    limits = torch.cat([rise + c, fall + c], dim=1)
    return a + c, torch.log(torch.clamp(du, min=TINY)) + log_scale, limits


def _pushed(W: Tensor, h: Tensor, t: Tensor, ends: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """W [B, H_out, H] times h, t and either end; where there are none yet these are +1 and -1 for all points."""
    if ends:
        return tuple(W @ part for part in (h, t, *ends))
    total = W.sum(-1, keepdim=True)
    return W @ h, W @ t, total, -total


def _activate(a: Tensor, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """tanh(a), u tanh'(a) without its slowest decay, and the log of that [B, 1, N]."""
    h, size = torch.tanh(a), torch.abs(a)
    least = size.amin(dim=1, keepdim=True)
    # Held at 1e-26: denormal numbers would take a product many times as long.
    decay = torch.exp(-2.0 * torch.clamp(size - least, max=30.0))
    flat = 1.0 + torch.abs(h)
    return h, u * decay * flat * flat, -2.0 * least


def fast_log_interval(a: Tensor, b: Tensor) -> Tensor:
    """`log_interval` by erf alone, good to about 1e-7 / (Phi(b) - Phi(a))."""
    mass = torch.erf(b * math.sqrt(0.5)) - torch.erf(a * math.sqrt(0.5))
    return torch.log(torch.clamp(mass, min=TINY)) - math.log(2.0)
