"""Inputs that try a graph where it could differ from PyTorch: ordinary ones, tails, saturation, single items."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from hcnaf_models.config import ConditionConfig, PomConfig
from hcnaf_models.emission import Emission, initial_raw
from hcnaf_models.flow import forward, split
from hcnaf_models.model import Hcnaf
from hcnaf_models.spec import FlowSpec

Array = npt.NDArray[Any]
Feeds = dict[str, Array]

RESOLVED = 0.3
"""Least normal mass of the image of y at which F_2 is compared."""

STAIRS = ("saturated", "faint")
"""Made-up flows whose z is a staircase or constant in float32: they have no inverse that two programs agree on."""

SEED = 20_200_614
FAR = (1e2, 1e4, 1e6)
DENORMAL = 1e-40


@dataclass(frozen=True, kw_only=True)
class SceneSetting:
    """What a made-up scene is like. `dropped`: share of history rows not observed. `centre`: where it lies (m)."""

    agents: int = 6
    targets: int = 3
    horizons: tuple[float, ...] = (0.5, 2.0, 4.0)
    raster: tuple[int, int] = (120, 140)
    stops: int = 3
    dropped: float = 0.0
    centre: float = 0.0


SCENES: dict[str, SceneSetting] = {
    "typical": SceneSetting(),
    "single": SceneSetting(agents=1, targets=1, horizons=(1.0,), stops=0),
    "gaps": SceneSetting(agents=12, dropped=0.6),
    "crowd": SceneSetting(agents=50, targets=2, stops=20),
    "small map": SceneSetting(raster=(2, 3), targets=1, stops=1),
    "one pixel": SceneSetting(raster=(1, 1), targets=1),
    "large map": SceneSetting(raster=(400, 300), targets=1, horizons=tuple(np.linspace(0.1, 4.0, 12))),
    "far away": SceneSetting(centre=1e4),
}


def scene(config: PomConfig, setting: SceneSetting, rng: np.random.Generator) -> Feeds:
    """Inputs of the scene graph: agents that drive straight with noise, on a map of random patches."""
    N, T = setting.agents, config.history
    yaw, speed = rng.uniform(-np.pi, np.pi, N), rng.uniform(0.0, 15.0, N)
    heading = np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)
    now = setting.centre + rng.uniform(-30.0, 30.0, (N, 2))
    back = (np.arange(T) - T + 1) * config.step
    track = now[:, None] + (speed[:, None] * back)[..., None] * heading[:, None]
    track = track + rng.normal(0.0, 0.1, track.shape)
    rest = np.broadcast_to(np.stack([np.sin(yaw), np.cos(yaw), speed], axis=-1)[:, None], (N, T, 3))
    past = np.concatenate([track, rest], axis=-1).astype(np.float32)
    past[rng.random((N, T)) < setting.dropped] = np.nan
    target = rng.permutation(N)[: setting.targets]
    observed = np.concatenate([now, rest[:, -1]], axis=-1)[target]
    past[target, -1] = observed  # a target is always observed now
    horizons = np.minimum(np.array(setting.horizons), config.horizon)
    feeds = {
        "past": past,
        "size": rng.uniform((3.5, 1.6), (12.0, 2.6), (N, 2)).astype(np.float32),
        "target": target.astype(np.int64),
        "horizons": horizons.astype(np.float32),
    }
    return feeds | _surroundings(config, setting, rng)


def _surroundings(config: PomConfig, setting: SceneSetting, rng: np.random.Generator) -> Feeds:
    feeds: Feeds = {}
    if config.channels:
        rows, columns = setting.raster
        patches = rng.integers(-127, 128, (len(config.channels), -(-rows // 8), -(-columns // 8)))
        blocks = patches.repeat(8, axis=1).repeat(8, axis=2)[:, :rows, :columns]
        scans = [k for k, name in enumerate(config.channels) if name.startswith("lidar_")]
        if scans:  # as sparse as scans are, and never negative
            blocks[scans] = 127 * (rng.random((len(scans), rows, columns)) < 0.04)
        feeds["raster"] = blocks.astype(np.int8)
        corner = setting.centre - 0.25 * np.array([columns, rows])
        feeds["raster_origin"] = corner.astype(np.float32)
        feeds["raster_resolution"] = np.array([0.5], np.float32)
    if config.stops:
        place = setting.centre + rng.uniform(-40.0, 40.0, (setting.stops, 2))
        yaw = rng.uniform(-np.pi, np.pi, (setting.stops, 1))
        feeds["stops"] = np.concatenate([place, yaw], axis=-1).astype(np.float32)
    return feeds


def edges(setting: SceneSetting | None = None) -> Feeds:
    """Edges of a grid that reaches everywhere, or of a single cell for a scene of a single agent."""
    if setting is not None and setting.agents == 1:
        return {"x_edges": np.array([-5.0, 25.0], np.float32), "y_edges": np.array([-8.0, 8.0], np.float32)}
    ends = (np.array([-1e6]), np.array([1e6]))
    x = np.concatenate([ends[0], np.linspace(-20.0, 60.0, 33), ends[1]])
    y = np.concatenate([ends[0], np.linspace(-25.0, 25.0, 26), ends[1]])
    return {"x_edges": x.astype(np.float32), "y_edges": y.astype(np.float32)}


def forecast_feeds(scenes: dict[str, Feeds]) -> dict[str, Feeds]:
    """Named inputs of forecast.onnx: those of the hyper-network, and a grid for each."""
    return {name: feeds | edges(SCENES.get(name)) for name, feeds in scenes.items()}


def conditions(config: ConditionConfig, rng: np.random.Generator) -> dict[str, Feeds]:
    """Inputs of the condition graph: what the model is meant for and mixtures of it, or just anything."""
    if config.examples:
        known = np.array(config.examples, np.float32)
        mixtures = rng.dirichlet(np.ones(len(known)), size=7) @ known
        values = {"typical": mixtures.astype(np.float32), "single": known[:1], "examples": known}
    else:
        typical = rng.normal(size=(7, config.size)).astype(np.float32)
        values = {
            "typical": typical,
            "single": typical[:1],
            "corners": np.eye(config.size, dtype=np.float32),
            "large": 4.0 * typical,
            "denormal": np.full((2, config.size), DENORMAL, np.float32),
        }
    return {name: {"condition": value} for name, value in values.items()}


def hypernet_feeds(model: Hcnaf) -> dict[str, Feeds]:
    """Named inputs of a model's hyper-network."""
    rng = np.random.default_rng(SEED)
    if isinstance(model.config, ConditionConfig):
        return conditions(model.config, rng)
    assert isinstance(model.config, PomConfig)  # see `exportable`
    return {name: scene(model.config, setting, rng) for name, setting in SCENES.items()}


