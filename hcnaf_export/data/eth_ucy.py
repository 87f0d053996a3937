"""ETH/UCY pedestrians: eight recordings, the leave-one-scene-out benchmark and its windows.

Positions in metres at 2.5 Hz (0.4 s; the files number frames in tens). A window is one pedestrian present in
20 consecutive frames: 8 observed (3.2 s) and 12 to forecast (4.8 s). Frames that follow each other in the
file but not in time (the recordings have gaps of up to 44 s) are not consecutive here; a window
never spans a gap.
"""

import gzip
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hcnaf_runtime.errors import DataError

Array = NDArray[np.float64]

STEP = 0.4
"""Seconds between the rows of a window."""

OBSERVED, PREDICTED = 8, 12
"""Rows of history (the last is now) and of future."""

RECORDINGS = (
    "biwi_eth", "biwi_hotel", "crowds_zara01", "crowds_zara02", "crowds_zara03",
    "students001", "students003", "uni_examples",
)  # fmt: skip
"""Names of the files, without `.txt.gz` or `.txt`."""

TEST: dict[str, tuple[str, ...]] = {
    "eth": ("biwi_eth",),
    "hotel": ("biwi_hotel",),
    "univ": ("students001", "students003"),
    "zara1": ("crowds_zara01",),
    "zara2": ("crowds_zara02",),
}
"""The benchmark's five splits and the recordings each is tested on; all others train it."""

_FRAME = 10


@dataclass(frozen=True, eq=False, kw_only=True)
class Windows:
    """W windows of one pedestrian each, in the order recording, pedestrian, frame.

    Attributes:
        history: float32 [W, 8, 2] positions in metres, row 7 is now.
        future: float32 [W, 12, 2]; row 0 is 0.4 s after now.
        scene: int64 [W], index in `RECORDINGS`.
        pedestrian: int64 [W], number within the recording.
        frame: int64 [W], the frame number of "now".
    """

    history: NDArray[np.float32]
    future: NDArray[np.float32]
    scene: NDArray[np.int64]
    pedestrian: NDArray[np.int64]
    frame: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.scene)


@dataclass(frozen=True, eq=False, kw_only=True)
class Split:
    """Windows to train on, to validate on and to test on; no recording occurs in two of them."""

    train: Windows
    validation: Windows
    test: Windows


def split(root: str | PathLike[str], name: str, *, validation: Sequence[str] = ()) -> Split:
    """One of the five leave-one-scene-out splits.

    Windows of one recording overlap, so windows drawn from the training recordings do not validate a model:
    name whole recordings to hold out instead.

    Args:
        root: folder with the eight recordings.
        name: a key of `TEST`.
        validation: recordings to take from the training set; without them `Split.validation` is empty.

    Raises:
        DataError: an unknown split, a validation recording that is unknown or tested on, or a file that is
            bad.
    """
    if name not in TEST:
        raise DataError(f"split '{name}'; expected one of {', '.join(TEST)}")
    others = [recording for recording in RECORDINGS if recording not in TEST[name]]
    wrong = [recording for recording in validation if recording not in others]
    if wrong:
        raise DataError(
            f"validation on '{wrong[0]}'; expected training recordings of '{name}': {', '.join(others)}"
        )
    train = [recording for recording in others if recording not in validation]
    return Split(
        train=load(root, train),
        validation=load(root, [recording for recording in others if recording in validation]),
        test=load(root, TEST[name]),
    )


def load(root: str | PathLike[str], recordings: Sequence[str] = RECORDINGS) -> Windows:
    """All windows of the recordings named.

    Raises:
        DataError: an unknown recording, or a file that is missing or bad.
    """
    parts = [_none()] + [
        windows(read_recording(_find(Path(root), name)), RECORDINGS.index(name)) for name in recordings
    ]
    merged = {field: np.concatenate([getattr(part, field) for part in parts]) for field in Windows.__annotations__}
    return Windows(**merged)


def read_recording(path: str | PathLike[str]) -> Array:
    """Read one recording, gzip or plain text: float64 [rows, 4], (frame, pedestrian, x, y), as in the file.

    Raises:
        DataError: a file that cannot be read or does not hold four finite numbers per line.
    """
    path = Path(path)
    try:
        with gzip.open(path, "rt") if path.suffix == ".gz" else path.open("rt") as lines:
            rows = np.array([line.split() for line in lines], dtype=np.float64)
    except (OSError, EOFError, zlib.error, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read ({error}); expected an ETH/UCY recording") from error
    except ValueError as error:
        raise DataError(
            f"{path}: not a table of numbers; expected frame, pedestrian, x, y on every line"
        ) from error
    if rows.ndim != 2 or rows.shape[1] != 4 or not np.isfinite(rows).all():
        raise DataError(
            f"{path}: table of shape {list(rows.shape)}; expected finite columns frame, pedestrian, x, y"
        )
    return rows


def windows(rows: Array, scene: int) -> Windows:
    """Every window of a recording.

    Args:
        rows: float64 [rows, 4] as from `read_recording`, in any order.
        scene: the number to give the recording.

    Raises:
        DataError: a pedestrian that is twice in a frame.
    """
    rows = rows[np.lexsort((rows[:, 0], rows[:, 1]))]
    gap = np.diff(rows[:, 0])
    same = np.diff(rows[:, 1]) == 0
    if (same & (gap == 0)).any():
        raise DataError("recording with a pedestrian twice in one frame; expected one position per frame")
    start = _starts(same & (gap == _FRAME), OBSERVED + PREDICTED)
    track = rows[start[:, None] + np.arange(OBSERVED + PREDICTED)]
    return Windows(
        history=track[:, :OBSERVED, 2:].astype(np.float32),
        future=track[:, OBSERVED:, 2:].astype(np.float32),
        scene=np.full(len(track), scene, dtype=np.int64),
        pedestrian=track[:, 0, 1].astype(np.int64),
        frame=track[:, OBSERVED - 1, 0].astype(np.int64),
    )


def _starts(linked: NDArray[np.bool_], length: int) -> NDArray[np.int64]:
    """Rows that begin a run of `length` rows, each linked to the next."""
    broken = np.concatenate([[0], np.cumsum(~linked)])
    last = len(broken) - length
    return np.flatnonzero(broken[: last + 1] == broken[length - 1 :]) if last >= 0 else np.zeros(0, dtype=np.int64)


def _none() -> Windows:
    return windows(np.zeros((0, 4)), 0)


def _find(root: Path, name: str) -> Path:
    if name not in RECORDINGS:
        raise DataError(f"recording '{name}'; expected one of {', '.join(RECORDINGS)}")
    for path in (root / f"{name}.txt.gz", root / f"{name}.txt"):
        if path.is_file():
            return path
    raise DataError(f"{root}: no {name}.txt.gz; expected a folder with the ETH/UCY recordings")
