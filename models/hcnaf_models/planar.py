r"""Exact distribution functions of a two-dimensional flow (a Knothe-Rosenblatt map).

    F_1(x)     = (Phi(z_1) - Phi(z_1(-))) / (Phi(z_1(+)) - Phi(z_1(-)))
    F_2(y | x) likewise from z_2

Everything that depends on x alone (dimension 1, and its context for dimension 2) is computed once per x and
broadcast over y. `normalised` support uses the formulas above, `paper` support Phi alone.

Written for the graphs that ship, where this is the hot path. The nodes s lie along contiguous memory. On a grid,
arrays are [B, E, H, S]: what depends on x is added in runs of H S numbers. At points of their own they are
[B, H, E S]: one product per layer, however few nodes there are. The limits z_2(-), z_2(+) ride along as images of
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
"""F [B, E, ...] from z [B, E, ...], whose last two along E are its limits z(-) and z(+), where F is 0 and 1."""

FAR = 1e30
"""A y (or x) whose first-layer units are all saturated, in either direction."""


def stable_fraction(z: Tensor) -> Tensor:
    """The truncated normal's distribution function, relatively accurate however far out the limits are."""
    return interval_fraction(z, z[:, -2:-1], z[:, -1:])


def fast_fraction(z: Tensor) -> Tensor:
    """The same by erf alone, good to about 1e-7 / (Phi(z(+)) - Phi(z(-)))."""
    return erf_fraction(z, z[:, -2:-1], z[:, -1:])


class Cells(NamedTuple):
    """What `cell_mass` returns."""

    mass: Tensor
    """[B, E - 1, C]: sum_s weight_sc (F_2(y_{j+1} | x_s) - F_2(y_j | x_s)), at least 0; columns keep sums."""
    error: Tensor
    """[B, C]: the largest doubt of a column, or what its negative masses add up to if that is more."""
    cdf: Tensor
    """[B, E, S]: F_2(y | x)."""


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
    u = x - location
    u = torch.cat([u, *_infinities(u[:, :1])], dim=-1).unsqueeze(-2)
    for layer in stack[:-1]:
        u = torch.tanh(layer.W_11 @ u + layer.B_1)
    z = (stack[-1].W_11 @ u + stack[-1].B_1).squeeze(-2)
    return _distribution(spec, z, fraction)


def conditional_cdf(
    spec: FlowSpec, theta: Tensor, x: Tensor, y: Tensor, fraction: Fraction = stable_fraction
) -> Tensor:
    """F_2(y | x) at x [B, S] and y [B, S, E] under theta [B, P]: [B, S, E]."""
    m_1, m_2, stack = cut(spec, theta)
    v = (y - m_2.unsqueeze(-1)).transpose(-1, -2)
    v = torch.cat([v, *_infinities(v[:, :1])], dim=1)  # [B, E + 2, S]
    contexts = second_contexts(stack, (x - m_1).unsqueeze(-2))
    h = torch.tanh(stack[0].W_22.unsqueeze(-1) * v.unsqueeze(1) + contexts[0].unsqueeze(2))  # [B, H, E + 2, S]
    for layer, c in zip(stack[1:-1], contexts[1:-1], strict=True):
        h = torch.tanh(torch.unflatten(layer.W_22 @ h.flatten(2), 2, v.shape[1:]) + c.unsqueeze(2))
    z = torch.unflatten(stack[-1].W_22 @ h.flatten(2), 2, v.shape[1:]).squeeze(1) + contexts[-1]
    return _distribution(spec, z, fraction).transpose(-1, -2)


def grid_cdf(spec: FlowSpec, theta: Tensor, x: Tensor, y: Tensor, fraction: Fraction = stable_fraction) -> Tensor:
    """F_2(y | x) at every pair of x [B, S] and y [B, E] under theta [B, P]: [B, E, S]."""
    return _on_grid(spec, theta, x, y, fraction)[:, :-2]


def _on_grid(spec: FlowSpec, theta: Tensor, x: Tensor, y: Tensor, fraction: Fraction) -> Tensor:
    """`grid_cdf` with its limits, [B, E + 2, S]."""
    m_1, m_2, stack = cut(spec, theta)
    v = torch.cat([y - m_2, torch.tensor([-FAR, FAR], dtype=y.dtype, device=y.device) - m_2], dim=-1)
    contexts = second_contexts(stack, (x - m_1).unsqueeze(-2))
    # W_22 v + c as one product with two terms: (v, 1) times (W_22 repeated along s, c), rows of H S numbers.
    first = torch.stack([stack[0].W_22.expand_as(contexts[0]), contexts[0]], dim=1)
    a = torch.nn.functional.pad(v.unsqueeze(-1), (0, 1), value=1.0) @ first.flatten(2)
    h = torch.tanh(torch.unflatten(a, -1, contexts[0].shape[1:]))  # [B, E + 2, H, S]
    for layer, c in zip(stack[1:-1], contexts[1:-1], strict=True):
        h = torch.tanh(layer.W_22.unsqueeze(1) @ h + c.unsqueeze(1))
    z = (stack[-1].W_22.unsqueeze(1) @ h).squeeze(2) + contexts[-1]
    return cdf(z) if spec.support == "paper" else fraction(z)


def cell_mass(
    spec: FlowSpec,
    theta: Tensor,
    x: Tensor,
    weight: Tensor,
    doubt: Tensor,
    y: Tensor,
    fraction: Fraction = stable_fraction,
) -> Cells:
    """Masses of cells and what they may be wrong by.

    Args:
        theta: [B, P].
        x: [B, S], nodes (m).
        weight: [B, S, C], what node s counts for in column c; a column's weights sum to its increment of F_1.
        doubt: [B, S, C], the weights minus those of a lesser rule: what cells would be wrong by under it.
        y: [B, E], cell edges, ascending (m).
        fraction: how F_2 follows from z_2 and its limits.
    """
    F = _on_grid(spec, theta, x, y, fraction)
    increments = torch.clamp(F[:, 1:-2] - F[:, :-3], min=0.0)  # [B, E - 1, S]
    mass, off = increments @ weight, increments @ doubt
    positive = torch.clamp(mass, min=0.0)
    total, kept = mass.sum(1, keepdim=True), positive.sum(1, keepdim=True)
    # Where weights of both signs made cells negative the others give way: columns keep their mass.
    cells = positive * (torch.clamp(total, min=0.0) / torch.clamp(kept, min=1e-30))
    return Cells(cells, torch.maximum(off.abs().amax(1), (kept - total).squeeze(1)), F[:, :-2])


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


def _distribution(spec: FlowSpec, z: Tensor, fraction: Fraction) -> Tensor:
    """F [B, E, ...] from z [B, E + 2, ...], which ends with its limits along E."""
    return cdf(z[:, :-2]) if spec.support == "paper" else fraction(z)[:, :-2]


def _infinities(v: Tensor) -> tuple[Tensor, Tensor]:
    far = torch.full_like(v, FAR)
    return -far, far
