"""What the reports of all experiments do with the scores of cells."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


def over_seeds(cells: Sequence[object], field: str) -> Float:
    """The mean of an array of scores over the seeds of a cell."""
    return np.asarray(np.mean([getattr(cell, field) for cell in cells], axis=0))


def band(
    ax: Any,
    seconds: Sequence[float],
    values: Sequence[float],
    errors: Sequence[float],
    *,
    label: str,
    color: Any,
    width: float = 1.5,
) -> None:
    """A line over seconds ahead with its standard error around it."""
    v, e = np.asarray(values), np.asarray(errors)
    ax.plot(seconds, v, label=label, lw=width, color=color)
    ax.fill_between(seconds, v - e, v + e, alpha=0.15, color=color, lw=0)
