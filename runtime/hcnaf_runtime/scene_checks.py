"""What a scene's fields must look like: dtypes, shapes, limits and values, each checked in one place.

Every function here raises SceneError with one line: the field, what was found, what is expected.
"""

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from hcnaf_runtime.errors import SceneError

if TYPE_CHECKING:
    from hcnaf_runtime.scene import Scene

Array = npt.NDArray[Any]
Mask = npt.NDArray[np.bool_]

KINDS = ("unknown", "vehicle", "pedestrian", "cyclist", "static")
"""Names of `Scene.kind`, by index."""

UNIT_TOLERANCE = 0.01
"""How far sin² + cos² may be from 1: well above float32 and rounding to three digits."""

_AGENTS, _HISTORY, _FUTURE, _CHANNELS, _PIXELS, _STOPS = 4096, 1000, 1000, 64, 4096, 65536

# dtype, symbols of the shape (numbers are exact), largest shape
SPECS: dict[str, tuple[str, tuple[str | int, ...], tuple[int, ...]]] = {
    "past": ("float32", ("N", "T", 5), (_AGENTS, _HISTORY, 5)),
    "size": ("float32", ("N", 2), (_AGENTS, 2)),
    "kind": ("uint8", ("N",), (_AGENTS,)),
    "target": ("int64", ("A",), (_AGENTS,)),
    "raster": ("int8", ("C", "H", "W"), (_CHANNELS, _PIXELS, _PIXELS)),
    "origin": ("float32", (2,), (2,)),
    "stops": ("float32", ("S", 3), (_STOPS, 3)),
    "future": ("float32", ("N", "F", 2), (_AGENTS, _FUTURE, 2)),
}
SCALARS = ("resolution", "step")
TEXTS = {"channels": 1, "frame": 0}  # and their number of axes
_MAX_TEXT_BYTES = 1 << 16


def check_header(name: str, dtype: np.dtype[Any], shape: tuple[int, ...]) -> None:
    """Refuse unknown fields, wrong types and oversized arrays from the header alone."""
    if name in SPECS:
        _check_type(name, dtype, shape)
    elif name in SCALARS or name == "version":
        if shape != () or dtype.kind not in "iuf":
            raise SceneError(f"{name} is {dtype} {list(shape)}, expected one number")
    elif name in TEXTS:
        _check_text(name, dtype, shape)
    else:
        raise SceneError(f"field '{name}' is unknown; expected only the fields of docs/scene.md")


def _check_text(name: str, dtype: np.dtype[Any], shape: tuple[int, ...]) -> None:
    # numpy writes an empty list of names as float64 [0].
    if len(shape) != TEXTS[name] or (dtype.kind != "U" and shape != (0,)):
        raise SceneError(f"{name} is {dtype} {list(shape)}, expected text")
    if dtype.itemsize * math.prod(shape) > _MAX_TEXT_BYTES:
        raise SceneError(f"{name} has more than {_MAX_TEXT_BYTES} bytes, expected names")


def _check_type(name: str, dtype: np.dtype[Any], shape: tuple[int, ...]) -> None:
    expected, symbols, largest = SPECS[name]
    fits = len(shape) == len(symbols) and all(
        isinstance(s, str) or s == n for s, n in zip(symbols, shape, strict=True)
    )
    if dtype != np.dtype(expected) or not fits:
        wanted = f"{expected} [{', '.join(map(str, symbols))}]"
        raise SceneError(f"{name} is {dtype} {list(shape)}, expected {wanted}")
    if any(n > limit for n, limit in zip(shape, largest, strict=True)):
        raise SceneError(f"{name} has the shape {list(shape)}, expected at most {list(largest)}")


def names(channels: Any) -> tuple[str, ...]:
    if isinstance(channels, str) or not all(isinstance(c, str) for c in channels):
        raise SceneError("channels is not a list of names, expected one str per raster channel")
    names = tuple(channels)
    twice = next((c for c in names if names.count(c) > 1), None)
    if twice is not None:
        raise SceneError(f"channels names '{twice}' twice, expected every name once")
    return names


