"""`python -m tests.benchmarks`: measure, compare, and write docs/results/performance.* and the picture.

Every section is written as soon as it is measured, so an interrupt loses only the one it falls into, and sections
measured earlier are kept. See README.md beside this file.
"""

import argparse
import json
import math
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import torch

from tests.benchmarks import plot, report, sections
from tests.benchmarks.density import source
from tests.benchmarks.quiet import Quiet, speed
from tests.benchmarks.sections import Json, Setting
from tests.benchmarks.sweep import export_flows, measure_sweep

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
FLOWS = ROOT / "build" / "benchmarks"
"""Exported flows are kept here, by what they were made from."""

SECTIONS: dict[str, Callable[[Setting], Json]] = {
    "export": export_flows,
    "rates": sections.measure_rates,
    "dense": sections.measure_dense,
    "graphs": sections.measure_graphs,
    "libraries": sections.measure_libraries,
    "vehicle": sections.measure_vehicle,
    "sweep": measure_sweep,
    "published": sections.measure_published,
    "memory": sections.measure_memory,
}
"""In this order: what matters most and takes least comes first, once the flows are there."""


UNTIMED = "export", "memory"
"""Sections that may as well be measured on a busy machine."""


def main() -> int:
    """Parse, measure, write; 1 if a section failed."""
    args = _arguments()
    torch.set_num_threads(args.threads)
    warnings.filterwarnings("ignore", module="torch._dynamo")  # remarks on what it traces, not on results
    failed = []
    folder = FLOWS / source()
    setting = Setting(args.threads, args.seconds, folder, args.bundle, tuple(args.scene), args.scenes, args.least)
    results = _load(args.out)
    asked = [] if args.render else args.only
    if asked or "machine" not in results:
        results["machine"] = sections.facts(setting)
    moment = Quiet(partial(speed, args.threads), results.get("fastest", 0.0), args.patience)
    paces: dict[str, float] = {}
    for name in _turns(asked, paces, moment):
        start = time.perf_counter()
        section = partial(SECTIONS[name], setting)
        try:
            found, pace = (section(), math.inf) if name in UNTIMED else moment.measure(section)
        except Exception as e:  # the other sections are worth having
            failed.append(name)
            paces[name] = math.inf
            print(f"{name}: failed: {type(e).__name__}: {e}", file=sys.stderr)
            continue
        if pace >= paces.get(name, 0.0):
            paces[name], results[name] = pace, found
            results.setdefault("measured", {})[name] = sections.now()
        if name not in UNTIMED:
            results.setdefault("pace", {})[name], results["fastest"] = paces[name], moment.fastest
        _write(results, args.out)
        print(f"{name}: {time.perf_counter() - start:.0f} s", file=sys.stderr)
    _write(results, args.out)
    print(report.targets(results))
    return 1 if failed else 0


def _turns(asked: list[str], paces: dict[str, float], moment: Quiet) -> Iterator[str]:
    """The sections to measure, in turn; then again those that did not meet a quiet moment, going by `paces`."""
    yield from asked
    while busy := [name for name, pace in paces.items() if moment.worth_another(pace)]:
        yield min(busy, key=paces.__getitem__)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks", description=__doc__)
    parser.add_argument("--only", type=_names, default=list(SECTIONS), help=f"of {','.join(SECTIONS)}")
    parser.add_argument("--out", type=Path, default=DOCS, help="where results/ and images/ are [docs]")
    parser.add_argument("--bundle", type=Path, help="bundle to serve [the embedded one]")
    parser.add_argument("--scene", type=Path, action="append", default=[], help="scene to serve [the samples]")
    parser.add_argument("--threads", type=int, default=min(2, os.cpu_count() or 1), help="of everybody [2]")
    parser.add_argument("--seconds", type=float, default=1.0, help="per fast case [1]")
    parser.add_argument("--least", type=int, default=10, help="calls per case, whatever the time [10]")
    parser.add_argument("--scenes", type=int, default=10_000, help="served in `memory` [10000]")
    parser.add_argument("--patience", type=float, default=0.0, help="seconds to spend on quieter moments [0]")
    parser.add_argument("--render", action="store_true", help="only write the tables and the picture again")
    return parser.parse_args()


def _names(text: str) -> list[str]:
    names = text.split(",")
    unknown = [name for name in names if name not in SECTIONS]
    if unknown:
        raise argparse.ArgumentTypeError(f"no section {unknown[0]}; there are {', '.join(SECTIONS)}")
    return names


def _load(out: Path) -> Json:
    path = out / "results" / "performance.json"
    found: Json = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    return found


def _write(results: Json, out: Path) -> None:
    folder = out / "results"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "performance.json").write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    (folder / "performance.md").write_text(report.markdown(results), encoding="utf-8")
    plot.draw(results, out / "images" / "performance.png")
    if (out / "performance.md").is_file():
        report.splice(out / "performance.md", results)


if __name__ == "__main__":
    sys.exit(main())
