"""Generated street networks: a topology from netgenerate, varied street by street, built by netconvert."""

import subprocess
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from hcnaf_runtime.errors import DataError, MissingExtraError

Points = NDArray[np.float64]

LAYOUTS = ("grid", "random", "spider")
JUNCTIONS = ("priority", "allway_stop", "traffic_light", "right_before_left", "mixed")


@dataclass(frozen=True)
class StreetPlan:
    """Which kind of network: one of LAYOUTS and one of JUNCTIONS; sizes and speeds are drawn."""

    layout: str
    junction: str

    @property
    def label(self) -> str:
        """Such as `grid, traffic_light`."""
        return f"{self.layout}, {self.junction}"


def build_streets(plan: StreetPlan, folder: Path, rng: np.random.Generator) -> Path:
    """Make a `.net.xml` spanning roughly 300 to 600 m.

    Args:
        plan: the kind of network.
        folder: scratch directory for netgenerate's and netconvert's files.
        rng: draws sizes, lane counts, speeds, bends and the tools' own seed.

    Raises:
        MissingExtraError: SUMO's tools are not installed.
        DataError: a tool failed.
    """
    seed = ["--seed", str(int(rng.integers(1 << 30)))]
    plain = str(folder / "plain")
    _tool("netgenerate", [*_layout_options(plan.layout, rng), *seed, "--plain-output-prefix", plain])
    _vary_nodes(folder / "plain.nod.xml", plan, rng)
    _vary_edges(folder / "plain.edg.xml", folder / "plain.nod.xml", rng)
    net = folder / "streets.net.xml"
    sources = ["-n", f"{plain}.nod.xml", "-e", f"{plain}.edg.xml", "-o", str(net)]
    _tool("netconvert", [*sources, *seed, *_junction_options(rng)])
    return net


def sumo_binary(name: str) -> Path:
    """A program of the eclipse-sumo distribution."""
    try:
        import sumo
    except ImportError as error:
        raise MissingExtraError(
            'the simulator needs SUMO, which is not installed; run: pip install "hcnaf[sim]"'
        ) from error
    return Path(sumo.SUMO_HOME) / "bin" / name


def _tool(name: str, options: list[str]) -> None:
    done = subprocess.run([str(sumo_binary(name)), *options], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        said = (done.stderr.strip().splitlines() or ["no message"])[0]
        raise DataError(f"{name} failed with {said!r}; try another seed")


def _layout_options(layout: str, rng: np.random.Generator) -> list[str]:
    if layout == "grid":
        columns, rows = rng.integers(3, 6, size=2)
        options = {"x-number": columns, "y-number": rows, "x-length": rng.integers(75, 120)}
        options |= {"y-length": rng.integers(75, 120), "attach-length": rng.integers(50, 80)}
        return ["--grid", *(f"--grid.{name}={value}" for name, value in options.items())]
    if layout == "random":
        options = {"iterations": rng.integers(35, 55), "min-distance": rng.integers(60, 85), "min-angle": 50}
        options |= {"max-distance": rng.integers(110, 150), "grid": rng.choice(["true", "false"])}
        return ["--rand", *(f"--rand.{name}={value}" for name, value in options.items())]
    options = {"arm-number": rng.integers(5, 9), "circle-number": rng.integers(2, 4)}
    options |= {"space-radius": rng.integers(75, 100), "omit-center": rng.choice(["true", "false"])}
    return ["--spider", *(f"--spider.{name}={value}" for name, value in options.items())]


def _junction_options(rng: np.random.Generator) -> list[str]:
    options = {
        "no-turnarounds": "true",
        "default.junctions.radius": f"{rng.uniform(3.0, 8.0):.2f}",
        "junctions.internal-link-detail": "10",
        "junctions.corner-detail": "8",
        "junctions.limit-turn-speed": f"{rng.uniform(2.5, 4.5):.2f}",
        "default.lanewidth": f"{rng.uniform(3.0, 3.6):.2f}",
        "tls.cycle.time": str(int(rng.integers(35, 70))),
    }
    return [f"--{name}={value}" for name, value in options.items()]


def _vary_nodes(path: Path, plan: StreetPlan, rng: np.random.Generator) -> None:
    """Move the nodes a little and give them the plan's junction type (a drawn one where mixed)."""
    tree = ElementTree.parse(path)
    for node in tree.iter("node"):
        for axis in ("x", "y"):
            node.set(axis, f"{float(node.get(axis, '0')) + rng.normal(0.0, 4.0):.2f}")
        drawn = JUNCTIONS[int(rng.integers(4))]
        node.set("type", drawn if plan.junction == "mixed" else plan.junction)
    tree.write(path)


def _vary_edges(path: Path, nodes: Path, rng: np.random.Generator) -> None:
    """Give each street lanes, a speed limit and a bend; both directions of a street share the bend."""
    place = {
        node.get("id"): np.array([float(node.get("x", "0")), float(node.get("y", "0"))])
        for node in ElementTree.parse(nodes).iter("node")
    }
    tree = ElementTree.parse(path)
    streets: dict[tuple[str, ...], tuple[int, float, float]] = {}
    for edge in tree.iter("edge"):
        ends = (edge.get("from", ""), edge.get("to", ""))
        drawn = (int(rng.choice([1, 1, 2])), float(rng.uniform(8.0, 17.0)), float(rng.normal(0.0, 0.05)))
        lanes, speed, bend = streets.setdefault(tuple(sorted(ends)), drawn)
        edge.set("numLanes", str(lanes))
        edge.set("speed", f"{speed:.2f}")
        shape = _bent(place[ends[0]], place[ends[1]], bend if ends[0] <= ends[1] else -bend)
        edge.set("shape", " ".join(f"{x:.2f},{y:.2f}" for x, y in shape))
    tree.write(path)


def _bent(start: Points, end: Points, bend: float) -> Points:
    """A parabola from start to end whose middle lies `bend` times the distance to the left of the chord."""
    t = np.linspace(0.0, 1.0, 9)[:, None]
    along = end - start
    bow = 4.0 * bend * t * (1.0 - t) * np.array([-along[1], along[0]])
    return np.asarray(start + t * along + bow, dtype=np.float64)
