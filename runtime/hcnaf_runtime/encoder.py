"""From a scene to the flow's weights: the hyper-network, run once per scene and remembered."""

import threading
import time
import weakref
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from hcnaf_runtime.bundle import Bundle
from hcnaf_runtime.errors import HorizonError, SceneError
from hcnaf_runtime.inputs import checked_horizons, condition_feeds, scene_feeds
from hcnaf_runtime.scene import Condition, Scene
from hcnaf_runtime.session import Settings

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Horizons = Sequence[float] | npt.NDArray[Any] | float | None

REMEMBERED = 8
"""How many scenes' weights are kept."""


@dataclass(frozen=True, eq=False)
class Theta:
    """What the hyper-network says about a scene: the flow's weights for every agent and horizon."""

    values: Float32
    """[A, T, P]: ready to multiply, in metres of the agent's frame."""
    pose: Float64
    """[A, 3]: x, y (m) and yaw (rad) of each agent now, in the scene frame; zeros for a condition."""
    horizons: Float32
    """[T] (s); a single 0 for a condition."""
    agents: npt.NDArray[np.int64]
    """[A]: index of each agent in the scene."""
    notes: tuple[str, ...]
    """What was assumed, such as an absent optional raster channel."""
    seconds: float
    """Time the hyper-network took (s)."""


@dataclass
class _Slot:
    lock: threading.Lock = field(default_factory=threading.Lock)
    theta: Theta | None = None


class Encoder:
    """Runs the hyper-network of `bundle`, once per scene and horizons. Thread-safe."""

    def __init__(self, bundle: Bundle, settings: Settings) -> None:
        self._bundle = bundle
        self._settings = settings
        self._slots: OrderedDict[Any, _Slot] = OrderedDict()
        self._lock = threading.Lock()

    def theta(self, scene: Scene | Condition, horizons: Horizons) -> tuple[Theta, float]:
        """The flow's weights, and the seconds the hyper-network took now: 0 where they were remembered.

        Raises SceneError where the scene does not fit the bundle, HorizonError outside the trained range.
        """
        times = self._horizons(scene, horizons)
        slot = self._slot((weakref.ref(scene), times))
        with slot.lock:
            if slot.theta is not None:
                return slot.theta, 0.0
            slot.theta = self._run(scene, times)
            return slot.theta, slot.theta.seconds

    def _horizons(self, scene: Scene | Condition, horizons: Horizons) -> tuple[float, ...]:
        if isinstance(scene, Scene) and self._bundle.manifest.kind == "pom":
            return checked_horizons(self._bundle.manifest, horizons)
        if horizons is not None:
            raise HorizonError("horizons were given, a condition has no time; leave them out")
        return (0.0,)

    def _slot(self, key: Any) -> _Slot:
        # The key holds the scene weakly: remembering weights must not keep a scene's raster alive.
        with self._lock:
            slot = self._slots.setdefault(key, _Slot())
            self._slots.move_to_end(key)
            while len(self._slots) > REMEMBERED:
                self._slots.popitem(last=False)
        return slot

    def _run(self, scene: Scene | Condition, horizons: tuple[float, ...]) -> Theta:
        times = np.array(horizons, np.float32)
        if isinstance(scene, Condition):
            feeds = condition_feeds(self._bundle.manifest, scene)
            (values,), seconds = self._hypernet(["theta"], feeds.tensors)
            A = len(values)
            return Theta(values, np.zeros((A, 3)), times, np.arange(A), feeds.notes, seconds)
        feeds = scene_feeds(self._bundle.manifest, scene, times)
        (values, pose), seconds = self._hypernet(["theta", "pose"], feeds.tensors)
        return Theta(values, pose.astype(np.float64), times, scene.target, feeds.notes, seconds)

    def _hypernet(self, outputs: list[str], tensors: dict[str, Any]) -> tuple[list[npt.NDArray[Any]], float]:
        session = self._bundle.session("hypernet", self._settings)
        start = time.perf_counter()
        # Copies, since they are remembered: onnxruntime's own would stay in its arena and cut up what is free.
        values = [value.copy() for value in session.run(outputs, {name: tensors[name] for name in session.inputs})]
        seconds = time.perf_counter() - start
        if not all(np.isfinite(value).all() for value in values):
            raise SceneError("the hyper-network gave NaN or infinity for this input; check the size of its values")
        return values, seconds
