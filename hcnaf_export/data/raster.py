"""Maps drawn from above: polygons, thick lines and lane directions as int8 channels.

Shared by the virtual simulator and by the converters of recordings, so that a network sees one style of map.
Needs Pillow, of the extras `sim` and `data`, and imports it when the first shape is drawn.
"""

from collections.abc import Sequence
from itertools import pairwise
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hcnaf_runtime.errors import DataError, GridError, MissingExtraError

Float32 = NDArray[np.float32]
Tile = tuple[slice, slice]

MAP_CHANNELS = ("drivable", "direction_x", "direction_y", "stop_line", "junction")
"""The static map's channels, in the order of every raster this package makes."""

FULL = 127
"""The int8 value of 1.0: channels hold value / 127 in [-1, 1]."""

OVERSAMPLE = 4
"""Sub-pixels per pixel and axis: anti-aliasing in steps of 1/16 of a pixel's area."""

_DISC = np.stack([np.cos(a := np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)), np.sin(a)], axis=1)


class Rasteriser:
    """A window of the ground plane into which shapes are drawn, channel by channel.

    Scene coordinates in (metres, x right, y up); pixel [row, col] covers
    `origin + resolution * ([col, col + 1], [row, row + 1])`, so row 0 is the lowest y. Parts of a shape outside
    the window are cut off. Coverage is anti-aliased.

    Args:
        origin: scene coordinates (x, y) of the lower-left corner, metres.
        resolution: metres per pixel, > 0.
        width: pixels along x, at least 1.
        height: pixels along y, at least 1.

    Raises:
        GridError: a window without pixels or a resolution that is not a positive number.

    Example:
        >>> lane = [[0.0, 0.0], [20.0, 0.0]]
        >>> canvas = Rasteriser(origin=(-10.0, -10.0), resolution=0.5, width=80, height=40)
        >>> canvas.polyline("drivable", lane, width=3.2)
        >>> canvas.lane_direction(lane, width=3.2)
        >>> canvas.to_int8().shape
        (5, 40, 80)
    """

    def __init__(self, origin: ArrayLike, resolution: float, width: int, height: int) -> None:
        if not (np.isfinite(resolution) and resolution > 0.0 and width >= 1 and height >= 1):
            raise GridError(
                f"raster window of {width} x {height} pixels at {resolution} m per pixel; "
                "expected at least 1 x 1 and a positive resolution"
            )
        self.origin: NDArray[np.float64] = np.asarray(origin, dtype=np.float64).reshape(2)
        self.resolution = float(resolution)
        self.width = int(width)
        self.height = int(height)
        self._channels: dict[str, Float32] = {}
        self._direction: Float32 = np.zeros((3, self.height, self.width), dtype=np.float32)

    def polygon(self, channel: str, points: ArrayLike, value: float = 1.0) -> None:
        """Fill a polygon into a channel, keeping the larger value where shapes overlap.

        Args:
            channel: the channel's name; created empty (zero) at its first use.
            points: [n, 2] corners in either order, metres; fewer than three draw nothing.
            value: the value of full coverage, in (0, 1].

        Raises:
            DataError: points of another shape or not finite.
            MissingExtraError: Pillow is not installed.
        """
        self._fill(channel, [_points(points)], value)

    def polyline(self, channel: str, points: ArrayLike, width: float, value: float = 1.0) -> None:
        """Draw a line of the given width (m), round at its inner corners and flat at its ends.

        Args as for `polygon`; `points` [n, 2] is the centre line.
        """
        self._fill(channel, _buffered(_points(points), width), value)

    def lane_direction(self, points: ArrayLike, width: float) -> None:
        """Draw a lane's direction of travel: (cos, sin) of its yaw into `direction_x` and `direction_y`.

        Overlapping lanes (junctions) are averaged, so that contradicting directions cancel; zero off lanes.

        Args:
            points: [n, 2] centre line in the direction of travel, metres.
            width: the lane's width, metres.
        """
        line = _points(points)
        step = np.diff(line, axis=0)
        length = np.hypot(step[:, 0], step[:, 1])
        for i in np.flatnonzero(length > 1e-6):
            drawn = self._coverage([_quad(line[i], line[i + 1], width)])
            if drawn is not None:
                (rows, cols), coverage = drawn
                cos, sin = step[i] / length[i]
                self._direction[:, rows, cols] += coverage * np.array([[[cos]], [[sin]], [[1.0]]], np.float32)

    def channel(self, name: str) -> Float32:
        """One channel as drawn so far.

        Returns:
            float32 [height, width]: in [0, 1], directions in [-1, 1]; zeros for a channel without shapes.
        """
        if name in ("direction_x", "direction_y"):
            row = 0 if name == "direction_x" else 1
            averaged: Float32 = self._direction[row] / np.maximum(self._direction[2], 1.0)
            return averaged
        return self._channels.get(name, np.zeros((self.height, self.width), dtype=np.float32))

    def to_int8(self, channels: Sequence[str] = MAP_CHANNELS) -> NDArray[np.int8]:
        """The named channels as a scene's raster: int8 [C, height, width], value = 127 times the channel."""
        stacked = np.stack([self.channel(name) for name in channels])
        return np.rint(np.clip(stacked, -1.0, 1.0) * FULL).astype(np.int8)

    def _fill(self, channel: str, polygons: list[NDArray[np.float64]], value: float) -> None:
        target = self._channels.setdefault(channel, np.zeros((self.height, self.width), dtype=np.float32))
        drawn = self._coverage(polygons)
        if drawn is not None:
            tile, coverage = drawn
            np.maximum(target[tile], coverage * np.float32(value), out=target[tile])

    def _coverage(self, polygons: list[NDArray[np.float64]]) -> tuple[Tile, Float32] | None:
        """Union of polygons as (rows and columns of its bounding box, coverage there), None if out of sight."""
        pixels = [(p - self.origin) / self.resolution for p in polygons if len(p) >= 3]
        if not pixels:
            return None
        corners = np.concatenate(pixels)
        low = np.maximum(np.floor(corners.min(axis=0)).astype(int), 0)
        high = np.minimum(np.ceil(corners.max(axis=0)).astype(int) + 1, (self.width, self.height))
        if (high <= low).any():
            return None
        image = _draw([(p - low) * OVERSAMPLE - 0.5 for p in pixels], (high - low) * OVERSAMPLE)
        rows, cols = int(high[1] - low[1]), int(high[0] - low[0])
        fine = image.reshape(rows, OVERSAMPLE, cols, OVERSAMPLE)
        tile = (slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0])))
        return tile, fine.mean(axis=(1, 3), dtype=np.float32)


