"""The flow of a bundle as functions: its graphs, and densities at many points in bounded memory."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import pairwise
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from hcnaf_runtime.bundle import Bundle
from hcnaf_runtime.errors import BundleError
from hcnaf_runtime.manifest import GraphName
from hcnaf_runtime.plane import CHUNK, Distribution
from hcnaf_runtime.session import Settings
from hcnaf_runtime.workers import Workers

Float32 = npt.NDArray[np.float32]
T = TypeVar("T")

_NEEDED: tuple[GraphName, ...] = ("flow", "marginal_cdf", "conditional_cdf", "cell_mass")

_APART: tuple[GraphName, ...] = ("cell_mass",)
"""Graphs that every lane has to itself (see `session.Settings`): what runs of the others take is small."""

PART = 1 << 17
"""Queries are cut into parts of about so many numbers in the widest intermediate."""

DRAWS = 1 << 17
"""Samples are drawn in parts of at most so many, times hidden units."""

LANDMARK = 0.1
"""What a column is taken to hold where F_2 alone is asked for: it is then accurate to about 3e-6."""

MISSED, LOST = 5e-6, 2e-5
"""Samples are drawn again alone where F_1 or F_2 misses its uniform by more than MISSED, one in RARE of them at
most: where more miss it float32 does not resolve z, and drawing again does not help. It does help those that miss
it by more than LOST, which did not get all steps: they are drawn again however many they are."""

RARE = 32

AGAIN = 1 << 22
"""Numbers of theta, repeated for each sample drawn again, that are run at once."""


class Flow(Distribution):
    """The graphs of `bundle` that take theta [B, P]. Stateless and safe to share between threads."""

    def __init__(self, bundle: Bundle, settings: Settings) -> None:
        self._bundle = bundle
        self._lanes = [replace(settings, threads=1, lane=k) for k in range(settings.threads)]
        self._workers = Workers(settings.threads)

    def load(self) -> None:
        """Load the graphs that maps and densities need, for every thread."""
        for graph in _NEEDED:
            if graph in self._bundle.manifest.graphs:
                for settings in self._lanes if graph in _APART else self._lanes[:1]:
                    self._bundle.session(graph, settings)

    @property
    def dims(self) -> int:
        """D."""
        return self._bundle.manifest.flow.dims

    @property
    def hidden(self) -> int:
        """H, hidden units per dimension."""
        return self._bundle.manifest.flow.hidden

    def marginal_cdf(self, theta: Float32, x: Float32) -> Float32:
        """F_1 [B, K] at `x` [B, K] (m)."""
        return self._many("marginal_cdf", "cdf", theta, x=x)

    def conditional_cdf(self, theta: Float32, x: Float32, y: Float32) -> Float32:
        """F_2 [B, S, E] at `y` [B, S, E] given `x` [B, S] (m)."""
        return self._many("conditional_cdf", "cdf", theta, x=x, y=y)

    def cell_mass(
        self, theta: Float32, x: Float32, weight: Float32, doubt: Float32, y: Float32
    ) -> tuple[Float32, Float32]:
        """Mass [B, E - 1, C], the sum over s of weight [B, S, C] times F_2's increments along y [B, E] given x
        [B, S]; and [B, C], the largest |sum| with the weights `doubt`, or what was below 0."""
        mass, error = self._run("cell_mass", ["mass", "error"], theta=theta, x=x, weight=weight, doubt=doubt, y=y)
        return mass, error

    def grid_cdf(self, theta: Float32, x: Float32, y: Float32) -> Float32:
        """F_2 [B, E, S] at every pair of `x` [B, S] and `y` [B, E] (m)."""
        # F_2 is as accurate as the weights ask for.
        weight = np.full((*x.shape, 1), LANDMARK / x.shape[1], np.float32)
        none = np.zeros_like(weight)
        return self._run("cell_mass", ["cdf"], theta=theta, x=x, weight=weight, doubt=none, y=y)[0]

    def log_prob(self, theta: Float32, points: Float32) -> Float32:
        """log p [B, N] at `points` [B, N, D] (nats per m² for D = 2)."""
        return self._many("flow", "log_prob", theta, points=points)

    def inverse(self, theta: Float32, uniform: Float32) -> tuple[Float32, Float32]:
        """The points [B, N, 2] (m) where F_1 and F_2 are `uniform` [B, N, 2], and log p [B, N] (nats per m²).

        Raises BundleError where the bundle has no graph `inverse`.
        """
        if "inverse" not in self._bundle.manifest.graphs:
            raise BundleError(f"{self._bundle.path}: no graph 'inverse', samples need it; export the bundle again")
        B, N, D = uniform.shape
        points, log_prob = np.empty((B, N, D), np.float32), np.empty((B, N), np.float32)
        # Parts of a size that does not depend on the threads: the samples must not either.
        most = max(1, DRAWS // self.hidden)
        some = _parts(N, -(-N // most))
        maps = _parts(B, -(-B // max(1, most // N)))

        def part(key: tuple[slice, slice]) -> None:
            points[key], log_prob[key] = self._drawn(theta[key[0]], uniform[key])

        self.each(part, [(i, k) for i in maps for k in some])
        return points, log_prob

    def _drawn(self, theta: Float32, uniform: Float32) -> tuple[Float32, Float32]:
        """`inverse`, at once. The graph's steps are for most samples enough; the others get all of them alone."""
        outputs = ["points", "log_prob", "error"]
        points, log_prob, error = self._run("inverse", outputs, theta=theta, uniform=uniform)
        late = _late(error)
        for some in _parts(len(late), -(-len(late) * theta.shape[1] // AGAIN)):
            b, i = np.unravel_index(late[some], error.shape)
            again = self._run("inverse", outputs, theta=theta[b], uniform=uniform[b, i][:, None])
            better = again[2][:, 0] < error[b, i]
            b, i = b[better], i[better]
            points[b, i], log_prob[b, i] = again[0][better, 0], again[1][better, 0]
        return points, log_prob

    def each(self, work: Callable[[T], object], items: Iterable[T]) -> None:
        """Call `work` with each item, on as many threads as there are."""
        self._workers.each(work, items)

    def _many(self, graph: GraphName, output: str, theta: Float32, **feeds: Float32) -> Float32:
        """One output [B, N, ...] for theta [B, P] and `feeds` [B, N, ...], part by part."""
        B, N = next(iter(feeds.values())).shape[:2]
        widest = max(value[0, 0].size for value in feeds.values()) if B * N else 1
        # Small parts keep all threads busy; to a thread that is busy already they are a waste.
        most = max(1, (CHUNK if self._workers.busy else PART) // (widest * self.hidden))
        if most >= B * N:
            return self._run(graph, [output], theta=theta, **feeds)[0]
        # Even parts: of 5 maps in parts of at most 4, three and two.
        maps = _parts(B, -(-B * N // most))
        points = _parts(N, -(-N // most))
        found: dict[tuple[int, int], Float32] = {}

        def part(key: tuple[int, int]) -> None:
            some = {name: value[maps[key[0]], points[key[1]]] for name, value in feeds.items()}
            found[key] = self._run(graph, [output], theta=theta[maps[key[0]]], **some)[0]

        self.each(part, [(i, k) for i in range(len(maps)) for k in range(len(points))])
        rows = [np.concatenate([found[i, k] for k in range(len(points))], axis=1) for i in range(len(maps))]
        return np.concatenate(rows)

    def _run(self, graph: GraphName, outputs: list[str], **feeds: Float32) -> list[Float32]:
        lane = self._workers.lane if graph in _APART else 0
        session = self._bundle.session(graph, self._lanes[lane])
        return session.run(outputs, {name: np.ascontiguousarray(value) for name, value in feeds.items()})


def _late(error: Float32) -> npt.NDArray[np.intp]:
    """Flat places of the samples to draw again (see MISSED), by their error."""
    late = np.flatnonzero(error > MISSED)
    late = late[np.argsort(error.flat[late])]
    lost = int((error > LOST).sum())
    return late[-max(1, error.size // RARE, lost) :]


def _parts(size: int, count: int) -> list[slice]:
    """`size` things in `count` even parts, or one part each if there are fewer."""
    cuts = np.linspace(0, size, min(size, count) + 1).astype(int).tolist()
    return [slice(a, b) for a, b in pairwise(cuts)]
