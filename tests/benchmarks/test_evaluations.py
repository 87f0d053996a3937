"""Points are counted on every thread, and not once counting is over."""

import numpy as np

from hcnaf_runtime import Forecaster, Grid, Scene, embedded_scenes
from hcnaf_runtime.flow import Flow
from tests.benchmarks import evaluations

GRID = Grid(width=80, height=80, resolution=0.5, origin=(-20.0, -20.0))


def test_a_map_takes_points_and_sparse_ones_take_fewer():
    scene = Scene.load(next(iter(embedded_scenes().values())))
    originals = [getattr(Flow, method) for method in evaluations.METHODS.values()]
    found = {}
    for threads in (1, 2):
        forecaster = Forecaster(threads=threads)
        found[threads] = evaluations.per_map(lambda f=forecaster: f.pom(scene, GRID, [1.0, 2.0]), 2)
    assert found[1] == found[2]
    assert all(np.isfinite(found[1][k]) and found[1][k] > 0 for k in ("cells", "meshes", "F_1"))
    sparse = evaluations.per_map(lambda: forecaster.pom(scene, GRID, [1.0, 2.0], lost_mass=1e-2), 2)
    assert sparse["cells"] < found[1]["cells"]
    assert [getattr(Flow, method) for method in evaluations.METHODS.values()] == originals
