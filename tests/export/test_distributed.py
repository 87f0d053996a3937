"""Two processes under torchrun learn what one does, and one of them writes; 16 bits stay away from the flow."""

import os
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest
import torch

from hcnaf_export.baselines import build
from hcnaf_export.recipe import parse_recipe, read_recipe, to_toml
from hcnaf_export.training.pom import theta_of
from hcnaf_export.training.precision import Precision
from hcnaf_export.training.run import make_task, run_training
from hcnaf_export.training.share import Share
from hcnaf_runtime.errors import RecipeError
from tests.export import processes, synthetic

TINY = processes.tiny()
CPU = torch.device("cpu")
CLOSE = 1e-4
"""Of losses (nats) and weights: sums over two processes are rounded in another order."""


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return synthetic.write(tmp_path_factory.mktemp("data") / "set")


@pytest.fixture(scope="module")
def together(tmp_path_factory, data):
    """What either of two processes found, and where they wrote."""
    out = tmp_path_factory.mktemp("together")
    root = Path(__file__).parents[2]
    paths = [str(root / part) for part in (".", "models", "runtime", "cli")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
    command = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    done = subprocess.run(
        [sys.executable, *command, str(root / "tests/export/processes.py"), str(data), str(out)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return out, [torch.load(out / f"found{rank}.pt", weights_only=True) for rank in (0, 1)]


@pytest.fixture(scope="module")
def alone(tmp_path_factory, data):
    """The same runs in one process."""
    out = tmp_path_factory.mktemp("alone")
    return {
        "whole": processes.watched(TINY, data, out / "whole"),
        "toy": processes.watched(processes.toy(), None, out / "toy"),
    }


def same(one, other, tolerance=0.0):
    return all(
        torch.allclose(a.double(), b.double(), rtol=0.0, atol=tolerance)
        for a, b in zip(one.values(), other.values(), strict=True)
    )


@pytest.mark.parametrize("name", ["whole", "toy"])
def test_two_processes_learn_what_one_does(together, alone, name):
    _, (leader, follower) = together
    assert len(alone[name]["losses"]) == leader[name]["step"]
    assert leader[name]["losses"] == pytest.approx(alone[name]["losses"], abs=CLOSE)
    assert follower[name]["losses"] == leader[name]["losses"]
    assert leader[name]["scores"] == pytest.approx(alone[name]["scores"], abs=CLOSE)
    assert same(leader[name]["model"], alone[name]["model"], CLOSE)


@pytest.mark.parametrize("name", ["whole", "toy"])
def test_each_process_learns_from_half_a_batch(together, alone, name):
    for found in together[1]:
        assert [2 * size for size in found[name]["sizes"]] == alone[name]["sizes"]


@pytest.mark.parametrize("name", ["whole", "toy", "stopped", "resumed"])
def test_all_processes_end_with_the_same_weights(together, name):
    _, (leader, follower) = together
    assert same(leader[name]["model"], follower[name]["model"])


def test_batch_norms_follow_the_whole_batch(together, alone):
    _, (leader, _) = together
    names = [name for name in alone["whole"]["model"] if "running_" in name]
    assert names
    for name in names:
        assert torch.allclose(leader["whole"]["model"][name], alone["whole"]["model"][name], rtol=1e-3, atol=1e-4)


def test_one_process_writes(together):
    out, (_, follower) = together
    files = {"model.pt", "last.pt", "checkpoint.pt", "metrics.jsonl", "recipe.toml"}
    for name in ("whole", "toy", "stopped"):
        assert {p.name for p in (out / "rank0" / name).iterdir()} == files
    assert not (out / "rank1").exists()
    assert follower["whole"]["scores"] == {}


def test_an_interrupt_of_one_process_stops_all_and_they_resume_exactly(together):
    for found in together[1]:
        assert (found["stopped"]["finished"], found["stopped"]["step"]) == (False, processes.STOP)
        assert (found["resumed"]["finished"], found["resumed"]["step"]) == (True, TINY.optimiser.steps)
        assert same(found["resumed"]["model"], found["whole"]["model"])


def test_what_cannot_run_is_refused_by_all(together):
    for found in together[1]:
        assert "not empty" in found["taken"]
        assert "15 examples, which 2 processes cannot share evenly" in found["odd"]


def test_one_process_speaks(together):
    _, (leader, follower) = together
    assert leader["spoken"][0] == follower["spoken"][0] == 0
    assert "8 steps" in leader["spoken"][1]
    assert follower["spoken"][1] == ""


@pytest.mark.parametrize("name", ["pom-tiny", "toy2"])
@pytest.mark.parametrize("step", [0, 11])
def test_shares_make_the_whole_batch(data, name, step):
    task = make_task(read_recipe(name), data, CPU)
    whole, parts = task.batch(step), [task.batch(step, Share(k, 4)) for k in range(4)]
    for field in ("reference", "others", "horizons", "crop", "points"):
        if hasattr(whole, field):
            pieces = torch.cat([getattr(part, field) for part in parts], dim=1 if name == "toy2" else 0)
            assert torch.allclose(getattr(whole, field), pieces, atol=1e-5, equal_nan=True)


@pytest.mark.parametrize("head", ["hcnaf", "mixture", "affine", "spline"])
def test_every_weight_takes_part(data, head):
    """DistributedDataParallel waits for the gradient of every one."""
    if head == "spline":
        pytest.importorskip("zuko")
    recipe = msgspec.structs.replace(TINY, model=with_head(head))
    model = build(recipe.model)
    task = make_task(recipe, data, CPU)
    task.loss(model, task.batch(0)).backward()
    assert [name for name, p in model.named_parameters() if p.grad is None] == []


def with_head(head):
    return msgspec.convert({**msgspec.to_builtins(TINY.model), "head": head}, type(TINY.model))


def test_a_batch_is_shared_evenly_or_not_at_all():
    assert [Share(k, 3).of(12) for k in range(3)] == [slice(0, 4), slice(4, 8), slice(8, 12)]
    with pytest.raises(RecipeError, match="multiple of 3"):
        Share(0, 3).of(16)


def test_16_bits_are_refused_on_a_cpu(tmp_path, data):
    low = msgspec.structs.replace(TINY, optimiser=msgspec.structs.replace(TINY.optimiser, precision="bfloat16"))
    assert parse_recipe(to_toml(low)) == low
    with pytest.raises(RecipeError, match="for CUDA devices"):
        run_training(low, data, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_16_bits_end_before_the_head(data):
    """torch can lower a CPU's networks too, which is enough to see where the bits go."""
    task = make_task(TINY, data, CPU)
    model, batch = build(TINY.model).eval(), task.batch(0)
    torch.nn.init.normal_(model.head.weights.weight, std=0.1)
    seen = []
    handle = model.hypernet.head.register_forward_pre_hook(
        lambda module, inputs: seen.extend((x.dtype, torch.is_autocast_enabled("cpu")) for x in inputs)
    )
    with torch.no_grad():
        exact = theta_of(model, batch)
        with Precision("bfloat16", CPU).lowered(model):
            low = theta_of(model, batch)
        again = theta_of(model, batch)
    handle.remove()
    assert set(seen) == {(torch.float32, False)}
    assert low.dtype == torch.float32
    assert 0.0 < float((low - exact).abs().max()) < 0.1 * float(exact.abs().max())
    assert torch.equal(again, exact)
    with Precision("float32", CPU).lowered(model):
        assert torch.equal(theta_of(model, batch), exact)


def test_an_overflow_is_no_step_and_lowers_the_factor():
    weight = torch.nn.Parameter(torch.ones(1))
    optimiser = torch.optim.SGD([weight], lr=0.5)
    precision = Precision("float16", CPU)
    before = precision.state["scale"]
    precision.backward((weight * torch.inf).sum(), optimiser)
    assert not torch.isfinite(weight.grad).all()
    precision.step(optimiser, good=False)
    assert weight.item() == 1.0
    assert precision.state["scale"] < before
    optimiser.zero_grad()
    precision.backward((3.0 * weight).sum(), optimiser)
    assert float(weight.grad) == pytest.approx(3.0)
    precision.step(optimiser, good=True)
    assert weight.item() == pytest.approx(-0.5)
    other = Precision("float16", CPU)
    other.state = precision.state
    assert other.state == precision.state
    assert Precision("bfloat16", CPU).state == {}
