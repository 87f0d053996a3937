"""Quadrature against a distribution function: integrals of g(x) dF(x) from values of F alone.

The interval is cut into panels. In each, g is sampled at q Gauss-Legendre nodes t_i (weights omega_i), F is
interpolated through the same nodes and the two ends by a polynomial P of degree q + 1, and

    integral of g dF  =  sum_i omega_i P'(t_i) g(t_i)        (up to the interpolation error)

Two properties no density-based rule has: P' is of degree q, which Gauss integrates exactly, so the weights of
a panel sum exactly to the increment of F over it and total mass is conserved whatever q; and a smooth integrand
converges exponentially in q, where mid-points need hundreds of nodes.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Rule:
    """`panels` equal panels with `order` q nodes each, on the unit interval."""

    panels: int
    order: int

    @property
    def size(self) -> int:
        """S, how many nodes there are."""
        return self.panels * self.order

    @cached_property
    def support(self) -> Float64:
        """[panels (q + 1) + 1]: where F is needed, ascending: 0, nodes, panel end, nodes, ..., 1."""
        inner = np.append(0.0, _gauss(self.order)[0])
        starts = np.arange(self.panels)[:, None]
        return np.append(((starts + inner) / self.panels).ravel(), 1.0)

    @cached_property
    def nodes(self) -> npt.NDArray[np.intp]:
        """[S]: which entries of `support` are the nodes of g."""
        return np.flatnonzero(np.arange(len(self.support)) % (self.order + 1))

    @cached_property
    def checks(self) -> Float64:
        """[len(support) - 1]: half-way between the points of `support`, where P can be compared with F."""
        return (self.support[:-1] + self.support[1:]) / 2.0

    def weights(self, F: Float64) -> Float64:
        """[..., S]: the weights of the nodes for the values `F` [..., len(support)] of the distribution."""
        return (F[..., self._panel] @ self._derivative).reshape(*F.shape[:-1], self.size)

    def at(self, places: Float64) -> Float64:
        """[n, S]: values at `places` [n] on the unit interval from those at the nodes, by the polynomial through
        the nodes of the panel that a place lies in."""
        panel = np.minimum((places * self.panels).astype(np.intp), self.panels - 1)
        found, t = np.zeros((len(places), self.panels, self.order)), _gauss(self.order)[0]
        within = places * self.panels - panel
        for j in range(self.order):
            found[np.arange(len(places)), panel, j] = _lagrange(t, j, within)
        return found.reshape(len(places), self.size)

    @cached_property
    def doubt(self) -> Float64:
        """[S, S]: values at the nodes minus those of the polynomial through all nodes of a panel but the second
        from either end, to judge the error by."""
        t = _gauss(self.order)[0]
        fewer = np.delete(np.arange(self.order), [1, self.order - 2])
        lesser = np.zeros((self.order, self.order))
        for k, node in enumerate(fewer):
            lesser[:, node] = _lagrange(t[fewer], k, t)
        doubt: Float64 = np.asarray(np.kron(np.eye(self.panels), np.eye(self.order) - lesser), np.float64)
        return doubt

    def misfit(self, F: Float64, at_checks: Float64) -> Float64:
        """[...]: how far P through `F` is from F's values `at_checks` at worst: is F resolved at all?"""
        P = (F[..., self._panel] @ self._midway).reshape(at_checks.shape)
        worst: Float64 = np.abs(P - at_checks).max(axis=-1)
        return worst

    @cached_property
    def _panel(self) -> npt.NDArray[np.intp]:
        """[panels, q + 2]: the entries of `support` that belong to each panel."""
        return np.arange(self.panels)[:, None] * (self.order + 1) + np.arange(self.order + 2)

    @cached_property
    def _points(self) -> Float64:
        """[q + 2]: the ends and nodes of a single panel."""
        return np.concatenate([[0.0], _gauss(self.order)[0], [1.0]])

    @cached_property
    def _midway(self) -> Float64:
        """[q + 2, q + 1]: L_j half-way between the points of a panel."""
        t = self._points
        between = (t[:-1] + t[1:]) / 2.0
        return np.stack([_lagrange(t, j, between) for j in range(len(t))])

    @cached_property
    def _derivative(self) -> Float64:
        """[q + 2, q]: omega_i L_j'(t_i) for the Lagrange polynomials L_j through the ends and the nodes."""
        return _differentiation(self._points)[1:-1].T * _gauss(self.order)[1]


@dataclass(frozen=True)
class Halo:
    """One node per column: g is sampled at the columns' centres alone and interpolated between them.

    The integral over a column takes g from its own centre and from `reach` neighbours on either side: a
    polynomial of degree 2 reach through equally spaced points, integrated against F by a `rule` that costs
    values of F only. For a g that is smooth on the scale of a column this is as accurate as several nodes in
    each, at the cost of one. Weights of a column still sum exactly to F's increment.
    """

    reach: int
    rule: Rule

    @cached_property
    def spread(self) -> Float64:
        """[q, 2 reach + 1]: what each node of the rule takes from the centres around it."""
        return _interpolation(self.rule, self.reach)

    @cached_property
    def doubt(self) -> Float64:
        """[q, 2 reach + 1]: `spread` minus that of one neighbour less on either side, to judge the error by."""
        less = np.pad(_interpolation(self.rule, self.reach - 1), ((0, 0), (1, 1)))
        return self.spread - less


def _interpolation(rule: Rule, reach: int) -> Float64:
    """[q, 2 reach + 1]: Lagrange polynomials through -reach .. reach at the rule's nodes, 0 being the centre."""
    places = np.arange(-reach, reach + 1, dtype=np.float64)
    nodes = rule.support[rule.nodes] - 0.5
    return np.stack([_lagrange(places, k, nodes) for k in range(len(places))], axis=1)


def _gauss(order: int) -> tuple[Float64, Float64]:
    """Gauss-Legendre nodes and weights on the unit interval."""
    t, omega = np.polynomial.legendre.leggauss(order)
    return (t + 1.0) / 2.0, omega / 2.0


def _lagrange(t: Float64, j: int, x: Float64) -> Float64:
    """L_j(x): 1 at t_j, 0 at the other points `t`."""
    others = np.delete(t, j)
    value: Float64 = ((x[:, None] - others) / (t[j] - others)).prod(axis=1)
    return value


def _differentiation(t: Float64) -> Float64:
    """D[i, j] = L_j'(t_i) of the Lagrange polynomials through `t`, in barycentric form."""
    gaps = t[:, None] - t[None, :]
    np.fill_diagonal(gaps, 1.0)
    scale = gaps.prod(axis=1)
    D: Float64 = scale[:, None] / scale[None, :] / gaps
    np.fill_diagonal(D, 0.0)
    np.fill_diagonal(D, -D.sum(axis=1))
    return D
