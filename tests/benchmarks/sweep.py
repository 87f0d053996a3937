"""What a map costs against its size, the flow's sizes, and how many maps are asked for."""

from collections.abc import Callable, Iterable
from functools import partial

from hcnaf_runtime import Bundle, Forecaster, Scene, embedded_scenes
from hcnaf_runtime.bench import LOST_MASS, Bench, crowd
from hcnaf_runtime.measure import latency
from tests.benchmarks.density import Density, window
from tests.benchmarks.sections import Json, Setting

CELLS = (50, 100, 200, 400, 800)
WIDTHS = (10, 20, 50, 100)
LAYERS = (1, 2, 3)
HORIZONS = (1, 2, 5, 10, 20)
AGENTS = (1, 2, 5, 10)


FLOWS = ((3, 20), (3, 100), *((3, H) for H in WIDTHS if H not in (20, 100)), *((L, 20) for L in LAYERS if L != 3))
"""L and H of every flow that is measured, here and elsewhere."""


def export_flows(setting: Setting) -> Json:
    """Export what is not there yet, so that no other section has to."""
    for L, H in FLOWS:
        setting.density(L, H)
    return {"flows": len(FLOWS)}


def measure_sweep(setting: Setting) -> Json:
    """Median seconds per call, dense and certified, for each value of each size.

    Wide flows; agents and horizons are those of the bundle that is served, hyper-network included.
    """
    return {
        "cells": _flows(setting, [(n, 3, 20, n) for n in CELLS]),
        "H": _flows(setting, [(H, 3, H, 200) for H in WIDTHS]),
        "L": _flows(setting, [(L, L, 20, 200) for L in LAYERS]),
        **_forecasts(setting),
    }


def _flows(setting: Setting, cases: Iterable[tuple[int, int, int, int]]) -> list[Json]:
    return [
        {"value": value} | _both(setting, partial(_pom, setting.density(L, H), cells))
        for value, L, H, cells in cases
    ]


def _pom(density: Density, cells: int) -> Callable[..., object]:
    return partial(density.forecaster.pom, density.condition(), window(cells))


def _both(setting: Setting, make: Callable[[], Callable[..., object]]) -> Json:
    """`make` gives the call anew each time: a new condition or scene, which nothing is remembered of."""

    def call(lost_mass: float) -> float:
        return latency(
            lambda pom: pom(lost_mass=lost_mass), make, setting.seconds / 4, min(5, setting.least)
        ).median

    return {"dense": call(0.0), "certified": call(LOST_MASS)}


def _forecasts(setting: Setting) -> Json:
    paths = {p.stem: p for p in setting.files} or embedded_scenes()
    try:
        bundle = Bundle.open(setting.bundle)
    except Exception as e:  # no model is embedded yet: the rest is worth having
        return {"note": str(e)}
    bench = Bench(Forecaster(bundle, setting.threads), {name: Scene.load(path) for name, path in paths.items()})
    scene = next(iter(bench.scenes.values()))

    def case(agents: int, horizons: int) -> Json:
        def make() -> Callable[..., object]:
            return partial(bench.forecaster.pom, crowd(scene, agents), bench.grid, bench.horizons(horizons))

        return _both(setting, make)

    return {
        "horizons": [{"value": n} | case(1, n) for n in HORIZONS],
        "agents": [{"value": n} | case(n, 20) for n in AGENTS],
    }
