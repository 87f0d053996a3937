"""Trajectories from files: when, where and how turned."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hcnaf_runtime.errors import InputError

Float64 = npt.NDArray[np.float64]

MOST = 1_000_000
"""Rows that are read."""

MOST_BYTES = 256 << 20

WOUND = 20.0
"""Yaws beyond (rad) are taken for degrees: nobody turns three times in a few seconds."""

EXPECTED = "expected rows of t, x, y, yaw (s, m, rad)"
_HEAD = "t,x,y,yaw"


def read_trajectories(path: Path) -> tuple[Float64, Float64]:
    """Times [T] (s) and x, y, yaw [K, T, 3] (m, rad) from .csv, .npy, .npz or .json.

    A .csv has one trajectory, a row "t,x,y,yaw" a line. The others hold [T, 4] or [K, T, 4]: the array of a .npy,
    the only array of a .npz or the one named `trajectories`, nested lists in a .json or under that name. A first
    row at t = 0, the present, is left out. Raises InputError, naming the file and what is wrong with it.
    """
    try:
        rows = _read(path)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; {EXPECTED}") from None
    except OSError as e:
        raise InputError(f"{path}: cannot be read ({e.strerror or e})") from e
    except (ValueError, EOFError, TypeError, RecursionError) as e:
        reason = " ".join(str(e).split())[:200]
        raise InputError(f"{path}: not a trajectory ({reason}); {EXPECTED}") from e
    try:
        return _checked(rows)
    except InputError as e:
        raise InputError(f"{path}: {e}") from e


def parse_size(text: str) -> tuple[float, float]:
    """Length and width from "4.6x1.9" (m). Raises InputError."""
    match = re.fullmatch(r"([0-9.]{1,10})x([0-9.]{1,10})", text.strip())
    try:
        if match is None:
            raise ValueError
        size = float(match[1]), float(match[2])
        if min(size) <= 0.0:
            raise ValueError
    except ValueError:
        raise InputError(f"ego size is '{text}', expected LENGTHxWIDTH in metres such as 4.6x1.9") from None
    return size


def parse_agents(text: str | None) -> list[int]:
    """Indices of agents from "0,3"; None is none. Raises InputError."""
    try:
        return [] if text is None else [int(part) for part in text.split(",")]
    except ValueError:
        raise InputError(f"exclude is '{text}', expected numbers of agents such as 0,3") from None


def _read(path: Path) -> npt.NDArray[Any]:
    suffix = path.suffix.lower()
    if path.stat().st_size > MOST_BYTES:
        raise ValueError(f"{path.stat().st_size >> 20} MiB, at most {MOST_BYTES >> 20} are read")
    if suffix == ".npy":
        # Mapped, so that nothing is allocated for a header that claims more than the file holds.
        return np.asarray(np.load(path, mmap_mode="r", allow_pickle=False))
    if suffix == ".npz":
        from hcnaf_runtime.npz import read_npz

        return np.asarray(_named(read_npz(path, InputError)))
    if suffix == ".json":
        found = json.loads(path.read_text(encoding="utf-8"))
        found = _named(found) if isinstance(found, dict) else found
        return np.array(found, dtype=np.float64)
    return _text(path.read_text(encoding="utf-8"))


def _named(arrays: dict[str, Any]) -> Any:
    if "trajectories" in arrays:
        return arrays["trajectories"]
    if len(arrays) != 1:
        raise ValueError(f"holds {', '.join(sorted(arrays)) or 'nothing'}, not one array named trajectories")
    return next(iter(arrays.values()))


def _text(text: str) -> Float64:
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if lines and lines[0].replace(" ", "").lower() == _HEAD:
        lines = lines[1:]
    if len(lines) > MOST:
        raise ValueError(f"{len(lines)} lines, at most {MOST} are read")
    return np.array([[float(cell) for cell in line.split(",")] for line in lines], dtype=np.float64)


def _checked(found: npt.NDArray[Any]) -> tuple[Float64, Float64]:
    if found.dtype.kind not in "fiu":
        raise InputError(f"{found.dtype} instead of numbers; {EXPECTED}")
    rows = found[None] if found.ndim == 2 else found
    if rows.ndim != 3 or rows.shape[-1] != 4 or rows.size == 0 or rows.size > 4 * MOST:
        raise InputError(f"shape {list(found.shape)}; {EXPECTED}, [T, 4] or [K, T, 4], at most {MOST} rows")
    rows = rows.astype(np.float64)
    if not np.isfinite(rows).all():
        raise InputError("NaN or infinity among the numbers; leave such rows out")
    times = rows[0, :, 0]
    if not (rows[..., 0] == times).all():
        raise InputError("trajectories have rows at different times; give all of them the same")
    if not (np.diff(times) > 0.0).all():
        raise InputError("times do not ascend; order the rows by t, each t once")
    if np.abs(rows[..., 3]).max() > WOUND:
        raise InputError(f"a yaw of {np.abs(rows[..., 3]).max():g}, expected radians")
    first = 1 if times[0] == 0.0 and len(times) > 1 else 0
    return times[first:], rows[:, first:, 1:]