def thetas(spec: FlowSpec, trained: dict[str, Array]) -> dict[str, Array]:
    """Named theta [B, P]: those of the model, random ones, and random ones pushed to the edges of float32."""
    generator = torch.Generator().manual_seed(SEED)
    random = _random_theta(spec, generator, count=4)
    one = random[:1]
    out = {name: theta.reshape(-1, spec.parameters)[:9] for name, theta in trained.items()}
    out["random"] = random
    out["single"] = one
    out["sharp"] = _first_layer(spec, random, 50.0)
    out["wide"] = _first_layer(spec, random, 0.02)
    out["saturated"] = _biases(spec, random, 40.0)
    out["faint"] = _last_layer(spec, one, 1e-30)
    return out


def _random_theta(spec: FlowSpec, generator: torch.Generator, count: int) -> Array:
    """The standard initialisation, shaken, at random places and scales."""
    plain = replace(spec, weight_norm="none")  # a trained norm's gains are in the trained thetas
    raw = torch.stack([initial_raw(plain, generator) for _ in range(count)])
    raw = raw + 0.3 * torch.randn(raw.shape, generator=generator)
    location = 10.0 * torch.randn(count, spec.dims, generator=generator)
    scale = torch.exp(torch.randn(count, spec.dims, generator=generator))
    with torch.no_grad():
        theta: Array = Emission(plain)(raw, location, scale).numpy()
    return theta


def _group(spec: FlowSpec, index: int) -> slice:
    """Where group `index` of theta lies (0: location; then diagonal, lower, bias of each layer)."""
    start = sum(spec.groups[:index])
    return slice(start, start + spec.groups[index])


def _first_layer(spec: FlowSpec, theta: Array, factor: float) -> Array:
    out = theta.copy()
    for index in (1, 2):
        out[:, _group(spec, index)] *= factor
    return out


def _last_layer(spec: FlowSpec, theta: Array, factor: float) -> Array:
    out = theta.copy()
    out[:, _group(spec, len(spec.groups) - 3)] *= factor
    return out


def _biases(spec: FlowSpec, theta: Array, shift: float) -> Array:
    """Half of the first layer's units far into +1, half into -1."""
    out = theta.copy()
    part = out[:, _group(spec, 3)]
    part += np.where(np.arange(part.shape[1]) % 2, shift, -shift)
    return out


def reach(spec: FlowSpec, theta: Array) -> tuple[Array, Array]:
    """Location and length scale [B, D] of theta [B, P] (m): where first-layer arguments reach 1.5."""
    with torch.no_grad():
        location, stack = split(spec, torch.from_numpy(theta))
        slope = stack[0].diagonal.flatten(2).median(dim=-1).values
    return location.numpy(), (1.5 / slope.clamp(min=1e-6)).clamp(max=1e3).numpy()


