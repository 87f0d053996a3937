"""The inverse of a flow with D = 2 in a fixed number of steps: what the `inverse` graph of a bundle runs.

The steps are those of `hcnaf_models.inverse`; what is added is a good first guess, so that few are needed, and a
way to spend more only where they are. Per theta, quantiles x(u_1) and y(u_2 | u_1) are tabulated on a lattice that
is even in log(u / (1 - u)), and a sample starts between the entries. The table takes no search: all that a
dimension can do happens where a unit of its first layer changes sign, so z is known well from its values at a few
knots per unit; the table in x is polished. After a few steps for all samples, those that are farthest from their
target get more, and the worst of these, which halve their brackets on a staircase, many more.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch._higher_order_ops.scan import scan

from hcnaf_models import flow
from hcnaf_models.inverse import (
    Path,
    State,
    Target,
    inputs_along,
    limits_of,
    newton,
    path_of,
    start,
    target_of,
)
from hcnaf_models.normal import erf_fraction, log_interval, log_phi
from hcnaf_models.quantile import log_odds_parts
from hcnaf_models.spec import FlowSpec

REACH = 8.0
"""Tables hold |log(u / (1 - u))| up to this: all but 7e-4 of each dimension's mass."""

FIRST, SECOND = 17, 17
"""Table sizes in u_1 and u_2."""

FINER = 4
"""Entries in u_1 of the table of x per entry of that of y."""

KNOTS = 0.0, -1.5, 1.5
"""Arguments of a first-layer unit at which z is tabulated."""

MOST_KNOTS = 100

POLISH = 2
"""Steps for the table in x. That in y is off between its entries more than at them."""

STEPS = 2, 3
"""For all samples, in x and in y."""

STRAGGLERS = ((8, 3), (32, 4)), ((4, 3), (16, 12))
"""In x and in y: one in so many samples gets so many more steps, after those before."""

Levels = Sequence[tuple[int, int]]


class Tables(NamedTuple):
    """Quantiles: x - m_1 [B, FINER (I - 1) + 1] and y - m_2 [B, I, J], even in log-odds from -REACH to REACH."""

    first: Tensor
    second: Tensor


class Drawn(NamedTuple):
    """What `planar_inverse` returns."""

    points: Tensor
    """[B, N, 2]: x."""
    log_prob: Tensor
    """[B, N]: log p(x), nats per unit of x squared."""
    error: Tensor
    """[B, N]: how far (F_1, F_2) at x is from u, the larger of the two."""


class Arrival(NamedTuple):
    """A dimension at the x - m found: its `inputs_along`, log p(x_d | x_<d), and how far F_d is from u_d."""

    along: list[Tensor]
    log_density: Tensor
    error: Tensor


def planar_inverse(spec: FlowSpec, theta: Tensor, uniform: Tensor) -> Drawn:
    """Samples for u [B, N, 2] in (0, 1) under theta [B, P], D = 2.

    A sample whose error is not small comes out better when drawn again alone: alone it gets all steps.
    """
    location, stack = flow.split(spec, theta)
    u = [uniform[..., d].unsqueeze(-2) for d in (0, 1)]  # [B, 1, N] each
    guesses = _looked_up(_tables(spec, stack), *u)
    known: list[list[Tensor]] = [[] for _ in stack]
    arrivals = []
    for d in (0, 1):
        path, place = path_of(stack, d, known), location[:, d, None, None]
        target = target_of(spec, path, u[d])
        state = _stepped(path, target, start(path, guesses[d]), STEPS[d])
        x = (_mended(path, target, state, STRAGGLERS[d]) + place) - place  # as it is once m was added
        arrival = _arrived(spec, path, target, x)
        for inputs, h in zip(known, arrival.along, strict=True):
            inputs.append(h)
        arrivals.append(arrival)
    first, second = arrivals
    points = [
        (a.along[0] + m).squeeze(-2) for a, m in zip(arrivals, location[..., None, None].unbind(1), strict=True)
    ]
    return Drawn(
        torch.stack(points, dim=-1),
        (first.log_density + second.log_density).squeeze(-2),
        torch.maximum(first.error, second.error).squeeze(-2),
    )


def _tables(spec: FlowSpec, stack: list[flow.Layer]) -> Tables:
    path = path_of(stack, 0, [[] for _ in stack])
    first = _tabulated(path, FINER * (FIRST - 1) + 1)  # [B, 1, ..]
    levels = torch.sigmoid(torch.linspace(-REACH, REACH, FINER * (FIRST - 1) + 1, dtype=first.dtype))
    target = target_of(spec, path, levels.expand_as(first))
    state = start(path, first)
    for _ in range(POLISH):
        state = newton(path, target, state)
    first = state.x
    x = first[..., ::FINER]
    B = x.shape[0]
    second = path_of(stack, 1, [[h] for h in inputs_along(path, x)])
    # Every x becomes a theta of its own: its contexts are single columns.
    single = [c.expand(-1, -1, FIRST).transpose(1, 2).reshape(B * FIRST, -1, 1) for c in second.contexts]
    weights = [w.repeat_interleave(FIRST, dim=0) for w in second.weights]
    return Tables(first.squeeze(-2), _tabulated(Path(weights, single), SECOND).reshape(B, FIRST, SECOND))


