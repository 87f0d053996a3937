import importlib.util
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from hcnaf_cli.run import main as hcnaf_run
from hcnaf_cli.train import main as hcnaf
from hcnaf_runtime import Bundle, Scene

# pytest runs in importlib mode, where a test's neighbours are not importable by themselves.
_PATH = Path(__file__).parents[1] / "runtime" / "gaussian_bundle.py"
_spec = importlib.util.spec_from_file_location("cli_gaussian_bundle", _PATH)
_gaussian = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(_gaussian)


@pytest.fixture
def run():
    """`hcnaf-run` with some arguments: exit code, stdout, stderr."""
    return lambda *args: CliRunner().invoke(hcnaf_run, [str(a) for a in args], prog_name="hcnaf-run")


@pytest.fixture
def train():
    """`hcnaf` with some arguments: exit code, stdout, stderr."""
    return lambda *args: CliRunner().invoke(hcnaf, [str(a) for a in args], prog_name="hcnaf")


def make_bundle(folder):
    """A bundle whose flow is a Gaussian, golden outputs included."""
    _gaussian.write_gaussian_bundle(folder)
    bundle = Bundle.open(folder)
    rng = np.random.default_rng(0)
    theta = np.tile(_gaussian.make_theta(1.0, 0.5, 1.0, 2.0, 0.3), (2, 1))
    fields = _gaussian.scene_fields()
    feeds = {
        "past": fields["past"],
        "target": fields["target"],
        "raster": fields["raster"],
        "horizons": np.float32([1, 2]),
        "theta": theta,
        "points": rng.normal(size=(2, 3, 2)).astype(np.float32),
        "x": rng.normal(size=(2, 4)).astype(np.float32),
        "uniform": np.float32([[[0.2, 0.7], [0.5, 0.01]], [[0.9, 0.4], [0.999, 0.6]]]),
        "weight": np.ones((2, 4, 1), np.float32),
        "doubt": np.ones((2, 4, 1), np.float32),
    }
    golden = {}
    for name in bundle.manifest.graphs:
        y = np.float32([[0, 1], [2, 4]]) if name == "cell_mass" else rng.normal(size=(2, 4, 5)).astype(np.float32)
        session = bundle.session(name, 1)
        inputs = {key: (feeds | {"y": y})[key] for key in session.inputs}
        golden |= {f"in.{name}.{key}": value for key, value in inputs.items()}
        for key, value in zip(session.outputs, session.run(session.outputs, inputs), strict=True):
            golden |= {f"out.{name}.{key}": value, f"tol.{name}.{key}": np.float64(1e-5)}
    np.savez(folder / "golden.npz", **golden)
    return folder


@pytest.fixture(scope="session")
def bundle(tmp_path_factory):
    return make_bundle(tmp_path_factory.mktemp("cli") / "bundle")


@pytest.fixture
def own_bundle(tmp_path):
    """A bundle that a test may damage."""
    return make_bundle(tmp_path / "bundle")


@pytest.fixture
def fields():
    """Constructor arguments of a scene that fits the bundle: two cars, a map, and where they went."""
    made = _gaussian.scene_fields()
    past, step = made["past"], made["step"]
    ahead = step * np.arange(1, 41)[:, None] * past[:, -1, 4][:, None, None]
    made["future"] = (past[:, -1:, :2] + ahead * past[:, -1:, [3, 2]]).astype(np.float32)
    return made


@pytest.fixture
def scene_path(fields, tmp_path):
    path = tmp_path / "crossing.npz"
    Scene(**fields).save(path)
    return path


@pytest.fixture
def embedded(bundle, fields, tmp_path, monkeypatch):
    """The test bundle and two scenes in place of what is embedded."""
    import hcnaf_runtime.bundle

    home = tmp_path / "embedded"
    (home / "scenes").mkdir(parents=True)
    (home / "model").symlink_to(bundle)
    for name in ("bend", "crossing"):
        Scene(**fields).save(home / "scenes" / f"{name}.npz")
    monkeypatch.setattr(hcnaf_runtime.bundle, "EMBEDDED", home)
    return home
