"""HCNAF on the vehicle: from a scene to exact occupancy probabilities, with numpy and onnxruntime alone.

from hcnaf_runtime import Forecaster, Scene

maps = Forecaster().pom(Scene.load("scene.npz"), horizons=[1, 2, 4])
maps.mass  # [agents, horizons, rows, columns], the probability of every cell
"""

from hcnaf_runtime import errors
from hcnaf_runtime._version import __version__
from hcnaf_runtime.bundle import Bundle, embedded_scenes
from hcnaf_runtime.encoder import Theta
from hcnaf_runtime.forecaster import Forecaster
from hcnaf_runtime.grid import Grid
from hcnaf_runtime.maps import Maps, Timings
from hcnaf_runtime.modes import Modes
from hcnaf_runtime.occupancy import Occupancy
from hcnaf_runtime.regions import Probability
from hcnaf_runtime.risk import Risk
from hcnaf_runtime.samples import Samples
from hcnaf_runtime.scene import KINDS, Condition, Scene
from hcnaf_runtime.verify import VerifyRow, verify

__all__ = [
    "KINDS",
    "Bundle",
    "Condition",
    "Forecaster",
    "Grid",
    "Maps",
    "Modes",
    "Occupancy",
    "Probability",
    "Risk",
    "Samples",
    "Scene",
    "Theta",
    "Timings",
    "VerifyRow",
    "__version__",
    "embedded_scenes",
    "errors",
    "verify",
]
