"""Ctrl-C and SIGTERM, held back until a step is done, so that what is saved is whole."""

from __future__ import annotations

import signal
import threading
from types import FrameType


class Interrupt:
    """While entered, in the main thread, SIGINT and SIGTERM set `requested`; a second one acts at once.

    The handlers that were there before are put back on leaving. In another thread nothing is installed.
    """

    def __init__(self) -> None:
        self.requested = False
        self._before: dict[int, object] = {}

    def __enter__(self) -> Interrupt:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._before[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)  # type: ignore[arg-type]
        self._before.clear()

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True
