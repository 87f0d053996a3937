"""What a call costs: latency over many repetitions, memory of this process, and the machine it is measured on."""

import datetime
import os
import platform
import re
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from hcnaf_runtime._version import __version__

T = TypeVar("T")

STATUS = Path("/proc/self/status")
WARM_UP = 3
"""Calls before the first one that counts, at least; a tenth of the time goes to them too."""


@dataclass(frozen=True)
class Latency:
    """Seconds per call over `repetitions` calls."""

    repetitions: int
    median: float
    p95: float
    p99: float
    max: float

    @property
    def tail(self) -> float:
        """p99 / median: 1 for a call that always takes the same time."""
        return self.p99 / self.median

    def to_dict(self) -> dict[str, float]:
        """Every number, `tail` included."""
        return asdict(self) | {"tail": self.tail}


def latency(
    call: Callable[[T], object],
    prepare: Callable[[], T],
    seconds: float = 1.0,
    least: int = 10,
    most: int = 2000,
    clock: Callable[[], float] = time.perf_counter,
) -> Latency:
    """Time `call(prepare())`, `call` alone, for about `seconds`, but `least` to `most` times.

    Warm-up calls come first. What `call` returns is dropped after the clock is read.
    """
    start = clock()
    warm = 0
    while warm < min(WARM_UP, least) or clock() - start < seconds / 10:
        call(prepare())
        warm += 1
        if warm >= most:
            break
    spent: list[float] = []
    start = clock()
    while len(spent) < least or (clock() - start < seconds and len(spent) < most):
        given = prepare()
        before = clock()
        result = call(given)
        spent.append(clock() - before)
        del result
    return summary(spent)


def summary(spent: list[float]) -> Latency:
    """The latency that a list of seconds per call amounts to; the list must not be empty."""
    median, p95, p99 = (float(q) for q in np.quantile(spent, [0.5, 0.95, 0.99]))
    return Latency(len(spent), median, p95, p99, max(spent))


@dataclass(frozen=True)
class Memory:
    """Bytes of this process in memory now, and the most there have been (since `reset_peak`, where that works)."""

    resident: int
    peak: int


def memory() -> Memory | None:
    """What the system says of this process; None where there is no /proc."""
    try:
        text = STATUS.read_text()
    except OSError:
        return None
    found = {key: int(value) << 10 for key, value in re.findall(r"^(VmRSS|VmHWM):\s+(\d+) kB", text, re.M)}
    return Memory(found["VmRSS"], found["VmHWM"]) if len(found) == 2 else None


def reset_peak() -> None:
    """Start the peak anew from what is resident now. Does nothing where the system does not allow it."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return


def machine(threads: int) -> dict[str, Any]:
    """The facts without which a time means nothing."""
    import onnxruntime  # here, because it costs more than the rest of the package together

    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {
        "cpu": _cpu(),
        "cores": usable,
        "threads": threads,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "numpy": np.__version__,
        "onnxruntime": onnxruntime.__version__,
        "hcnaf": __version__,
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }


def _cpu() -> str:
    try:
        match = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.M)
    except OSError:
        match = None
    return match[1].strip() if match else platform.processor() or "unknown"
