"""How fast a bundle forecasts on this machine, and what memory it takes. Numpy and onnxruntime alone.

Every section is a few cases; a case is one call, repeated. Times after theta are taken with theta known; those of
whole forecasts get a new scene each time, so that nothing is remembered from the last one.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from hcnaf_runtime import measure
from hcnaf_runtime.errors import InputError
from hcnaf_runtime.forecaster import Forecaster
from hcnaf_runtime.grid import Grid
from hcnaf_runtime.measure import Latency, Memory
from hcnaf_runtime.scene import Scene

Float32 = npt.NDArray[np.float32]

SECTIONS = ("hypernet", "dense", "certified", "forecast", "points", "samples", "risk", "memory")
GRID = Grid(200, 200, 0.5)
HORIZONS, AGENTS, POINTS, DRAWS = 20, 10, 100, 1000
TRAJECTORIES, AT_RISK, EGO_SIZE = 200, 5, (4.6, 1.9)
LOST_MASS = 1e-4
SPACING = 4.0
"""How far copies of an agent stand from each other (m), across the scene's y."""


@dataclass(frozen=True)
class Row:
    """One case: `maps` are computed by every call (1 where a call gives something else)."""

    section: str
    name: str
    maps: int
    latency: Latency
    facts: dict[str, float]
    """Measured beside the time, such as the mass a certified map lost."""

    @property
    def per_map(self) -> float:
        """Median seconds per map."""
        return self.latency.median / self.maps


@dataclass(frozen=True)
class Serving:
    """Memory of this process while it served scenes of changing size: bytes resident after so many scenes."""

    scenes: int
    before: Memory
    samples: tuple[tuple[int, int], ...]
    peak: int
    latency: Latency

    @property
    def growth(self) -> int:
        """The most resident in the last half of the samples, beyond the most in the first: 0 if it is flat."""
        half = len(self.samples) // 2
        first, last = (max((b for _, b in part), default=0) for part in (self.samples[:half], self.samples[half:]))
        return max(0, last - first) if half else 0


