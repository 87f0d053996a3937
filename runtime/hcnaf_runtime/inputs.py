"""From a scene to the tensors a bundle's hyper-network takes, and all that must agree between the two."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from hcnaf_runtime.errors import BundleError, HorizonError, SceneError
from hcnaf_runtime.manifest import HorizonRange, Manifest, SceneContract
from hcnaf_runtime.scene import Condition, Scene

Array = npt.NDArray[Any]


@dataclass(frozen=True)
class Feeds:
    """Tensors by name, and what had to be assumed to make them."""

    tensors: dict[str, Array]
    notes: tuple[str, ...] = ()


def condition_feeds(manifest: Manifest, condition: Condition) -> Feeds:
    """The hyper-network's input of a bundle of kind `condition`. Raises SceneError for another width K."""
    contract = manifest.condition
    if contract is None:
        raise SceneError(f"a Condition was given, bundle '{manifest.name}' forecasts scenes; give a Scene")
    found = condition.values.shape[1]
    if found != contract.size:
        names = ", ".join(contract.names)
        raise SceneError(f"condition has {found} values per row, the bundle expects {contract.size} ({names})")
    return Feeds({"condition": condition.values})


def scene_feeds(manifest: Manifest, scene: Scene, horizons: Array) -> Feeds:
    """The hyper-network's inputs for `scene`.

    `horizons` is float32 [T] (s). Raises SceneError for a history of another length or time step and for a
    missing required channel: a converter resamples, the runtime does not guess.
    """
    contract = manifest.scene
    if contract is None:
        raise SceneError(f"a Scene was given, bundle '{manifest.name}' takes conditions; give a Condition")
    _check_history(contract, scene)
    tensors: dict[str, Array] = {
        "past": scene.past,
        "size": scene.size,
        "kind": scene.kind,
        "target": scene.target,
        "stops": scene.stops,
        "horizons": horizons,
    }
    raster, notes = _raster(contract, scene)
    return Feeds(tensors | raster, notes)


def _check_history(contract: SceneContract, scene: Scene) -> None:
    rows = scene.past.shape[1]
    if rows != contract.history:
        raise SceneError(f"past has {rows} rows, the bundle expects {contract.history}; cut or pad it")
    if abs(scene.step - contract.step) > contract.step_tolerance:
        raise SceneError(f"step is {scene.step:g} s, the bundle expects {contract.step:g} s; resample it")


def _raster(contract: SceneContract, scene: Scene) -> tuple[dict[str, Array], tuple[str, ...]]:
    """The channels the graph takes, in its order; absent optional ones are zero and noted."""
    absent = [c for c in contract.channels if c not in scene.channels]
    required = [c for c in absent if c not in contract.optional_channels]
    if required:
        have = ", ".join(scene.channels) or "no channels"
        raise SceneError(f"raster channel '{required[0]}' is missing, found {have}; add it to the scene")
    tensors: dict[str, Array] = {
        "raster": _select(contract, scene),
        "raster_origin": scene.origin,
        "raster_resolution": np.array([scene.resolution], np.float32),
    }
    return tensors, tuple(f"raster channel '{c}' is absent and was taken as 0" for c in absent)


def _select(contract: SceneContract, scene: Scene) -> Array:
    if tuple(contract.channels) == scene.channels:
        return scene.raster
    # A scene without a raster gets a pixel, so that no graph has to crop from nothing.
    height, width = scene.raster.shape[1:] if len(scene.raster) else (1, 1)
    raster = np.zeros((len(contract.channels), height, width), np.int8)
    for k, channel in enumerate(contract.channels):
        if channel in scene.channels:
            raster[k] = scene.raster[scene.channels.index(channel)]
    return raster


def checked_horizons(manifest: Manifest, horizons: Any) -> tuple[float, ...]:
    """Horizons (s) as given, or every whole second the model was trained for.

    Raises HorizonError for one outside the trained range, above `min` up to and including `max`.
    """
    trained = manifest.horizons
    if trained is None:
        raise BundleError(f"bundle '{manifest.name}' has no horizons")
    if horizons is None:
        return _whole_seconds(trained)
    found = np.atleast_1d(np.asarray(horizons, np.float64))
    if found.ndim != 1 or not found.size:
        raise HorizonError(f"horizons has the shape {list(found.shape)}, expected [T] with T >= 1")
    bad = ~((found > trained.min) & (found <= trained.max))
    if bad.any():
        raise HorizonError(
            f"horizon {found[bad][0]:g} s is outside the trained range, "
            f"expected above {trained.min:g} s and up to {trained.max:g} s"
        )
    return tuple(found.tolist())


def _whole_seconds(trained: HorizonRange) -> tuple[float, ...]:
    first = int(trained.min) + 1
    return tuple(float(s) for s in range(first, int(trained.max) + 1)) or (trained.max,)
