"""Experiments on toys: scores are right, records are whole, and no broken model meets a quick run's bounds."""

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from hcnaf_export.data.toys import ToyOne, ToyTwo
from hcnaf_export.recipe import read_recipe
from hcnaf_export.reproduce import figure, peers, toy1, toy2, toys
from hcnaf_export.reproduce.record import (
    Bound,
    Clock,
    Figure,
    Record,
    Request,
    Row,
    Stopped,
    read,
)
from hcnaf_runtime.errors import InputError, ReproductionError


class Gaussian:
    """The best isotropic Gaussian for every condition, or a given one for all of them."""

    def __init__(self, mean, sigma):
        self.mean, self.sigma = mean, sigma

    def log_prob(self, index, x):
        z = (x - self.mean(index)) / self.sigma(index)
        return -0.5 * np.square(z).sum(-1) - math.log(2.0 * math.pi * self.sigma(index) ** 2)


def record(**changes):
    rows = (
        Row("AAF", "2 by 2", {"NLL": Figure(6.1, 0.012, 6.056)}),
        Row("HCNAF", "2 by 2", {"NLL": Figure(3.9, 0.001, 3.896), "KL": Figure(0.00123, 0.00004)}),
    )
    fields = {"experiment": "toy1", "about": "a test", "quick": True, "settings": {"seed": 3}, "machine": {}}
    return Record(**fields | {"rows": rows, "seconds": {"training": 1.5}} | changes)


def test_a_score_of_a_known_gaussian():
    toy, sigma, shift = ToyTwo(), 0.8, 0.3
    model = Gaussian(lambda i: toy.centres()[i] + shift, lambda i: sigma)
    exact = (toy.sigma / sigma) ** 2 - 1.0 - math.log((toy.sigma / sigma) ** 2) + shift**2 / sigma**2
    for found in toys.scores(toy, model, (0, 6), 150_000, seed=1):
        assert abs(found.kl - exact) < 4.0 * found.kl_error
        assert abs(found.gap - exact) < 4.0 * found.nll_error
        assert 0.0 < found.kl_error < 0.01
        assert 0.0 < found.nll_error < 0.01
        assert found.nll == pytest.approx(found.gap + toy.entropy(found.index))


def test_the_truth_scores_nothing_and_its_error_is_that_of_its_entropy():
    toy = ToyOne()
    for found in toys.scores(toy, figure.Target(toy), toy.seen, 70_000, seed=0):
        assert (found.kl, found.kl_error) == (pytest.approx(0.0, abs=1e-12), pytest.approx(0.0, abs=1e-9))
        assert abs(found.gap) < 4.0 * found.nll_error
    x = toy.sample(np.random.default_rng((0, 3, 0)), 0, 5000)
    few = toys.score(toy, figure.Target(toy), 0, 5000, seed=0)
    assert few.nll_error == pytest.approx(toy.log_prob(0, x).std(ddof=1) / math.sqrt(5000))


def test_no_model_of_a_single_gaussian_meets_the_quick_bounds():
    one, two = ToyOne(), ToyTwo()
    spread = [math.sqrt(one.means(i).var() + one.variance(i)) for i in one.seen]
    found = toys.scores(one, Gaussian(lambda i: 0.0, lambda i: spread[i]), one.seen, 5000, seed=0)
    assert not any(b.holds for b in toys.bounds(found, "of", toy1.MOST_KL_QUICK))
    pooled = math.sqrt(two.centres()[list(two.seen)].var() + two.sigma**2)
    for part, indices in (("seen", two.seen), ("unseen", two.unseen)):
        blind = toys.scores(two, Gaussian(lambda i: 8.0, lambda i: pooled), indices, 5000, seed=0)
        assert not toys.mean_bound(blind, part, toy2.MOST_KL_QUICK[part]).holds


