"""Which agents of a scene take part, and how their boxes are turned: what occupancy and risk have in common."""

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from hcnaf_runtime.encoder import Theta
from hcnaf_runtime.errors import InputError
from hcnaf_runtime.scene import Scene

Float64 = npt.NDArray[np.float64]
Heading = Literal["motion", "present"] | npt.NDArray[Any]
"""Boxes turn as the way to where they are implies, stay as they are now, or have given headings [A, T] (rad)."""


def excluded(exclude: Sequence[int], count: int) -> npt.NDArray[np.int64]:
    """`exclude` as indices of `count` agents. Raises InputError for anything else."""
    found = np.asarray(exclude)
    if found.size == 0:
        return np.empty(0, np.int64)
    if found.ndim != 1 or found.dtype.kind not in "iu" or found.min() < 0 or found.max() >= count:
        raise InputError(f"exclude is {found.tolist()}, expected indices of agents from 0 to {count - 1}")
    return found.astype(np.int64)


def given_headings(heading: Heading, A: int, T: int) -> Float64 | None:
    """Headings [A, T] (rad, scene frame), None where they are named. Raises InputError for anything else."""
    if isinstance(heading, str):
        if heading not in ("motion", "present"):
            raise InputError(f"heading is '{heading}', expected 'motion', 'present' or an array [{A}, {T}] (rad)")
        return None
    found = np.asarray(heading)
    try:
        if found.dtype.kind not in "fiu" or not np.isfinite(found).all():
            raise ValueError
        return np.broadcast_to(found.astype(np.float64), (A, T))
    except ValueError:
        shape = f"{found.dtype} {list(found.shape)}"
        raise InputError(f"heading is {shape}, expected finite numbers [{A}, {T}] (rad)") from None


def at_present_box(
    scene: Scene, theta: Theta, left_out: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.int64], tuple[str, ...]]:
    """Agents [n] that enter at their present box, and what is to be said of those without a forecast.

    They are neither forecast nor `left_out`, and were observed now.
    """
    rest = np.setdiff1d(np.arange(len(scene.past)), np.concatenate([theta.agents, left_out]))
    seen = np.isfinite(scene.past[rest, -1]).all(axis=1)
    notes = []
    if seen.any():
        notes.append(f"agents without a forecast are taken to stay where they are: {_listed(rest[seen])}")
    if not seen.all():
        notes.append(f"agents not observed now are left out: {_listed(rest[~seen])}")
    return rest[seen], tuple(notes)


def _listed(agents: npt.NDArray[np.int64]) -> str:
    return ", ".join(str(i) for i in agents)