def _points(points: ArrayLike) -> NDArray[np.float64]:
    array = np.asarray(points, dtype=np.float64)
    if array.size == 0:
        return array.reshape(0, 2)
    if array.ndim != 2 or array.shape[1] != 2 or not np.isfinite(array).all():
        raise DataError(f"shape with points {array.shape}; expected [n, 2] finite coordinates in metres")
    return array


def _quad(start: NDArray[np.float64], end: NDArray[np.float64], width: float) -> NDArray[np.float64]:
    along = end - start
    normal = np.array([-along[1], along[0]]) / np.hypot(along[0], along[1]) * (0.5 * width)
    return np.stack([start + normal, end + normal, end - normal, start - normal])


def _buffered(line: NDArray[np.float64], width: float) -> list[NDArray[np.float64]]:
    """Quads along the segments and discs at the inner corners."""
    quads = [_quad(a, b, width) for a, b in pairwise(line) if np.hypot(*(b - a)) > 1e-6]
    return quads + [corner + _DISC * (0.5 * width) for corner in line[1:-1]]


def _draw(polygons: list[NDArray[np.float64]], size: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Polygons in sub-pixel coordinates as a 0/1 image of (columns, rows) = size."""
    pillow_image, pillow_draw = _pillow()
    image = pillow_image.new("L", (int(size[0]), int(size[1])), 0)
    draw: Any = pillow_draw.Draw(image)
    for polygon in polygons:
        draw.polygon([(float(x), float(y)) for x, y in polygon], fill=1)
    return np.asarray(image, dtype=np.uint8)


def _pillow() -> tuple[ModuleType, ModuleType]:
    try:
        from PIL import Image, ImageDraw
    except ImportError as error:
        raise MissingExtraError(
            'drawing maps needs Pillow, which is not installed; run: pip install "hcnaf[data]"'
        ) from error
    return Image, ImageDraw