def points(spec: FlowSpec, theta: Array, rng: np.random.Generator, count: int = 60) -> Array:
    """Points [B, N, D] for theta [B, P]: around it, in its tails, up to 1e6 m away, at the location, near zero."""
    location, scale = reach(spec, theta)
    unit = rng.normal(size=(len(theta), count, spec.dims))
    near = location[:, None] + scale[:, None] * unit
    tails = [location[:, None] + r * scale[:, None] * unit[:, :6] for r in (4.0, 10.0, 30.0)]
    signs = np.sign(rng.normal(size=(len(theta), 4, spec.dims)))
    mixed = np.concatenate([near[:, :2, :1], signs[:, :2, 1:] * 1e6], axis=-1)  # one coordinate far, one near
    edges = [location[:, None], np.full((len(theta), 1, spec.dims), DENORMAL), mixed]
    return np.concatenate([near, *tails, *(r * signs for r in FAR), *edges], axis=1).astype(np.float32)


def flow_cases(graph: str, spec: FlowSpec, trained: dict[str, Array]) -> dict[str, Feeds]:
    """Named inputs of one of the flow's graphs, for the model's own theta and made-up ones."""
    cases = thetas(spec, trained)
    if graph == "inverse":
        cases = {name: theta for name, theta in cases.items() if name not in STAIRS}
    return {name: flow_feeds(graph, spec, theta) for name, theta in cases.items()}


def flow_feeds(graph: str, spec: FlowSpec, theta: Array) -> Feeds:
    """Inputs of one of the flow's graphs for theta [B, P]."""
    rng = np.random.default_rng(SEED)
    if graph == "cell_mass":
        return {"theta": theta, **_cells(spec, theta, rng)}
    if graph == "inverse":
        return {"theta": theta, "uniform": _uniforms(spec, theta, rng)}
    where = points(spec, theta, rng)
    if graph == "flow":
        return {"theta": theta, "points": where}
    if graph == "marginal_cdf":
        return {"theta": theta, "x": where[..., 0]}
    ends = np.broadcast_to(np.array([-1e6, 1e6], np.float32), (len(theta), 2))
    y = np.sort(np.concatenate([where[:, ::3, 1], ends], axis=-1), axis=-1)
    x = _resolved(spec, theta, where[:, ::4, 0])
    return {"theta": theta, "x": x, "y": np.repeat(y[:, None], x.shape[1], axis=1)}


def _uniforms(spec: FlowSpec, theta: Array, rng: np.random.Generator, count: int = 60) -> Array:
    """u [B, N, D], even in log(u / (1 - u)): farther out x is worth no comparison, as dz/dx is too small."""
    odds = rng.uniform(-5.0, 5.0, (len(theta), count, spec.dims))
    u: Array = (1.0 / (1.0 + np.exp(-odds))).astype(np.float32)
    return u


def _resolved(spec: FlowSpec, theta: Array, x: Array) -> Array:
    """x [B, S] with those replaced at which the image (z_2(-), z_2(+)) of y holds little of the normal mass.

    z_2 carries a float32 error of about 1e-6 and F_2 that error over the mass, in PyTorch as in onnxruntime: where
    the mass is small the two differ by more than a promise could hold, and neither is wrong.
    """
    points = torch.from_numpy(np.stack([x, np.zeros_like(x)], axis=-1))
    with torch.no_grad():
        image = forward(spec, torch.from_numpy(theta), points)
        mass = torch.special.ndtr(image.z_plus[..., 1]) - torch.special.ndtr(image.z_minus[..., 1])
    held = mass.numpy()
    best = np.take_along_axis(x, held.argmax(axis=1)[:, None], axis=1)
    return np.where(held < RESOLVED, best, x)


def _cells(spec: FlowSpec, theta: Array, rng: np.random.Generator, columns: int = 12, nodes: int = 3) -> Feeds:
    """A grid around the first theta: random weights that sum to at most one, as increments of F_1 do."""
    location, scale = reach(spec, theta)
    S = columns * nodes
    x = location[:, :1] + scale[:, :1] * np.linspace(-4.0, 4.0, S)
    x = _resolved(spec, theta, x.astype(np.float32))
    y = location[0, 1] + scale[0, 1] * np.linspace(-5.0, 5.0, 41)
    share = rng.dirichlet(np.ones(S), size=len(theta))
    weight = np.zeros((len(theta), S, columns))
    for c in range(columns):
        weight[:, c * nodes : (c + 1) * nodes, c] = share[:, c * nodes : (c + 1) * nodes]
    doubt = np.roll(weight, nodes, axis=1) - weight
    edges = np.tile(np.concatenate([[-1e6], y, [1e6]]), (len(theta), 1))
    return {
        name: v.astype(np.float32) for name, v in (("x", x), ("weight", weight), ("doubt", doubt), ("y", edges))
    }