def positive(name: str, value: Any) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise SceneError(f"{name} is a {type(value).__name__}, expected a positive number") from None
    if not (np.isfinite(number) and number > 0):
        raise SceneError(f"{name} is {number}, expected a positive number")
    return number


def array(name: str, value: Any) -> npt.NDArray[Any]:
    if not isinstance(value, np.ndarray):
        raise SceneError(f"{name} is {describe(value)}, expected a numpy array of {SPECS[name][0]}")
    _check_type(name, value.dtype, value.shape)
    return locked_copy(value)


def describe(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {list(value.shape)}"
    return f"a {type(value).__name__}"


def locked_copy(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """A contiguous read-only array; one that is both already is used as it is."""
    if array.flags.writeable or not array.flags.c_contiguous:
        array = np.array(array, order="C")
        array.setflags(write=False)
    return array


def check_extents(scene: "Scene") -> None:
    agents, rows, _ = scene.past.shape
    if agents == 0 or rows == 0:
        raise SceneError(f"past is {describe(scene.past)}: no observed agent, expected at least one")
    for name in ("size", "kind", "future"):
        value = getattr(scene, name)
        if value is not None and len(value) != agents:
            raise SceneError(f"{name} has {len(value)} rows, expected one for each of past's {agents} agents")
    if len(scene.channels) != len(scene.raster):
        raise SceneError(f"raster has {len(scene.raster)} channels, channels has {len(scene.channels)} names")
    if scene.raster.size == 0 and len(scene.raster):
        raise SceneError(f"raster is {describe(scene.raster)}, expected at least one pixel per channel")


def check_values(scene: "Scene") -> None:
    observed = _check_past(scene.past)
    if not observed[:, -1].any():
        raise SceneError("past has no observed agent: every current row is NaN, expected at least one")
    _check_targets(scene.target, observed[:, -1])
    _check_rows("size", scene.size, np.isfinite(scene.size) & (scene.size > 0), "finite and positive numbers (m)")
    _check_rows("kind", scene.kind, scene.kind < len(KINDS), f"an index below {len(KINDS)} (scene.KINDS)")
    _check_rows("origin", scene.origin, np.isfinite(scene.origin), "finite numbers (m)")
    _check_rows("stops", scene.stops, np.isfinite(scene.stops), "finite numbers")
    if scene.future is not None:
        whole = _whole(np.isfinite(scene.future)) | _whole(np.isnan(scene.future))
        _check_rows("future", scene.future, whole, "finite rows, or rows wholly NaN where unknown")


def _check_rows(name: str, values: npt.NDArray[Any], good: Mask, expected: str) -> None:
    if not good.all():
        index = tuple(int(i) for i in np.argwhere(~good)[0])
        raise SceneError(f"{name}{list(index)} is {values[index].tolist()}, expected {expected}")


def _whole(mask: Mask) -> Mask:
    return np.asarray(mask.all(axis=-1))


def _check_past(past: Array) -> Mask:
    """The observed rows [N, T], once it is known that every row is whole."""
    observed = _whole(np.isfinite(past))
    _check_rows("past", past, observed | _whole(np.isnan(past)), "a finite row, or one wholly NaN if not observed")
    norm = past[..., 2] ** 2 + past[..., 3] ** 2
    unit = np.abs(norm - 1.0) <= UNIT_TOLERANCE
    _check_rows("past", past, unit | ~observed, "sin(yaw)² + cos(yaw)² = 1 in columns 2 and 3")
    return observed


def _check_targets(target: npt.NDArray[np.int64], now: Mask) -> None:
    if len(target) == 0:
        raise SceneError("target is empty: no agent to forecast, expected at least one index")
    outside = (target < 0) | (target >= len(now))
    if outside.any():
        raise SceneError(f"target names agent {target[outside][0]}, expected 0 to {len(now) - 1}")
    if len(np.unique(target)) != len(target):
        raise SceneError(f"target is {target.tolist()}, expected every agent once")
    if not now[target].all():
        lost = target[~now[target]][0]
        raise SceneError(f"past[{lost}, -1] is NaN, expected an observed current state of every target")
