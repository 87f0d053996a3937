"""Occupancy maps as translucent heat and as contours of the regions that hold half and 90 % of the probability.

A cell's tint follows the probability of all cells at least as likely as it: the same share of the probability
looks the same in a narrow map and in a wide one.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from hcnaf_runtime import Maps, frames

Float64 = npt.NDArray[np.float64]

REGIONS = {0.5: 1.4, 0.9: 0.7}
"""Highest-density regions that are outlined: their probability, and the line's width."""

SHOWN = 0.99
"""The share of the probability that is tinted."""

FINER = 4
"""Pixels per cell and axis."""


def density_rank(mass: Float64) -> Float64:
    """The probability of all cells at least as likely as each cell; equal cells share theirs."""
    flat = mass.ravel()
    values, place = np.unique(flat, return_inverse=True)
    totals = np.bincount(place, weights=flat, minlength=len(values))
    above = np.cumsum(totals[::-1])[::-1]
    return np.asarray(above[place].reshape(mass.shape))


def threshold(mass: Float64, share: float) -> float | None:
    """The mass of the least likely cell of the smallest region with probability `share`; None if there is none."""
    found = np.sort(mass.ravel())[::-1]
    total = np.cumsum(found)
    return float(found[np.searchsorted(total, share)]) if total[-1] > share else None


def crop(mass: Float64, share: float) -> tuple[slice, slice]:
    """Rows and columns of the box around the region with `share` of what the map holds, and a cell more."""
    held = mass >= (threshold(mass, share * float(mass.sum())) or 0.0)
    rows, columns = np.flatnonzero(held.any(axis=1)), np.flatnonzero(held.any(axis=0))
    return (
        slice(max(int(rows[0]) - 1, 0), int(rows[-1]) + 2),
        slice(max(int(columns[0]) - 1, 0), int(columns[-1]) + 2),
    )


def refine(mass: Float64) -> Float64:
    """Every cell cut into FINER x FINER, then smoothed over the width of a cell; the sum is kept.

    A margin of one cell is added all around, so that nothing is smoothed away.
    """
    kernel = np.convolve(np.ones(FINER), np.ones(FINER)) / FINER**2
    fine = np.kron(np.pad(mass, 1), np.full((FINER, FINER), 1.0 / FINER**2))
    for axis in (0, 1):
        fine = np.apply_along_axis(np.convolve, axis, fine, kernel, "same")
    return fine


def extent(maps: Maps, agent: int, horizon: int) -> Float64:
    """[4, 2]: the corners (m, scene frame) of the box around what is shown of a map; [0, 2] for an empty one."""
    mass = maps.mass[agent, horizon].astype(np.float64)
    if not mass.any():
        return np.empty((0, 2))
    rows, columns = crop(mass, SHOWN)
    x0, y0 = maps.origin + maps.resolution * np.array([columns.start, rows.start])
    x1, y1 = maps.origin + maps.resolution * np.array([columns.stop, rows.stop])
    return _to_scene(maps, agent, np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]))


def heat(axes: Any, maps: Maps, agent: int, horizon: int, hue: Any) -> None:
    """Lay one map over the scene."""
    from matplotlib.colors import to_rgb
    from matplotlib.transforms import Affine2D

    mass = maps.mass[agent, horizon].astype(np.float64)
    if not mass.any():
        return
    rows, columns = crop(mass, SHOWN)
    fine = refine(mass[rows, columns])
    step = maps.resolution / FINER
    left, low = maps.origin + maps.resolution * (np.array([columns.start, rows.start]) - 1)
    turn = Affine2D()
    if maps.frame == "agent":
        x, y, yaw = maps.pose[agent]
        turn = turn.rotate(yaw).translate(x, y)
    tint = np.empty((*fine.shape, 4))
    tint[..., :3] = to_rgb(hue)
    tint[..., 3] = 0.8 * np.clip(1.0 - density_rank(fine) / SHOWN, 0.0, 1.0) ** 0.7
    box = (left, left + step * fine.shape[1], low, low + step * fine.shape[0])
    axes.imshow(
        tint, extent=box, origin="lower", transform=turn + axes.transData, interpolation="bilinear", zorder=4
    )
    _outlines(axes, maps, agent, fine, np.array([left, low]), hue)


def _outlines(axes: Any, maps: Maps, agent: int, fine: Float64, corner: Float64, hue: Any) -> None:
    step = maps.resolution / FINER
    rows, columns = fine.shape
    x, y = corner[0] + (np.arange(columns) + 0.5) * step, corner[1] + (np.arange(rows) + 0.5) * step
    places = _to_scene(maps, agent, np.stack(np.meshgrid(x, y), axis=-1))
    for share, width in REGIONS.items():
        level = threshold(fine, share)
        if level is not None and level < fine.max():
            axes.contour(places[..., 0], places[..., 1], fine, [level], colors=[hue], linewidths=width, zorder=5)


def legend(horizons: Sequence[float] | npt.NDArray[np.float32], hues: Sequence[Any]) -> list[Any]:
    """Handles for the horizons and the outlines."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Any] = [
        Patch(color=hue, alpha=0.75, label=f"where it may be in {t:g} s")
        for t, hue in zip(horizons, hues, strict=True)
    ]
    for share, width in REGIONS.items():
        label = f"{share:.0%} of the probability is inside"
        handles.append(Line2D([], [], color="0.25", linewidth=width, label=label))
    return handles


def _to_scene(maps: Maps, agent: int, points: Float64) -> Float64:
    return frames.to_scene(points, maps.pose[agent]) if maps.frame == "agent" else points
