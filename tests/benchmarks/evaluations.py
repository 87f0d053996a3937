"""How many points a forecaster evaluates for a map: what is left of its edges once rows are interpolated."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from hcnaf_runtime.flow import Flow

POINTS: dict[str, Callable[..., int]] = {
    "cells": lambda theta, x, weight, doubt, y: x.size * y.shape[1],
    "meshes": lambda theta, x, y: x.size * y.shape[1],
    "checks": lambda theta, x, y: y.size,
    "F_1": lambda theta, x: x.size,
}
METHODS = {"cells": "cell_mass", "meshes": "grid_cdf", "checks": "conditional_cdf", "F_1": "marginal_cdf"}


def per_map(call: Callable[[], Any], maps: int) -> dict[str, float]:
    """Points evaluated for each of so many maps: of F_2 for cells, on meshes and at landmarks, and for checks,
    with padding; and of F_1."""
    with counted() as found:
        call()
    return {name: number / maps for name, number in found.items()}


@contextmanager
def counted() -> Iterator[dict[str, int]]:
    """Count the points of all graph runs meanwhile, on whatever thread."""
    found, lock = dict.fromkeys(METHODS, 0), threading.Lock()
    originals = {name: getattr(Flow, method) for name, method in METHODS.items()}

    def counting(name: str) -> Callable[..., Any]:
        def method(self: Flow, *arguments: Any) -> Any:
            with lock:
                found[name] += POINTS[name](*arguments)
            return originals[name](self, *arguments)

        return method

    for name, method in METHODS.items():
        setattr(Flow, method, counting(name))
    try:
        yield found
    finally:
        for name, method in METHODS.items():
            setattr(Flow, method, originals[name])
