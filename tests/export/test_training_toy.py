"""Toy tasks: the divergence is the right number, and training lowers it."""

import math

import msgspec
import pytest
import torch

from hcnaf_export.data.toys import ToyTwo
from hcnaf_export.evaluation import evaluate_toy_checkpoint
from hcnaf_export.recipe import read_recipe
from hcnaf_export.training.run import run_training
from hcnaf_export.training.toy import ToyTask, evaluate_toy, toy_of
from hcnaf_models.model import build
from hcnaf_runtime.errors import RecipeError


class Gaussian:
    """A model of toy 2 that is off by a shift and a wrong width."""

    def __init__(self, sigma, shift):
        self.sigma, self.shift = sigma, shift

    def hypernet(self, condition):
        return (8.0 + 4.0 * condition).unsqueeze(1)

    def log_prob(self, theta, x):
        d = (x - theta.unsqueeze(-2) - self.shift) / self.sigma
        return -0.5 * d.square().sum(-1) - math.log(2.0 * math.pi * self.sigma**2)


def test_the_divergence_of_two_gaussians():
    toy = ToyTwo()
    rows = evaluate_toy(Gaussian(0.8, 0.3), toy, samples=40_000)
    r = (toy.sigma / 0.8) ** 2
    exact = r - 1.0 - math.log(r) + 0.3**2 / 0.8**2
    assert [row.seen for row in rows] == [True] * 5 + [False] * 4
    for row in rows:
        assert abs(row.kl - exact) < 4.0 * row.error
        assert 0.0 < row.error < 0.01
    assert rows[0].name == "(4, 4)"


def test_the_true_density_diverges_by_nothing():
    for row in evaluate_toy(Gaussian(0.5, 0.0), ToyTwo(), samples=1000, seen_only=True):
        assert row.kl == pytest.approx(0.0, abs=1e-5)


@pytest.mark.parametrize("name", ["toy1", "toy2"])
def test_batches_follow_from_the_step_and_hold_every_seen_condition(name):
    recipe = read_recipe(name)
    task = ToyTask(recipe, torch.device("cpu"))
    batch = task.batch(5)
    toy = toy_of(name)
    assert batch.condition.shape == (len(toy.seen), recipe.model.size)
    assert batch.points.shape == (len(toy.seen), recipe.optimiser.batch, 2)
    assert torch.equal(batch.points, task.batch(5).points)
    assert not torch.equal(batch.points, task.batch(6).points)


def test_training_lowers_the_divergence(tmp_path):
    recipe = read_recipe("toy2")
    recipe = msgspec.structs.replace(
        recipe,
        optimiser=msgspec.structs.replace(
            recipe.optimiser,
            steps=150,
            batch=64,
            learning_rate=1e-2,
            average=0.9,
            warm_up=10,
            units_first=110,
            units_rate=3e-2,
            validate_every=150,
        ),
        model=msgspec.convert({**msgspec.to_builtins(recipe.model), "flow": {"hidden": 8}}, type(recipe.model)),
        samples=msgspec.structs.replace(recipe.samples, validation=2000),
    )
    result = run_training(recipe, None, tmp_path / "run", threads=1)
    assert set(result.scores) == {"(4, 4)", "(4, 12)", "(8, 8)", "(12, 4)", "(12, 12)", "mean"}
    assert result.scores["mean"] < 0.2
    rows = evaluate_toy_checkpoint(result.out / "model.pt", samples=4000)
    seen = [row.kl for row in rows if row.seen]
    assert sum(seen) / len(seen) == pytest.approx(result.scores["mean"], abs=0.05)


def test_a_model_of_another_condition_is_refused():
    recipe = read_recipe("toy1")
    model = msgspec.convert({**msgspec.to_builtins(recipe.model), "size": 2, "examples": []}, type(recipe.model))
    with pytest.raises(RecipeError, match=r"model.size is 2"):
        ToyTask(msgspec.structs.replace(recipe, model=model), torch.device("cpu"))


def test_a_recipe_says_how_steep_the_first_layer_starts():
    config = read_recipe("toy1").model
    units = config.flow.dims * config.flow.hidden
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        slopes = build(config).hypernet.head.weights.bias[:units].detach()
    assert float(slopes.mean()) == pytest.approx(math.log(config.slope), abs=0.1)
