"""Points are counted on every thread, and not once counting is over."""

import numpy as np

from hcnaf_runtime import Forecaster, Grid, Scene, embedded_scenes
from hcnaf_runtime.flow import Flow
from tests.benchmarks import evaluations

GRID = Grid(width=80, height=80, resolution=0.5, origin=(-20.0, -20.0))


def test_a_map_takes_points_and_sparse_ones_take_fewer():
    scene = Scene.load(next(iter(embedded_scenes().values())))
    originals = Flow.cell_mass, Flow.grid_cdf, Flow.marginal_cdf
    found = {}
    for threads in (1, 2):
        forecaster = Forecaster(threads=threads)
        found[threads] = evaluations.per_map(lambda f=forecaster: f.pom(scene, GRID, [1.0, 2.0]), 2)
    assert found[1] == found[2]
    assert all(np.isfinite(n) and n > 0 for n in found[1].values())
    sparse = evaluations.per_map(lambda: forecaster.pom(scene, GRID, [1.0, 2.0], lost_mass=1e-2), 2)
    assert sparse["cells"] < found[1]["cells"]
    assert (Flow.cell_mass, Flow.grid_cdf, Flow.marginal_cdf) == originals
