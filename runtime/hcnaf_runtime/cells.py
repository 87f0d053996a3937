"""Cell masses from the flow's distribution functions F_1(x) and F_2(y given x).

The mass of the cell [x_a, x_b] x [y_a, y_b] is

    integral over [x_a, x_b] of  (F_2(y_b given x) - F_2(y_a given x)) dF_1(x)

exact in y, a quadrature in x (see `quadrature`). A column's cells telescope to its increment of F_1 times
what F_2 leaves inside the window, whatever the quadrature, so a map never loses or invents mass.

Maps are shared out to threads here; `columns` decides which columns are computed and from how many nodes,
`tile_rows` which of their rows, and how.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hcnaf_runtime import pages
from hcnaf_runtime.columns import Columns
from hcnaf_runtime.plane import CHUNK, Distribution, Window

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]

SHARE, SHARES = 128, 8
"""Maps are shared out to threads by so many, in two shares at least and in this many at most."""


@dataclass(frozen=True)
class Cells:
    """Maps of a window."""

    mass: Float32
    """[B, R, C]."""
    inside: Float64
    """[B]: the sum of each map."""
    error: Float64
    """[B]: what the quadrature may miss in the worst cell, as far as refinement can tell."""
    lost: Float64
    """[B]: a bound on the mass inside the window that was left out, itself at most `lost_mass`."""


def masses(
    flow: Distribution,
    theta: Float32,
    window: Window,
    tolerance: float,
    lost_mass: float = 0.0,
    chunk: int = CHUNK,
) -> Cells:
    """The mass of every cell.

    A column is refined until its cells are within `tolerance`, as far as two rules of different order tell.
    Columns and rows are left out while what they hold stays below `lost_mass` per map; with 0 only what float32
    cannot tell from nothing. Memory beyond the result is bounded by `chunk`, whatever the size of the window and
    the number of maps. Results do not depend on how many threads there are.
    """
    mass = pages.empty((len(theta), len(window.y) - 1, len(window.x) - 1))  # each share clears its own
    shares = _shares(window, len(theta))
    parts = [
        Columns(flow, theta[maps], strip, mass[..., columns], maps, tolerance, lost_mass * portion, chunk)
        for maps, strip, columns, portion in shares
    ]
    flow.each(Columns.run, parts)
    inside, error, lost = np.zeros((3, len(theta)))
    for part, (maps, *_) in zip(parts, shares, strict=True):
        inside[maps] += part.inside[:, :-1].sum(axis=1)
        lost[maps] += part.outside[:, :-1].sum(axis=1)
        error[maps] = np.maximum(error[maps], part.error.max(axis=1, initial=0.0))
    return Cells(mass, inside, error, lost)


def _shares(window: Window, maps: int) -> list[tuple[Indices, Window, slice, float]]:
    """What is computed side by side, whatever the number of threads: maps dealt out to and fro, or either half of
    one; with the window, its columns and the portion of the mass that it may lose.

    The further ahead a map is the more there is to do: dealt out in turn, one share would get the later horizons.
    """
    C, index = len(window.x) - 1, np.arange(maps)
    if maps == 1 and C > 1:
        cuts = (slice(0, C // 2), slice(C // 2, C))
        return [(index, Window(window.x[cut.start : cut.stop + 1], window.y), cut, 0.5) for cut in cuts]
    count = int(np.clip(-(-maps // SHARE), 2, SHARES))
    to_and_fro = np.abs((index + count) % (2 * count) - count + 0.5) - 0.5
    return [(index[to_and_fro == k], window, slice(0, C), 1.0) for k in range(min(count, maps))]
