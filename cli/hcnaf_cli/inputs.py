"""What commands are given: scenes, points, horizons."""

from pathlib import Path

import click
import numpy as np
import numpy.typing as npt

from hcnaf_runtime import Scene, embedded_scenes
from hcnaf_runtime.errors import InputError

FIRST = "*"
"""The value of --sample without a name."""

MOST_POINTS = 10_000_000


def open_scene(path: Path | None, sample: str | None) -> tuple[str, Scene]:
    """The scene's name and the scene, from a file or from those that come with the package.

    Raises UsageError for none or both, InputError for an unknown sample, SceneError for a bad file.
    """
    if (path is None) == (sample is None):
        raise click.UsageError("give one scene: a file, or --sample", click.get_current_context())
    if path is None:
        path = _sample(str(sample))
    return path.stem, Scene.load(path)


def _sample(name: str) -> Path:
    scenes = embedded_scenes()
    if not scenes:
        raise InputError("this installation has no sample scenes; name a scene file")
    if name == FIRST:
        return next(iter(scenes.values()))
    if name not in scenes:
        raise InputError(f"no sample scene '{name}'; there are {', '.join(scenes)}")
    return scenes[name]


def parse_horizons(text: str | None) -> list[float] | None:
    """Seconds from "1,2,4"; None stays None. Raises InputError."""
    if text is None:
        return None
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise InputError(f"horizons are '{text}', expected seconds such as 1,2,4") from None


def read_points(path: Path) -> npt.NDArray[np.float64]:
    """Points (m) from a .npy file of any shape [..., D], or [N, D] from a text file with one "x,y" a line.

    Raises InputError for a missing file, another content, or more than MOST_POINTS.
    """
    try:
        points = _read_npy(path) if path.suffix == ".npy" else _read_text(path)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; expected points as .npy or lines of x,y") from None
    except OSError as e:
        raise InputError(f"{path}: cannot be read ({e.strerror or e})") from e
    except (ValueError, EOFError) as e:
        reason = " ".join(str(e).split())[:200]
        raise InputError(f"{path}: not points ({reason}); expected .npy or lines of x,y in metres") from e
    if points.size == 0:
        raise InputError(f"{path}: no points; expected .npy or lines of x,y in metres")
    return points


def _read_npy(path: Path) -> npt.NDArray[np.float64]:
    # Mapped, so that nothing is allocated for a header that claims more than the file holds.
    found = np.load(path, mmap_mode="r", allow_pickle=False)
    if not isinstance(found, np.ndarray) or found.dtype.kind not in "fiu":
        raise ValueError(f"{getattr(found, 'dtype', type(found).__name__)} instead of numbers")
    if found.ndim == 0 or found.size > 2 * MOST_POINTS:
        raise ValueError(f"shape {list(found.shape)}, at most {MOST_POINTS} points are read")
    return found.astype(np.float64)


def _read_text(path: Path) -> npt.NDArray[np.float64]:
    lines = path.read_text(encoding="utf-8").splitlines()
    if len(lines) > MOST_POINTS:
        raise ValueError(f"{len(lines)} lines, at most {MOST_POINTS} points are read")
    if lines and lines[0].replace(" ", "").lower() == "x,y":
        lines = lines[1:]
    rows = [line for line in lines if line.strip() and not line.lstrip().startswith("#")]
    return np.array([[float(cell) for cell in row.split(",")] for row in rows], dtype=np.float64)
