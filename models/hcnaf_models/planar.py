r"""Exact distribution functions of a two-dimensional flow (a Knothe-Rosenblatt map).

    F_1(x)     = (Phi(z_1) - Phi(z_1(-))) / (Phi(z_1(+)) - Phi(z_1(-)))
    F_2(y | x) likewise from z_2

Everything that depends on x alone (dimension 1, and its context for dimension 2) is computed once per x and
broadcast over y. `normalised` support uses the formulas above, `paper` support Phi alone.

Written for the graphs that ship, where this is the hot path: arrays over y are [B, S, H, E], one product per x
with its context broadcast along contiguous memory, and the limits z_2(-), z_2(+) ride along as images of
y = -+`FAR`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from hcnaf_models.normal import cdf, erf_fraction, interval_fraction
from hcnaf_models.spec import FlowSpec

Fraction = Callable[[Tensor], Tensor]
"""F [..., E] from z [..., E], whose last two entries are its limits z(-) and z(+), where F is 0 and 1."""

FAR = 1e30
"""A y (or x) whose first-layer units are all saturated, in either direction."""


def stable_fraction(z: Tensor) -> Tensor:
    """The truncated normal's distribution function, relatively accurate however far out the limits are."""
    return interval_fraction(z, z[..., -2:-1], z[..., -1:])


def fast_fraction(z: Tensor) -> Tensor:
    """The same by erf alone, good to about 1e-7 / (Phi(z(+)) - Phi(z(-)))."""
    return erf_fraction(z, z[..., -2:-1], z[..., -1:])


class PlanarLayer(NamedTuple):
    """Blocks of one layer of a flow with D = 2: weights [B, H_out, H_in], biases [B, H_out, 1]."""

    W_11: Tensor
    W_22: Tensor
    W_21: Tensor
    B_1: Tensor
    B_2: Tensor


def marginal_cdf(spec: FlowSpec, theta: Tensor, x: Tensor, fraction: Fraction = stable_fraction) -> Tensor:
    """F_1 at x [B, K] under theta [B, P]: [B, K]."""
    location, _, stack = cut(spec, theta)
    u = torch.cat([x - location, *_infinities(x)], dim=-1).unsqueeze(-2)
    for layer in stack[:-1]:
        u = torch.tanh(layer.W_11 @ u + layer.B_1)
    z = (stack[-1].W_11 @ u + stack[-1].B_1).squeeze(-2)
    return _distribution(spec, z, fraction)


def conditional_cdf(
    spec: FlowSpec, theta: Tensor, x: Tensor, y: Tensor, fraction: Fraction = stable_fraction
) -> Tensor:
    """F_2(y | x) at x [B, S] and y [B, S, E] or [B, 1, E] under theta [B, P]: [B, S, E]."""
    m_1, m_2, stack = cut(spec, theta)
    v = y - m_2.unsqueeze(-1)
    h = torch.cat([v, *_infinities(v)], dim=-1).unsqueeze(-2)  # [B, S or 1, 1, E + 2]
    contexts = second_contexts(stack, (x - m_1).unsqueeze(-2))
    h = torch.tanh(stack[0].W_22.unsqueeze(1) * h + _columns(contexts[0]))
    for layer, c in zip(stack[1:-1], contexts[1:-1], strict=True):
        h = torch.tanh(layer.W_22.unsqueeze(1) @ h + _columns(c))
    z = (stack[-1].W_22.unsqueeze(1) @ h + _columns(contexts[-1])).squeeze(-2)
    return _distribution(spec, z, fraction)


def cell_mass(
    spec: FlowSpec, theta: Tensor, x: Tensor, weight: Tensor, y: Tensor, fraction: Fraction = stable_fraction
) -> Tensor:
    """Masses of cells: sum_s weight_cs (F_2(y_{j+1} | x_s) - F_2(y_j | x_s)), [B, E - 1, C].

    Args:
        theta: [B, P].
        x: [B, S], nodes (m).
        weight: [B, C, S], what node s counts for in column c; a column's weights sum to its increment of F_1.
        y: [B, E], cell edges, ascending (m).
        fraction: how F_2 follows from z_2 and its limits.
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


def _columns(c: Tensor) -> Tensor:
    """Contexts [B, H, S] as [B, S, H, 1], to be added along y."""
    return c.transpose(-1, -2).unsqueeze(-1)


def _distribution(spec: FlowSpec, z: Tensor, fraction: Fraction) -> Tensor:
    """F [..., E] from z [..., E + 2], which ends with its limits."""
    return cdf(z[..., :-2]) if spec.support == "paper" else fraction(z)[..., :-2]


def _infinities(v: Tensor) -> tuple[Tensor, Tensor]:
    far = torch.full_like(v[..., :1], FAR)
    return -far, far
