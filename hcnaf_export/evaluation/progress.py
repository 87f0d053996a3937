"""How far an evaluation is."""

from __future__ import annotations

from collections.abc import Callable

Report = Callable[[float], None]
"""Told the fraction done, in [0, 1]."""


class Stages:
    """Counts work done of a known `total` and tells `report`, if there is one."""

    def __init__(self, report: Report | None, total: int) -> None:
        self._report, self._total, self._done = report, max(total, 1), 0

    def done(self, count: int) -> None:
        """So much more is done."""
        self._done = min(self._done + count, self._total)
        if self._report:
            self._report(self._done / self._total)

    def finish(self) -> None:
        """All is done: what was counted on may have been impossible."""
        self.done(self._total)
