"""Distributions written in numpy, in place of a bundle's graphs."""

import numpy as np
from scipy.stats import norm


class Analytic:
    """What maps ask of a bundle, from `marginal` F_1(x) and `exact` F_2 [B, E, S] in float64."""

    hidden = 20

    def marginal_cdf(self, theta, x):
        return self.marginal(np.float64(x)).astype(np.float32)

    def grid_cdf(self, theta, x, y):
        return self.exact(x, y).astype(np.float32)

    def conditional_cdf(self, theta, x, y):
        B, S, E = y.shape
        found = self.exact(x.reshape(-1, 1), y.reshape(-1, E))
        return found.reshape(B, S, E).astype(np.float32)

    def cell_mass(self, theta, x, weight, doubt, y):
        steps = np.maximum(np.diff(self.grid_cdf(theta, x, y), axis=1), 0)
        raw = steps @ weight
        error = np.maximum(np.abs(steps @ doubt).max(axis=1), -np.minimum(raw, 0).sum(axis=1))
        return np.maximum(raw, 0), error

    def each(self, work, items):
        for item in items:
            work(item)

    def truth(self, window, panels=40):
        """[R, C] by 8-point Gauss-Legendre on `panels` panels of every column, in float64."""
        t, w = np.polynomial.legendre.leggauss(8)
        edges = np.linspace(0, 1, panels + 1)
        half = 0.5 / panels
        share = ((edges[:-1] + half)[:, None] + half * t).ravel()
        omega = np.tile(w * half, panels)
        x_edges, y_edges = window.x.astype(np.float64), window.y.astype(np.float64)
        truth = np.zeros((len(y_edges) - 1, len(x_edges) - 1))
        for c in range(truth.shape[1]):
            x = x_edges[c] + (x_edges[c + 1] - x_edges[c]) * share
            F = self.exact(x[None], y_edges[None])[0]
            truth[:, c] = np.diff(F, axis=0) @ (self.density(x) * omega * (x_edges[c + 1] - x_edges[c]))
        return truth


class Mixture(Analytic):
    """Gaussians (weight, mean x, mean y, sigma x, sigma y, rho)."""

    def __init__(self, parts):
        self.parts = [np.float64(part) for part in parts]

    def marginal(self, x):
        return sum(w * norm.cdf(x, mx, sx) for w, mx, _, sx, _, _ in self.parts)

    def density(self, x):
        return sum(w * norm.pdf(x, mx, sx) for w, mx, _, sx, _, _ in self.parts)

    def exact(self, x, y):
        x, y = np.float64(x)[:, None], np.float64(y)[..., None]
        log_p = [np.log(w) + norm.logpdf(x, mx, sx) for w, mx, _, sx, _, _ in self.parts]
        top = np.max(log_p, axis=0)
        share = np.exp(log_p - top)
        share /= share.sum(axis=0)
        means = [my + rho * sy / sx * (x - mx) for _, mx, my, sx, sy, rho in self.parts]
        spreads = [sy * np.sqrt(1 - rho**2) for *_, sy, rho in self.parts]
        return sum(s * norm.cdf(y, m, d) for s, m, d in zip(share, means, spreads, strict=True))


class Bent(Analytic):
    """Gaussian in x; y given x is Gaussian about `mean(x)` with a spread of `spread(x)` (m)."""

    def __init__(self, mean, spread, x=0.0, sigma=20.0):
        self.mean, self.spread, self.x, self.sigma = mean, spread, x, sigma

    def marginal(self, x):
        return norm.cdf(x, self.x, self.sigma)

    def density(self, x):
        return norm.pdf(x, self.x, self.sigma)

    def exact(self, x, y):
        x, y = np.float64(x)[:, None], np.float64(y)[..., None]
        return norm.cdf(y, self.mean(x), self.spread(x))
