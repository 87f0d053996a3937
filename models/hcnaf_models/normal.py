"""The standard normal distribution in the tails, with the operators ONNX has.

Differences of Phi are needed for the truncated base (z never leaves (z-, z+)), often far out in one tail
where Phi saturates. Everything here is therefore built on the scaled complementary error function
erfcx(u) = exp(u^2) erfc(u), a smooth function that neither under- nor overflows for u >= 0, and on moving a
pair of bounds to the left tail by symmetry first. Relative accuracy is that of the polynomial below,
about 1.2e-7, at any depth.

References:
    Press et al., Numerical Recipes in C, 2nd ed., section 6.2 (`erfcc`: Chebyshev fit of erfcx).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

_ERFCX = (
    -1.26551223, 1.00002368, 0.37409196, 0.09678418, -0.18628806,
    0.27886807, -1.13520398, 1.48851587, -0.82215223, 0.17087277,
)  # fmt: skip
_FLOOR = -55.0
_LOG_HALF = math.log(0.5)
_LOG_SQRT_2PI = 0.5 * math.log(2.0 * math.pi)


def log_phi(z: Tensor) -> Tensor:
    """log of the standard normal density."""
    return -0.5 * z * z - _LOG_SQRT_2PI


def log_erfcx(u: Tensor) -> Tensor:
    """log(exp(u^2) erfc(u)) for u >= 0."""
    t, p = _fit(u)
    return p + torch.log(t)


def _fit(u: Tensor) -> tuple[Tensor, Tensor]:
    """t and P(t) with erfcx(u) = t exp(P(t))."""
    t = 1.0 / (1.0 + 0.5 * u)
    p = t * _ERFCX[-1] + _ERFCX[-2]
    for c in reversed(_ERFCX[:-2]):
        p = p * t + c
    return t, p


def log_left_tail(z: Tensor) -> Tensor:
    """log Phi(z) for z <= 0 (larger z are taken as 0)."""
    u = -torch.clamp(z, max=0.0)
    return _LOG_HALF - 0.5 * u * u + log_erfcx(u * math.sqrt(0.5))


def log_interval(a: Tensor, b: Tensor) -> Tensor:
    """log(Phi(b) - Phi(a)) for a <= b, finite for all finite bounds.

    By symmetry the pair is moved to the left tail (a + b <= 0). Below the relative resolution of the
    bounds (b - a of about 1e-7) the result is held at the resolution instead of falling to -infinity.
    """
    flip = a + b > 0.0
    lo, hi = torch.where(flip, -b, a), torch.where(flip, -a, b)
    log_lo = log_left_tail(lo)
    # hi <= 0: Phi(hi) (1 - Phi(lo) / Phi(hi)).   hi > 0: 1 - (Phi(lo) + Phi(-hi)).
    one_tail = hi <= 0.0
    log_hi = log_left_tail(torch.where(one_tail, hi, -hi))
    removed = torch.where(one_tail, torch.exp(log_lo - log_hi), torch.exp(log_lo) + torch.exp(log_hi))
    kept = torch.log1p(-torch.clamp(removed, max=1.0 - 1e-7))
    return kept + torch.where(one_tail, log_hi, torch.zeros_like(log_hi))


def cdf(z: Tensor) -> Tensor:
    """Phi(z), relatively accurate in the left tail."""
    tail = _scaled_tail(torch.abs(z), torch.zeros_like(z))
    return torch.where(z > 0.0, 1.0 - tail, tail)


def erf_fraction(z: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """`interval_fraction` by erf alone: fast, with an absolute error of about 1e-7 / (Phi(b) - Phi(a))."""
    bottom, top = torch.erf(a * math.sqrt(0.5)), torch.erf(b * math.sqrt(0.5))
    return (torch.erf(z * math.sqrt(0.5)) - bottom) / torch.clamp(top - bottom, min=1e-30)


def interval_fraction(z: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """(Phi(z) - Phi(a)) / (Phi(b) - Phi(a)) for a <= z <= b: the truncated normal's distribution function.

    `a` and `b` broadcast against `z`. Both tails are scaled by exp(m^2 / 2), with m the bound nearest to
    the centre when both lie on one side, so that nothing underflows however far out the interval is.
    """
    flip = a + b > 0.0
    sign = torch.where(flip, -1.0, 1.0).to(z.dtype)
    lo, hi = torch.where(flip, -b, a), torch.where(flip, -a, b)
    m = torch.clamp(hi, max=0.0)
    bottom = _scaled_tail(torch.abs(lo), m)
    total = torch.clamp(_scaled_cdf(hi, m) - bottom, min=1e-30)
    fraction = torch.clamp((_scaled_cdf(sign * z, m) - bottom) / total, 0.0, 1.0)
    return torch.where(flip, 1.0 - fraction, fraction)


def _scaled_tail(u: Tensor, m: Tensor) -> Tensor:
    """exp(m^2 / 2) Phi(-u) for u >= |m|, m <= 0; not below about 1e-26.

    Without the floor tails would be full of denormal numbers, which take a CPU a hundred times as long.
    """
    t, p = _fit(u * math.sqrt(0.5))
    return (0.5 * t) * torch.exp(torch.clamp(p + 0.5 * (m - u) * (m + u), min=_FLOOR))


def _scaled_cdf(z: Tensor, m: Tensor) -> Tensor:
    """exp(m^2 / 2) Phi(z); z > 0 occurs only where m = 0."""
    tail = _scaled_tail(torch.abs(z), m)
    return torch.where(z > 0.0, 1.0 - tail, tail)
