"""Tracks recorded at one time step, read at another: positions, headings and speeds.

A recording that gives positions alone still tells headings and speeds, within limits that are stated here: a
car that stands has no course, so it keeps the heading it is known to have; a car in a turn does not point
exactly along the path of its centre, so only the change of course is used and the known heading anchors it.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

MOVING = 0.5
"""Speed (m/s) above which the direction of motion says how the heading changes."""

_SNAP = 1e-6
"""Fraction of an interval within which a wanted time is one of the recorded times."""


def resample(track: ArrayLike, times: ArrayLike, wanted: ArrayLike) -> Array:
    """A track at other times, by linear interpolation.

    Args:
        track: [..., T, K] values, NaN where unknown.
        times: [T] seconds, strictly increasing, T >= 2.
        wanted: [M] seconds, in any order.

    Returns:
        float64 [..., M, K]: NaN outside the recorded times and between a known and an unknown row.
    """
    values, t = np.asarray(track, dtype=np.float64), np.asarray(times, dtype=np.float64)
    query = np.asarray(wanted, dtype=np.float64)
    left = np.clip(np.searchsorted(t, query, side="right") - 1, 0, len(t) - 2)
    weight = (query - t[left]) / (t[left + 1] - t[left])
    weight = np.where(np.abs(weight - np.rint(weight)) < _SNAP, np.rint(weight), weight)[:, None]
    lower, upper = values[..., left, :], values[..., left + 1, :]
    mixed = np.where(weight <= 0.0, lower, np.where(weight >= 1.0, upper, lower + weight * (upper - lower)))
    return np.where((weight < 0.0) | (weight > 1.0), np.nan, mixed)


def speeds(position: ArrayLike, step: float) -> Array:
    """Speed by finite differences: central inside, one-sided at both ends, so "now" uses the past alone.

    Args:
        position: [..., T, 2] metres, T >= 2.
        step: seconds between rows.

    Returns:
        float64 [..., T], m/s.
    """
    velocity = np.gradient(np.asarray(position, dtype=np.float64), step, axis=-2)
    return np.hypot(velocity[..., 0], velocity[..., 1])


def headings(position: ArrayLike, yaw_now: ArrayLike, step: float) -> Array:
    """Headings of tracks whose last heading is known.

    Going back from the last row, the heading turns as much as the direction of motion does. Rows slower than
    `MOVING` keep the heading of the row after them. Of the two senses of a course the one nearer to the later
    heading counts, so a car that backs up and then drives off does not turn about.

    Args:
        position: [..., T, 2] metres, T >= 2.
        yaw_now: [...] heading of the last row, radians.
        step: seconds between rows.

    Returns:
        float64 [..., T], radians, continuous (not wrapped).
    """
    velocity = np.gradient(np.asarray(position, dtype=np.float64), step, axis=-2)
    course = np.arctan2(velocity[..., 1], velocity[..., 0])
    moving = np.hypot(velocity[..., 0], velocity[..., 1]) >= MOVING
    yaw = np.empty(course.shape)
    after = np.broadcast_to(np.asarray(yaw_now, dtype=np.float64), course.shape[:-1])
    later = np.full(course.shape[:-1], np.nan)
    for row in reversed(range(course.shape[-1])):
        turns = moving[..., row] & np.isfinite(later)
        after = after + np.where(turns, half_turn(course[..., row] - np.where(turns, later, 0.0)), 0.0)
        yaw[..., row] = after
        later = np.where(moving[..., row], course[..., row], later)
    return yaw


def half_turn(angle: Any) -> Any:
    """An angle modulo pi, in [-pi/2, pi/2): the turn of an axis rather than of an arrow."""
    return (angle + 0.5 * np.pi) % np.pi - 0.5 * np.pi


def states(position: ArrayLike, yaw: ArrayLike, speed: ArrayLike) -> Array:
    """Rows of a scene's `past`: [..., T, 2], [..., T], [..., T] to [..., T, 5] (x, y, sin, cos, speed)."""
    xy, angle = np.asarray(position, dtype=np.float64), np.asarray(yaw, dtype=np.float64)
    rest = np.stack([np.sin(angle), np.cos(angle), np.asarray(speed, dtype=np.float64)], axis=-1)
    return np.concatenate([xy, rest], axis=-1)
