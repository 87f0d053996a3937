"""A SUMO network as geometry: lanes, junctions, where traffic must yield, and its raster from above."""

import gzip
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from hcnaf_export.data.raster import Rasteriser
from hcnaf_runtime.errors import DataError

Points = NDArray[np.float64]

MARGIN = 20.0
"""Metres of empty map around a network."""

LARGEST = 5000.0
"""Networks wider than this (m) are refused: their raster would not fit in memory."""

_YIELD = {"m": 0.5, "=": 0.5, "s": 1.0, "w": 1.0, "Z": 0.5}


@dataclass(frozen=True)
class Lane:
    """One lane: `shape` [n, 2] is its centre line in the direction of travel, metres."""

    edge: str
    index: int
    shape: Points
    width: float
    internal: bool

    @property
    def length(self) -> float:
        """Length of the centre line, metres."""
        return float(np.hypot(*np.diff(self.shape, axis=0).T).sum())


@dataclass(frozen=True)
class RoadMap:
    """The part of a network that cars may use.

    Attributes:
        lanes: car lanes, internal ones (across junctions) included.
        junctions: polygons [n, 2] of the junctions, dead ends left out.
        stops: (x, y, yaw, width, strength) per lane end where traffic yields: 1 stop, 0.75 light, 0.5 give way.
        successors: edges reachable from each edge, U-turns left out: at a dead end traffic leaves the map.
    """

    lanes: tuple[Lane, ...]
    junctions: tuple[Points, ...]
    stops: NDArray[np.float64]
    successors: dict[str, tuple[str, ...]]

    @property
    def streets(self) -> tuple[Lane, ...]:
        """The lanes outside junctions."""
        return tuple(lane for lane in self.lanes if not lane.internal)


def read_roadmap(path: Path) -> RoadMap:
    """Read a `.net.xml` or `.net.xml.gz`.

    Raises:
        DataError: not a SUMO network, without car lanes, or wider than LARGEST.
    """
    root = _parse(path)
    lanes = _lanes(root)
    if not any(not lane.internal for lane in lanes.values()):
        raise DataError(f"{path} has no lane open to cars; give a SUMO network with streets")
    span = np.ptp(np.concatenate([lane.shape for lane in lanes.values()]), axis=0).max()
    if span > LARGEST:
        raise DataError(f"{path} spans {span:.0f} m, at most {LARGEST:.0f} m can be drawn; cut it with netconvert")
    junctions = tuple(
        _shape(junction.get("shape", ""))
        for junction in root.iter("junction")
        if junction.get("type") not in ("internal", "dead_end")
    )
    kept = tuple(junction for junction in junctions if len(junction) >= 3)
    return RoadMap(tuple(lanes.values()), kept, _stops(root, lanes), _successors(root, lanes))


def draw(roads: RoadMap, resolution: float) -> Rasteriser:
    """Draw MAP_CHANNELS over the whole network and a margin, the corner on a whole pixel."""
    corners = np.concatenate([lane.shape for lane in roads.lanes])
    low = np.floor((corners.min(axis=0) - MARGIN) / resolution) * resolution
    size = np.ceil((corners.max(axis=0) + MARGIN - low) / resolution).astype(int)
    canvas = Rasteriser(low, resolution, int(size[0]), int(size[1]))
    for lane in roads.lanes:
        canvas.polyline("drivable", lane.shape, lane.width)
        canvas.lane_direction(lane.shape, lane.width)
    for junction in roads.junctions:
        canvas.polygon("drivable", junction)
        canvas.polygon("junction", junction)
    for x, y, yaw, width, strength in roads.stops:
        across = 0.5 * width * np.array([-np.sin(yaw), np.cos(yaw)])
        canvas.polyline("stop_line", np.array([x, y]) + np.stack([-across, across]), 0.8, strength)
    return canvas


def _parse(path: Path) -> ElementTree.Element:
    try:
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
            root = ElementTree.parse(file).getroot()
    except (OSError, ElementTree.ParseError, EOFError) as error:
        raise DataError(f"{path} cannot be read as a SUMO network ({error}); give a .net.xml file") from error
    if root.tag != "net":
        raise DataError(f"{path} is XML of <{root.tag}>, expected <net>; give a .net.xml file")
    return root


def _lanes(root: ElementTree.Element) -> dict[tuple[str, int], Lane]:
    lanes = {}
    for edge in root.iter("edge"):
        function = edge.get("function", "normal")
        if function not in ("normal", "internal"):
            continue
        for lane in edge.iter("lane"):
            shape = _shape(lane.get("shape", ""))
            if _open_to_cars(lane) and len(shape) >= 2:
                key = (edge.get("id", ""), int(lane.get("index", "0")))
                lanes[key] = Lane(*key, shape, float(lane.get("width", "3.2")), function == "internal")
    return lanes


def _open_to_cars(lane: ElementTree.Element) -> bool:
    allow, disallow = lane.get("allow", "all").split(), lane.get("disallow", "").split()
    return ("passenger" in allow or "all" in allow) and not {"passenger", "all"} & set(disallow)


def _stops(root: ElementTree.Element, lanes: dict[tuple[str, int], Lane]) -> NDArray[np.float64]:
    """The rule at each street lane's end: that of going straight on, or the strictest where one cannot.

    A left turn from a priority road gives way to oncoming traffic; its lane has no line all the same.
    """
    rules: dict[tuple[str, int], list[tuple[bool, float]]] = defaultdict(list)
    for link in root.iter("connection"):
        key = (link.get("from", ""), int(link.get("fromLane", "0")))
        if key in lanes and not lanes[key].internal and link.get("dir") != "t":
            rule = 0.75 if link.get("tl") else _YIELD.get(link.get("state", ""), 0.0)
            rules[key].append((link.get("dir") == "s", rule))
    ends = {key: max(found)[1] for key, found in rules.items()}
    rows = [_lane_end(lanes[key], rule) for key, rule in ends.items() if rule > 0.0]
    return np.array(rows, dtype=np.float64).reshape(-1, 5)


def _lane_end(lane: Lane, rule: float) -> tuple[Any, ...]:
    along = lane.shape[-1] - lane.shape[-2]
    return (*lane.shape[-1], np.arctan2(along[1], along[0]), lane.width, rule)


def _successors(root: ElementTree.Element, lanes: dict[tuple[str, int], Lane]) -> dict[str, tuple[str, ...]]:
    ahead: dict[str, dict[str, None]] = {lane.edge: {} for lane in lanes.values() if not lane.internal}
    for link in root.iter("connection"):
        start = (link.get("from", ""), int(link.get("fromLane", "0")))
        end = (link.get("to", ""), int(link.get("toLane", "0")))
        if start in lanes and end in lanes and not lanes[start].internal and link.get("dir") != "t":
            ahead[start[0]][end[0]] = None
    return {edge: tuple(following) for edge, following in ahead.items()}


def _shape(text: str) -> Points:
    """SUMO's `x,y x,y,z ...` as [n, 2]."""
    return np.array([point.split(",")[:2] for point in text.split()], dtype=np.float64).reshape(-1, 2)
