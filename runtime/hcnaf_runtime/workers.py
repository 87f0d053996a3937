"""Threads that share out work: one graph on one thread each, instead of all threads on one graph.

The flow's graphs are small: a second thread inside a run waits and is waited for at every node. Independent runs
side by side need no such agreement, and give the same numbers however many threads there are.
"""

import itertools
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")


class Workers:
    """`threads` threads, the caller's own among them. The others start when first needed and end with this."""

    def __init__(self, threads: int) -> None:
        self.threads = threads
        here, lanes = threading.local(), itertools.count(1)

        def begin() -> None:  # holds on to no Workers: they end when nobody else does
            here.lane = next(lanes)

        self._pool = ThreadPoolExecutor(threads - 1, "hcnaf", begin) if threads > 1 else None
        self._here = here

    @property
    def lane(self) -> int:
        """Which thread this is: 0 for a caller's own, 1 to `threads` - 1 for the others."""
        return getattr(self._here, "lane", 0)

    @property
    def busy(self) -> bool:
        """Whether this is called from inside of a call to `work`."""
        return getattr(self._here, "busy", False)

    def each(self, work: Callable[[T], object], items: Iterable[T]) -> None:
        """Call `work` with each of the items, in no particular order. Raises what the first failing call raises.

        Inside of a call to `work` it goes one by one: nothing waits for a thread that waits.
        """
        todo = list(items)
        if self.busy:
            for item in todo:
                work(item)
            return
        queue, lock = iter(todo), threading.Lock()
        extra = min(self.threads, len(todo)) - 1
        others = [self._pool.submit(self._drain, work, queue, lock) for _ in range(extra)] if self._pool else []
        try:
            self._drain(work, queue, lock)
        finally:
            # Also after a failure: what runs on must not outlive the call.
            failures = [other.exception() for other in others]
        for failure in failures:
            if failure is not None:
                raise failure

    def _drain(self, work: Callable[[T], object], queue: Iterator[T], lock: threading.Lock) -> None:
        self._here.busy = True
        try:
            while True:
                with lock:
                    item = next(queue, _END)
                if isinstance(item, _End):
                    return
                work(item)
        finally:
            self._here.busy = False


class _End:
    """What comes after the last item."""


_END = _End()
