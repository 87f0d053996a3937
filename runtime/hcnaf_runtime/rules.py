"""Quadrature of g against F_1 on an interval, from values at a few nodes, with a doubt.

F_1 is interpolated by a polynomial P through the nodes and both ends, and the integrand P' g is summed with the
nodes' weights. The first try has the three nodes of Gauss, the second adds the four of Kronrod. What a try misses
is judged by the last coefficients of the integrand's Legendre series.

References:
    Kronrod, Nodes and Weights of Quadrature Formulas, 1965.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]

DOUBT = 0.2, 0.1
"""Shares of what makes either try doubtful that are taken for its error. Set by comparison with 50,000 regions of
all shapes under the embedded model: of those computed to 2e-6 none was off by 1e-5."""


@dataclass(frozen=True, eq=False)
class Nodes:
    """A rule on the unit interval: q nodes `t` and their weights `omega`."""

    t: Float64
    omega: Float64

    @cached_property
    def support(self) -> Float64:
        """[q + 2]: where F_1 is needed: 0, the nodes, 1."""
        return np.concatenate([[0.0], self.t, [1.0]])

    @cached_property
    def slope(self) -> Float64:
        """[q + 2, q]: from F_1 at the support to P' at the nodes."""
        basis = np.eye(len(self.support))
        legendre = np.polynomial.legendre
        P = np.linalg.inv(legendre.legvander(2.0 * self.support - 1.0, len(self.t) + 1))
        derivative = legendre.legval(2.0 * self.t - 1.0, 2.0 * legendre.legder(basis))
        return np.asarray((derivative.T @ P).T)

    @cached_property
    def last(self) -> Float64:
        """[q, 2]: from values at the nodes to the last two coefficients of their Legendre series."""
        series = np.linalg.inv(np.polynomial.legendre.legvander(2.0 * self.t - 1.0, len(self.t) - 1))
        return np.asarray(series[-2:].T)

    def weights(self, F: Float64) -> Float64:
        """[..., q]: what each node counts for by F_1 [..., q + 2] at the support; they add up to its increment."""
        return np.asarray((F @ self.slope) * self.omega)


def _centred(t: list[float], omega: list[float]) -> Nodes:
    """A symmetric rule from the nodes t >= 0 of the interval from -1 to 1, descending, and their weights."""
    half, weight = np.array(t), np.array(omega)
    both = np.concatenate([-half[:-1], half[::-1]]), np.concatenate([weight[:-1], weight[::-1]])
    return Nodes((both[0] + 1.0) / 2.0, both[1] / 2.0)


SHARED, ADDED = np.array([1, 3, 5]), np.array([0, 2, 4, 6])  # KRONROD's nodes that are GAUSS's, and the others

GAUSS = _centred([0.7745966692414834, 0.0], [5 / 9, 8 / 9])
KRONROD = _centred(
    [0.9604912687080203, 0.7745966692414834, 0.4342437493468026, 0.0],
    [0.1046562260264673, 0.2684880898683334, 0.4013974147759622, 0.4509165386584741],
)


def first_try(F: Float64, g: Float64) -> tuple[Float64, Float64]:
    """The integral [M] of g [M, 3] against F [M, 5] by GAUSS, and what it may be off by [M].

    It is off where g bends, and where it changes while the density does.
    """
    increment, weight = F[:, -1] - F[:, 0], GAUSS.weights(F)
    (a, b, c), (u, v, w) = g.T, (weight - increment[:, None] * GAUSS.omega).T  # reductions over 3 numbers are slow
    change = np.maximum(np.maximum(a, b), c) - np.minimum(np.minimum(a, b), c)
    uneven = np.maximum(np.maximum(np.abs(u), np.abs(v)), np.abs(w))
    mass = weight[:, 0] * a + weight[:, 1] * b + weight[:, 2] * c
    return mass, DOUBT[0] * (increment * np.abs(a - 2.0 * b + c) + uneven * change)


def second_try(F: Float64, g: Float64) -> tuple[Float64, Float64]:
    """The integral [M] of g [M, 7] against F [M, 9] by KRONROD, and what it may be off by [M].

    The rule misses coefficients of the integrand's Legendre series from 12 on; the last two it knows are larger.
    """
    weight = KRONROD.weights(F)
    # Weights add up to F's increment whatever P is: where g is constant there is nothing to be off.
    changing = weight / KRONROD.omega * (g - (g @ np.full((7, 1), 1 / 7)))
    last = np.abs(changing @ KRONROD.last)
    return np.einsum("mq,mq->m", weight, g), DOUBT[1] * (last[:, 0] + last[:, 1])
