"""One thread ahead: the next batches are made while the current one is learnt from."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

T = TypeVar("T")


class Prefetch(Generic[T]):
    """Iterates make(first), make(first + 1), ... up to make(last - 1), `depth` of them made ahead.

    A failure in `make` is raised where its result is taken. Use as a context manager.
    """

    def __init__(self, make: Callable[[int], T], first: int, last: int, depth: int = 2) -> None:
        self._make, self._next, self._last, self._depth = make, first, last, depth
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="prefetch")
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