@dataclass(frozen=True)
class Bench:
    """What to measure: a forecaster of scenes on sample `scenes` by name, `seconds` and `least` calls per case.

    Raises InputError for a bundle that takes conditions, and where there is no scene.
    """

    forecaster: Forecaster
    scenes: dict[str, Scene]
    seconds: float = 1.0
    least: int = 10
    grid: Grid = GRID
    agents: int = AGENTS

    def __post_init__(self) -> None:
        manifest = self.forecaster.bundle.manifest
        if manifest.horizons is None:
            raise InputError(f"bundle '{manifest.name}' takes conditions, a benchmark needs one that takes scenes")
        if not self.scenes:
            raise InputError("no sample scenes to measure with; name a scene file")

    def rows(self, sections: Sequence[str] = SECTIONS) -> Iterator[Row]:
        """The cases of the named sections but `memory`, one by one, in the order of SECTIONS."""
        makers = {
            "hypernet": self._hypernet,
            "dense": self._dense,
            "certified": self._certified,
            "forecast": self._forecast,
            "points": self._points,
            "samples": self._samples,
            "risk": self._risk,
        }
        for section, cases in makers.items():
            if section in sections:
                yield from cases()

    def horizons(self, count: int) -> tuple[float, ...]:
        """`count` horizons evenly over the trained range, the longest included."""
        trained = self.forecaster.bundle.manifest.horizons
        assert trained is not None  # checked on construction
        return tuple(trained.min + (trained.max - trained.min) * (k + 1) / count for k in range(count))

    @property
    def _first(self) -> Scene:
        return next(iter(self.scenes.values()))

    def _row(self, section: str, name: str, maps: int, call: Callable[[Scene], Any], scene: Scene) -> Row:
        """`scene` as it is: its theta is remembered from the warm-up."""
        return Row(section, name, maps, measure.latency(call, lambda: scene, self.seconds, self.least), {})

    def _fresh(self, section: str, name: str, maps: int, call: Callable[[Scene], Any], scene: Scene) -> Row:
        """A new scene each time, equal to `scene`: nothing is remembered."""
        return Row(
            section, name, maps, measure.latency(call, lambda: replace(scene), self.seconds, self.least), {}
        )

    def _hypernet(self) -> Iterator[Row]:
        times = self.horizons(HORIZONS)
        for agents in (1, self.agents):
            scene = crowd(self._first, agents)
            name = f"hyper-network, {_count(agents, HORIZONS)}"
            yield self._fresh("hypernet", name, 1, partial(self.forecaster.theta, horizons=times), scene)

    def _dense(self) -> Iterator[Row]:
        for count in (1, HORIZONS):
            call = partial(self.forecaster.pom, grid=self.grid, horizons=self.horizons(count))
            name = f"dense maps after theta, {_count(1, count)}"
            yield self._row("dense", name, count, call, crowd(self._first, 1))

    def _certified(self) -> Iterator[Row]:
        times = self.horizons(HORIZONS)
        call = partial(self.forecaster.pom, grid=self.grid, horizons=times, lost_mass=LOST_MASS)
        for name, scene in self.scenes.items():
            for agents in dict.fromkeys((1, len(scene.target))):
                some, maps = crowd(scene, agents), agents * HORIZONS
                title = f"certified maps after theta, {name}, {_count(agents, HORIZONS)}"
                row = self._row("certified", title, maps, call, some)
                yield replace(row, facts={"lost_mass": float(np.max(call(some).lost_mass))})

    def _forecast(self) -> Iterator[Row]:
        times = self.horizons(HORIZONS)
        for agents in (1, self.agents):
            for kind, lost_mass in (("certified", LOST_MASS), ("dense", 0.0)):
                call = partial(self.forecaster.pom, grid=self.grid, horizons=times, lost_mass=lost_mass)
                name = f"whole forecast, {kind}, {_count(agents, HORIZONS)}"
                yield self._fresh("forecast", name, agents * HORIZONS, call, crowd(self._first, agents))

    def _points(self) -> Iterator[Row]:
        scene, times = crowd(self._first, 1), self.horizons(HORIZONS)
        points = np.random.default_rng(0).uniform([-5.0, -10.0], [45.0, 10.0], (POINTS, 2)).astype(np.float32)
        asked = f"{POINTS} points, {_count(1, HORIZONS)}"
        log_prob = partial(self.forecaster.log_prob, points=points, horizons=times)
        yield self._row("points", f"log_prob after theta, {asked}", 1, log_prob, scene)

        cdf = partial(self.forecaster.cdf, points=points, horizons=times)
        yield self._row("points", f"cdf after theta, {asked}", 1, cdf, scene)

    def _samples(self) -> Iterator[Row]:
        scene, times = crowd(self._first, 1), self.horizons(HORIZONS)
        call = partial(self.forecaster.sample, n=DRAWS, horizons=times)
        yield self._row("samples", f"{DRAWS} samples after theta, {_count(1, HORIZONS)}", 1, call, scene)

    def _risk(self) -> Iterator[Row]:
        """The first target drives through the others: it is left out of them."""
        times, own = self.horizons(HORIZONS), int(self._first.target[0])
        others = np.delete(np.arange(len(self._first.past)), own)[:AT_RISK]
        scene = self._first if not len(others) else replace(self._first, target=others)
        call = partial(
            self.forecaster.collision_probability,
            trajectories=fan(scene, own, np.array(times), TRAJECTORIES),
            ego_size=EGO_SIZE,
            horizons=times,
            exclude=(own,),
        )
        name = f"risk after theta, {TRAJECTORIES} trajectories, {_count(AT_RISK, HORIZONS)}"
        yield self._row("risk", name, 1, call, crowd(scene, AT_RISK))

    def serve(self, count: int, seed: int = 0, every: int | None = None) -> Serving | None:
        """Forecast `count` scenes of changing size, certified; None where memory cannot be read.

        Agents, horizons, cells and the raster's rows change from scene to scene. Memory is noted after each
        `every` scenes (default: a fiftieth of them).
        """
        rng = np.random.default_rng(seed)
        every = every or max(1, count // 50)
        measure.reset_peak()
        before = measure.memory()
        if before is None:
            return None
        samples, spent, now = [], [], before
        for done in range(1, count + 1):
            spent.append(self._serve_one(rng))
            if done % every == 0 or done == count:
                now = measure.memory() or now
                samples.append((done, now.resident))
        return Serving(count, before, tuple(samples), now.peak, measure.summary(spent))

    def _serve_one(self, rng: np.random.Generator) -> float:
        scene = list(self.scenes.values())[rng.integers(len(self.scenes))]
        agents = int(2 ** rng.uniform(0.0, np.log2(self.agents + 1)))
        times = self.horizons(HORIZONS)[: int(2 ** rng.uniform(0.0, np.log2(HORIZONS + 1)))]
        width, height = (int(n) for n in 2 ** rng.uniform(5.0, np.log2(200.0), 2))
        grid = Grid(width, height, GRID.resolution)
        some = cut(crowd(scene, agents), int(rng.integers(1, 3)) / 2)
        timings = self.forecaster.pom(some, grid, times, lost_mass=LOST_MASS).timings
        return timings.hypernet + timings.maps


def fan(scene: Scene, agent: int, times: npt.NDArray[Any], count: int) -> npt.NDArray[np.float64]:
    """Paths [count, T, 3] (x, y, yaw, scene frame) that an agent might drive from now on: ten curvatures up to 0.1
    1/m either way, and accelerations from -4 to 4 m/s² until it stands."""
    x, y, sin, cos, speed = scene.past[agent, -1].astype(np.float64)
    rates = np.linspace(-4.0, 4.0, count // 10)
    curvature, rate = (m.ravel()[:, None] for m in np.meshgrid(np.linspace(-0.1, 0.1, 10), rates))
    until = np.where(rate < 0.0, np.minimum(times, speed / np.maximum(-rate, 1e-9)), times)
    way = speed * until + 0.5 * rate * until**2
    turn = curvature * way
    reach = way * np.sinc(turn / (2.0 * np.pi))  # the chord of the arc
    yaw = np.arctan2(sin, cos)
    place = [x + reach * np.cos(yaw + turn / 2.0), y + reach * np.sin(yaw + turn / 2.0), yaw + turn]
    return np.stack(np.broadcast_arrays(*place), axis=-1)


def crowd(scene: Scene, agents: int) -> Scene:
    """`scene` with exactly so many targets: some of its own, or all and copies of them beside each other."""
    own = len(scene.target)
    if agents <= own:
        return replace(scene, target=scene.target[:agents], future=None)
    copies = scene.target[np.arange(agents - own) % own]
    past = scene.past[copies].copy()
    past[..., 1] += SPACING * (1 + np.arange(agents - own) // own)[:, None].astype(np.float32)
    added = len(scene.past) + np.arange(agents - own)
    return replace(
        scene,
        past=np.concatenate([scene.past, past]),
        size=np.concatenate([scene.size, scene.size[copies]]),
        kind=np.concatenate([scene.kind, scene.kind[copies]]),
        target=np.concatenate([scene.target, added]),
        future=None,
    )


def cut(scene: Scene, part: float) -> Scene:
    """`scene` with this part of the raster's rows, from the lowest y."""
    rows = max(1, int(part * scene.raster.shape[1]))
    return scene if not scene.raster.size else replace(scene, raster=scene.raster[:, :rows])


def _count(agents: int, horizons: int) -> str:
    return f"{agents} agent{'s' if agents > 1 else ''} x {horizons} horizon{'s' if horizons > 1 else ''}"
