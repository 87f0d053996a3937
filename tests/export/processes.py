"""What torchrun starts in test_distributed.py: each process runs all of it and leaves its findings in a file.

torchrun --nproc-per-node 2 tests/export/processes.py DATA OUT
"""

import contextlib
import datetime
import io
import os
import signal
import sys
import warnings
from pathlib import Path

import msgspec
import torch
import torch.distributed as dist

from hcnaf_cli.train import main
from hcnaf_export.recipe import read_recipe, to_toml
from hcnaf_export.training.distributed import Team
from hcnaf_export.training.loop import Loop
from hcnaf_export.training.run import run_training
from hcnaf_export.training.state import RunState
from hcnaf_runtime.errors import CheckpointError, RecipeError

STOP = 10
"""The step at which one process is interrupted."""


def tiny():
    """Batch norms, a map, drawn boxes."""
    return read_recipe("pom-tiny")


def toy():
    """A few steps on samples, the first of them for location and scale alone."""
    recipe = read_recipe("toy2")
    few = msgspec.structs.replace(recipe.optimiser, steps=8, units_first=4, warm_up=2, validate_every=8)
    model = msgspec.convert({**msgspec.to_builtins(recipe.model), "flow": {"hidden": 8}}, type(recipe.model))
    samples = msgspec.structs.replace(recipe.samples, validation=500)
    return msgspec.structs.replace(recipe, optimiser=few, model=model, samples=samples)


def odd():
    """A batch that two processes cannot share."""
    recipe = tiny()
    return msgspec.structs.replace(recipe, optimiser=msgspec.structs.replace(recipe.optimiser, batch=15))


class Watch:
    """Notes the size and loss of every step and the state of every run; interrupts this process at a step."""

    def __init__(self, stop=None):
        self.losses, self.states, self.sizes, self.stop = [], [], [], stop

    def __enter__(self):
        self.before = Team.mean, RunState.start, Loop._step
        Team.mean = lambda team, value: self._note(self.before[0](team, value))
        RunState.start = lambda *args: self._keep(self.before[1](*args))
        Loop._step = lambda loop, batch: self.sizes.append(batch.points.numel()) or self.before[2](loop, batch)
        return self

    def __exit__(self, *_):
        Team.mean, RunState.start, Loop._step = self.before

    def _note(self, loss):
        self.losses.append(loss)
        if len(self.losses) == self.stop:
            signal.raise_signal(signal.SIGINT)
        return loss

    def _keep(self, state):
        self.states.append(state)
        return state


def watched(recipe, data, out, *, stop=None, **options):
    """Train; what came of it, as plain data and tensors."""
    with Watch(stop) as watch:
        result = run_training(recipe, data, out, threads=1, **options)
    facts = {"finished": result.finished, "step": result.step, "scores": result.scores, "losses": watch.losses}
    return facts | {"sizes": watch.sizes, "model": watch.states[0].model.state_dict()}


def refused(error, *args, **options):
    """What a run that must not start says."""
    try:
        run_training(*args, **options)
    except error as found:
        return str(found)
    return "nothing"


def spoken(*words):
    """What the command prints, and its exit code."""
    out = io.StringIO()
    code = None
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
        try:
            main([str(word) for word in words])
        except SystemExit as end:
            code = end.code
    return code, out.getvalue()


def all_of_it(data, out):
    """Every process names a directory of its own: only the leader's may come to be."""
    rank = int(os.environ["RANK"])
    mine = out / f"rank{rank}"
    few = out / f"few{rank}.toml"
    few.write_text(to_toml(toy()), encoding="utf-8")
    return {
        "whole": watched(tiny(), data, mine / "whole"),
        "toy": watched(toy(), None, mine / "toy"),
        "stopped": watched(tiny(), data, mine / "stopped", stop=STOP if rank == 1 else None),
        "resumed": watched(tiny(), data, mine / "stopped", resume=True),
        "taken": refused(CheckpointError, tiny(), data, mine / "whole"),
        "odd": refused(RecipeError, odd(), data, mine / "odd"),
        "spoken": spoken("train", few, "--out", mine / "spoken"),
    }


if __name__ == "__main__":
    warnings.simplefilter("error")
    torch.set_num_threads(1)
    dist.init_process_group("gloo", timeout=datetime.timedelta(seconds=60))
    found = all_of_it(Path(sys.argv[1]), Path(sys.argv[2]))
    dist.destroy_process_group()
    torch.save(found, Path(sys.argv[2]) / f"found{os.environ['RANK']}.pt")