def _tabulated(path: Path, count: int) -> Tensor:
    """Quantiles x - m [B, 1, count] of one dimension whose contexts are single columns."""
    w, c = path.weights[0], path.contexts[0]
    used = KNOTS[: max(1, MOST_KNOTS // w.shape[1])]
    at = torch.cat([(k - c) / w for k in used], dim=1).transpose(1, 2)
    knots = torch.sort(at, dim=-1).values  # [B, 1, K]
    z = path.weights[-1] @ inputs_along(path, knots)[-1] + path.contexts[-1]
    F = torch.clamp(erf_fraction(z, *limits_of(path)), 1e-6, 1.0 - 1e-6)
    values = torch.log(F / (1.0 - F))
    wanted = torch.linspace(-REACH, REACH, count, dtype=z.dtype).unsqueeze(-1)
    before = (values[..., 1:-1] < wanted).to(z.dtype).sum(-1).to(torch.int64).unsqueeze(1)
    x0, x1 = torch.gather(knots, -1, before), torch.gather(knots, -1, before + 1)
    v0, v1 = torch.gather(values, -1, before), torch.gather(values, -1, before + 1)
    share = (wanted.squeeze(-1) - v0) / torch.clamp(v1 - v0, min=1e-6)
    return x0 + (x1 - x0) * torch.clamp(share, -3.0, 4.0)


def _looked_up(tables: Tables, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    """Quantiles at u_1, u_2 [B, 1, N], linear between a table's entries."""
    J = SECOND
    k, r = _place(u.squeeze(-2), FINER * (FIRST - 1) + 1)
    i, s = _place(u.squeeze(-2), FIRST)
    j, t = _place(v.squeeze(-2), SECOND)
    flat = tables.second.flatten(1)

    def entry(di: int, dj: int) -> Tensor:
        return torch.gather(flat, 1, (i + di) * J + (j + dj))

    x = torch.lerp(torch.gather(tables.first, 1, k), torch.gather(tables.first, 1, k + 1), r)
    y = torch.lerp(torch.lerp(entry(0, 0), entry(1, 0), s), torch.lerp(entry(0, 1), entry(1, 1), s), t)
    return x.unsqueeze(-2), y.unsqueeze(-2)


def _place(u: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The table entry before u and the share of the way to the next."""
    log_u, log_v = log_odds_parts(u)
    at = (torch.clamp(log_u - log_v, -REACH, REACH) + REACH) * ((count - 1) / (2.0 * REACH))
    before = torch.clamp(torch.floor(at), max=count - 2.0)
    return before.to(torch.int64), at - before


def _stepped(path: Path, target: Target, state: State, steps: int) -> State:
    if not torch.compiler.is_exporting():
        for _ in range(steps):
            state = newton(path, target, state)
        return state
    # A loop may not share memory with what surrounds it, hence the products; they are dropped.
    own = Path([w * 1.0 for w in path.weights], [c * 1.0 for c in path.contexts])
    aim = Target(*(v * 1.0 for v in target))

    def step(now: tuple[Tensor, ...], count: Tensor) -> tuple[tuple[Tensor, ...], Tensor]:
        return tuple(newton(own, aim, State(*now))), count + 1.0

    carried, _ = scan(step, tuple(v * 1.0 for v in state), torch.zeros(steps))
    return State(*carried)


def _mended(path: Path, target: Target, state: State, levels: Levels, taken: int = 1) -> Tensor:
    """x - m after more steps for those, one in `taken` being here, that were farthest from their target."""
    if not levels:
        return state.x
    (share, steps), *rest = levels
    worst = torch.topk(_missed(target, state), state.x.shape[-1] // (share // taken) + 1, dim=-1).indices
    part = Path(path.weights, [_picked(c, worst) for c in path.contexts])
    aim = Target(*(_picked(v, worst) for v in target))
    begun = State(*(_picked(v, worst) for v in state))
    mended = _mended(part, aim, _stepped(part, aim, begun, steps), rest, share)
    return state.x.scatter(-1, worst, mended)


def _missed(target: Target, state: State) -> Tensor:
    """How far z was from its target before the last step."""
    z, wanted = torch.sigmoid(target.zeta + state.residual), torch.sigmoid(target.zeta)
    return torch.abs(z - wanted) * (target.plus - target.minus)


def _picked(v: Tensor, index: Tensor) -> Tensor:
    """Columns [B, 1, K] of v [B, H, N]; what has one column is the same for all."""
    return v if v.shape[-1] == 1 else torch.gather(v, -1, index.expand(-1, v.shape[-2], -1))


def _arrived(spec: FlowSpec, path: Path, target: Target, x: Tensor) -> Arrival:
    """At x - m [B, 1, N], by a tangent that does not cancel far out."""
    a = path.weights[0] * x + path.contexts[0]
    along, t = [x, torch.tanh(a)], path.weights[0] * _quarter_slope(a)
    for w, c in zip(path.weights[1:-1], path.contexts[1:-1], strict=True):
        a = w @ along[-1] + c
        along, t = [*along, torch.tanh(a)], (w @ t) * _quarter_slope(a)
    z = path.weights[-1] @ along[-1] + path.contexts[-1]
    wanted = target.minus + (target.plus - target.minus) * torch.sigmoid(target.zeta)
    log_slope = torch.log(torch.clamp(path.weights[-1] @ t, min=1.2e-38)) + spec.layers * math.log(4.0)
    log_base = log_phi(z)  # of the truncated normal, log dF/dz
    if spec.support != "paper":
        log_base = log_base - log_interval(target.minus, target.plus)
    return Arrival(along, log_base + log_slope, torch.abs(z - wanted) * torch.exp(log_base))


def _quarter_slope(a: Tensor) -> Tensor:
    """tanh'(a) / 4 from exp(-2 |a|), where 1 - tanh^2 would cancel."""
    e = torch.exp(-2.0 * torch.abs(a))
    d = 1.0 + e
    return e / (d * d)
