"""The manifest of a bundle: what its files are, what its graphs take and give, and how good it is.

Strict: an unknown key, a missing key or a value of another type is refused with its place in the file.
"""

import os
import re
from pathlib import Path
from typing import Any, Literal

import msgspec

from hcnaf_runtime.errors import BundleError

FORMAT = 1
"""Format of the manifest this release writes and the newest it reads."""
OLDEST_FORMAT = 1
"""The oldest format this release reads."""
FILE = "manifest.json"

GraphName = Literal["hypernet", "flow", "marginal_cdf", "conditional_cdf", "cell_mass", "inverse", "forecast"]
"""The graphs a bundle may hold; the last five exist for two-dimensional flows only, `forecast` for scenes only."""

Precision = Literal["fp32", "fp16", "int8"]
"""What the hyper-network's weights are stored as; the flow is always float32."""

_PLAIN_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
_MAX_BYTES = 16 << 20


class _Strict(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of the parts: immutable, unknown keys refused."""


class Flow(_Strict, frozen=True, kw_only=True):
    """Sizes of the flow: `dims` D, `layers` L (hidden), `hidden` H (units per dimension), `parameters` P."""

    dims: int
    layers: int
    hidden: int
    support: Literal["normalised", "paper"]
    weight_norm: str
    parameters: int


class SceneContract(_Strict, frozen=True, kw_only=True):
    """What a scene must hold for the hyper-network (kind `pom`)."""

    step: float
    """Time between history rows (s)."""
    history: int
    """History rows, now included."""
    channels: list[str]
    """All raster channels the graph takes, in the graph's order; empty if it takes no raster."""
    optional_channels: list[str] = []
    """Those of `channels` that are filled with zeros where a scene lacks them; the others are required."""
    stops: bool = False
    """Whether the graph takes stop lines."""
    step_tolerance: float = 1e-3
    """How far a scene's step may be from `step` (s)."""

    def __post_init__(self) -> None:
        stray = set(self.optional_channels) - set(self.channels)
        if stray:
            raise ValueError(f"optional channel '{min(stray)}' is not among the channels")
        if self.history < 1 or not self.step > 0:
            raise ValueError("history and step must be positive")


class ConditionContract(_Strict, frozen=True, kw_only=True):
    """What a condition must hold (kind `condition`): `size` K numbers, named."""

    size: int
    names: list[str]


class HorizonRange(_Strict, frozen=True, kw_only=True):
    """Horizons the model was trained on (s): above `min`, up to and including `max`."""

    min: float
    max: float


class Tensor(_Strict, frozen=True, kw_only=True):
    """One input or output of a graph. A shape entry is a number, or the name of a size that may vary."""

    name: str
    dtype: str
    shape: list[int | str]
    unit: str
    description: str


class Graph(_Strict, frozen=True, kw_only=True):
    """One .onnx file and its contract."""

    file: str
    inputs: list[Tensor]
    outputs: list[Tensor]


class File(_Strict, frozen=True, kw_only=True):
    """Fingerprint of one file of the bundle: `sha256` in hexadecimal and its size in `bytes`."""

    sha256: str
    bytes: int


class ParityRow(_Strict, frozen=True, kw_only=True):
    """How far one output of an exported graph is from PyTorch, and the two values where it is farthest."""

    graph: str
    output: str
    max_abs: float
    max_rel: float
    rms: float
    worst_index: list[int]
    torch: float
    onnx: float
    tolerance: float
    passed: bool


class Manifest(_Strict, frozen=True, kw_only=True):
    """The whole manifest; `files` names every file of the bundle but the manifest itself."""

    format: int = FORMAT
    name: str
    version: str
    """Version of hcnaf that wrote the bundle."""
    created: str
    """Date and time of the export, ISO 8601."""
    kind: Literal["pom", "condition"]
    flow: Flow
    graphs: dict[GraphName, Graph]
    opset: int
    ir_version: int
    onnxruntime_min: str
    files: dict[str, File]
    scene: SceneContract | None = None
    condition: ConditionContract | None = None
    horizons: HorizonRange | None = None
    parity: list[ParityRow] = []
    training: dict[str, Any] = {}
    scores: dict[str, Any] = {}
    precision: Precision = "fp32"
    precision_cost: dict[str, Any] = {}
    """What a precision below fp32 costs in nats, cell mass and total variation, and saves in bytes."""

    def __post_init__(self) -> None:
        if self.kind == "pom" and (self.scene is None or self.horizons is None):
            raise ValueError("a bundle of kind 'pom' needs 'scene' and 'horizons'")
        if self.kind == "condition" and self.condition is None:
            raise ValueError("a bundle of kind 'condition' needs 'condition'")
        for name in self.files:
            if not _PLAIN_NAME.fullmatch(name):
                raise ValueError(f"file name {name!r} is not a plain name inside the bundle")
        for graph in self.graphs.values():
            if graph.file not in self.files:
                raise ValueError(f"graph file {graph.file!r} is not among the files")


class _Peek(msgspec.Struct):
    """The one key every format has."""

    format: int


def encode(manifest: Manifest) -> bytes:
    """The manifest as indented UTF-8 JSON, ready to be written to manifest.json."""
    # A value that is left at its default is written too: readers in other languages know no defaults.
    return msgspec.json.format(msgspec.json.encode(manifest), indent=2) + b"\n"


def read(path: str | os.PathLike[str]) -> Manifest:
    """The manifest at `path`. Raises BundleError if it is missing, malformed or of a format not read here."""
    data = _read_bounded(Path(path))
    try:
        found = msgspec.json.decode(data, type=_Peek).format
    except msgspec.DecodeError as e:
        raise BundleError(f"{path}: not a manifest ({e}); export the bundle again") from e
    if not OLDEST_FORMAT <= found <= FORMAT:
        raise BundleError(
            f"{path}: bundle format {found} found, formats {OLDEST_FORMAT} to {FORMAT} are read; "
            "update with `pip install --upgrade hcnaf` or export the bundle again"
        )
    try:
        return msgspec.json.decode(data, type=Manifest)
    except msgspec.DecodeError as e:
        raise BundleError(f"{path}: not a manifest of format {found} ({e}); export the bundle again") from e


def _read_bounded(path: Path) -> bytes:
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise BundleError(f"{path}: more than {_MAX_BYTES >> 20} MiB, expected a manifest")
        return path.read_bytes()
    except FileNotFoundError:
        raise BundleError(f"{path}: no such file; expected a bundle directory holding {FILE}") from None
    except OSError as e:
        raise BundleError(f"{path}: cannot be read ({e.strerror or e})") from e
