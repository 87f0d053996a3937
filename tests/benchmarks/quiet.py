"""Sections measured at quiet moments: neighbours of a virtual machine slow it down for minutes or hours.

A fixed piece of work, timed before and after a section, tells how fast the machine was. It alone decides whether a
section is measured again, and which of its measurements counts, never what they found.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import onnx

from tests.benchmarks import rates

Json = dict[str, Any]

ENOUGH = 0.85
"""A moment is quiet if the machine does this share of the most it was seen to do."""

PAUSE = 10.0
"""Seconds to wait for a quieter moment."""

WIDTH, SECONDS = 20, 0.5
"""The piece of work: products and tanh in turn at this width, for so long."""


def speed(threads: int) -> float:
    """Operations per second (products and tanh as one each) of the piece of work."""
    node, rng = onnx.helper.make_node, np.random.default_rng(0)
    nodes = [
        node("MatMul", ["W", f"h{k}"], [f"h{k + 1}"]) if k % 2 else node("Tanh", [f"h{k}"], [f"h{k + 1}"])
        for k in range(rates.CHAIN)
    ]
    W = rng.normal(scale=WIDTH**-0.5, size=(WIDTH, WIDTH)).astype(np.float32)
    start = rng.normal(size=(WIDTH, rates.NUMBERS[0] // WIDTH)).astype(np.float32)
    return rates.rate(nodes, start, W, float(rates.CHAIN), threads, SECONDS)


@dataclass
class Quiet:
    """How fast the machine was seen to be at most (`fastest`), and how many seconds it may be waited for."""

    probe: Callable[[], float]
    fastest: float
    patience: float
    sleep: Callable[[float], object] = time.sleep
    clock: Callable[[], float] = time.perf_counter

    def measure(self, section: Callable[[], Json]) -> tuple[Json, float]:
        """What `section` returned at the quietest moment, and how fast the machine was then."""
        found: list[tuple[float, Json]] = []
        while True:
            before = self._waited()
            start = self.clock()
            result = section()
            found.append((min(before, self._look()), result))
            if len(found) > 1:
                self.patience -= self.clock() - start
            pace, result = max(found, key=lambda pair: pair[0])
            if not self.worth_another(pace):
                return result, pace

    def _waited(self) -> float:
        """The machine's speed, once it is quiet or patience is out."""
        while self.worth_another(pace := self._look()):
            self.sleep(PAUSE)
            self.patience -= PAUSE
        return pace

    def worth_another(self, pace: float) -> bool:
        """Whether a moment at which the machine was so fast was not quiet, and there is patience left."""
        return pace < ENOUGH * self.fastest and self.patience > 0.0

    def _look(self) -> float:
        pace = self.probe()
        self.fastest = max(self.fastest, pace)
        return pace
