r"""Exact distribution functions of a two-dimensional flow (a Knothe-Rosenblatt map).

    F_1(x)     = (Phi(z_1) - Phi(z_1(-))) / (Phi(z_1(+)) - Phi(z_1(-)))
    F_2(y | x) likewise from z_2

Everything that depends on x alone (dimension 1, and its context for dimension 2) is computed once per x and
broadcast over y. `normalised` support uses the formulas above, `paper` support Phi alone.

Written for the graphs that ship, where this is the hot path. Arrays over y are [B, S, H, E], one small product
per x; the limits z_2(-), z_2(+) ride along as the images of y = -+`FAR`; and for narrow layers the context of an x
is one more column of the weights, met by a unit that is always 1, which saves a pass over [B, S, H, E] per layer.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from hcnaf_models.normal import cdf, interval_fraction
from hcnaf_models.spec import FlowSpec

Fraction = Callable[[Tensor, Tensor, Tensor], Tensor]
"""(Phi(z) - Phi(a)) / (Phi(b) - Phi(a)) of z, a, b."""

FAR = 1e30
"""A y (or x) whose first-layer units are all saturated, in either direction."""

SURE = 20.0
"""tanh(20) is 1 in float32 and within 1e-17 of it in float64: the argument of the unit that is always 1."""

NARROW = 48
"""Up to this many hidden units contexts go into the weights; beyond, copying the weights costs more."""


class PlanarLayer(NamedTuple):
    """Blocks of one layer of a flow with D = 2: weights [B, H_out, H_in], biases [B, H_out, 1]."""

    W_11: Tensor
    W_22: Tensor
    W_21: Tensor
    B_1: Tensor
    B_2: Tensor


def marginal_cdf(spec: FlowSpec, theta: Tensor, x: Tensor, fraction: Fraction = interval_fraction) -> Tensor:
    """F_1 at x [B, K] under theta [B, P]: [B, K]."""
    location, _, stack = cut(spec, theta)
    u = torch.cat([x - location, *_infinities(x)], dim=-1).unsqueeze(-2)
    for layer in stack[:-1]:
        u = torch.tanh(layer.W_11 @ u + layer.B_1)
    z = (stack[-1].W_11 @ u + stack[-1].B_1).squeeze(-2)
    return _distribution(spec, z, fraction)


def conditional_cdf(
    spec: FlowSpec, theta: Tensor, x: Tensor, y: Tensor, fraction: Fraction = interval_fraction
) -> Tensor:
    """F_2(y | x) at x [B, S] and y [B, S, E] or [B, 1, E] under theta [B, P]: [B, S, E]."""
    m_1, m_2, stack = cut(spec, theta)
    v = y - m_2.unsqueeze(-1)
    h = torch.cat([v, *_infinities(v)], dim=-1).unsqueeze(-2)  # [B, S or 1, 1, E + 2]
    if spec.hidden <= NARROW:
        h = torch.cat([h, torch.ones_like(h)], dim=-2)
    contexts = second_contexts(stack, (x - m_1).unsqueeze(-2))
    for layer, c in zip(stack[:-1], contexts[:-1], strict=True):
        h = torch.tanh(_advance(spec, layer.W_22, c, h, carry=True))
    z = _advance(spec, stack[-1].W_22, contexts[-1], h, carry=False).squeeze(-2)
    return _distribution(spec, z, fraction)


def cell_mass(
    spec: FlowSpec, theta: Tensor, x: Tensor, weight: Tensor, y: Tensor, fraction: Fraction = interval_fraction
) -> Tensor:
    """Masses of cells: sum_s weight_cs (F_2(y_{j+1} | x_s) - F_2(y_j | x_s)), [B, E - 1, C].

    Args:
        theta: [B, P].
        x: [B, S], nodes (m).
        weight: [B, C, S], what node s counts for in column c; a column's weights sum to its increment of F_1.
        y: [B, E], cell edges, ascending (m).
        fraction: how F_2 is computed from z_2 and its limits.
    """
    F = conditional_cdf(spec, theta, x, y.unsqueeze(-2), fraction)
    increments = torch.clamp(F[..., 1:] - F[..., :-1], min=0.0)  # [B, S, E - 1]
    return increments.transpose(-1, -2) @ weight.transpose(-1, -2)


def cut(spec: FlowSpec, theta: Tensor) -> tuple[Tensor, Tensor, list[PlanarLayer]]:
    """theta [B, P] as the locations m_1, m_2 [B, 1] and the layers."""
    shapes = [(1, 1)] * 2
    for k in range(1, spec.layers + 2):
        rows, columns = spec.fan_out(k), spec.fan_in(k)
        shapes += [(rows, columns)] * 3 + [(rows, 1)] * 2
    parts = torch.split(theta, [rows * columns for rows, columns in shapes], dim=-1)
    blocks = [part.reshape(-1, *shape) for part, shape in zip(parts[2:], shapes[2:], strict=True)]
    return parts[0], parts[1], [PlanarLayer(*blocks[i : i + 5]) for i in range(0, len(blocks), 5)]


def second_contexts(stack: list[PlanarLayer], u: Tensor) -> list[Tensor]:
    """c_2^k = W_21^k h_1^{k-1} + B_2^k, k = 1 .. L + 1, at u = x - m_1 [B, 1, S]: [B, H, S] (last: [B, 1, S])."""
    contexts = []
    for layer in stack[:-1]:
        contexts.append(layer.W_21 @ u + layer.B_2)
        u = torch.tanh(layer.W_11 @ u + layer.B_1)
    return [*contexts, stack[-1].W_21 @ u + stack[-1].B_2]


def _advance(spec: FlowSpec, W: Tensor, c: Tensor, h: Tensor, *, carry: bool) -> Tensor:
    """W h_s + c_s for every x_s: W [B, H_out, H_in], c [B, H_out, S], h [B, S, H_in, E] -> [B, S, H_out, E].

    For narrow layers h ends with the unit that is always 1, and so does the result if `carry`.
    """
    columns = c.transpose(-1, -2).unsqueeze(-1)  # [B, S, H_out, 1]
    if spec.hidden > NARROW:
        return W.unsqueeze(1) @ h + columns
    if carry:
        W = torch.nn.functional.pad(W, (0, 0, 0, 1))
        columns = torch.nn.functional.pad(columns, (0, 0, 0, 1), value=SURE)
    W = W.unsqueeze(1).expand(-1, c.shape[-1], -1, -1)
    return torch.cat([W, columns], dim=-1) @ h


def _distribution(spec: FlowSpec, z: Tensor, fraction: Fraction) -> Tensor:
    """F [..., E] from z [..., E + 2], whose last two entries are its limits z(-) and z(+)."""
    inner = z[..., :-2]
    if spec.support == "paper":
        return cdf(inner)
    return fraction(inner, z[..., -2:-1], z[..., -1:])


def _infinities(v: Tensor) -> tuple[Tensor, Tensor]:
    far = torch.full_like(v[..., :1], FAR)
    return -far, far
