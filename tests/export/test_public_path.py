"""The public path, as a user walks it: train by a recipe, export, open the bundle, ask the forecaster."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
import torch

from hcnaf_export.checkpoint import load_checkpoint
from hcnaf_export.export import export_bundle
from hcnaf_export.recipe import read_recipe
from hcnaf_export.training.run import run_training
from hcnaf_models import planar
from hcnaf_runtime import Condition, Forecaster, Grid

NODES = 128  # mid-points per column of the reference


@pytest.fixture(scope="module", params=[(2, 20), (3, 20), (2, 100), (3, 100)], ids=lambda v: f"L{v[0]}H{v[1]}")
def walked(request, tmp_path_factory):
    layers, hidden = request.param
    recipe = read_recipe("toy1")
    flow = replace(recipe.model.flow, layers=layers, hidden=hidden)
    model = replace(recipe.model, flow=flow, scale=3.0, slope=1.5)  # the recipe's own are for its number of units
    optimiser = msgspec.structs.replace(
        recipe.optimiser, steps=40, batch=64, learning_rate=3e-4, warm_up=5, validate_every=40
    )
    recipe = msgspec.structs.replace(recipe, model=model, optimiser=optimiser)
    folder = tmp_path_factory.mktemp("path")
    run_training(recipe, None, folder / "run")
    result = export_bundle(folder / "run" / "model.pt", folder / "bundle")
    return load_checkpoint(folder / "run" / "model.pt").model.eval(), result


def _theta(model):
    with torch.no_grad():
        return model.hypernet(torch.eye(3))


def test_log_densities_agree(walked):
    model, result = walked
    points = np.random.default_rng(0).uniform(-9, 9, (400, 2)).astype(np.float32)
    found = Forecaster(result.path, threads=1).log_prob(Condition(np.eye(3, dtype=np.float32)), points)[:, 0]
    with torch.no_grad():
        expected = model.log_prob(_theta(model)[:, 0], torch.from_numpy(points).expand(3, -1, -1)).numpy()
    likely = expected > -50
    assert likely.mean() > 0.5
    assert np.abs(found - expected)[likely].max() < 1e-4


def test_cell_masses_agree(walked):
    """The runtime's map against PyTorch in float64 with many nodes; the graph itself within 1e-6."""
    model, result = walked
    grid = Grid(12, 10, 0.5).at(-3.0, -2.5)
    maps = Forecaster(result.path, threads=1).pom(Condition(np.eye(3, dtype=np.float32)), grid)
    theta, spec = _theta(model)[:, 0].double(), model.config.flow
    fine = torch.linspace(-3.0, 3.0, 12 * NODES + 1, dtype=torch.float64)
    F = planar.marginal_cdf(spec, theta, fine.expand(3, -1))
    steps = (F[:, 1:] - F[:, :-1]).reshape(3, 12, NODES)
    weight = torch.zeros(3, 12, NODES, 12, dtype=torch.float64)
    weight[:, range(12), :, range(12)] = steps.transpose(0, 1)
    middle = ((fine[1:] + fine[:-1]) / 2).expand(3, -1)
    y = torch.linspace(-2.5, 2.5, 11, dtype=torch.float64).expand(3, -1)
    expected = planar.cell_mass(
        spec, theta, middle, weight.flatten(1, 2), 0.0 * weight.flatten(1, 2), y
    ).mass.numpy()
    assert expected.sum() > 0.1
    np.testing.assert_allclose(maps.mass[:, 0], expected, atol=3e-6)
    graph = next(r for r in result.rows if r.graph == "cell_mass")
    assert graph.max_abs <= 1e-6
