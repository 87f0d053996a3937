"""Traffic on a network: libsumo driven step by step, every vehicle recorded at every step."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hcnaf_export.data.sim.drivers import write_drivers
from hcnaf_export.data.sim.roadmap import RoadMap
from hcnaf_export.data.sim.settings import SimSettings
from hcnaf_export.data.tracks import STEP
from hcnaf_runtime.errors import DataError, MissingExtraError

ROUTE_EDGES = 25
"""Edges of a random walk through the network; a vehicle that reaches its end leaves and is replaced."""


@dataclass(frozen=True)
class Recording:
    """What libsumo reported: one row per vehicle and step, in the order of the steps.

    Attributes:
        step: int64 [R], step since the recording began.
        vehicle: int64 [R], index of the vehicle.
        state: float64 [R, 4], front bumper x, y (m), navigational angle (degrees clockwise from north), speed.
        size: float64 [V, 2], box length and width of each vehicle.
    """

    step: NDArray[np.int64]
    vehicle: NDArray[np.int64]
    state: NDArray[np.float64]
    size: NDArray[np.float64]


def box_centre(state: NDArray[np.float64], length: NDArray[np.float64]) -> NDArray[np.float64]:
    """From SUMO's front bumper and navigational angle to the box centre and yaw.

    Args:
        state: [R, 4] front x, y, angle in degrees clockwise from north (+y), speed.
        length: [R] box lengths, metres.

    Returns:
        [R, 4] centre x, y, yaw in radians counter-clockwise from +x in (-pi, pi], speed.
    """
    yaw = np.pi / 2.0 - np.deg2rad(state[:, 2])
    yaw = np.pi - np.mod(np.pi - yaw, 2.0 * np.pi)
    back = 0.5 * length
    x, y = state[:, 0] - back * np.cos(yaw), state[:, 1] - back * np.sin(yaw)
    return np.stack([x, y, yaw, state[:, 3]], axis=1)


def run_traffic(
    net: Path, roads: RoadMap, settings: SimSettings, folder: Path, rng: np.random.Generator
) -> Recording:
    """Simulate warm-up and recording on one network; libsumo allows one simulation per process at a time.

    Args:
        net: the network file.
        roads: the same network, for routes.
        settings: densities and durations.
        folder: scratch directory.
        rng: draws drivers, routes, events and SUMO's own seed.

    Raises:
        MissingExtraError: libsumo is not installed.
        DataError: SUMO refused the network.
    """
    sumo = _libsumo()
    sizes = write_drivers(folder / "drivers.add.xml", settings.violators, rng)
    options = _options(net, folder / "drivers.add.xml", int(rng.integers(1 << 30)))
    try:
        sumo.start(["sumo", *options])
        try:
            return _Traffic(sumo, roads, settings, sizes, rng).run()
        finally:
            sumo.close()
    except (sumo.TraCIException, sumo.FatalTraCIError) as error:
        raise DataError(f"SUMO refused {net.name} ({error}); give a network with routes for cars") from error


def _options(net: Path, drivers: Path, seed: int) -> list[str]:
    options: dict[str, Any] = {
        "net-file": net,
        "additional-files": drivers,
        "seed": seed,
        "step-length": STEP,
        "lateral-resolution": 0.4,
        # A vehicle stuck for a minute or in a crash leaves: a teleport would be a jump in its track.
        "time-to-teleport": 60,
        "time-to-teleport.remove": "true",
        "collision.action": "remove",
        "collision.check-junctions": "true",
        "collision.mingap-factor": 0,
        "max-depart-delay": 3,
        "no-step-log": "true",
        "no-warnings": "true",
        "xml-validation": "never",
    }
    return [text for name, value in options.items() for text in (f"--{name}", str(value))]


class _Traffic:
    """One running simulation: keeps the number of vehicles, disturbs some, writes down all."""

    def __init__(
        self,
        sumo: Any,
        roads: RoadMap,
        settings: SimSettings,
        sizes: dict[str, tuple[float, float]],
        rng: np.random.Generator,
    ) -> None:
        self.sumo, self.roads, self.settings, self.rng = sumo, roads, settings, rng
        self.types, self.sizes = list(sizes), sizes
        self.index: dict[str, int] = {}
        self.box: list[tuple[float, float]] = []
        self.starts = [lane.edge for lane in roads.streets if roads.successors[lane.edge]]
        if not self.starts:
            raise DataError("the network has no street that leads to another; give one with connections")
        length = np.array([lane.length for lane in roads.streets if roads.successors[lane.edge]])
        self.weight = length / length.sum()
        self.wanted = int(np.clip(round(settings.density * length.sum() / 1000.0), 1, settings.max_vehicles))

    def run(self) -> Recording:
        for second in range(round(self.settings.warm_up)):
            self._second(self.wanted if second < 10 else 4)
            for _ in range(round(1.0 / STEP)):
                self.sumo.simulationStep()
        steps: list[int] = []
        vehicles: list[int] = []
        states: list[tuple[float, float, float, float]] = []
        for step in range(round(self.settings.seconds / STEP)):
            if step % round(1.0 / STEP) == 0:
                self._second(4)
            self.sumo.simulationStep()
            for vehicle, state in self._states():
                steps.append(step)
                vehicles.append(vehicle)
                states.append(state)
        return Recording(
            np.array(steps, np.int64),
            np.array(vehicles, np.int64),
            np.array(states, np.float64).reshape(-1, 4),
            np.array(self.box, np.float64).reshape(-1, 2),
        )

    def _states(self) -> list[tuple[int, tuple[float, float, float, float]]]:
        vehicle = self.sumo.vehicle
        rows = []
        for name in vehicle.getIDList():
            x, y = vehicle.getPosition(name)
            rows.append((self.index[name], (x, y, vehicle.getAngle(name), vehicle.getSpeed(name))))
        return rows

    def _second(self, most: int) -> None:
        """Once a second: replace vehicles that left, at most so many, and disturb a few."""
        names = self.sumo.vehicle.getIDList()
        pending = len(self.sumo.simulation.getPendingVehicles())
        for _ in range(min(most, self.wanted - len(names) - pending)):
            self._add()
        for _ in range(self.rng.poisson(self.settings.sudden_stops * len(names) / 60.0)):
            self._disturb(names[int(self.rng.integers(len(names)))])

    def _add(self) -> None:
        name = f"v{len(self.box)}"
        kind = self.types[int(self.rng.integers(len(self.types)))]
        self.index[name] = len(self.box)
        self.box.append(self.sizes[kind])
        self.sumo.route.add(f"r{name}", self._walk())
        self.sumo.vehicle.add(
            name, f"r{name}", kind, departLane="best", departPos="random_free", departSpeed="max"
        )

    def _walk(self) -> list[str]:
        """A random walk: every turn is as likely, so there is more turning than on shortest paths."""
        route = [self.starts[int(self.rng.choice(len(self.starts), p=self.weight))]]
        while len(route) < ROUTE_EDGES and (ahead := self.roads.successors[route[-1]]):
            route.append(ahead[int(self.rng.integers(len(ahead)))])
        return route

    def _disturb(self, name: str) -> None:
        """Slow a moving vehicle down, or stop it in its lane for a while; it then goes on by itself."""
        vehicle, rng = self.sumo.vehicle, self.rng
        speed, lane = vehicle.getSpeed(name), vehicle.getLaneID(name)
        halting = rng.random() < 0.5
        if speed < 2.0 or lane.startswith(":"):
            return
        if not halting:
            vehicle.slowDown(name, speed * rng.uniform(0.1, 0.6), rng.uniform(1.5, 4.0))
            return
        stop = vehicle.getLanePosition(name) + speed**2 / 5.0 + speed + rng.uniform(2.0, 15.0)
        if stop < self.sumo.lane.getLength(lane) - 1.0:
            edge, number = self.sumo.lane.getEdgeID(lane), int(lane.rsplit("_", 1)[1])
            vehicle.setStop(name, edge, pos=stop, laneIndex=number, duration=rng.uniform(2.0, 10.0))


def _libsumo() -> Any:
    try:
        import libsumo
    except ImportError as error:
        raise MissingExtraError(
            'the simulator needs SUMO, which is not installed; run: pip install "hcnaf[sim]"'
        ) from error
    return libsumo
