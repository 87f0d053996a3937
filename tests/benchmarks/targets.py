"""What must hold, against what was measured: one row per target."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from statistics import median
from typing import Any

Json = dict[str, Any]

EAGER, PER_POINT = "log-sum-exp, eager", "log-sum-exp, weights per point"

PEERS = (
    "zuko NSF (3 transforms)",
    "zuko MAF (3 transforms)",
    "nflows NSF (3 transforms)",
    "nflows MAF (3 transforms)",
)


@dataclass(frozen=True)
class Target:
    """A measured number and its limit: an upper one, or a lower one where `least`.

    `value` raises KeyError, ValueError or IndexError where nothing was measured.
    """

    name: str
    unit: str
    limit: float
    prototype: str
    value: Callable[[Json], float]
    least: bool = False

    def row(self, results: Json) -> Json:
        """name, unit, limit, prototype, found, share (found / limit), met."""
        try:
            found: float | None = self.value(results)
        except (KeyError, ValueError, IndexError):
            found = None
        met = None if found is None else (found >= self.limit if self.least else found <= self.limit)
        share = None if found is None else found / self.limit
        known = {"name": self.name, "unit": self.unit, "limit": self.limit, "prototype": self.prototype}
        return known | {"found": found, "share": share, "least": self.least, "met": met}


def dense(results: Json, H: int) -> float:
    """Seconds of a dense map of the wide flow, L = 3, when MAPS are asked for at once."""
    case = results["dense"][f"H={H} wide"]
    return float(case[f"dense x{case['maps']}"]["median"]) / int(case["maps"])


def times_ours(case: Json) -> float:
    """How many times as long as our dense map, measured around it, a peer takes."""
    return float(case["median"]) / float(case["ours"])


def _published(results: Json, H: int, form: str = EAGER) -> float:
    return times_ours(results["published"][f"H={H}"][form])


def _peer(results: Json, names: tuple[str, ...]) -> float:
    return min(times_ours(results["libraries"][name]) for name in names if "median" in results["libraries"][name])


def _cases(results: Json, section: str, containing: str = "") -> list[Json]:
    return [c for c in results["vehicle"]["cases"] if c["section"] == section and containing in c["name"]]


def _certified(results: Json) -> float:
    """Of whole scenes: one agent alone fills no graph run."""
    cases = [c for c in _cases(results, "certified") if ", 1 agent " not in c["name"]]
    return 1e3 * median(float(case["per_map"]) for case in cases)


def _median(results: Json, section: str, containing: str) -> float:
    return 1e3 * max(float(case["seconds"]["median"]) for case in _cases(results, section, containing))


def _tail(results: Json) -> float:
    return max(float(case["seconds"]["tail"]) for case in _cases(results, "forecast"))


TARGETS = (
    Target("dense exact map, L=3 H=20", "ms per map", 1.2, "2.2", lambda r: 1e3 * dense(r, 20)),
    Target("dense exact map, L=3 H=100", "ms per map", 9.0, "11.5", lambda r: 1e3 * dense(r, 100)),
    Target("certified map, shipped model, all agents, median over scenes", "ms per map", 0.5, "0.8", _certified),
    Target(
        "whole forecast, 1 agent x 20 horizons",
        "ms",
        25.0,
        "-",
        lambda r: _median(r, "forecast", "certified, 1 agent "),
    ),
    Target(
        "whole forecast, 10 agents x 20 horizons",
        "ms",
        100.0,
        "-",
        lambda r: _median(r, "forecast", "certified, 10 agents"),
    ),
    Target("100 points x 20 horizons after theta", "ms", 1.0, "-", lambda r: _median(r, "points", "")),
    *(
        Target(f"against {name}, H={H}", "times", limit, prototype, partial(_published, H=H, form=form), True)
        for form, name in ((EAGER, "eager log-sum-exp"), (PER_POINT, "the same, weights per point"))
        for H, limit, prototype in ((20, 500.0, "480"), (100, 1500.0, "1400"))
    ),
    Target("against zuko NAF(64)", "times", 60.0, "39", lambda r: _peer(r, ("zuko NAF (1 transform)",)), True),
    Target("against the fastest of NSF, MAF, nflows", "times", 30.0, "19", lambda r: _peer(r, PEERS), True),
    Target("resident memory while serving", "MiB", 150.0, "-", lambda r: r["memory"]["memory"]["peak"] / 2**20),
    Target("its growth over the second half", "MiB", 2.0, "-", lambda r: r["memory"]["memory"]["growth"] / 2**20),
    Target("1,000 samples x 20 horizons after theta", "ms", 30.0, "-", lambda r: _median(r, "samples", "")),
    Target("risk, 200 trajectories x 20 x 5 agents", "ms", 50.0, "-", lambda r: _median(r, "risk", "")),
    Target("p99 / median, whole forecasts", "", 1.5, "-", _tail),
)
