"""Training recipes: TOML files, read strictly into frozen data.

    recipe.toml ── read_recipe ──> PomRecipe | ToyRecipe | ... ── run_training ──> run directory

Shipped recipes are found by name (`shipped()` lists them), others by path. Every key is checked: an unknown
one is refused, naming it and what is known, since a misspelt setting that is ignored costs hours.
"""

from __future__ import annotations

import dataclasses
import tomllib
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import msgspec

from hcnaf_models.config import MAP_CHANNELS, ConditionConfig, Crop, HistoryConfig, PomConfig
from hcnaf_models.spec import FlowSpec
from hcnaf_models.wide_config import WideConfig
from hcnaf_runtime.errors import RecipeError

_NESTED: dict[str, type[Any]] = {"flow": FlowSpec, "crop": Crop}


class Optimiser(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Adam with decoupled weight decay, linear warm-up, cosine decay and an average of the weights.

    Attributes:
        steps: length of the run and of the schedule.
        minutes: training time after which the run ends, whatever the steps; 0 for no limit. The schedule follows
            whichever of the two limits comes first, so that it always ends at its lowest rate.
        batch: windows, or toy samples per condition, in a step.
        learning_rate: the highest rate. warm_up: steps to reach it. final: last rate as a share of the highest.
        weight_decay: on matrices and kernels, not on biases and gains.
        units_first: so many first steps train the flow's location and scale alone, so that its shape is not spent
            on what they say more simply (and carry over better to unseen conditions).
        units_rate: the highest rate meanwhile.
        clip: largest gradient norm.
        average: decay of the exponential average of the weights that is scored and exported.
        validate_every: steps between validations.
        patience: bad steps (loss or gradient not finite) in a row that end the run.
        precision: float32, or on CUDA devices bfloat16 or float16 for the networks that read the scene; the flow
            is in float32 always.
    """

    steps: int
    minutes: float = 0.0
    batch: int = 256
    learning_rate: float = 1e-3
    warm_up: int = 100
    final: float = 0.01
    weight_decay: float = 0.0
    units_first: int = 0
    units_rate: float = 1e-2
    clip: float = 1.0
    average: float = 0.999
    validate_every: int = 500
    patience: int = 20
    precision: Literal["float32", "bfloat16", "float16"] = "float32"

    def __post_init__(self) -> None:
        whole = {"steps": self.steps, "batch": self.batch, "validate_every": self.validate_every}
        low = {name: value for name, value in whole.items() if value < 1}
        if low or self.learning_rate <= 0.0 or self.clip <= 0.0 or not 0.0 <= self.average < 1.0:
            raise ValueError(
                f"steps, batch and validate_every must be at least 1 (found {low or 'that'}), learning_rate and "
                f"clip above 0 (found {self.learning_rate}, {self.clip}), average in [0, 1) (found {self.average})"
            )


class Windows(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How training windows are made from tracks.

    Attributes:
        horizons: horizons drawn per window, uniformly over (0, longest].
        draws: draws of the label noise per horizon.
        neighbours: how many of the nearest others are given to the hyper-network.
        shift: windows are moved in time by up to so many steps, where the track allows.
        redraw: draw the perception noise of histories anew each time instead of using the recorded one.
        no_map: share of windows without any map channel, in half of them without a raster at all.
        no_channel: share of windows without a channel, for each channel of `optional`; a bundle takes scenes that
            lack these. short_map: share of windows whose raster ends within
            `map_reach` metres of a point up to `map_shift` metres away, as a vehicle's own map does.
        lone: share of windows without neighbours.
        validation: windows of the validation set that are scored (0: all).
    """

    horizons: int = 8
    draws: int = 2
    neighbours: int = 16
    shift: int = 4
    redraw: bool = True
    no_map: float = 0.1
    no_channel: float = 0.05
    optional: tuple[str, ...] = MAP_CHANNELS
    short_map: float = 0.5
    map_reach: float = 80.0
    map_shift: float = 60.0
    lone: float = 0.02
    validation: int = 2000


class Samples(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Toy data. `validation`: samples per condition that a validation scores."""

    validation: int = 20_000


class PedestrianTracks(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How training windows are made from ETH/UCY recordings.

    Attributes:
        split: the split that is held out for tests: eth, hotel, univ, zara1 or zara2.
        validation: whole recordings that choose the best weights; those that are tested on are left out.
        horizons: horizons drawn per window, of twelve.
        noise: standard deviation of what is added to labels (m), in training and validation. Annotations repeat
            and interpolate positions: without it the likelihood of labels has no upper bound.
        stretch: tracks grow by a random factor within exp(+-stretch).
        roughness: half of the tracks get noise at all their positions, whose standard deviation lies between 3 mm
            and this (m): recordings differ in how smooth their annotations are.
        compile: train through torch.compile where there is a C++ compiler: the same function, faster.
    """

    split: str = "zara1"
    validation: tuple[str, ...] = ("crowds_zara03", "uni_examples")
    horizons: int = 4
    noise: float = 0.01
    stretch: float = 0.2
    roughness: float = 0.0
    compile: bool = False

    def __post_init__(self) -> None:
        if not 1 <= self.horizons <= 12 or min(self.noise, self.stretch) < 0.0 or 0.0 != self.roughness < 0.003:
            raise ValueError(
                f"horizons must be 1 to 12 (found {self.horizons}), noise and stretch 0 or more (found "
                f"{self.noise}, {self.stretch}), roughness 0 or at least 0.003 (found {self.roughness})"
            )


class Episodes(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How training batches are made from PRECOG-CARLA episodes.

    Attributes:
        noise: standard deviation of what is added to labels (m), in training and validation. 0.5 m is what the
            published code adds, 0.01 of metres / 50; PRECOG adds 0.01 m.
        draws: draws of it per horizon.
        horizons: future rows drawn per episode, of those within the model's horizon.
        thin: in training every episode loses a share of its overhead pixels, drawn evenly from 0 to this: scans of
            one place differ more than a small set of episodes shows.
        validation: episodes of the validation split that are scored (0: all).
    """

    noise: float = 0.5
    draws: int = 10
    horizons: int = 8
    thin: float = 0.0
    validation: int = 2000


class PomRecipe(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Occupancy forecasts from tracks and maps."""

    name: str
    about: str
    task: Literal["pom"]
    optimiser: Optimiser
    model: PomConfig = PomConfig()
    windows: Windows = Windows()
    seed: int = 0


class PrecogRecipe(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Forecasts of the player of PRECOG-CARLA episodes. `model.step` is the time between the files' rows (s)."""

    name: str
    about: str
    task: Literal["precog"]
    optimiser: Optimiser
    model: PomConfig = PomConfig()
    episodes: Episodes = Episodes()
    seed: int = 0


class ToyRecipe(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A toy distribution with a known density."""

    name: str
    about: str
    task: Literal["toy1", "toy2"]
    optimiser: Optimiser
    model: ConditionConfig
    samples: Samples = Samples()
    seed: int = 0


class TrackRecipe(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Forecasts from a pedestrian's track alone."""

    name: str
    about: str
    task: Literal["eth-ucy"]
    optimiser: Optimiser
    model: HistoryConfig = HistoryConfig()
    tracks: PedestrianTracks = PedestrianTracks()
    seed: int = 0


class MnistRecipe(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The density of MNIST's images under their class.

    Attributes:
        units: training images that location, scale and quantiles are taken from, to start with.
        validation: validation images that are scored.
        drop: share of what a pixel hears from earlier ones that is left out at random in training.
    """

    name: str
    about: str
    task: Literal["mnist"]
    optimiser: Optimiser
    model: WideConfig = WideConfig()
    units: int = 10_000
    validation: int = 10_000
    drop: float = 0.0
    seed: int = 0


PlanarRecipe = PomRecipe | PrecogRecipe | ToyRecipe | TrackRecipe
Recipe = PlanarRecipe | MnistRecipe

_TASKS: dict[str, type[Any]] = {
    "pom": PomRecipe,
    "precog": PrecogRecipe,
    "toy1": ToyRecipe,
    "toy2": ToyRecipe,
    "eth-ucy": TrackRecipe,
    "mnist": MnistRecipe,
}

_MODELS: dict[type[Any], type[Any]] = {
    PomRecipe: PomConfig,
    PrecogRecipe: PomConfig,
    ToyRecipe: ConditionConfig,
    TrackRecipe: HistoryConfig,
    MnistRecipe: WideConfig,
}


def shipped() -> tuple[str, ...]:
    """Names of the recipes that come with the package."""
    folder = resources.files("hcnaf_export") / "recipes"
    return tuple(sorted(f.name[: -len(".toml")] for f in folder.iterdir() if f.name.endswith(".toml")))


def read_recipe(source: str | Path) -> Recipe:
    """The recipe of a shipped name or of a file.

    Raises:
        RecipeError: no such recipe, not TOML, or an unknown or impossible setting.
    """
    path = Path(source)
    if str(source) in shipped():
        text = (resources.files("hcnaf_export") / "recipes" / f"{source}.toml").read_text(encoding="utf-8")
    elif path.is_file():
        text = path.read_text(encoding="utf-8", errors="replace")
    else:
        names = ", ".join(shipped())
        raise RecipeError(f"no recipe {str(source)!r}; give the path of a TOML file or one of {names}")
    return parse_recipe(text, str(source))


def parse_recipe(text: str, source: str = "recipe") -> Recipe:
    """The recipe in a TOML text; `source` names it in messages. Raises RecipeError as `read_recipe` does."""
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise RecipeError(f"{source} is not TOML: {error}; see the shipped recipes") from error
    return from_plain(data, source)


def from_plain(data: dict[str, Any], source: str = "recipe") -> Recipe:
    """The recipe that `to_plain` wrote. Raises RecipeError as `read_recipe` does."""
    task = data.get("task")
    if not isinstance(task, str) or task not in _TASKS:
        raise RecipeError(f"{source}: task is {task!r}, expected one of {', '.join(sorted(_TASKS))}")
    kind = _TASKS[task]
    _refuse_unknown(data, kind, source, "")
    try:
        recipe: Recipe = msgspec.convert(data, kind)
    except msgspec.ValidationError as error:
        raise RecipeError(f"{source}: {error}") from error
    return recipe


def to_plain(recipe: Recipe) -> dict[str, Any]:
    """Plain dicts, lists, strings and numbers, defaults included, fit for a checkpoint."""
    plain: dict[str, Any] = msgspec.to_builtins(recipe)
    # msgspec leaves out those settings of a dataclass that were never given.
    return {**plain, "model": dataclasses.asdict(recipe.model)}


def to_toml(recipe: Recipe) -> str:
    """The whole recipe, defaults included, as TOML that `parse_recipe` reads back to an equal recipe."""
    lines: list[str] = []
    _write_table(lines, "", to_plain(recipe))
    return "\n".join(lines).lstrip("\n") + "\n"


def _write_table(lines: list[str], path: str, table: dict[str, Any]) -> None:
    if path:
        lines += ["", f"[{path}]"]
    lines += [f"{key} = {_toml(value)}" for key, value in table.items() if not isinstance(value, dict)]
    for key, value in table.items():
        if isinstance(value, dict):
            _write_table(lines, f"{path}.{key}" if path else key, value)


def _toml(value: Any) -> str:
    """Strings, booleans, numbers and lists look in TOML as in JSON (control characters included)."""
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_toml(item) for item in value) + "]"
    return msgspec.json.encode(value).decode()


def _refuse_unknown(data: dict[str, Any], kind: type[Any], source: str, path: str) -> None:
    known = _fields(kind)
    for key, value in data.items():
        if key not in known:
            names = ", ".join(sorted(known))
            raise RecipeError(f"{source}: unknown key {path + key!r}, expected one of {names}; mend or remove it")
        if isinstance(value, dict) and known[key] is not None:
            _refuse_unknown(value, known[key], source, f"{path}{key}.")


def _fields(kind: type[Any]) -> dict[str, Any]:
    """Field names, each with the class of its table or None."""
    tables: dict[str, Any] = dict(_NESTED)
    tables |= {"optimiser": Optimiser, "windows": Windows, "samples": Samples, "tracks": PedestrianTracks}
    tables["episodes"] = Episodes
    tables["model"] = _MODELS.get(kind)
    if issubclass(kind, msgspec.Struct):
        names: tuple[str, ...] = kind.__struct_fields__
    else:
        names = tuple(field.name for field in dataclasses.fields(kind))
    return {name: tables.get(name) for name in names}
