"""The paper's toy distributions (section 5.1): known densities, so that a trained flow has a true limit.

Both are conditional densities p(x | C) on the plane, C running over a short list of conditions numbered from
0: draw with `sample`, compare with `log_prob`, and hold the negative log-likelihood against `entropy`.
"""

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

LOG_2PI = math.log(2.0 * math.pi)


class Toy(Protocol):
    """A conditional density on the plane with finitely many conditions."""

    @property
    def seen(self) -> tuple[int, ...]:
        """Indices of the conditions to train on."""

    @property
    def unseen(self) -> tuple[int, ...]:
        """Indices of the conditions kept for the test; may be empty."""

    def conditions(self) -> NDArray[np.float32]:
        """What the hyper-network is given: [conditions, K], seen ones first."""

    def sample(self, rng: np.random.Generator, index: int, n: int) -> Array:
        """Draw n points [n, 2] under condition `index`."""

    def quantiles(self, index: int, u: Array) -> Array:
        """The point [..., 2] at every u [..., 2] in (0, 1)^2: uniform u become samples."""

    def log_prob(self, index: int, x: ArrayLike) -> Array:
        """log p(x | C_index) in nats at points [..., 2]: [...]."""

    def entropy(self, index: int) -> float:
        """H(p(. | C_index)) in nats: the least negative log-likelihood that any model can reach."""


@dataclass(frozen=True, kw_only=True)
class ToyOne:
    """Toy 1: for each n a mixture of n x n equal Gaussians on a square grid.

    p(x, y | n) = q_n(x) q_n(y),   q_n(x) = 1/n sum_i N(x; m_i, v_n),
    m = linspace(-5, 5, n),        v_n = 1 / (n ln n)

    v_n is the variance, not the standard deviation: the paper's likelihoods (3.896, 3.966, 4.278) fit the
    entropies of this reading (3.8975, 3.9696, 4.2677). The condition is one-hot.

    Attributes:
        sides: n of each condition.
    """

    sides: tuple[int, ...] = (2, 5, 10)

    @property
    def seen(self) -> tuple[int, ...]:
        """All of them."""
        return tuple(range(len(self.sides)))

    @property
    def unseen(self) -> tuple[int, ...]:
        """None: the experiment has no held-out condition."""
        return ()

    def conditions(self) -> NDArray[np.float32]:
        """One-hot rows, float32 [3, 3]."""
        return np.eye(len(self.sides), dtype=np.float32)

    def variance(self, index: int) -> float:
        """v_n = 1 / (n ln n), m^2 say."""
        n = self.sides[index]
        return 1.0 / (n * math.log(n))

    def means(self, index: int) -> Array:
        """The n means along one axis; the centres are all pairs of them."""
        return np.linspace(-5.0, 5.0, self.sides[index])

    def sample(self, rng: np.random.Generator, index: int, n: int) -> Array:
        """Draw n points, float64 [n, 2]."""
        centre = rng.choice(self.means(index), size=(n, 2))
        return centre + math.sqrt(self.variance(index)) * rng.standard_normal((n, 2))

    def quantiles(self, index: int, u: Array) -> Array:
        """Per axis the integer part of n u names the component, the rest is the quantile in it: [..., 2]."""
        n = self.sides[index]
        component = np.minimum(np.floor(n * u), n - 1).astype(int)
        return np.asarray(self.means(index)[component] + self.variance(index) ** 0.5 * _normal(n * u - component))

    def log_prob(self, index: int, x: ArrayLike) -> Array:
        """log p at points [..., 2], float64 [...]."""
        return np.asarray(self._log_axis(index, np.asarray(x, dtype=np.float64)).sum(axis=-1))

    def entropy(self, index: int) -> float:
        """H = -2 integral of q log q: the density is a product, so one dimension's quadrature is enough.

        Trapezoids at a hundredth of a standard deviation out to ten of them: exact to rounding, as the
        integrand is smooth and vanishes at both ends.
        """
        sigma = math.sqrt(self.variance(index))
        reach = 5.0 + 10.0 * sigma
        x, dx = np.linspace(-reach, reach, math.ceil(200.0 * reach / sigma), retstep=True)
        log_q = self._log_axis(index, x)
        return float(-2.0 * np.sum(np.exp(log_q) * log_q) * dx)

    def _log_axis(self, index: int, x: Array) -> Array:
        """log q_n(x), element-wise."""
        v = self.variance(index)
        exponent = -0.5 * (x[..., None] - self.means(index)) ** 2 / v
        mixed = np.logaddexp.reduce(exponent, axis=-1)
        return np.asarray(mixed - math.log(self.sides[index]) - 0.5 * (LOG_2PI + math.log(v)))


