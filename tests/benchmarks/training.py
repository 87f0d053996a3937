"""`python -m tests.benchmarks.training RECIPE`: how fast training is, and whether making batches holds it up.

Measured one after the other, in examples per second: batches made and thrown away (`loader`), steps on a batch
that is there already (`model`), steps on batches made meanwhile, as in training (`together`). Under torchrun every
process does its share, and the rates are those of all together:

    python -m tests.benchmarks.training pom-sim --data DATA --threads 1
    torchrun --nproc-per-node 2 -m tests.benchmarks.training pom-sim --data DATA --device cuda
"""

import argparse
import json
import platform
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import torch

from hcnaf_export.recipe import PlanarRecipe, read_recipe
from hcnaf_export.training.distributed import Team, team
from hcnaf_export.training.loop import Loop
from hcnaf_export.training.prefetch import Prefetch, loaders
from hcnaf_export.training.run import _fresh, make_task
from hcnaf_export.training.state import RunState

Json = dict[str, Any]


def main() -> int:
    """Measure; the leader writes JSON to stdout, or to --out."""
    args = _arguments()
    torch.set_num_threads(args.threads)
    recipe = read_recipe(args.recipe)
    assert isinstance(recipe, PlanarRecipe)
    optimiser = msgspec.structs.replace(recipe.optimiser, precision=args.precision, steps=10**6, minutes=0.0)
    recipe = msgspec.structs.replace(recipe, optimiser=optimiser)
    with team(torch.device(args.device)) as crew, tempfile.TemporaryDirectory() as folder:
        threads = args.loaders or loaders(crew.device)
        found = measure(recipe, args.data, crew, args.steps, threads, Path(folder))
        if crew.leads:
            text = json.dumps(facts(args, crew, threads) | found, indent=1) + "\n"
            args.out.write_text(text, encoding="utf-8") if args.out else sys.stdout.write(text)
    return 0


def measure(recipe: PlanarRecipe, data: Path | None, crew: Team, steps: int, threads: int, folder: Path) -> Json:
    """Medians over steps, and their spread."""
    task = make_task(recipe, data, crew.device)
    state = RunState.start(_fresh(recipe).to(crew.device), recipe.optimiser)
    loop = Loop(task, state, recipe, folder, device=crew.device, team=crew)
    ready = loop._batch(0)
    with loop.precision.lowered(state.model):
        for _ in range(3):
            loop._step(ready)  # first steps choose kernels and allocate
        rates = {
            "loader": _rates(_made(loop, steps, threads), task.examples),
            "model": _rates(_timed(lambda: loop._step(ready), steps), task.examples),
        }
        with Prefetch(loop._batch, 0, steps + threads + 2, threads) as batches:
            source = iter(batches)
            for _ in range(threads + 2):
                loop._step(next(source))  # those made ahead while nobody waited
            rates["together"] = _rates(_timed(lambda: loop._step(next(source)), steps), task.examples)
    medians = {name: value["median"] for name, value in rates.items()}
    kept = medians["together"] / medians["model"]
    return {"examples_per_step": task.examples, "rates": rates, "together_over_model": round(kept, 3)}


def _made(loop: Loop, steps: int, threads: int) -> Iterator[float]:
    """Seconds between batches."""
    with Prefetch(loop._batch, 0, steps + 2 * threads + 1, threads) as batches:
        source = iter(batches)
        for _ in range(2 * threads + 1):
            next(source)
        yield from _timed(lambda: next(source), steps)


def _timed(call: Callable[[], Any], times: int) -> Iterator[float]:
    for _ in range(times):
        start = time.perf_counter()
        call()
        yield time.perf_counter() - start


def _rates(seconds: Iterator[float], examples: int) -> Json:
    """Examples per second: by the median step, and all of them over all the time."""
    taken = list(seconds)
    return {
        "median": round(examples / statistics.median(taken), 1),
        "overall": round(examples * len(taken) / sum(taken), 1),
        "steps": len(taken),
    }


def facts(args: argparse.Namespace, crew: Team, threads: int) -> Json:
    """Where and how it was measured."""
    on_gpu = crew.device.type == "cuda"
    return {
        "recipe": args.recipe,
        "device": torch.cuda.get_device_name(crew.device) if on_gpu else f"CPU, {platform.machine()}",
        "processes": crew.size,
        "threads": args.threads,
        "loaders": threads,
        "precision": args.precision,
        "torch": str(torch.__version__),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.training", description=__doc__)
    parser.add_argument("recipe", help="name or path of a recipe, but for MNIST's")
    parser.add_argument("--data", type=Path, help="its data set")
    parser.add_argument("--device", default="cpu", help="cpu or cuda [cpu]")
    parser.add_argument("--threads", type=int, default=1, help="CPU threads of a process [1]")
    parser.add_argument("--loaders", type=int, help="threads that make batches [as training chooses]")
    parser.add_argument("--precision", choices=["float32", "bfloat16", "float16"], default="float32")
    parser.add_argument("--steps", type=int, default=20, help="timed steps of each kind [20]")
    parser.add_argument("--out", type=Path, help="file to write [stdout]")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
