"""The sections of the comparison: each measures one thing and returns plain data for performance.json."""

import datetime
import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import torch

from hcnaf_models import flow
from hcnaf_models.spec import FlowSpec
from hcnaf_runtime import Condition
from hcnaf_runtime.bench import LOST_MASS
from hcnaf_runtime.measure import latency, machine
from tests.benchmarks import evaluations, libraries, ov, published, rates
from tests.benchmarks.density import SPREAD, Density, centres, window

Json = dict[str, Any]

HIDDEN = (20, 100)
MAPS, EXACT = 20, 3
"""Maps per call, and how many are compared with ones as exact as can be."""


@dataclass(frozen=True)
class Setting:
    """For all sections.

    Threads of everybody, `seconds` and `least` calls per case, where exported flows are kept, a bundle to serve
    (None: the embedded one) with its scene files, and how many scenes to serve for memory.
    """

    threads: int
    seconds: float
    folder: Path
    bundle: Path | None = None
    files: tuple[Path, ...] = ()
    scenes: int = 10_000
    least: int = 10

    def density(self, L: int, H: int) -> Density:
        return Density.make(L, H, self.folder, self.threads)

    def time(self, call: Callable[[], Any], least: int = 10) -> Json:
        """Latency of a call without arguments."""
        return latency(lambda _: call(), lambda: None, self.seconds, min(least, self.least)).to_dict()

    def beside(self, density: Density, peer: Callable[[], Any], least: int = 10) -> Json:
        """Latency of a peer, and with it the seconds of our dense map, measured right before and after.

        A machine is not as fast in one minute as in the next.
        """
        maps = partial(density.forecaster.pom, density.condition(MAPS), window())
        before, found, after = self.time(maps), self.time(peer, least), self.time(maps)
        return found | {"ours": (before["median"] + after["median"]) / (2 * MAPS)}


def now() -> str:
    """Date and time, ISO 8601."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


def facts(setting: Setting) -> Json:
    """The machine and what is installed on it."""
    versions = {"torch": str(torch.__version__)}
    for name in ("zuko", "nflows", "openvino"):
        try:
            versions[name] = metadata.version(name)
        except ImportError:
            versions[name] = "absent"
    return machine(setting.threads) | versions


def measure_rates(setting: Setting) -> Json:
    """GEMM and tanh rates (1/s)."""
    short = setting.seconds / 10
    gemm = {str(H): rates.gemm(H, setting.threads, short) for H in HIDDEN}
    return {"gemm": gemm, "tanh": rates.tanh(setting.threads, short)}


def measure_dense(setting: Setting) -> Json:
    """Our maps after theta, 200 x 200 cells, L = 3: dense and certified, of a wide and a narrow density."""
    return {
        f"H={H} {name}": _maps(setting, setting.density(3, H), scale)
        for H in HIDDEN
        for name, scale in (("wide", 1.0), ("narrow", 1.0 / SPREAD))
    }


def _maps(setting: Setting, density: Density, scale: float) -> Json:
    found: Json = {}
    for maps in (1, MAPS):
        condition = density.condition(maps, scale)
        dense = partial(density.forecaster.pom, condition, window())
        certified = partial(dense, lost_mass=LOST_MASS)
        found |= {f"dense x{maps}": setting.time(dense), f"certified x{maps}": setting.time(certified)}
    sparse, full = certified(), dense()
    return found | {
        "maps": MAPS,
        "lost_mass": float(np.max(sparse.lost_mass)),
        "difference": float(np.abs(sparse.mass - full.mass).sum(axis=(2, 3)).max()),
        "errors": _errors(density, density.condition(EXACT, scale)),
        "window_mass": float(full.window_mass.min()),
        "occupied": float((full.mass[0, 0] > 1e-8).mean()),
        "evaluations": evaluations.per_map(dense, MAPS),
    }


def _errors(density: Density, condition: Condition) -> Json:
    """How far dense maps are from ones refined as far as float32 goes: the worst cell, and all cells of a map."""
    pom = partial(density.forecaster.pom, condition, window())
    off = np.abs(pom().mass.astype(np.float64) - pom(tolerance=1e-8).mass)
    return {"cell": float(off.max()), "map": float(off.sum(axis=(2, 3)).max())}


def measure_published(setting: Setting) -> Json:
    """PyTorch on the 40,000 centres: log-sum-exp as published and the tangent form, eager and compiled; and with
    weights for every point, as the authors' code has them."""
    return {f"H={H}": _pytorch(setting, setting.density(3, H)) for H in HIDDEN}


