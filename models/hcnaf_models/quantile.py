"""The inverse of the (truncated) normal distribution function, with the operators ONNX has.

u in (0, 1) goes to the z in (a, b) with Phi(z) = (1 - u) Phi(a) + u Phi(b). Both that sum and its complement have
positive terms only, so the smaller of the two is accurate at any depth once the pair of bounds is moved to the
left tail and logarithms are carried.

References:
    Wichura, Algorithm AS 241, Applied Statistics 37 (1988): rational approximations for |z| < 38, good to 1e-16
    (`PPND16`, used for float64) and 1e-7 (`PPND7`, for float32).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from hcnaf_models.normal import log_left_tail

Fit = tuple[Sequence[float], Sequence[float]]
"""Coefficients above and below, ascending."""

_SINGLE: tuple[Fit, Fit, Fit] = (
    ((3.3871327179, 50.434271938, 159.29113202, 59.109374720), (1.0, 17.895169469, 78.757757664, 67.187563600)),
    ((1.4234372777, 2.7568153900, 1.3067284816, 0.17023821103), (1.0, 0.73700164250, 0.12021132975)),
    ((6.6579051150, 3.0812263860, 0.42868294337, 0.017337203997), (1.0, 0.24197894225, 0.012258202635)),
)

_DOUBLE: tuple[Fit, Fit, Fit] = (
    (
        (3.387132872796366608, 133.14166789178437745, 1971.5909503065514427, 13731.693765509461125,
         45921.953931549871457, 67265.770927008700853, 33430.575583588128105, 2509.0809287301226727),
        (1.0, 42.313330701600911252, 687.1870074920579083, 5394.1960214247511077,
         21213.794301586595867, 39307.89580009271061, 28729.085735721942674, 5226.495278852545925),
    ),
    (
        (1.42343711074968357734, 4.6303378461565452959, 5.7694972214606914055, 3.64784832476320460504,
         1.27045825245236838258, 0.24178072517745061177, 0.0227238449892691845833, 7.7454501427834140764e-4),
        (1.0, 2.05319162663775882187, 1.6763848301838038494, 0.68976733498510000455,
         0.14810397642748007459, 0.0151986665636164571966, 5.475938084995344946e-4, 1.05075007164441684324e-9),
    ),
    (
        (6.6579046435011037772, 5.4637849111641143699, 1.7848265399172913358, 0.29656057182850489123,
         0.026532189526576123093, 0.0012426609473880784386, 2.71155556874348757815e-5, 2.01033439929228813265e-7),
        (1.0, 0.59983220655588793769, 0.13692988092273580531, 0.0148753612908506148525,
         7.868691311456132591e-4, 1.8463183175100546818e-5, 1.4215117583164458887e-7, 2.04426310338993978564e-15),
    ),
)  # fmt: skip


def truncated_quantile(u: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """z in [a, b] with (Phi(z) - Phi(a)) / (Phi(b) - Phi(a)) = u; `a` < `b` broadcast against u in (0, 1)."""
    flip = a + b > 0.0
    lo, hi = torch.where(flip, -b, a), torch.where(flip, -a, b)
    log_u, log_v = log_odds_parts(u)
    up, down = torch.where(flip, log_v, log_u), torch.where(flip, log_u, log_v)
    log_lo, outer = log_tail(lo), log_tail(torch.where(hi <= 0.0, hi, -hi))
    log_hi = torch.where(hi > 0.0, log1m_exp(outer), outer)
    lower = log_add_exp(down + log_lo, up + log_hi)
    upper = log_add_exp(down + log1m_exp(log_lo), up + outer)
    left = (lower <= upper) | (hi < 0.0)  # hi < 0: everything is in the left tail, `upper` means nothing
    z = tail_quantile(torch.where(left, lower, upper))
    z = torch.where(left == flip, -z, z)
    return torch.minimum(torch.maximum(z, a), b)


def quantile(u: Tensor) -> Tensor:
    """Phi^-1(u) for u in (0, 1)."""
    log_u, log_v = log_odds_parts(u)
    z = tail_quantile(torch.minimum(log_u, log_v))
    return torch.where(u < 0.5, z, -z)


def log_odds_parts(u: Tensor) -> tuple[Tensor, Tensor]:
    """log u and log(1 - u), u held where both are finite."""
    info = torch.finfo(u.dtype)
    held = torch.clamp(u, info.tiny, 1.0 - 0.5 * info.eps)
    return torch.log(held), torch.log1p(-held)


def tail_quantile(log_p: Tensor) -> Tensor:
    """z <= 0 with log Phi(z) = log_p, for log_p <= log(1/2)."""
    centre, tail, far = _DOUBLE if log_p.dtype == torch.float64 else _SINGLE
    q = 0.5 - torch.exp(log_p)
    r = torch.sqrt(torch.clamp(-log_p, min=0.5))
    outside = torch.where(r <= 5.0, _ratio(tail, r - 1.6), _ratio(far, r - 5.0))
    return -torch.where(q <= 0.425, q * _ratio(centre, 0.180625 - q * q), outside)


def log_tail(z: Tensor) -> Tensor:
    """log Phi(z) for z <= 0: exact in float64, in float32 the fit that the distribution functions use."""
    return torch.special.log_ndtr(z) if z.dtype == torch.float64 else log_left_tail(z)


def log_add_exp(a: Tensor, b: Tensor) -> Tensor:
    """log(exp(a) + exp(b)). torch.logaddexp becomes just that in ONNX: off below -87, -infinity below -104."""
    return torch.maximum(a, b) + torch.log1p(torch.exp(-torch.abs(a - b)))


def log1m_exp(v: Tensor) -> Tensor:
    """log(1 - exp(v)) for v <= log(1/2)."""
    return torch.log1p(-torch.exp(v))


def _ratio(fit: Fit, r: Tensor) -> Tensor:
    above, below = (_polynomial(c, r) for c in fit)
    return above / below


def _polynomial(coefficients: Sequence[float], r: Tensor) -> Tensor:
    value = r * coefficients[-1] + coefficients[-2]
    for c in reversed(coefficients[:-2]):
        value = value * r + c
    return value
