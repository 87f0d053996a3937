r"""The mean negative log-likelihood of a wide flow and its gradient, in one sweep down and one up its stripes.

Autograd would keep every array of [N, D, H] and run through main memory for each of some forty operations. A
stripe at a time all of it stays in the processor's cache, and the gradient of what is elementwise is known in
closed form. With T = sum_j w_j v_j tanh'(a_j), S = sum_j v_j, c the context and
loss = z^2/2 - log T + log(Phi(c+S) - Phi(c-S)):

    dc = z + l_c                       l_c = (phi(c+S) - phi(c-S)) / (Phi(c+S) - Phi(c-S)), 0 under `paper`
    da = dz v tanh'(a) + 2 h q         q_j = w_j v_j tanh'(a_j) / T,   dz = z
    dlog v = z v h - q + l_S v         l_S = (phi(c+S) + phi(c-S)) / (Phi(c+S) - Phi(c-S)), 0 under `paper`
    dlog w = -q + da w y

and what later stripes add to dh = k_2 W_2^T (r_2 dc) follows on the way up.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from hcnaf_models.normal import log_interval, log_phi
from hcnaf_models.wide import Factors, below_diagonal, factors
from hcnaf_models.wide_config import WideConfig

FAR = 30.0
"""Where tanh' is held, at 1e-26: denormal numbers would take a product many times as long."""


def mean_nll(
    config: WideConfig,
    W_1: Sequence[Tensor],
    W_2: Sequence[Tensor],
    theta: Tensor,
    labels: Tensor,
    x: Tensor,
    drop: float = 0.0,
) -> Tensor:
    """-mean log p(x_n | theta_{labels_n}) in nats for x [N, D], labels [N], theta [K, P]; differentiable once.

    The gradient is computed with the value; x gets none. `drop` is the share of what a dimension hears from
    earlier ones, x and hidden units, that is left out at random (and the rest scaled up); own paths are complete.
    """
    loss: Tensor = _MeanNll.apply(config, drop, labels, x, theta, *W_1, *W_2)  # type: ignore[no-untyped-call]
    return loss


class _MeanNll(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, config: WideConfig, drop: float, labels: Tensor, x: Tensor, theta: Tensor, *W: Tensor
    ) -> Tensor:
        ctx.wanted = any(t.requires_grad for t in (theta, *W))
        sweep = _Sweep(config, drop, labels, x, theta, W)
        total = sweep.down(ctx.wanted)
        if ctx.wanted:
            ctx.save_for_backward(*sweep.up())
        return total

    @staticmethod
    def backward(ctx: Any, *grad: Tensor) -> Any:  # type: ignore[override]
        return (None, None, None, None, *(g * grad[0] for g in ctx.saved_tensors))


class _Stripe(NamedTuple):
    """What the way up needs of one stripe, all [N, n H]."""

    slope: Tensor  # tanh'(a)
    h: Tensor
    A: Tensor  # W_1 (k_1 y)
    da: Tensor  # of the own path
    q: Tensor
    own: Tensor  # z v h - q


