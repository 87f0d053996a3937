"""One graph of a bundle, loaded into onnxruntime with every setting made on purpose."""

import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy.typing as npt

from hcnaf_runtime import manifest
from hcnaf_runtime.errors import BundleError, InputError

Array = npt.NDArray[Any]

MOST_THREADS = 4
"""More threads than this do not pay for graphs of this size."""

_REGION = 32 << 20
"""Bytes of the arena's first region: all that two threads need, with room. What is free in one region can be
joined, in several it cannot; and what is never touched takes no memory."""


def default_threads() -> int:
    """The CPUs this process may use, at most MOST_THREADS."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(usable, MOST_THREADS)


@dataclass(frozen=True)
class Settings:
    """How a graph runs.

    `threads` may be used by one run: all there are for the hyper-network, one for the flow's graphs, which run
    side by side (see `workers`). With `spinning` they wait for the next run in a busy loop: the lowest latency,
    for a CPU that has nothing else to do. `flush_denormals` makes numbers below 1e-38 zero, in the graph and from
    then on in the thread that loaded it; the flow's graphs make none.

    Threads that run graphs side by side may have a `lane` each. In lane 0 graphs share one arena; in any other
    each has its own: memory that goes to and fro between threads leaves the cache of one for that of the other.
    """

    threads: int
    spinning: bool = False
    flush_denormals: bool = False
    lane: int = 0


class Session:
    """A loaded graph. Safe to run from several threads at once.

    Raises BundleError if onnxruntime is older than the bundle asks for, cannot load the file, or finds other
    inputs or outputs in it than the manifest says.
    """

    def __init__(self, path: Path, contract: manifest.Graph, settings: Settings, onnxruntime_min: str) -> None:
        import onnxruntime  # here, because it costs more than the rest of the package together

        _check_version(onnxruntime.__version__, onnxruntime_min, path)
        self._path = path
        try:
            self._session = onnxruntime.InferenceSession(
                path, _options(onnxruntime, settings), providers=["CPUExecutionProvider"]
            )
        except Exception as e:  # onnxruntime's exceptions share no base but Exception
            raise BundleError(f"{path}: onnxruntime cannot load it ({_first_line(e)}); export again") from e
        _check_names(path, "inputs", contract.inputs, self._session.get_inputs())
        _check_names(path, "outputs", contract.outputs, self._session.get_outputs())
        self.inputs = tuple(t.name for t in contract.inputs)
        self.outputs = tuple(t.name for t in contract.outputs)

    def run(self, outputs: Sequence[str], feeds: dict[str, Array]) -> list[Array]:
        """The named outputs for `feeds`. Raises InputError if onnxruntime refuses them."""
        try:
            result: list[Array] = self._session.run(list(outputs), feeds)
        except Exception as e:
            raise InputError(f"{self._path}: onnxruntime refused the input ({_first_line(e)})") from e
        return result


def _options(onnxruntime: Any, settings: Settings) -> Any:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = settings.threads
    options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_ALL
    # A plan of memory is kept for every shape of inputs ever seen: with shapes that change it only grows.
    options.enable_mem_pattern = False
    options.log_severity_level = 3  # errors only: everything that matters is raised
    # Threads that spin between calls take the CPU from whatever else runs on the vehicle.
    options.add_session_config_entry("session.intra_op.allow_spinning", str(int(settings.spinning)))
    if settings.flush_denormals:
        options.add_session_config_entry("session.set_denormal_as_zero", "1")
    if settings.lane == 0:
        _share_arena(onnxruntime)
        options.add_session_config_entry("session.use_env_allocators", "1")
    return options


@cache
def _share_arena(onnxruntime: Any) -> None:
    """One arena for all graphs of a lane, where each would keep what its largest run took.

    Only sessions that ask for it use it. If the program has shared an arena of its own, that one serves.
    """
    where = onnxruntime.OrtMemoryInfo(
        "Cpu", onnxruntime.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, onnxruntime.OrtMemType.DEFAULT
    )
    # No limit, further regions twice as large each time, and the rest as onnxruntime has it.
    how = {"max_mem": 0, "arena_extend_strategy": 0}
    how |= {"initial_chunk_size_bytes": _REGION, "max_dead_bytes_per_chunk": -1}
    with suppress(Exception):  # there is one already; onnxruntime's exceptions share no base but Exception
        onnxruntime.create_and_register_allocator(where, onnxruntime.OrtArenaCfg(how))


def _check_version(installed: str, smallest: str, path: Path) -> None:
    if _numbers(installed) < _numbers(smallest):
        raise BundleError(f"{path}: onnxruntime {installed} found, {smallest} or newer expected; update it")


def _numbers(version: str) -> tuple[int, ...]:
    parts = version.split("+")[0].split(".")[:3]
    return tuple(int(part) if part.isdigit() else 0 for part in parts)


def _check_names(path: Path, what: str, expected: list[manifest.Tensor], found: list[Any]) -> None:
    names, wanted = sorted(t.name for t in found), sorted(t.name for t in expected)
    if names != wanted:
        raise BundleError(f"{path}: {what} {names} found, the manifest says {wanted}; export it again")


def _first_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]
