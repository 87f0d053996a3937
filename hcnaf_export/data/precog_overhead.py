"""Overhead channels as a lidar might see them, rendered from road geometry and the boxes of vehicles.

No rays are cast: nothing hides behind a vehicle. Ground returns lie on the road and grow sparse with distance, as
those of a scanner do; vehicles stand out as whole boxes, and the edges of the built-up blocks as facades that
follow the roads at `SETBACK`. Data made with it says so (`hcnaf_export.data.precog_write`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hcnaf_export.data.tracks import TrackSet

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

PIXELS = 200
"""Rows and columns of the overhead channels."""

PIXELS_PER_METER = 2
"""Their scale; they cover 50 m to all sides."""

REACH = 0.5 * PIXELS / PIXELS_PER_METER
"""Half the width they cover (m)."""

HITS = 25
"""Returns per pixel that are counted, at most."""

DENSE = 12.0
"""Distance (m) up to which every pixel of the road returns; beyond it returns thin out with its square."""

SETBACK = (6.0, 7.5)
"""Facades stand between so many metres from the road."""

ROW_OFFSET = (np.arange(PIXELS) + 0.5) / PIXELS_PER_METER - REACH


class Surroundings:
    """Road and facades of one network, to be looked at from anywhere on it."""

    def __init__(self, tracks: TrackSet) -> None:
        self.tracks = tracks
        self.road: Bool = tracks.raster[tracks.channels.index("drivable")] > 63
        near, far = (round(d / tracks.resolution) for d in SETBACK)
        inner = grown(self.road, near)
        self.facade: Bool = grown(inner, far - near) & ~inner

    def channels(self, pose: Float, boxes: Float, rng: np.random.Generator) -> Float:
        """The four channels of an episode around a pose.

        Args:
            pose: [3], x, y (m) and yaw (rad) of the player in the right-handed frame of the network.
            boxes: [K, 5], x, y, yaw, length and width of the others in that frame.
            rng: draws which pixels return, and how often.

        Returns:
            [PIXELS, PIXELS, 4] in the file's left-handed frame, index [y to the right][x forward]: hits / HITS,
            above ground, below (the ground itself), higher up (the facades).
        """
        x, right = np.meshgrid(ROW_OFFSET, ROW_OFFSET)
        seen = rng.random(x.shape) < np.square(DENSE / np.maximum(np.hypot(x, right), DENSE))
        cars = self._cars(pose, boxes)
        road, facade = self._look(pose, x, -right)
        below, higher = road & seen & ~cars, facade & seen
        above = cars | higher
        hits = np.where(above | below, 1 + rng.poisson(np.where(above, 6.0, 1.0)), 0)
        return np.stack([np.minimum(hits, HITS) / HITS, above, below, higher], axis=-1).astype(np.float64)

    def _look(self, pose: Float, x: Float, y: Float) -> tuple[Bool, Bool]:
        """Road and facades at points of the player's frame (y left); nothing off the network."""
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        place = np.stack([pose[0] + cos * x - sin * y, pose[1] + sin * x + cos * y], axis=-1)
        column, row = np.moveaxis(
            np.floor((place - self.tracks.origin) / self.tracks.resolution).astype(np.int64), -1, 0
        )
        rows, columns = self.road.shape
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        where = np.where(inside, row, 0), np.where(inside, column, 0)
        return self.road[where] & inside, self.facade[where] & inside

    def _cars(self, pose: Float, boxes: Float) -> Bool:
        """Pixels that boxes cover, [y right][x forward], from points half a pixel apart."""
        image = np.zeros((PIXELS, PIXELS), bool)
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        for x, y, yaw, length, width in boxes:
            u, v = np.meshgrid(_line(length), _line(width))
            dx = x - pose[0] + np.cos(yaw) * u - np.sin(yaw) * v
            dy = y - pose[1] + np.sin(yaw) * u + np.cos(yaw) * v
            column = np.floor((cos * dx + sin * dy + REACH) * PIXELS_PER_METER).astype(np.int64)
            row = np.floor((sin * dx - cos * dy + REACH) * PIXELS_PER_METER).astype(np.int64)
            inside = (row >= 0) & (row < PIXELS) & (column >= 0) & (column < PIXELS)
            image[row[inside], column[inside]] = True
        return image


def grown(mask: Bool, pixels: int) -> Bool:
    """A mask that reaches so many pixels farther, in octagons."""
    out = mask.copy()
    for k in range(pixels):
        # Alternating crosses and squares make an octagon, near enough to a disc.
        out = _shifted(out, square=bool(k % 2))
    return out


def _shifted(mask: Bool, square: bool) -> Bool:
    out = mask.copy()
    out[1:] |= mask[:-1]
    out[:-1] |= mask[1:]
    start = out.copy() if square else mask
    out[:, 1:] |= start[:, :-1]
    out[:, :-1] |= start[:, 1:]
    return out


def _line(length: float) -> Float:
    """Points at most a quarter of a metre apart, from end to end of a box."""
    return np.linspace(-0.5, 0.5, max(2, int(4.0 * length) + 1)) * length
