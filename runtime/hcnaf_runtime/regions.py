"""Probability that the agent's centre lies in a box, a rectangle or any simple polygon.

polygons --> those that meet the mass (sketch) --> trapezoids with upright sides (slabs)
         --> cut where things change (sketch) --> quadrature (trapezoids)
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from hcnaf_runtime.encoder import Theta
from hcnaf_runtime.errors import InputError
from hcnaf_runtime.frames import to_agent
from hcnaf_runtime.plane import CHUNK, Distribution
from hcnaf_runtime.sketch import Sketch, ranges, sketch
from hcnaf_runtime.slabs import slabs
from hcnaf_runtime.trapezoids import Trapezoids, masses, with_ends

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
Mask = npt.NDArray[np.bool_]

TOLERANCE = 2e-6
"""What each probability may be off by, about. float32 resolves half of that."""

_AT_ONCE = 10_000  # regions
_SHARES = 2  # parts that threads share, at least
_NOTHING = 1e-7  # parts of a region that hold less are left out, whatever the tolerance
_NEGLIGIBLE = 0.3  # share of the tolerance that may be overlooked: beyond either end, and between limits


@dataclass(frozen=True, eq=False)
class Probability:
    """Probabilities of regions and what they may be off by, of one shape."""

    value: Float64
    """From 0 to 1."""
    error: Float64
    """The quadrature's doubt, summed over the parts of a region, and what was not worth computing."""


def forecast_probability(
    flow: Distribution, theta: Theta, polygons: npt.NDArray[Any], frame: str, tolerance: float = TOLERANCE
) -> Probability:
    """Probabilities [A, T, n] of `polygons` [n, V, 2], [A, n, V, 2] or [A, T, n, V, 2] (m) for a scene's `theta`.

    `frame` is "agent" or "scene". Raises InputError for another shape, for numbers that are not finite, and for a
    tolerance that is not positive.
    """
    A, T, P = theta.values.shape
    check_tolerance(tolerance)
    places = _broadcast(polygons, A, T)
    if frame == "scene":
        places = np.stack([to_agent(p, pose) for p, pose in zip(places, theta.pose, strict=True)])
    found = polygon_probability(
        flow, theta.values.reshape(A * T, P), places.reshape(A * T, *places.shape[2:]), tolerance
    )
    return Probability(found.value.reshape(A, T, -1), found.error.reshape(A, T, -1))


def box_corners(boxes: npt.NDArray[Any]) -> Float64:
    """[..., 4, 2] of boxes [..., 4]: x_0, y_0, x_1, y_1, opposite corners. Raises InputError for other shapes."""
    _check_fields("boxes", boxes, 4, "x_0, y_0, x_1, y_1 (m)")
    x0, y0, x1, y1 = np.moveaxis(np.asarray(boxes, np.float64), -1, 0)
    return np.stack([np.stack([x0, x1, x1, x0], axis=-1), np.stack([y0, y0, y1, y1], axis=-1)], axis=-1)


def rectangle_corners(rectangles: npt.NDArray[Any]) -> Float64:
    """[..., 4, 2], counter-clockwise, of rectangles [..., 5]: x, y of the middle, yaw, length, width (m, rad).

    Raises InputError for another shape.
    """
    _check_fields("rectangles", rectangles, 5, "x, y, yaw, length, width (m, rad)")
    x, y, yaw, length, width = np.moveaxis(np.asarray(rectangles, np.float64), -1, 0)
    ahead = np.stack([np.cos(yaw), np.sin(yaw)], axis=-1) * length[..., None] / 2.0
    left = np.stack([-np.sin(yaw), np.cos(yaw)], axis=-1) * width[..., None] / 2.0
    corners = [-ahead - left, ahead - left, ahead + left, left - ahead]
    return np.asarray(np.stack([x, y], axis=-1)[..., None, :] + np.stack(corners, axis=-2))


def polygon_probability(
    flow: Distribution,
    theta: Float32,
    polygons: npt.NDArray[np.floating],
    tolerance: float = TOLERANCE,
    chunk: int = CHUNK,
) -> Probability:
    """Probability [B, n] of `polygons` [B, n, V, 2] (m, frame of theta) under theta [B, P].

    Polygons are simple; their corners go round either way. Repeated corners do no harm: they let polygons of
    fewer corners be stacked with others. Memory is bounded by `chunk` beside a few numbers per corner.
    """
    B, n, V, _ = polygons.shape
    places = np.ascontiguousarray(np.moveaxis(polygons.reshape(B * n, V, 2), (1, 2), (1, 0)), np.float64)
    low, high = (ends.reshape(2, B, n) for ends in (places.min(axis=1), places.max(axis=1)))
    return probability(flow, theta, low, high, lambda some: places[..., some], tolerance, chunk)


