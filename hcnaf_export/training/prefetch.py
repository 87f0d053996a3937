"""The next batches are made by other threads while the current one is learnt from."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

import torch

T = TypeVar("T")


class Prefetch(Generic[T]):
    """Iterates make(first), make(first + 1), ... up to make(last - 1), in order, `threads` + 1 of them made ahead.

    A failure in `make` is raised where its result is taken. Use as a context manager.
    """

    def __init__(self, make: Callable[[int], T], first: int, last: int, threads: int = 1) -> None:
        self._make, self._next, self._last, self._depth = make, first, last, threads + 1
        self._pool = ThreadPoolExecutor(max_workers=threads, thread_name_prefix="prefetch")
        self._ahead: deque[Future[T]] = deque()

    def __enter__(self) -> Prefetch[T]:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)

    def __iter__(self) -> Iterator[T]:
        while self._next < self._last or self._ahead:
            while self._next < self._last and len(self._ahead) <= self._depth:
                self._ahead.append(self._pool.submit(self._make, self._next))
                self._next += 1
            yield self._ahead.popleft().result()


def loaders(device: torch.device) -> int:
    """Threads that make batches: one on a CPU, whose cores are the model's; a share of the cores for a GPU."""
    if device.type == "cpu":
        return 1
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(max(1, cores // int(os.environ.get("LOCAL_WORLD_SIZE", "1")) - 1), 16)
