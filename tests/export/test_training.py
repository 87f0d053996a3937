"""The training loop: it learns, it resumes exactly, it saves when stopped, it leaves bad steps out."""

import json
import math
import signal
from itertools import pairwise
from typing import NamedTuple

import msgspec
import pytest
import torch
from torch import nn

from hcnaf_export.checkpoint import load_checkpoint
from hcnaf_export.recipe import Optimiser, parse_recipe, read_recipe
from hcnaf_export.training.average import Average
from hcnaf_export.training.loop import Loop, schedule
from hcnaf_export.training.prefetch import Prefetch
from hcnaf_export.training.run import make_task, run_training
from hcnaf_export.training.state import RunState
from hcnaf_models.model import build
from hcnaf_runtime.errors import CheckpointError, RecipeError, TrainingError
from tests.export import synthetic

TINY = read_recipe("pom-tiny")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return synthetic.write(tmp_path_factory.mktemp("data") / "set")


@pytest.fixture(scope="module")
def whole(tmp_path_factory, data):
    """An uninterrupted run."""
    out = tmp_path_factory.mktemp("run") / "whole"
    return run_training(TINY, data, out, threads=1)


def test_a_run_leaves_what_it_promises(whole):
    assert whole.finished
    assert whole.step == TINY.optimiser.steps
    assert {p.name for p in whole.out.iterdir()} == {
        "model.pt", "last.pt", "checkpoint.pt", "metrics.jsonl", "recipe.toml",
    }  # fmt: skip
    assert parse_recipe((whole.out / "recipe.toml").read_text(encoding="utf-8")) == TINY
    lines = [json.loads(line) for line in (whole.out / "metrics.jsonl").read_text(encoding="utf-8").splitlines()]
    validations = [line["validation"] for line in lines if "validation" in line]
    assert len(validations) == 2
    assert set(validations[0]) == {"0.5 s", "1 s", "2 s", "3 s", "4 s", "mean"}


def test_a_run_learns(whole, data):
    task = make_task(TINY, data, torch.device("cpu"))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        fresh = build(TINY.model).eval()
    trained = load_checkpoint(whole.out / "model.pt").model
    batches = [task.batch(1000 + i) for i in range(8)]
    with torch.no_grad():
        before, after = (sum(float(task.loss(m, b)) for b in batches) / 8 for m in (fresh, trained))
    assert after < before - 0.3


def test_a_checkpoint_says_how_it_came_about(whole):
    loaded = load_checkpoint(whole.out / "model.pt")
    assert loaded.config == TINY.model
    facts = loaded.training
    assert facts["recipe"] == "pom-tiny"
    assert facts["steps"] == whole.step
    assert facts["optional_channels"] == list(TINY.model.channels)
    assert {"seed", "seconds", "versions", "machine", "date", "data", "windows", "nll_floor"} <= set(facts)
    assert loaded.scores["validation"] == whole.scores


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_stopped_run_resumes_exactly(tmp_path, data, whole, number):
    before = signal.getsignal(number)

    def stop(progress):
        if progress.step == 10:
            signal.raise_signal(number)

    first = run_training(TINY, data, tmp_path / "run", threads=1, progress=stop)
    assert not first.finished
    assert first.step == 10
    assert signal.getsignal(number) == before
    second = run_training(TINY, data, tmp_path / "run", resume=True, threads=1)
    assert second.finished
    assert second.scores == whole.scores
    for name in ("model.pt", "last.pt"):
        one, other = load_checkpoint(whole.out / name).model, load_checkpoint(second.out / name).model
        for a, b in zip(one.state_dict().values(), other.state_dict().values(), strict=True):
            assert torch.equal(a, b)


def test_a_finished_run_resumes_to_the_same_end(tmp_path, data):
    short = msgspec.structs.replace(TINY, optimiser=msgspec.structs.replace(TINY.optimiser, steps=3))
    first = run_training(short, data, tmp_path / "run", threads=1)
    again = run_training(short, data, tmp_path / "run", resume=True, threads=1)
    assert again.finished
    assert (again.step, again.scores) == (first.step, first.scores)


def test_training_leaves_global_state_alone(tmp_path, data):
    rng, threads = torch.random.get_rng_state(), torch.get_num_threads()
    short = msgspec.structs.replace(TINY, optimiser=msgspec.structs.replace(TINY.optimiser, steps=1))
    run_training(short, data, tmp_path / "run", threads=threads + 1)
    assert torch.equal(rng, torch.random.get_rng_state())
    assert torch.get_num_threads() == threads


def test_time_can_end_a_run(tmp_path, data):
    brief = msgspec.structs.replace(TINY.optimiser, steps=10_000, minutes=0.01)
    result = run_training(msgspec.structs.replace(TINY, optimiser=brief), data, tmp_path / "run", threads=1)
    assert result.finished
    assert result.step < 10_000


def test_what_cannot_run_is_refused(tmp_path, data, whole):
    with pytest.raises(RecipeError, match="needs a data set"):
        run_training(TINY, None, tmp_path / "run")
    with pytest.raises(RecipeError, match="device"):
        run_training(TINY, data, tmp_path / "run", device="abacus")
    with pytest.raises(CheckpointError, match=r"no checkpoint\.pt to resume"):
        run_training(TINY, data, tmp_path / "none", resume=True)
    with pytest.raises(CheckpointError, match="not empty"):
        run_training(TINY, data, whole.out)
    other = msgspec.structs.replace(TINY, seed=5)
    with pytest.raises(CheckpointError, match="another recipe"):
        run_training(other, data, whole.out, resume=True)


