r"""Exact distribution functions of a two-dimensional flow (a Knothe-Rosenblatt map).

    F_1(x)     = (Phi(z_1) - Phi(z_1(-))) / (Phi(z_1(+)) - Phi(z_1(-)))
    F_2(y | x) likewise from z_2

Everything that depends on x alone (dimension 1, and its context for dimension 2) is computed once per x and
broadcast over y. `normalised` support uses the formulas above, `paper` support Phi alone.
Arrays over y are laid out [..., H, S, E], so that contexts broadcast along contiguous memory.
"""

from __future__ import annotations

import torch
from torch import Tensor

from hcnaf_models.flow import Layer, distribution, split
from hcnaf_models.spec import FlowSpec


def marginal_cdf(spec: FlowSpec, theta: Tensor, x: Tensor) -> Tensor:
    """F_1 at x [B, K] under theta [B, P]: [B, K]."""
    location, stack = split(spec, theta)
    hidden = first_dimension(stack, x - location[..., :1])
    last = stack[-1]
    z = _first(last, hidden[-1])
    limits = limit_paths([_own(layer, 0) for layer in stack], _first_biases(stack))
    return distribution(spec, z, *limits)


def conditional_cdf(spec: FlowSpec, theta: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """F_2(y | x) at x [B, S] and y [B, S, E] or [E] under theta [B, P]: [B, S, E]."""
    location, stack = split(spec, theta)
    contexts = second_contexts(stack, first_dimension(stack, x - location[..., :1]))
    own = [_own(layer, 1) for layer in stack]
    z = second_dimension(own, contexts, y - location[..., 1:].unsqueeze(-1))
    minus, plus = limit_paths(own, contexts)
    return distribution(spec, z, minus.unsqueeze(-1), plus.unsqueeze(-1))


def cell_mass(spec: FlowSpec, theta: Tensor, x: Tensor, weight: Tensor, y: Tensor) -> Tensor:
    """Masses of cells: sum_s weight_cs (F_2(y_{j+1} | x_s) - F_2(y_j | x_s)), [B, E - 1, C].

    Args:
        theta: [B, P].
        x: [B, S], one node per sub-column (m).
        weight: [B, C, S], the exact F_1 increment of sub-column s in row c of the column that holds it.
        y: [E], cell edges (m).
    """
    F = conditional_cdf(spec, theta, x, y)
    increments = torch.clamp(F[..., 1:] - F[..., :-1], min=0.0)  # [B, S, E - 1]
    return increments.transpose(-1, -2) @ weight.transpose(-1, -2)


def first_dimension(stack: list[Layer], x: Tensor) -> list[Tensor]:
    """x and h_1^k for k = 1 .. L at x [B, S], relative to the location: L + 1 tensors [B, H, S]."""
    h = torch.tanh(_own(stack[0], 0) * x.unsqueeze(-2) + _bias(stack[0], 0))
    hidden = [h]
    for layer in stack[1:-1]:
        h = torch.tanh(_own(layer, 0) @ h + _bias(layer, 0))
        hidden.append(h)
    return [x.unsqueeze(-2), *hidden]


def second_contexts(stack: list[Layer], inputs: list[Tensor]) -> list[Tensor]:
    """c_2^k = W_21^k h_1^{k-1} + B_2^k for k = 1 .. L + 1: [B, H, S] (last: [B, 1, S])."""
    first = _lower(stack[0]) * inputs[0] + _bias(stack[0], 1)
    rest = [_lower(layer) @ h + _bias(layer, 1) for layer, h in zip(stack[1:], inputs[1:], strict=True)]
    return [first, *rest]


def second_dimension(own: list[Tensor], contexts: list[Tensor], y: Tensor) -> Tensor:
    """z_2 at y [B, S, E] or [B, 1, E], relative to the location: [B, S, E]."""
    h = torch.tanh(own[0].unsqueeze(-1) * y.unsqueeze(-3) + contexts[0].unsqueeze(-1))  # [B, H, S, E]
    B, _, S, E = h.shape
    for w, c in zip(own[1:], contexts[1:], strict=True):
        a = (w @ h.reshape(B, -1, S * E)).reshape(B, -1, S, E) + c.unsqueeze(-1)
        h = torch.tanh(a) if w is not own[-1] else a
    return h.squeeze(-3)


def limit_paths(own: list[Tensor], contexts: list[Tensor]) -> tuple[Tensor, Tensor]:
    """z_d(-) and z_d(+) [B, S]: the own path started at h_d^1 = -1 and +1."""
    h = torch.ones_like(contexts[0])
    up, down = h, -h
    for w, c in zip(own[1:-1], contexts[1:-1], strict=True):
        up, down = torch.tanh(w @ up + c), torch.tanh(w @ down + c)
    w, c = own[-1], contexts[-1]
    return (w @ down + c).squeeze(-2), (w @ up + c).squeeze(-2)


def _own(layer: Layer, d: int) -> Tensor:
    return layer.diagonal[..., d, :, :]


def _lower(layer: Layer) -> Tensor:
    return layer.lower[..., 0, :, :]


def _bias(layer: Layer, d: int) -> Tensor:
    return layer.bias[..., d, :].unsqueeze(-1)


def _first(layer: Layer, h: Tensor) -> Tensor:
    return (_own(layer, 0) @ h + _bias(layer, 0)).squeeze(-2)


def _first_biases(stack: list[Layer]) -> list[Tensor]:
    return [_bias(layer, 0) for layer in stack]
