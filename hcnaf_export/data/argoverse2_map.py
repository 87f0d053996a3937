"""The vector map of an Argoverse 2 scenario, read from JSON and drawn into the channels of a scene."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hcnaf_export.data.raster import Rasteriser
from hcnaf_runtime.errors import DataError

Array = NDArray[np.float64]

CHANNELS = ("drivable", "direction_x", "direction_y", "junction")
"""What an Argoverse 2 map can tell: it has no stop lines, so that channel is left out, not drawn empty."""

_DRIVEN = ("VEHICLE", "BUS")
_SAMPLES = 20
_PIXELS = 4096


@dataclass(frozen=True, eq=False, kw_only=True)
class Lane:
    """A lane segment: boundaries and centre line in the direction of travel, [n, 2] metres, city frame."""

    left: Array
    right: Array
    centre: Array
    kind: str
    intersection: bool

    @property
    def outline(self) -> Array:
        """[n, 2] corners of the lane's area."""
        return np.concatenate([self.left, self.right[::-1]])

    @property
    def width(self) -> float:
        """Median distance (m) between the boundaries."""
        return float(np.median(np.hypot(*(along(self.left) - along(self.right)).T)))


@dataclass(frozen=True, eq=False, kw_only=True)
class VectorMap:
    """Lane segments and drivable areas ([n, 2] metres, city frame) of one scenario."""

    lanes: tuple[Lane, ...]
    areas: tuple[Array, ...]


def read_map(path: Path) -> VectorMap:
    """Read a `log_map_archive_*.json`.

    Raises:
        DataError: a file that cannot be read, is not JSON or lacks lanes or areas of the form expected.
    """
    try:
        record = msgspec.json.decode(path.read_bytes())
        lanes = tuple(_lane(lane) for lane in record["lane_segments"].values())
        areas = tuple(_points(area["area_boundary"]) for area in record["drivable_areas"].values())
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}); expected the scenario's map") from error
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: not valid JSON ({error}); expected an Argoverse 2 map") from error
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise DataError(
            f"{path}: no Argoverse 2 map ({error!r}); expected lane_segments and drivable_areas"
        ) from error
    return VectorMap(lanes=lanes, areas=areas)


def draw(vector_map: VectorMap, low: ArrayLike, high: ArrayLike, resolution: float) -> NDArray[np.int8]:
    """Draw a map into a window.

    Drivable: the drivable areas and every lane for vehicles; direction: the centre lines of those lanes, at
        the lane's
    width; junction: all lanes inside intersections. Bicycle lanes are drivable where the areas say so.

    Args:
        vector_map: in the city's frame.
        low: city coordinates of the window's lower-left corner, metres.
        high: of the upper-right corner; the window is extended to whole pixels.
        resolution: metres per pixel.

    Returns:
        int8 [4, H, W]: channels as in `CHANNELS`, row 0 the lowest y.

    Raises:
        DataError: a window of more than 4096 pixels along an axis.
    """
    corner, extent = np.asarray(low, dtype=np.float64), np.subtract(high, low)
    width, height = np.ceil(extent / resolution - 1e-6).astype(int)
    if max(width, height) > _PIXELS:
        raise DataError(f"map of {width} x {height} pixels; expected at most {_PIXELS}: choose a smaller radius")
    # Drawn about the window's corner: city coordinates run to kilometres.
    canvas = Rasteriser((0.0, 0.0), resolution, int(width), int(height))
    for area in vector_map.areas:
        canvas.polygon("drivable", area - corner)
    for lane in vector_map.lanes:
        if lane.intersection:
            canvas.polygon("junction", lane.outline - corner)
        if lane.kind in _DRIVEN:
            canvas.polygon("drivable", lane.outline - corner)
            canvas.lane_direction(lane.centre - corner, lane.width)
    return canvas.to_int8(CHANNELS)


def along(line: Array) -> Array:
    """A line's points at equal shares of its length: [n, 2] to [20, 2]."""
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    wanted = np.linspace(0.0, length[-1], _SAMPLES)
    return np.stack([np.interp(wanted, length, line[:, axis]) for axis in range(2)], axis=1)


def _lane(record: dict[str, Any]) -> Lane:
    left, right = _points(record["left_lane_boundary"]), _points(record["right_lane_boundary"])
    centre = record.get("centerline")
    return Lane(
        left=left,
        right=right,
        centre=_points(centre) if centre else 0.5 * (along(left) + along(right)),
        kind=str(record["lane_type"]),
        intersection=bool(record["is_intersection"]),
    )


def _points(record: list[dict[str, float]]) -> Array:
    points = np.array([(p["x"], p["y"]) for p in record], dtype=np.float64)
    if len(points) < 2 or not np.isfinite(points).all():
        raise ValueError("a line of fewer than two finite points")
    return points
