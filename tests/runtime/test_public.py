"""The public names, and the promise of the light install: no torch, and onnxruntime only when it is needed."""

import subprocess
import sys
from pathlib import Path

import pytest

import hcnaf_runtime

NAMES = [
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

_BLOCKED = """
import sys

class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("torch", "onnx", "onnxscript", "hcnaf_export", "hcnaf_models", "scipy"):
            raise ImportError(f"{name} is blocked")

sys.meta_path.insert(0, Blocker())
"""

_FORECAST = """
import sys
from hcnaf_runtime import Forecaster, Scene
maps = Forecaster(sys.argv[1]).pom(Scene.load(sys.argv[2]), horizons=[1.0])
assert maps.window_mass.min() > 0.999
assert "torch" not in sys.modules
"""


def _python(code, *arguments):
    root = Path(hcnaf_runtime.__file__).parents[1]
    return subprocess.run(
        [sys.executable, "-c", code, *arguments], cwd=root, capture_output=True, text=True, check=False
    )


def test_public_names():
    assert hcnaf_runtime.__all__ == NAMES
    assert all(hasattr(hcnaf_runtime, name) for name in NAMES)


@pytest.mark.parametrize("module", ["torch", "onnx", "onnxruntime", "hcnaf_export", "hcnaf_models"])
def test_importing_is_light(module):
    result = _python(f"import sys, hcnaf_runtime; sys.exit({module!r} in sys.modules)")
    assert result.returncode == 0, result.stderr


def test_forecasts_where_torch_cannot_be_imported(bundle_path, scene, tmp_path):
    scene.save(tmp_path / "s.npz")
    result = _python(_BLOCKED + _FORECAST, str(bundle_path), str(tmp_path / "s.npz"))
    assert result.returncode == 0, result.stderr
    assert (result.stdout, result.stderr) == ("", "")
