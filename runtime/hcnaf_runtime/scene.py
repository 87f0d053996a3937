"""The scene: what the vehicle knows at "now", and the only input the runtime takes.

Everything is in one right-handed frame (x forward, y left, yaw counter-clockwise): metres, seconds, radians.
"""

import os
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from hcnaf_runtime import scene_checks as checks
from hcnaf_runtime.errors import SceneError
from hcnaf_runtime.npz import read_npz, write_npz
from hcnaf_runtime.scene_checks import KINDS as KINDS

Float32 = npt.NDArray[np.float32]

VERSION = 1
"""Version of the scene file this release reads and writes."""

_REQUIRED = ("past", "size", "kind", "target", "step")


def _no_raster() -> npt.NDArray[np.int8]:
    return np.zeros((0, 0, 0), np.int8)


def _no_offset() -> Float32:
    return np.zeros(2, np.float32)


def _no_stops() -> Float32:
    return np.zeros((0, 3), np.float32)


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """Agents' past states, the map around them, and which agents to forecast.

    Arrays are copied and made read-only; a scene compares and hashes by identity. Raises SceneError, naming
    the field, what was found and what is expected, for a wrong dtype, shape or value.
    """

    past: Float32
    """[N, T, 5]: x, y (m), sin(yaw), cos(yaw), speed (m/s) of each box centre. Row T-1 is now; a NaN row was
    not observed. The current row of every target must be observed."""
    size: Float32
    """[N, 2]: length and width of each box (m)."""
    kind: npt.NDArray[np.uint8]
    """[N]: index in KINDS."""
    target: npt.NDArray[np.int64]
    """[A]: the agents to forecast, at least one, each once."""
    step: float
    """Time between two rows of `past` (s)."""
    raster: npt.NDArray[np.int8] = field(default_factory=_no_raster)
    """[C, H, W]: map and sensor channels, value/127 in [-1, 1]; row 0 is the lowest y, column 0 the lowest
    x. [0, 0, 0] where there is none."""
    channels: tuple[str, ...] = ()
    """The C names of the raster's channels, each once."""
    origin: Float32 = field(default_factory=_no_offset)
    """[2]: x, y of the raster's lower-left corner (m)."""
    resolution: float = 0.5
    """Size of a raster pixel (m)."""
    stops: Float32 = field(default_factory=_no_stops)
    """[S, 3]: stop lines as x, y (m) and yaw (rad) of the traffic that must stop there."""
    frame: str = "map"
    """Name of the frame."""
    future: Float32 | None = None
    """[N, F, 2] or None: ground-truth x, y (m); row 0 is one step after now, NaN where unknown."""

    version: ClassVar[int] = VERSION

    def __post_init__(self) -> None:
        object.__setattr__(self, "channels", checks.names(self.channels))
        for name in checks.SCALARS:
            object.__setattr__(self, name, checks.positive(name, getattr(self, name)))
        if not isinstance(self.frame, str):
            raise SceneError(f"frame is a {type(self.frame).__name__}, expected the frame's name as a str")
        for name in checks.SPECS:
            if name != "future" or self.future is not None:
                object.__setattr__(self, name, checks.array(name, getattr(self, name)))
        checks.check_extents(self)
        checks.check_values(self)

    @property
    def pose(self) -> npt.NDArray[np.float64]:
        """[A, 3]: x, y (m) and yaw (rad) of each target now, in the scene frame."""
        now = self.past[self.target, -1].astype(np.float64)
        return np.column_stack([now[:, 0], now[:, 1], np.arctan2(now[:, 2], now[:, 3])])

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the scene as an .npz file; either all of it appears or nothing does."""
        arrays: dict[str, Any] = {"version": VERSION}
        arrays |= {f.name: getattr(self, f.name) for f in fields(self)}
        arrays["channels"] = np.array(self.channels, dtype=np.str_)
        if self.future is None:
            del arrays["future"]
        write_npz(path, arrays)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "Scene":
        """Read a scene from an .npz file. Raises SceneError for anything else, before allocating it."""
        _check_version(path)
        arrays = read_npz(path, SceneError, checks.check_header)
        missing = [name for name in _REQUIRED if name not in arrays]
        if missing:
            raise SceneError(f"{path}: field '{missing[0]}' is missing; see docs/scene.md for the fields")
        del arrays["version"]
        try:
            return cls(**{name: _plain(name, value) for name, value in arrays.items()})
        except SceneError as e:
            raise SceneError(f"{path}: {e}") from e


@dataclass(frozen=True, eq=False)
class Condition:
    """The input of a bundle of kind `condition`: `values` float32 [A, K], finite, one row per condition."""

    values: Float32

    def __post_init__(self) -> None:
        found = self.values
        if not (isinstance(found, np.ndarray) and found.dtype == np.float32 and found.ndim == 2 and len(found)):
            raise SceneError(f"condition is {checks.describe(found)}, expected a non-empty float32 [A, K]")
        if not np.isfinite(found).all():
            raise SceneError("condition holds NaN or infinity, expected finite numbers")
        object.__setattr__(self, "values", checks.locked_copy(found))


def _check_version(path: str | os.PathLike[str]) -> None:
    """Refuse another version before its fields, which may be new, are looked at."""
    found = read_npz(path, SceneError, only="version").get("version")
    if found is None:
        raise SceneError(f"{path}: no field 'version'; expected a scene of version {VERSION}")
    if found.shape != () or found.dtype.kind not in "iu":
        raise SceneError(f"{path}: version is {checks.describe(found)}, expected one integer")
    if found != VERSION:
        raise SceneError(f"{path}: scene version {found}, only {VERSION} is read; update hcnaf or convert again")


def _plain(name: str, value: npt.NDArray[Any]) -> Any:
    if name == "channels":
        return tuple(str(v) for v in value)
    if name == "frame":
        return str(value)
    return float(value) if name in checks.SCALARS else value
