r"""The conditional autoregressive flow z = f(x; theta), pure functions of theta.

Notation (paper: Oh & Valois, CVPR 2020):

    x, z      [..., N, D]   points and their images, z ~ N(0, I)
    theta     [..., P]      parameters, ready to multiply (layout: `hcnaf_models.spec`)
    h_d^k     hidden units of dimension d after layer k                                    (eq. 6)
    c_d^k     context: what dimensions r < d and the bias contribute to layer k            (eq. 6, 7)
    t_d^k     tangent dh_d^k / dx_d, a positive vector

One primitive, `forward`, carries for every dimension the unit's own path next to the two paths that start at
h_d^1 = +1 and -1: the images of x_d = +-infinity with x_<d as given. tanh is bounded, so f maps R^D onto a box;
these limits z_d(-), z_d(+) are its faces and give the exact normaliser (`normalised` support):

    log p(x_d | x_<d) = log phi(z_d) + log dz_d/dx_d - log(Phi(z_d(+)) - Phi(z_d(-)))

The log-determinant needs no log-sum-exp over [N, H, H]: dz_d/dx_d is a product of strictly positive matrices and
tanh' > 0, so the tangent is carried by plain products; only its range needs care (a running log-scale).

References:
    Oh & Valois, HCNAF, CVPR 2020. De Cao et al., Block Neural Autoregressive Flow, 2019 (arXiv 1904.04676).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from hcnaf_models.normal import cdf, interval_fraction, log_interval, log_phi
from hcnaf_models.spec import FlowSpec, lower_pairs


class Layer(NamedTuple):
    """Weights of one layer: W_dd, W_dr (r < d, theta's order) and B_d."""

    diagonal: Tensor  # [..., D, H_out, H_in]
    lower: Tensor  # [..., D (D - 1) / 2, H_out, H_in]
    bias: Tensor  # [..., D, H_out]


class Image(NamedTuple):
    """What `forward` returns, all [..., N, D]."""

    z: Tensor
    log_dz: Tensor  # log dz_d / dx_d
    z_minus: Tensor  # z_d(-), the image of x_d = -infinity
    z_plus: Tensor  # z_d(+), the image of x_d = +infinity


def split(spec: FlowSpec, theta: Tensor) -> tuple[Tensor, list[Layer]]:
    """Cut theta [..., P] into the location [..., D] and the layers (views, nothing is copied)."""
    location, *parts = torch.split(theta, list(spec.groups), dim=-1)
    return location, layers(spec, parts)


def layers(spec: FlowSpec, parts: Sequence[Tensor]) -> list[Layer]:
    """The groups of theta after the location, shaped into layers."""
    lead = parts[0].shape[:-1]
    out = []
    for k in range(1, spec.layers + 2):
        diagonal, lower, bias = parts[3 * k - 3 : 3 * k]
        rows, cols = spec.fan_out(k), spec.fan_in(k)
        out.append(
            Layer(
                diagonal.reshape(*lead, spec.dims, rows, cols),
                lower.reshape(*lead, spec.pairs, rows, cols),
                bias.reshape(*lead, spec.dims, rows),
            )
        )
    return out


def forward(spec: FlowSpec, theta: Tensor, x: Tensor) -> Image:
    """z, its log-derivative and its limits for points x [..., N, D] under theta [..., P]."""
    location, (first, *rest) = split(spec, theta)
    xs = (x - location.unsqueeze(-2)).transpose(-1, -2).unsqueeze(-1)  # [..., D, N, 1]
    a = xs * first.diagonal.transpose(-1, -2) + context(spec, first, xs)
    h = torch.tanh(a)
    t, log_scale = _damp(first.diagonal.transpose(-1, -2).expand_as(a), a)
    up, down = torch.ones_like(h), -torch.ones_like(h)
    for layer in rest[:-1]:
        c = context(spec, layer, h)
        w = layer.diagonal.transpose(-1, -2)
        a = h @ w + c
        t, log_scale = _damp(t @ w, a, log_scale)
        up, down = torch.tanh(up @ w + c), torch.tanh(down @ w + c)
        h = torch.tanh(a)
    c = context(spec, rest[-1], h)
    w = rest[-1].diagonal.transpose(-1, -2)
    # The floor is the smallest normal number: 1e-38 would be zero where denormals are flushed, as in the runtime.
    log_dz = torch.log(torch.clamp(t @ w, min=1.2e-38)) + log_scale
    return Image(*(_points(v) for v in (h @ w + c, log_dz, down @ w + c, up @ w + c)))


def context(spec: FlowSpec, layer: Layer, h: Tensor) -> Tensor:
    """c_d = sum_{r<d} W_dr h_r + B_d for h [..., D, N, H_in]: [..., D, N, H_out]."""
    bias = layer.bias.unsqueeze(-2)
    if spec.dims == 1:
        return bias.expand(*h.shape[:-1], -1)
    if spec.dims == 2:
        second = h[..., :1, :, :] @ layer.lower.transpose(-1, -2)
        return torch.cat([torch.zeros_like(second), second], dim=-3) + bias
    D, N = h.shape[-3], h.shape[-2]
    flat = h.transpose(-3, -2).reshape(*h.shape[:-3], N, -1)
    out = flat @ strictly_lower(spec, layer.lower).transpose(-1, -2)
    return out.reshape(*h.shape[:-3], N, D, -1).transpose(-3, -2) + bias


def strictly_lower(spec: FlowSpec, lower: Tensor) -> Tensor:
    """The blocks below the diagonal as one matrix [..., D H_out, D H_in], zero elsewhere."""
    D, (rows, cols) = spec.dims, lower_pairs(spec.dims)
    *lead, _, H_out, H_in = lower.shape
    matrix = lower.new_zeros(*lead, D, D, H_out, H_in)
    matrix[..., list(rows), list(cols), :, :] = lower
    return matrix.transpose(-3, -2).reshape(*lead, D * H_out, D * H_in)


def _damp(u: Tensor, a: Tensor, log_scale: Tensor | float = 0.0) -> tuple[Tensor, Tensor]:
    """u * tanh'(a) as (tangent, log-scale), the tangent's largest entry being 1.

    tanh' = 4 e / (1 + e)^2 with e = exp(-2|a|). The slowest decay of each point is taken out first, so that far
    from the data nothing underflows before it is scaled. Scales are constants to the gradient: they cancel. Decay
    is held at 1e-26 beside the slowest: denormal numbers would take a product many times as long.
    """
    size = torch.abs(a)
    least = size.amin(dim=-1, keepdim=True).detach()
    e = torch.exp(-2.0 * size)
    t = u * torch.exp(-2.0 * torch.clamp(size - least, max=30.0)) * (4.0 / (1.0 + e) ** 2)
    largest = torch.clamp(t.amax(dim=-1, keepdim=True).detach(), min=1.2e-38)
    return t / largest, log_scale - 2.0 * least + torch.log(largest)


def _points(v: Tensor) -> Tensor:
    return v.squeeze(-1).transpose(-1, -2)


def log_prob_terms(spec: FlowSpec, image: Image) -> Tensor:
    """log p(x_d | x_<d) per dimension, [..., N, D]."""
    terms = log_phi(image.z) + image.log_dz
    if spec.support == "paper":
        return terms
    return terms - log_interval(image.z_minus, image.z_plus)


def log_prob(spec: FlowSpec, theta: Tensor, x: Tensor) -> Tensor:
    """log p(x | theta) [..., N] in nats per unit of x to the D, for x [..., N, D]."""
    return log_prob_terms(spec, forward(spec, theta, x)).sum(-1)


def distribution(spec: FlowSpec, z: Tensor, z_minus: Tensor, z_plus: Tensor) -> Tensor:
    """F_d from z_d and its limits; under `paper` support Phi(z_d), whose range is short of [0, 1]."""
    if spec.support == "paper":
        return cdf(z)
    return interval_fraction(z, z_minus, z_plus)
