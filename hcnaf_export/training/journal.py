"""The metrics file: one JSON object per line, appended as the run goes."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import msgspec


class Journal:
    """Appends to `path`; each line is on the disk when `write` returns. NaN and infinity become null."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def write(self, **entry: Any) -> None:
        """Add one line."""
        with self.path.open("ab") as file:
            file.write(msgspec.json.encode(_plain(entry)) + b"\n")


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, float):
        return round(value, 6) if math.isfinite(value) else None
    return value