def probability(
    flow: Distribution,
    theta: Float32,
    low: Float64,
    high: Float64,
    corners: Callable[[Indices], Float64],
    tolerance: float = TOLERANCE,
    chunk: int = CHUNK,
) -> Probability:
    """Probability [B, n] of polygons under theta [B, P] that lie in boxes from `low` to `high` [2, B, n] (m).

    `corners` gives those of regions [m], counted through all B n, as [2, V, m]. It is asked for no more than hold
    anything.
    """
    B, n = low.shape[1:]
    value, error = np.zeros((B, n)), np.zeros((B, n))
    index = np.arange(B * n).reshape(B, n)

    def part(some: tuple[slice, slice]) -> None:
        which = index[some].ravel()
        box = low[:, *some], high[:, *some]
        value[some], error[some] = _probability(
            flow, theta[some[0]], *box, lambda k: corners(which[k]), tolerance, chunk
        )

    # Every so many-th map: neighbours are the same agent at like times, and as much work.
    shares = min(B, max(_SHARES, -(-B * n // _AT_ONCE)))
    maps = [slice(i, None, shares) for i in range(shares)]
    columns = [slice(k, k + _AT_ONCE) for k in range(0, n, _AT_ONCE)]
    flow.each(part, [(b, k) for b in maps for k in columns])
    return Probability(value, error)


def _check_fields(name: str, given: npt.NDArray[Any], count: int, fields: str) -> None:
    found = np.asarray(given)
    if found.ndim < 2 or found.shape[-1] != count or found.dtype.kind not in "fiu":
        raise InputError(f"{name} is {found.dtype} {list(found.shape)}, expected float [..., {count}]: {fields}")


def check_tolerance(tolerance: float) -> None:
    """Raises InputError for one that is not positive."""
    if not tolerance > 0.0:
        raise InputError(f"tolerance is {tolerance}, expected a positive number such as {TOLERANCE:g}")


def _broadcast(polygons: npt.NDArray[Any], A: int, T: int) -> npt.NDArray[Any]:
    """`polygons` as [A, T, n, V, 2]."""
    found = np.asarray(polygons)
    places = found[:, None] if found.ndim == 4 else found
    try:
        if (
            found.ndim not in (3, 4, 5)
            or found.shape[-1] != 2
            or found.shape[-2] < 3
            or found.dtype.kind not in "fiu"
        ):
            raise ValueError
        places = np.broadcast_to(places, (A, T, *found.shape[-3:]))
    except ValueError:
        raise InputError(
            f"regions are {found.dtype} {list(found.shape)}, expected float [n, V, 2], [{A}, n, V, 2] or "
            f"[{A}, {T}, n, V, 2] with at least 3 corners (boxes and rectangles likewise, without V)"
        ) from None
    if not np.isfinite(found).all():
        raise InputError("regions hold NaN or infinity, expected finite numbers (m)")
    return places


def _probability(
    flow: Distribution,
    theta: Float32,
    low: Float64,
    high: Float64,
    corners: Callable[[Indices], Float64],
    tolerance: float,
    chunk: int,
) -> tuple[Float64, Float64]:
    """Value and error [B, n] of the regions of `probability`."""
    B, n = low.shape[1:]
    overlooked = _NEGLIGIBLE * tolerance
    reach = ranges(flow, theta, np.stack([low.min(axis=2), high.max(axis=2)], axis=1), overlooked)
    near: Mask = np.asarray(((low < reach[:, 1, :, None]) & (high > reach[:, 0, :, None])).all(axis=0))
    maps = np.flatnonzero(np.any(near, axis=1))  # nothing more is computed for the others
    value, error = np.zeros((B, n)), np.full((B, n), 2.0 * overlooked)
    if len(maps):
        seen = sketch(flow, theta[maps], reach[..., maps], chunk)
        whose = (maps[:, None] * n + np.arange(n)).ravel()
        some, left_out = _worth(seen, low[:, maps], high[:, maps], near[maps], overlooked)
        parts = slabs(corners(whose[some]), some, n)
        found, doubt = _sums(flow, theta[maps], seen, parts, near[maps].size, tolerance, chunk)
        value[maps], error[maps] = found.reshape(-1, n), error[maps] + left_out + doubt.reshape(-1, n)
    return np.clip(value, 0.0, 1.0), error


def _worth(seen: Sketch, low: Float64, high: Float64, near: Mask, overlooked: float) -> tuple[Indices, Float64]:
    """The regions [m] that are worth computing, and what the others may hold [B, n]."""
    some = np.flatnonzero(near)
    low, high = (end.reshape(2, -1).take(some, axis=1) for end in (low, high))
    bound = seen.bound(low, high, some // near.shape[1])
    worth = bound > overlooked
    left_out = np.zeros(near.shape)
    left_out.ravel()[some[~worth]] = bound[~worth]
    return some[worth], left_out


def _sums(
    flow: Distribution,
    theta: Float32,
    seen: Sketch,
    parts: Trapezoids,
    count: int,
    tolerance: float,
    chunk: int,
) -> tuple[Float64, Float64]:
    """Value and error [count] of regions from their trapezoids; nodes are spent where limits leave room."""
    parts = parts.take(seen.bound(*parts.box(), parts.map) > _NOTHING)
    parts = with_ends(flow, theta, seen.cut(parts, tolerance), chunk)
    least, most = seen.limits(parts)
    wide = most - least > _NEGLIGIBLE * tolerance
    middle = np.where(least > 0.0, (least + most) / 2, 0.0)
    known = np.where(wide, 0.0, parts.sign * middle)
    value, doubt = masses(flow, theta, parts.take(wide), (most - least)[wide], count, tolerance, chunk)
    doubt += np.bincount(parts.owner, np.where(wide, 0.0, most - middle), count)
    return value + np.bincount(parts.owner, known, count), doubt