@dataclass(frozen=True, kw_only=True)
class ToyTwo:
    """Toy 2: an isotropic Gaussian around its condition, p(x | C) = N(x; C, sigma^2 I), C = (x_c, y_c).

    Five centres are trained on and four are not, so the test asks whether the hyper-network generalises. The
    network is given (C - 8) / 4, which is -1, 0 or 1.

    Attributes:
        sigma: standard deviation.
        seen_centres: centres to train on.
        unseen_centres: centres for the test, numbered after the seen ones.
    """

    sigma: float = 0.5
    seen_centres: tuple[tuple[float, float], ...] = ((4, 4), (4, 12), (8, 8), (12, 4), (12, 12))
    unseen_centres: tuple[tuple[float, float], ...] = ((4, 8), (12, 8), (8, 4), (8, 12))

    @property
    def seen(self) -> tuple[int, ...]:
        """0 to 4."""
        return tuple(range(len(self.seen_centres)))

    @property
    def unseen(self) -> tuple[int, ...]:
        """5 to 8."""
        return tuple(range(len(self.seen_centres), len(self.seen_centres) + len(self.unseen_centres)))

    def centres(self) -> Array:
        """All centres in natural units, float64 [9, 2], seen ones first."""
        return np.array(self.seen_centres + self.unseen_centres, dtype=np.float64)

    def conditions(self) -> NDArray[np.float32]:
        """(C - 8) / 4, float32 [9, 2]."""
        return ((self.centres() - 8.0) / 4.0).astype(np.float32)

    def sample(self, rng: np.random.Generator, index: int, n: int) -> Array:
        """Draw n points, float64 [n, 2]."""
        return np.asarray(self.centres()[index] + self.sigma * rng.standard_normal((n, 2)))

    def quantiles(self, index: int, u: Array) -> Array:
        """centre + sigma Phi^-1(u), [..., 2]."""
        return np.asarray(self.centres()[index] + self.sigma * _normal(u))

    def log_prob(self, index: int, x: ArrayLike) -> Array:
        """log p at points [..., 2], float64 [...]."""
        z = (np.asarray(x, dtype=np.float64) - self.centres()[index]) / self.sigma
        return np.asarray(-0.5 * (z**2).sum(axis=-1) - LOG_2PI - 2.0 * math.log(self.sigma))

    def entropy(self, index: int) -> float:
        """H = 1 + log(2 pi sigma^2), the same for every centre."""
        del index
        return 1.0 + LOG_2PI + 2.0 * math.log(self.sigma)


def even(rng: np.random.Generator, n: int) -> Array:
    """n points [n, 2] in (0, 1)^2, spread more evenly than chance would.

    The square is cut into rows x columns cells with one point in each, and so that every n-th of either axis holds
    one point too. A point picked at random among them is uniform, so means over them are as unbiased as those over
    independent points; they vary far less.

    References:
        Chiu, Shirley & Wang, Multi-jittered sampling, Graphics Gems IV, 1994.
    """
    rows = next(k for k in range(math.isqrt(n), 0, -1) if n % k == 0)
    columns = n // rows
    i, j = np.indices((rows, columns))
    along = rng.random((rows, columns)).argsort(axis=1)
    across = rng.random((rows, columns)).argsort(axis=0)
    u = (i + (along + rng.random(i.shape)) / columns) / rows
    v = (j + (across + rng.random(i.shape)) / rows) / columns
    return np.stack([u.ravel(), v.ravel()], axis=-1)


def _normal(u: Array) -> Array:
    """Phi^-1, held within eight standard deviations."""
    inside = np.clip(u, 1e-15, 1.0 - 1e-15)
    return np.asarray(torch.special.ndtri(torch.from_numpy(inside)).numpy())
