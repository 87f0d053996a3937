import importlib.util
import sys
from pathlib import Path

import pytest

from hcnaf_runtime import Bundle, Forecaster, Scene


# pytest runs in importlib mode, where a test's neighbours are not importable by themselves.
def _neighbour(name):
    spec = importlib.util.spec_from_file_location(name, Path(__file__).with_name(f"{name}.py"))
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


gaussian_bundle = _neighbour("gaussian_bundle")
_neighbour("analytic")


@pytest.fixture(scope="session")
def bundle_path(tmp_path_factory):
    return gaussian_bundle.write_gaussian_bundle(tmp_path_factory.mktemp("pom") / "bundle")


@pytest.fixture(scope="session")
def condition_path(tmp_path_factory):
    return gaussian_bundle.write_gaussian_bundle(tmp_path_factory.mktemp("toy") / "bundle", "condition")


@pytest.fixture
def own_bundle(tmp_path):
    """A bundle that a test may damage."""
    return gaussian_bundle.write_gaussian_bundle(tmp_path / "bundle")


@pytest.fixture(scope="session")
def bundle(bundle_path):
    return Bundle.open(bundle_path)


@pytest.fixture(scope="session")
def forecaster(bundle):
    return Forecaster(bundle, threads=1)


@pytest.fixture
def fields():
    return gaussian_bundle.scene_fields()


@pytest.fixture(scope="session")
def scene():
    return Scene(**gaussian_bundle.scene_fields())