class Nothing(NamedTuple):
    """A batch of no data: the step alone."""

    step: torch.Tensor


class MadeUp:
    """A task whose losses and scores are given."""

    examples = 1

    def __init__(self, bad=(), scores=()):
        self.bad, self.scores, self.facts, self.seen = bad, list(scores), {}, []

    def batch(self, step):
        return Nothing(torch.tensor(step))

    def loss(self, model, batch):
        total = sum(p.square().sum() for p in model.parameters())
        return total * math.nan if int(batch.step) in self.bad else total

    def validate(self, model):
        self.seen.append({name: v.clone() for name, v in model.state_dict().items()})
        return {"mean": self.scores.pop(0)}


def toy_loop(tmp_path, task, **settings):
    recipe = read_recipe("toy2")
    optimiser = Optimiser(**{"steps": 6, "warm_up": 0, "validate_every": 2, "patience": 3, **settings})
    model = msgspec.convert({"size": 2, "hidden": [4], "flow": {"hidden": 3}}, type(recipe.model))
    recipe = msgspec.structs.replace(recipe, optimiser=optimiser, model=model)
    state = RunState.start(build(model), optimiser)
    return Loop(task, state, recipe, tmp_path, device=torch.device("cpu"))


def test_bad_steps_change_nothing_and_are_counted(tmp_path):
    loop = toy_loop(tmp_path, MadeUp(bad=(0, 1), scores=[1.0, 2.0, 3.0]))
    start = [p.detach().clone() for p in loop.state.model.parameters()]
    loop._step(Nothing(torch.tensor(0)))
    assert all(torch.equal(a, b) for a, b in zip(start, loop.state.model.parameters(), strict=True))
    loop._step(Nothing(torch.tensor(1)))
    loop._step(Nothing(torch.tensor(2)))
    assert not all(torch.equal(a, b) for a, b in zip(start, loop.state.model.parameters(), strict=True))
    assert (loop.state.bad, loop.state.bad_in_a_row, loop.state.step) == (2, 0, 3)


def test_units_are_trained_first(tmp_path):
    loop = toy_loop(tmp_path, MadeUp(), units_first=1)
    head = loop.state.model.hypernet.head
    torch.nn.init.ones_(head.units.weight)
    shape, units = head.weights.bias.detach().clone(), head.units.weight.detach().clone()
    loop._step(Nothing(torch.tensor(0)))
    assert torch.equal(head.weights.bias, shape)
    assert not torch.equal(head.units.weight, units)
    loop._step(Nothing(torch.tensor(1)))
    assert not torch.equal(head.weights.bias, shape)


def test_divergence_ends_the_run(tmp_path):
    loop = toy_loop(tmp_path, MadeUp(bad=range(9), scores=[1.0, 2.0, 3.0]))
    with pytest.raises(TrainingError, match="not finite for 3 steps"):
        loop.run()


def test_the_best_weights_are_kept_by_value(tmp_path):
    task = MadeUp(scores=[2.0, 1.0, 3.0])
    loop = toy_loop(tmp_path, task)
    assert loop.run()
    assert (loop.state.best, loop.state.best_step) == ({"mean": 1.0}, 4)
    best = loop.state.best_weights
    assert all(torch.equal(best[name], value) for name, value in task.seen[1].items())
    assert any(not torch.equal(best[name], value) for name, value in task.seen[2].items())


def test_a_score_that_is_not_finite_is_never_best(tmp_path):
    loop = toy_loop(tmp_path, MadeUp(scores=[math.nan, 1.0, -math.inf]))
    loop.run()
    assert loop.state.best == {"mean": 1.0}


def test_the_schedule_warms_up_and_ends_low():
    settings = Optimiser(steps=100, warm_up=10, final=0.05)
    rates = [schedule(settings, step, step / 100) for step in range(101)]
    assert rates[0] == pytest.approx(0.1, rel=0.01)
    assert all(a < b for a, b in pairwise(rates[:10]))
    assert all(a > b for a, b in pairwise(rates[10:]))
    assert rates[-1] == pytest.approx(0.05)


def test_the_average_of_still_weights_is_the_weights():
    model = nn.Sequential(nn.Linear(3, 2), nn.BatchNorm1d(2))
    average = Average(model, 0.9)
    for _ in range(20):
        average.update(model)
    for a, b in zip(average.model.parameters(), model.parameters(), strict=True):
        assert torch.allclose(a, b, atol=1e-7)


def test_the_average_follows_and_takes_buffers():
    model = nn.BatchNorm1d(2)
    average = Average(model, 0.5)
    with torch.no_grad():
        model.weight.fill_(3.0)
    model.running_mean.fill_(7.0)
    for _ in range(40):
        average.update(model)
    assert torch.allclose(average.model.weight, torch.full((2,), 3.0), atol=1e-5)
    assert torch.equal(average.model.running_mean, model.running_mean)
    assert not average.model.training


def test_prefetch_keeps_the_order_and_passes_on_failures():
    with Prefetch(lambda i: i * i, 3, 9) as batches:
        assert list(batches) == [i * i for i in range(3, 9)]

    def fail(i):
        if i == 2:
            raise ValueError("two")
        return i

    with Prefetch(fail, 0, 5) as batches:
        found = iter(batches)
        assert [next(found), next(found)] == [0, 1]
        with pytest.raises(ValueError, match="two"):
            next(found)
