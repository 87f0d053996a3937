"""The model inside the package: it verifies, and forecasts every sample scene without loss."""

import numpy as np
import pytest

from hcnaf_runtime import Bundle, Forecaster, Scene, embedded_scenes, verify
from hcnaf_runtime.bundle import EMBEDDED

pytestmark = pytest.mark.skipif(
    not (EMBEDDED / "model").is_dir(), reason="this working tree holds no embedded model yet"
)


def test_verifies():
    assert [row for row in verify(Bundle.open()) if not row.passed] == []


def test_forecasts_every_sample():
    forecaster = Forecaster(threads=1)
    assert embedded_scenes()
    for path in embedded_scenes().values():
        maps = forecaster.pom(Scene.load(path), horizons=[0.5, 4.0])
        assert np.isfinite(maps.mass).all()
        assert (maps.window_mass > 0.9).all()
        assert (maps.window_mass < 1 + 1e-5).all()
        assert maps.quadrature_error.max() < 1e-5


def test_fits_the_wheel():
    assert sum(path.stat().st_size for path in (EMBEDDED / "model").iterdir()) < 5_000_000


@pytest.mark.parametrize("lost_mass", [1e-6, 1e-4, 1e-2])
@pytest.mark.parametrize("name", sorted(embedded_scenes()))
def test_trained_forecasts_lose_no_more_than_asked(name, lost_mass):
    """Also where the bound is close to what float32 tells apart."""
    maps = Forecaster(threads=1).pom(Scene.load(embedded_scenes()[name]), lost_mass=lost_mass)
    assert (maps.lost_mass <= lost_mass).all()
    assert (maps.lost_mass >= 0.2 * lost_mass).mean() > 0.5
