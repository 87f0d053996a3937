"""What commands say: data on stdout, talk on stderr, files as a whole or not at all."""

import json
import math
import os
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from hcnaf_runtime.errors import InputError

QUIET_EVERY = 60.0
"""Seconds between two lines of progress where there is no terminal."""


def talk(text: str) -> None:
    """A line on stderr."""
    click.echo(text, err=True)


def show_json(data: Any) -> None:
    """`data` on stdout as JSON; numbers that JSON has no word for become null."""
    click.echo(json.dumps(_plain(data), indent=2, allow_nan=False))


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Right-aligned columns under their names; a column is left-aligned where its name ends with a blank."""
    lines = [[name.strip() for name in head], *rows]
    widths = [max(len(line[k]) for line in lines) for k in range(len(head))]
    left = [name.endswith(" ") for name in head]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if flush else cell.rjust(width)
            for cell, width, flush in zip(line, widths, left, strict=True)
        ).rstrip()
        for line in lines
    )


def check_target(path: Path | None) -> None:
    """Refuse a file that cannot be written before time is spent on its content. None is fine.

    Raises InputError for a directory that is missing or read-only, or a target that is no ordinary file.
    """
    if path is None:
        return
    folder = path.parent
    if not folder.is_dir():
        raise InputError(f"{path}: cannot be written, there is no directory {folder}; make it first")
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: cannot be written, it exists and is not a file; name another")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InputError(f"{path}: cannot be written, the directory is read-only; name another")


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Say which file it was when writing fails (a full disk, a directory that went away)."""
    try:
        yield
    except OSError as e:
        raise InputError(f"{path}: cannot be written ({e.strerror or e})") from e


class ProgressLine:
    """Progress on stderr: one line rewritten in place on a terminal, at most a line a minute elsewhere."""

    def __init__(self) -> None:
        self._stream = sys.stderr
        self._terminal = self._stream.isatty()
        self._width = 0
        self._told = time.monotonic()

    def __call__(self, text: str) -> None:
        """Show `text` in place of what was shown before."""
        if self._terminal:
            self._stream.write("\r" + text.ljust(self._width))
            self._stream.flush()
            self._width = len(text)
        elif time.monotonic() - self._told >= QUIET_EVERY:
            self._told = time.monotonic()
            talk(text)

    def __enter__(self) -> "ProgressLine":
        return self

    def __exit__(self, *_: object) -> None:
        if self._terminal and self._width:
            self._stream.write("\n")
            self._stream.flush()


def duration(seconds: float) -> str:
    """Such as 45 s, 12 min 05 s or 3 h 20 min."""
    if not math.isfinite(seconds):
        return "?"
    whole = max(round(seconds), 0)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
