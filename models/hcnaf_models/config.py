"""What a model is made of, as plain frozen data: it travels in checkpoints and decides every shape.

The paper's ablation conditions C1-C6 are configurations:

    C1  reference history                  actors="none"
    C2  C1 + other actors now              actors="now"
    C3  C1 + other actors' history         actors="history"
    C4  C3 + stop lines                    actors="history", stops=True
    C5  C1 + bird's-eye-view rasters       channels=(...), draw_actors=True
    C6  C4 + bird's-eye-view rasters       all of them
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal

from hcnaf_models.spec import FlowSpec

MAP_CHANNELS = ("drivable", "direction_x", "direction_y", "stop_line", "junction")

Actors = Literal["none", "now", "history"]

HeadKind = Literal["hcnaf", "mixture", "affine", "spline"]
"""The density a model emits: HCNAF, or a baseline in its place (`hcnaf_models.heads`)."""


@dataclass(frozen=True, kw_only=True)
class Crop:
    """The actor-centric window of the encoder: x forward from -behind to ahead, y left within +-side (m)."""

    behind: float = 16.0
    ahead: float = 80.0
    side: float = 32.0
    resolution: float = 1.0

    @property
    def columns(self) -> int:
        return round((self.behind + self.ahead) / self.resolution)

    @property
    def rows(self) -> int:
        return round(2.0 * self.side / self.resolution)


@dataclass(frozen=True, kw_only=True)
class ConditionConfig:
    """A flow whose hyper-network is an MLP over a vector of `size` numbers (toy distributions).

    Args:
        hidden: widths of the hidden layers; the last one is the rank of the head. () is linear in the condition.
        location, scale: units of the flow, one number for all dimensions.
        slope: how steep the first layer's units are to start with, per scale; about H / 6 suits many modes.
        examples: conditions it is meant for, each of `size` numbers. Exports are checked at these and between
            them; far from them an MLP may emit anything.
    """

    flow: FlowSpec = field(default_factory=FlowSpec)
    size: int = 1
    names: tuple[str, ...] = ()
    hidden: tuple[int, ...] = (64,)
    location: float = 0.0
    scale: float = 1.0
    slope: float = 1.5
    examples: tuple[tuple[float, ...], ...] = ()
    kind: Literal["condition"] = "condition"

    def __post_init__(self) -> None:
        if any(len(example) != self.size for example in self.examples):
            raise ValueError(f"examples of a condition must have {self.size} numbers each")


@dataclass(frozen=True, kw_only=True)
class PomConfig:
    """A planar flow whose hyper-network reads a scene (paper: figure 5).

    Args:
        history: history rows, the last one is now. step: seconds between them.
        horizon: longest horizon (s); horizons lie in (0, horizon].
        actors: what is known of the others. max_actors: how many of the nearest are read.
        stops: read the nearest `max_stops` stop lines.
        channels: raster channels the encoder reads, () for no encoder.
        draw_actors: also draw the `max_drawn` nearest boxes into the encoder's window, now and at the first row.
        reference_size, actors_size, map_size, time_size: widths of the parts' outputs.
        widths: channels of the encoder's stages. trunk: widths of the joint MLP; the last is the heads' rank.
        spread: base scale per dimension, s(t) = a + b t + c t^2 with t in seconds.
        head: the density emitted.
    """

    flow: FlowSpec = field(default_factory=FlowSpec)
    history: int = 10
    step: float = 0.1
    horizon: float = 4.0
    actors: Actors = "none"
    max_actors: int = 4
    stops: bool = False
    max_stops: int = 4
    channels: tuple[str, ...] = MAP_CHANNELS
    draw_actors: bool = True
    max_drawn: int = 12
    crop: Crop = field(default_factory=Crop)
    reference_size: int = 24
    actors_size: int = 18
    map_size: int = 64
    time_size: int = 10
    widths: tuple[int, ...] = (16, 32, 48, 64)
    trunk: tuple[int, ...] = (128, 64)
    spread: tuple[float, float, float] = (0.3, 0.4, 0.3)
    head: HeadKind = "hcnaf"
    kind: Literal["pom"] = "pom"

    def __post_init__(self) -> None:
        if self.flow.dims != 2:
            raise ValueError(f"an occupancy map needs a flow of 2 dimensions, found {self.flow.dims}")
        if self.draw_actors and not self.channels:
            raise ValueError("draw_actors needs an encoder: name at least one raster channel")


@dataclass(frozen=True, kw_only=True)
class HistoryConfig:
    """A planar density whose hyper-network reads a track of positions and nothing else (pedestrians).

    Args:
        history: history rows, the last one is now. step: seconds between them.
        horizon: longest horizon (s); horizons lie in (0, horizon].
        trunk: widths of the MLP that reads a history once. rank: features per horizon, the heads' rank.
        dropout: share of features dropped in training, after every layer of the trunk.
        spread: base scale per dimension, s(t) = a + b t + c t^2 with t in seconds.
        head: the density emitted.
    """

    flow: FlowSpec = field(default_factory=FlowSpec)
    history: int = 8
    step: float = 0.4
    horizon: float = 4.8
    trunk: tuple[int, ...] = (256, 256)
    rank: int = 64
    dropout: float = 0.1
    spread: tuple[float, float, float] = (0.02, 0.15, 0.0)
    head: HeadKind = "hcnaf"
    kind: Literal["history"] = "history"

    def __post_init__(self) -> None:
        if self.flow.dims != 2:
            raise ValueError(f"positions need a flow of 2 dimensions, found {self.flow.dims}")
        if self.history < 3 or not 0.0 <= self.dropout < 1.0:
            raise ValueError(
                f"history must be at least 3 (found {self.history}), dropout in [0, 1) (found {self.dropout})"
            )


ModelConfig = ConditionConfig | PomConfig | HistoryConfig


def to_dict(config: ModelConfig) -> dict[str, Any]:
    """Plain dicts, lists and numbers, fit for a checkpoint loaded with weights_only."""
    return asdict(config)


def from_dict(data: dict[str, Any]) -> ModelConfig:
    """The configuration that `to_dict` wrote. Raises ValueError for an unknown kind or key."""
    kinds: dict[str, type[ModelConfig]] = {
        "condition": ConditionConfig,
        "pom": PomConfig,
        "history": HistoryConfig,
    }
    kind = data.get("kind")
    if kind not in kinds:
        raise ValueError(f"model kind must be one of {sorted(kinds)}, found {kind!r}")
    config: ModelConfig = _build(kinds[kind], data)
    return config


def _build(cls: type[Any], data: dict[str, Any]) -> Any:
    known = {f.name for f in fields(cls)}
    if unknown := sorted(set(data) - known):
        raise ValueError(f"unknown keys {unknown} for {cls.__name__}, known are {sorted(known)}")
    nested = {"flow": FlowSpec, "crop": Crop}
    values = {}
    for key, value in data.items():
        if key in nested and isinstance(value, dict):
            value = _build(nested[key], value)
        values[key] = _frozen(value)
    return cls(**values)


def _frozen(value: Any) -> Any:
    """Lists as tuples, all the way down."""
    return tuple(_frozen(v) for v in value) if isinstance(value, (list, tuple)) else value