class _Sweep:
    """The arrays of one evaluation. Gradients are of the sum; `up` divides by N."""

    def __init__(
        self, config: WideConfig, drop: float, labels: Tensor, x: Tensor, theta: Tensor, W: Sequence[Tensor]
    ) -> None:
        self.config, self.labels, self.H = config, labels, config.flow.hidden
        n = len(config.cuts)
        self.W_1, self.W_2 = W[:n], W[n:]
        self.f = Factors(*(p.flatten(1) for p in factors(config, theta)))
        self.y = x - self.f.m[labels]
        self.hk = x.new_empty(x.shape[0], config.flow.dims * self.H)
        self.heard_x, self.heard_h = _heard(x, drop), _heard(self.hk, drop)
        self.yk = self.y * self.f.k_1[labels]
        if self.heard_x is not None:
            self.yk.mul_(self.heard_x)
        self.C, self.z, self.log_t = (torch.empty_like(x) for _ in range(3))
        self.l_S: Tensor | None = None
        self.dc = self.z
        self.stripes: list[_Stripe] = []
        self.by_class = torch.nn.functional.one_hot(labels, theta.shape[0]).T.to(x.dtype)

    def down(self, keep: bool) -> Tensor:
        """The mean negative log-likelihood."""
        for index in range(len(self.config.cuts)):
            self._stripe(index, keep)
        loss = -(log_phi(self.z) + self.log_t)
        if self.config.flow.support == "normalised":
            loss += self._limits()
        return loss.sum() / len(self.labels)

    def _of(self, part: Tensor, a: int, b: int) -> Tensor:
        """Columns of a part of theta, a row for each sample."""
        return part[:, a:b].index_select(0, self.labels)

    def _repeat(self, v: Tensor) -> Tensor:
        """[N, n] to [N, n H]."""
        return v.repeat_interleave(self.H, 1)

    def _sum(self, v: Tensor) -> Tensor:
        """[N, n H] to [N, n]."""
        return self._units(v).sum(-1)

    def _units(self, v: Tensor) -> Tensor:
        """[N, n H] to [N, n, H]."""
        return v.view(len(v), -1, self.H)

    def _stripe(self, index: int, keep: bool) -> None:
        (a, b), f = self.config.cuts[index], self.f
        lo, hi = a * self.H, b * self.H
        w, v = self._of(f.w, lo, hi), self._of(f.v, lo, hi)
        A = self.yk[:, :b] @ self.W_1[index].T
        t = self._repeat(self.y[:, a:b]).mul_(w)
        t.add_(self._of(f.B_1, lo, hi)).addcmul_(A, self._of(f.r_1, lo, hi))
        h = torch.tanh(t)
        q, slope, self.log_t[:, a:b] = self._slopes(t, w.mul_(v))
        torch.mul(h, self._of(f.k_2, lo, hi), out=self.hk[:, lo:hi])
        if self.heard_h is not None:
            self.hk[:, lo:hi] *= self.heard_h[:, lo:hi]
        C = torch.mm(self.hk[:, :hi], self.W_2[index].T)
        vh = v * h
        z = self._sum(vh).addcmul_(C, self._of(f.r_2, a, b)).add_(self._of(f.B_2, a, b))
        self.C[:, a:b], self.z[:, a:b] = C, z
        if keep:
            zs = self._repeat(z)
            own = vh.mul_(zs).sub_(q)
            da = zs.mul_(v).mul_(slope).addcmul_(h, q, value=2.0)
            self.stripes.append(_Stripe(slope, h, A, da, q, own))

    def _slopes(self, a: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """q, tanh'(a) and log T: see `wide.log_slope` for the range."""
        size = torch.abs(a)
        least = self._units(size).amin(-1)
        e = torch.exp(size.clamp(max=FAR).mul_(-2.0))
        g = (e + 1.0).square_().reciprocal_().mul_(4.0)
        q = torch.exp(size.sub_(self._repeat(least)).clamp_(max=FAR).mul_(-2.0)).mul_(g).mul_(weight)
        T = self._sum(q).clamp_(min=1.2e-38)
        return q.div_(self._repeat(T)), g.mul_(e), torch.log(T) - 2.0 * least

    def _limits(self) -> Tensor:
        """log(Phi(z(+)) - Phi(z(-))) [N, D]; leaves l_S, and z + l_c in dc."""
        total = self._sum(self.f.v)[self.labels]
        c = self.C * self.f.r_2[self.labels] + self.f.B_2[self.labels]
        minus, plus = c - total, c + total
        log_mass = log_interval(minus, plus)
        at_minus, at_plus = torch.exp(log_phi(minus) - log_mass), torch.exp(log_phi(plus) - log_mass)
        self.l_S, self.dc = at_plus + at_minus, self.z + at_plus - at_minus
        return log_mass

    def up(self) -> list[Tensor]:
        """Gradients of theta [K, P] and of all stripes of W_1 and W_2."""
        f, n = self.f, len(self.config.cuts)
        self.dh, self.dyk = torch.zeros_like(self.hk), torch.zeros_like(self.yk)
        g_1, g_2 = [torch.empty(0)] * n, [torch.empty(0)] * n
        inner: list[tuple[Tensor, ...]] = []
        for index in reversed(range(n)):
            g_1[index], g_2[index], sums = self._back(index)
            inner.insert(0, sums)
        r_1, w, B_1, k_2, v = (torch.cat(part, dim=1) for part in zip(*inner, strict=True))
        w = w / f.w
        if self.l_S is not None:
            v = v + (self.by_class @ self.l_S).repeat_interleave(self.H, 1) * f.v
        if self.heard_x is not None:
            self.dyk.mul_(self.heard_x)
        k_1, r_2, B_2 = (self.by_class @ t for t in (self.dyk * self.y, self.dc * self.C, self.dc))
        # The location is no parameter.
        theta = torch.cat([torch.zeros_like(f.m), k_1, r_1, w, B_1, k_2, v / f.v, r_2, B_2], dim=1)
        return [g.div_(len(self.labels)) for g in (theta, *g_1, *g_2)]

    def _back(self, index: int) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
        """One stripe: gradients of its W_1 and W_2, and of r_1, log w, B_1, k_2 and log v (but for l_S)."""
        (a, b), s, f, H = self.config.cuts[index], self.stripes.pop(), self.f, self.H
        lo, hi = a * H, b * H
        dC = self.dc[:, a:b] * self._of(f.r_2, a, b)
        g_2 = self._weights(dC, self.hk[:, :hi], index, 1, H)
        self.dh[:, :hi].addmm_(dC, self.W_2[index])
        mine = self.dh[:, lo:hi]
        if self.heard_h is not None:
            mine.mul_(self.heard_h[:, lo:hi])
        d_k_2 = self.by_class @ s.h.mul_(mine)
        da = s.da.addcmul_(mine.mul_(self._of(f.k_2, lo, hi)), s.slope)
        dA = da * self._of(f.r_1, lo, hi)
        g_1 = self._weights(dA, self.yk[:, :b], index, H, 1)
        self.dyk[:, :b].addmm_(dA, self.W_1[index])
        d_B = self.by_class @ da
        d_r = self.by_class @ s.A.mul_(da)
        # d log w = w y da - q
        d_w = (self.by_class @ da.mul_(self._repeat(self.y[:, a:b]))) * f.w[:, lo:hi] - self.by_class @ s.q
        return g_1, g_2, (d_r, d_w, d_B, d_k_2, self.by_class @ s.own)

    def _weights(self, d: Tensor, v: Tensor, index: int, out: int, into: int) -> Tensor:
        """d^T v, zero on and above the diagonal."""
        cut = self.config.cuts[index]
        g = d.T @ v
        g[:, into * cut[0] :] *= below_diagonal(cut[1] - cut[0], out, into).to(g)
        return g


def _heard(like: Tensor, drop: float) -> Tensor | None:
    """What each number is multiplied with: 0 for the share `drop`."""
    if drop == 0.0:
        return None
    kept = torch.empty_like(like).bernoulli_(1.0 - drop)
    return kept.mul_(1.0 / (1.0 - drop))