def test_recipes_have_the_paper_s_sizes():
    sizes = {name: read_recipe(name).model.flow for name in ("toy1", "toy1-quick", "toy2")}
    assert {name: (s.layers, s.hidden) for name, s in sizes.items()} == {
        "toy1": (2, 64),
        "toy1-quick": (2, 64),
        "toy2": (3, 200),
    }


def test_a_record_comes_back_as_it_was_written(tmp_path):
    written = record(bounds=(Bound("KL", 0.1, 0.2),), notes=("a", "b"))
    assert read(written.write(tmp_path)) == written
    (tmp_path / "other.json").write_text('{"experiment": "toy1"}')
    with pytest.raises(InputError, match="not the record"):
        read(tmp_path / "other.json")


def test_a_record_s_table_has_the_paper_beside_ours():
    head, rows = record().table()
    assert head == ["model ", "on ", "NLL", "paper", "KL"]
    assert rows[0] == ["AAF", "2 by 2", "6.100 ± 0.012", "6.056", ""]
    assert rows[1] == ["HCNAF", "2 by 2", "3.9000 ± 0.0010", "3.896", "0.001230 ± 0.000040"]


@pytest.mark.parametrize("found", [0.3, math.nan])
def test_a_broken_bound_is_an_error_that_names_it(found):
    record(bounds=(Bound("fine", 0.1, 0.2),)).require()
    with pytest.raises(ReproductionError, match=r"KL of n = 2 is .*, expected at most 0.2"):
        record(bounds=(Bound("fine", 0.1, 0.2), Bound("KL of n = 2", found, 0.2))).require()


def test_peers_learn_one_density_per_condition():
    pytest.importorskip("zuko")
    toy, said = ToyTwo(sigma=2.0, seen_centres=((3, -3), (-3, 3)), unseen_centres=()), []
    model = peers.train_peers("AAF", toy, 200, 128, 0, 1, said.append)
    found = toys.scores(toy, model, toy.seen, 4000, seed=0)
    assert all(s.kl < 0.5 for s in found)  # the other centre's model would be 9 nats off
    assert said[0] == "AAF, model 1 of 2: step 0/200"


def test_a_figure_shows_what_it_is_given(tmp_path):
    toy = ToyTwo()
    panel = figure.panel("target", figure.Target(toy), [1], toy2.VIEW)
    row, column = np.unravel_index(panel.values.argmax(), panel.values.shape)
    axis = np.linspace(toy2.VIEW.low, toy2.VIEW.high, figure.CELLS)
    assert (axis[column], axis[row]) == (pytest.approx(4.0, abs=0.05), pytest.approx(12.0, abs=0.05))
    figure.draw(tmp_path / "figure.png", "a title", [[panel, panel], [panel, panel]], toy2.VIEW)
    assert (tmp_path / "figure.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_an_interrupted_training_stops_the_experiment_and_is_taken_up(tmp_path, monkeypatch):
    recipe = read_recipe("toy2-quick")
    settings = msgspec.structs.replace(recipe.optimiser, steps=4, batch=4, validate_every=4)
    recipe = msgspec.structs.replace(
        recipe, optimiser=settings, samples=msgspec.structs.replace(recipe.samples, validation=50)
    )
    monkeypatch.setattr(toys, "recipe_for", lambda name, seed: msgspec.structs.replace(recipe, seed=seed))
    exported = []
    monkeypatch.setattr(toys, "export_bundle", lambda model, bundle, **how: exported.append((bundle, how)))
    real, calls = toys.run_training, []

    def interrupted(*args, resume, **kwargs):
        calls.append(resume)
        return replace(real(*args, resume=resume, **kwargs), finished=resume)

    monkeypatch.setattr(toys, "run_training", interrupted)
    with pytest.raises(Stopped):
        toys.make_bundle(recipe, tmp_path, Request(out=tmp_path), Clock(), density_only=True)
    toys.make_bundle(recipe, tmp_path, Request(out=tmp_path, resume=True), Clock(), density_only=True)
    assert calls == [False, True]
    assert exported == [(tmp_path / "bundle", {"force": True, "density_only": True})]
