r"""The inverse flow x = f^-1(z; theta), dimension by dimension, and samples x = F^-1(u).

z_d is a strictly increasing function of x_d once x_<d is known, so each dimension is one scalar equation. It is
solved in the scale

    zeta_d(x_d) = log (z_d - z_d(-)) - log (z_d(+) - z_d)

which tanh makes nearly straight: zeta grows linearly on both sides, where z itself is flat. A Newton step (its
derivative is the tangent the flow carries anyway) is taken while it stays in the bracket; where it does not, or
the last one leapt across the target and gained little, the bracket is halved. The bracket needs no growing: beyond
the x_d that saturates every unit of the first layer, z_d equals its limits to the last bit.

Uniforms go through the truncated base, Phi(z_d) = (1 - u_d) Phi(z_d(-)) + u_d Phi(z_d(+)), so every u in (0, 1)^D
has an image. `paper` support knows no truncation: there z_d = Phi^-1(u_d), and a z_d outside the image is moved to
its edge, which lies as far out as float numbers tell.

Gradients follow from the implicit function theorem at the solution; nothing is kept of the iterations. They are
right to first order: second derivatives are not.

References:
    Rosenblatt, Remarks on a multivariate transformation, 1952.
    Press et al., Numerical Recipes, 3rd ed., section 9.4 (safeguarded Newton).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from hcnaf_models import flow
from hcnaf_models.normal import log_interval, log_phi
from hcnaf_models.quantile import log_odds_parts, quantile, truncated_quantile
from hcnaf_models.spec import FlowSpec

MOST_STEPS = 200
"""Bisection alone would need about 100."""

OUTERMOST = 1e9
"""|x - m| is not searched beyond this."""


class Sampled(NamedTuple):
    """Points x [..., N, D] and log p(x) [..., N] in nats per unit of x to the D."""

    x: Tensor
    log_prob: Tensor


class Path(NamedTuple):
    """One dimension's way through the flow, with all before it known: arrays are [B, H, N].

    `weights` are W_dd [B, H_out, H_in] of layers 1 .. L + 1, `contexts` c_d [B, H_out, N or 1].
    """

    weights: list[Tensor]
    contexts: list[Tensor]


class State(NamedTuple):
    """Where the search stands, all [B, 1, N]: x - m, its bracket, and the residual one step ago."""

    x: Tensor
    low: Tensor
    high: Tensor
    residual: Tensor


class Target(NamedTuple):
    """What is searched for, [B, 1, N or 1]: zeta, and the limits z(-), z(+)."""

    zeta: Tensor
    minus: Tensor
    plus: Tensor


def inverse(spec: FlowSpec, theta: Tensor, uniform: Tensor) -> Sampled:
    """F^-1(u): samples x [..., N, D] for u [..., N, D] in (0, 1) under theta [..., P], and their log-density.

    Differentiable in theta and u. u is held between the smallest normal number and the largest below one.
    """
    return _inverse(spec, theta, uniform, from_uniform=True)


def from_base(spec: FlowSpec, theta: Tensor, z: Tensor) -> Sampled:
    """f^-1(z): x [..., N, D] for z [..., N, D] under theta [..., P], and its log-density.

    Differentiable in theta and z. A z_d outside (z_d(-), z_d(+)) has no image and is moved to the nearer edge.
    """
    return _inverse(spec, theta, z, from_uniform=False)


def _inverse(spec: FlowSpec, theta: Tensor, v: Tensor, *, from_uniform: bool) -> Sampled:
    lead = (theta[..., 0] + v[..., 0, 0]).shape
    flat = theta.expand(*lead, -1).reshape(-1, spec.parameters)
    places = v.expand(*lead, *v.shape[-2:]).reshape(-1, *v.shape[-2:])
    location, stack = flow.split(spec, flat)
    known: list[list[Tensor]] = [[] for _ in stack]  # inputs of every layer, of the dimensions done
    found = []
    for d in range(spec.dims):
        path = path_of(stack, d, known)
        wanted = places[..., d].unsqueeze(-2)
        offset = _solve(spec, path, wanted, from_uniform)
        if torch.is_grad_enabled():
            offset = _attach(spec, path, offset, wanted, from_uniform)
        for inputs, h in zip(known, inputs_along(path, offset), strict=True):
            inputs.append(h)
        found.append(offset.squeeze(-2))
    x = (torch.stack(found, dim=-1) + location.unsqueeze(-2)).reshape(*lead, *v.shape[-2:])
    return Sampled(x, flow.log_prob(spec, theta.expand(*lead, -1), x))


def path_of(stack: list[flow.Layer], d: int, known: list[list[Tensor]]) -> Path:
    """Dimension d (from 0), given what dimensions r < d put into each layer: a list of [B, H_in, N] per layer."""
    weights = [layer.diagonal[:, d] for layer in stack]
    contexts = []
    for layer, inputs in zip(stack, known, strict=True):
        c = layer.bias[:, d].unsqueeze(-1)
        if d:
            first = d * (d - 1) // 2  # theta's order: W_d1 .. W_d,d-1
            blocks = layer.lower[:, first : first + d]
            row = blocks.transpose(1, 2).flatten(2)  # [B, H_out, d H_in]
            c = row @ torch.cat(inputs, dim=-2) + c
        contexts.append(c)
    return Path(weights, contexts)


def inputs_along(path: Path, x: Tensor) -> list[Tensor]:
    """What the dimension puts into layers 1 .. L + 1 at x - m [B, 1, N]: itself, then its hidden units."""
    inputs = [x]
    for w, c in zip(path.weights[:-1], path.contexts[:-1], strict=True):
        first = len(inputs) == 1
        inputs.append(torch.tanh((w * x if first else w @ inputs[-1]) + c))
    return inputs


def image_of(path: Path, x: Tensor) -> tuple[Tensor, Tensor]:
    """z and dz/dx at x - m [B, 1, N]. Far out, where 1 - tanh^2 cancels, the derivative is rough."""
    first, *rest = path.weights
    h = torch.tanh(first * x + path.contexts[0])
    t = 1.0 - h * h
    # dh/dx is t times the first layer's weights, which are folded into the second's: they are smaller than t.
    rest[0] = rest[0] * first.transpose(1, 2)
    for own, w, c in zip(path.weights[1:-1], rest[:-1], path.contexts[1:-1], strict=True):
        h, t = torch.tanh(own @ h + c), w @ t
        t = t * (1.0 - h * h)
    return path.weights[-1] @ h + path.contexts[-1], rest[-1] @ t


def limits_of(path: Path) -> tuple[Tensor, Tensor]:
    """z(-) and z(+), [B, 1, N or 1]."""
    up = torch.ones_like(path.contexts[0])
    down = -up
    for w, c in zip(path.weights[1:-1], path.contexts[1:-1], strict=True):
        up, down = torch.tanh(w @ up + c), torch.tanh(w @ down + c)
    return path.weights[-1] @ down + path.contexts[-1], path.weights[-1] @ up + path.contexts[-1]


def bracket_of(path: Path) -> tuple[Tensor, Tensor]:
    """The x - m [B, 1, N or 1] at which the last unit of the first layer saturates, on either side."""
    w, c = path.weights[0], path.contexts[0]
    reach = -0.5 * torch.log(torch.tensor(torch.finfo(c.dtype).eps, dtype=c.dtype)) + 1.0
    low = ((-reach - c) / w).amin(dim=-2, keepdim=True)
    high = ((reach - c) / w).amax(dim=-2, keepdim=True)
    return torch.clamp(low, -OUTERMOST, OUTERMOST), torch.clamp(high, -OUTERMOST, OUTERMOST)


def target_of(spec: FlowSpec, path: Path, wanted: Tensor, *, from_uniform: bool = True) -> Target:
    """zeta and the limits for u (or z) [B, 1, N]."""
    a, b = limits_of(path)
    if not from_uniform:
        z = torch.minimum(torch.maximum(wanted, a), b)
    elif spec.support == "paper":
        z = torch.minimum(torch.maximum(quantile(wanted), a), b)
    else:
        z = truncated_quantile(wanted, a, b)
    return Target(zeta_of(z - a, b - z), a, b)


def newton(path: Path, target: Target, state: State) -> State:
    """One safeguarded step."""
    z, slope = image_of(path, state.x)
    below, above = z - target.minus, target.plus - z
    width, room = target.plus - target.minus, below * above
    residual = zeta_of(below, above) - target.zeta
    beyond = residual > 0.0
    low, high = torch.where(beyond, state.low, state.x), torch.where(beyond, state.x, state.high)
    trial = state.x - residual * room / (width * slope)
    # The last step leapt across the target and more than half of the residual is left: it would go on like that.
    calm = state.residual * (residual + 0.5 * state.residual) >= 0.0
    resolved = room > torch.finfo(z.dtype).eps * width * width
    good = (trial >= low) & (trial <= high) & calm & resolved  # false for NaN
    return State(torch.where(good, trial, 0.5 * (low + high)), low, high, residual)


def start(path: Path, guess: Tensor) -> State:
    """The search from x - m = `guess` [B, 1, N], moved into the bracket."""
    low, high = bracket_of(path)
    x = torch.minimum(torch.maximum(guess, low), high)
    return State(x, low.expand_as(x), high.expand_as(x), torch.zeros_like(x))


def zeta_of(below: Tensor, above: Tensor) -> Tensor:
    """zeta from z - z(-) and z(+) - z."""
    return torch.log(torch.clamp(below, min=1e-30) / torch.clamp(above, min=1e-30))


@torch.no_grad()
def _solve(spec: FlowSpec, path: Path, wanted: Tensor, from_uniform: bool) -> Tensor:
    """x - m [B, 1, N], to what the type of the numbers resolves."""
    target = target_of(spec, path, wanted, from_uniform=from_uniform)
    state = start(path, torch.zeros_like(wanted))
    best, least = state.x, torch.full_like(wanted, torch.inf)
    for _ in range(MOST_STEPS):
        after = newton(path, target, state)
        size = torch.abs(after.residual)
        best, least = torch.where(size < least, state.x, best), torch.minimum(size, least)
        step = torch.abs(after.x - state.x)
        still = 2.0 * torch.finfo(step.dtype).eps * torch.clamp(torch.abs(state.x), min=1e-6)
        state = after
        if bool(((step <= still) | (size == 0.0)).all()):
            break
    return best


def _attach(spec: FlowSpec, path: Path, offset: Tensor, wanted: Tensor, from_uniform: bool) -> Tensor:
    """`offset` with its derivative: dx = (dz* - dz) / (dz/dx), z* being what z was asked to be."""
    z, slope = image_of(path, offset)
    change = _change(z)
    if not from_uniform:
        wish = _change(wanted)
    elif spec.support == "paper":
        wish = _change(wanted) * torch.exp(-log_phi(z.detach()))
    else:
        a, b = limits_of(path)
        log_u, log_v = log_odds_parts(wanted.detach())
        at = log_phi(z.detach())
        wish = (
            torch.exp(log_interval(a, b).detach() - at) * _change(wanted)
            + torch.exp(log_v + log_phi(a.detach()) - at) * _change(a)
            + torch.exp(log_u + log_phi(b.detach()) - at) * _change(b)
        )
    return offset + (wish - change) / slope.detach()


def _change(v: Tensor) -> Tensor:
    """Zero, with v's derivative."""
    return v - v.detach()
