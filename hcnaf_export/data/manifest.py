"""What a simulated data set says about itself: its `dataset.json`."""

import math
from pathlib import Path
from typing import Any, Literal

import msgspec

from hcnaf_runtime.errors import DataError

Split = Literal["train", "val", "test"]

FORMAT = "hcnaf-tracks"
VERSION = 1


class SetEntry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One track set of a data set: file name, what the network is, and what it holds."""

    file: str
    network: str
    windows: int
    tracks: int
    rows: int


class NoiseModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The noise recorded with the tracks: standard deviations, and how detections drop out.

    Attributes:
        position: observed x and y, metres.
        yaw: observed yaw, radians.
        speed: observed speed, m/s.
        drop: share of dropped detections.
        drop_length: mean length of a gap, rows (gaps are geometric: a two-state Markov chain).
        label: x and y of the labels, metres.
    """

    position: float = 0.1
    yaw: float = 0.02
    speed: float = 0.2
    drop: float = 0.05
    drop_length: float = 2.0
    label: float = 0.1

    @property
    def label_entropy(self) -> float | None:
        """Entropy of the label noise in nats per m², 1 + log(2 pi label²); None without noise."""
        return 1.0 + math.log(2.0 * math.pi * self.label**2) if self.label > 0.0 else None


class Manifest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The `dataset.json` of a data set.

    Attributes:
        format, version: FORMAT and VERSION.
        seed: of the simulation.
        splits: the track sets of each split.
        noise: recorded with the tracks.
        nll_floor: entropy of the label noise (nats per m²): no forecast's expected NLL can lie below it; None
            without label noise.
        step: seconds between rows.
        history: rows of a window's past, now included.
        future: rows of a window's future.
        settings: the simulator's settings, by name.
        software: version of each package the tracks depend on.
    """

    format: str
    version: int
    seed: int
    splits: dict[Split, list[SetEntry]]
    noise: NoiseModel
    nll_floor: float | None
    step: float
    history: int
    future: int
    settings: dict[str, Any]
    software: dict[str, str]


def read_manifest(path: Path) -> Manifest:
    """Read and check a `dataset.json`.

    Raises:
        DataError: missing, malformed, or of another format version.
    """
    try:
        manifest = msgspec.json.decode(path.read_bytes(), type=Manifest)
    except OSError as error:
        raise DataError(f"{path} cannot be read ({error.strerror}); give a directory of hcnaf simulate") from error
    except msgspec.DecodeError as error:
        raise DataError(f"{path} is not a data set manifest ({error}); run hcnaf simulate again") from error
    if (manifest.format, manifest.version) != (FORMAT, VERSION):
        raise DataError(
            f"{path} is {manifest.format} version {manifest.version}, expected {FORMAT} version {VERSION}; "
            "run hcnaf simulate again"
        )
    return manifest