def _pytorch(setting: Setting, density: Density) -> Json:
    x = torch.from_numpy(centres())
    forms = {"log-sum-exp": published.log_prob, "tangent": flow.log_prob}
    found: Json = {}
    for form, function in forms.items():
        for mode, maker in (("eager", lambda f: f), ("compiled", torch.compile)):
            call = maker(partial(function, density.spec, density.theta))
            whole = partial(_parts, form, call, density.spec, x)
            with torch.no_grad():
                # The slow ones take seconds: two calls after the warm-up say enough.
                least = 2 if form == "log-sum-exp" else 5
                found[f"{form}, {mode}"] = setting.beside(density, whole, least)
    each = partial(published.log_prob_each, density.spec, density.theta)
    with torch.no_grad():
        whole = partial(_parts, "log-sum-exp", each, density.spec, x)
        found["log-sum-exp, weights per point"] = setting.beside(density, whole, 1)
        found["agreement"] = _agreement(density, x[::97])
    return found


def _parts(
    form: str, call: Callable[[torch.Tensor], torch.Tensor], spec: FlowSpec, x: torch.Tensor
) -> torch.Tensor:
    return published.in_parts(call, spec, x) if form == "log-sum-exp" else call(x)


def _agreement(density: Density, x: torch.Tensor) -> float:
    """Largest difference (nats) of the published form from ours without our normaliser, where density is."""
    plain = FlowSpec(layers=density.spec.layers, hidden=density.spec.hidden, support="paper")
    ours, theirs = flow.log_prob(plain, density.theta, x), published.log_prob(plain, density.theta, x)
    return float((ours - theirs)[ours > -20.0].abs().max())


def measure_libraries(setting: Setting) -> Json:
    """log_prob of other libraries' flows at 40,000 points over [-5, 5]^2."""
    x, density = torch.from_numpy(centres() / 10.0), setting.density(3, 20)
    found: Json = {}
    for name, make in libraries.FLOWS.items():
        try:
            log_prob = make()
        except ImportError as e:
            found[name] = {"absent": e.name}
            continue
        with torch.no_grad():  # zuko's NAF turns gradients on for its own Jacobian
            found[name] = setting.beside(density, partial(log_prob, x), least=5)
    return found


def measure_graphs(setting: Setting) -> Json:
    """Single graphs in onnxruntime and OpenVINO: the density at the centres; a map with one node per column."""
    found: Json = {}
    for H in HIDDEN:
        density = setting.density(3, H)
        for graph in ("flow", "cell_mass"):
            ours = ov.in_onnxruntime(density, graph)
            case: Json = {"onnxruntime": setting.time(ours)}
            try:
                theirs = ov.in_openvino(density, graph)
                case["openvino"] = setting.time(theirs)
                case["difference"] = float(np.abs(theirs() - ours()).max())
            except ImportError:
                case["openvino"] = {"absent": "openvino"}
            found[f"{graph} H={H}"] = case
    return found


def measure_vehicle(setting: Setting) -> Json:
    """`hcnaf-run bench` on the bundle, in a process without PyTorch.

    Whole forecasts longest: of 200 calls, p99 would be the slowest but one; of a thousand it means something.
    """
    times = {"hypernet,dense,certified,points,samples,risk": 3, "forecast": 20}
    parts = [_hcnaf_run(setting, only, f"--seconds={n * setting.seconds}") for only, n in times.items()]
    return parts[0] | {"cases": [case for part in parts for case in part["cases"]]}


def measure_memory(setting: Setting) -> Json:
    """`hcnaf-run bench`: memory while serving scenes of changing size."""
    return _hcnaf_run(setting, "memory", f"--scenes={setting.scenes}")


def _hcnaf_run(setting: Setting, only: str, *options: str) -> Json:
    start = [sys.executable, "-c", "from hcnaf_cli.run import main; main()", "bench", "--json", f"--only={only}"]
    command = [*start, f"--threads={setting.threads}", *options, *(f"--scene={file}" for file in setting.files)]
    if setting.bundle is not None:
        command.append(str(setting.bundle))
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"hcnaf-run bench: {done.stderr.strip()[-500:]}")
    result: Json = json.loads(done.stdout)
    return result
