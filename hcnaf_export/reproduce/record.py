"""What an experiment returns: figures beside the paper's, bounds that must hold, and how it all came about."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from hcnaf_runtime.errors import InputError, ReproductionError

FILE = "record.json"
"""The record's name in an experiment's directory."""


class Stopped(Exception):  # noqa: N818 - not an error: asked for, and undone by resuming
    """A training was interrupted; its state is saved, and the same request with `resume` goes on from it."""


@dataclass(frozen=True, kw_only=True)
class Request:
    """How an experiment is to be run.

    Attributes:
        out: directory for everything it writes; trainings go to directories inside.
        quick: a small version for continuous integration, with loose bounds.
        seed: everything random follows from it.
        threads: of PyTorch and onnxruntime.
        resume: go on with what is in `out` instead of refusing it.
        data: a directory of recordings, where the experiment needs one.
        say: told what is being done, now and then.
    """

    out: Path
    quick: bool = False
    seed: int = 0
    threads: int = 1
    resume: bool = False
    data: Path | None = None
    say: Callable[[str], None] = field(default=lambda _: None)


class Figure(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One number.

    Attributes:
        value: ours. error: its standard error, None where there is none.
        paper: the paper's number for the same thing, None where it gives none.
    """

    value: float
    error: float | None = None
    paper: float | None = None


class Row(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What one model scores on one thing.

    Attributes:
        model: such as `HCNAF`, `NAF (zuko)`.
        on: what it was scored on, such as `2 by 2` or `test images`.
        figures: by name and unit, such as `NLL (nats)`; names are columns of the table.
    """

    model: str
    on: str
    figures: dict[str, Figure]


class Bound(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Something that must hold: `found` is at most `most`."""

    what: str
    found: float
    most: float

    @property
    def holds(self) -> bool:
        """False for NaN too."""
        return self.found <= self.most


class Record(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Everything about one run of an experiment.

    Attributes:
        experiment: `toy1`, `toy2` or `mnist`. about: what it is, a sentence or two.
        quick: whether it was the small version.
        settings: seed, sizes, steps, samples, budgets: what the figures follow from.
        machine: see `hcnaf_runtime.measure.machine`; versions and date are in it.
        rows: the figures. bounds: what must hold.
        seconds: wall time by part, such as `training`, `export`, `evaluation`.
        notes: what a reader must know to read the figures right.
    """

    experiment: str
    about: str
    quick: bool
    settings: dict[str, Any]
    machine: dict[str, Any]
    rows: tuple[Row, ...]
    bounds: tuple[Bound, ...] = ()
    seconds: dict[str, float] = {}
    notes: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Plain data, fit for JSON."""
        plain: dict[str, Any] = msgspec.to_builtins(self)
        return plain

    def write(self, out: Path) -> Path:
        """Write `record.json` to the directory `out`; its path."""
        path = out / FILE
        path.write_bytes(msgspec.json.format(msgspec.json.encode(self), indent=2) + b"\n")
        return path

    def table(self) -> tuple[list[str], list[list[str]]]:
        """Head and rows of text: a column per figure, and one for the paper's number where there is any."""
        columns = _columns(self.rows)
        head = ["model ", "on "]
        for name, in_paper in columns:
            head += [name, *(["paper"] if in_paper else [])]
        return head, [_cells(row, columns) for row in self.rows]

    def require(self) -> None:
        """Raise ReproductionError, naming what does not hold."""
        broken = [f"{b.what} is {b.found:.4g}, expected at most {b.most:g}" for b in self.bounds if not b.holds]
        if broken:
            raise ReproductionError(f"{self.experiment}: {'; '.join(broken)}; see {FILE}")


def read(path: Path) -> Record:
    """The record that `write` wrote. Raises InputError for any other file."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=Record)
    except (OSError, msgspec.DecodeError) as error:
        raise InputError(f"{path} is not the record of an experiment ({error}); run `hcnaf reproduce`") from error


def _columns(rows: Sequence[Row]) -> list[tuple[str, bool]]:
    """Names of figures in the order they first appear, each with whether the paper gives any."""
    names = dict.fromkeys(name for row in rows for name in row.figures)
    return [(n, any(n in r.figures and r.figures[n].paper is not None for r in rows)) for n in names]


def _cells(row: Row, columns: Sequence[tuple[str, bool]]) -> list[str]:
    cells = [row.model, row.on]
    for name, in_paper in columns:
        figure = row.figures.get(name)
        cells.append("" if figure is None else _number(figure))
        if in_paper:
            cells.append("" if figure is None or figure.paper is None else f"{figure.paper:g}")
    return cells


def _number(figure: Figure) -> str:
    """With as many digits as the standard error has two of, four where there is none."""
    if figure.error is None:
        return f"{figure.value:.4f}"
    digits = next((d for d in range(7) if figure.error * 10**d >= 1.0), 6) + 1
    return f"{figure.value:.{digits}f} ± {figure.error:.{digits}f}"


class Clock:
    """Wall time by part: `with clock("training"): ...`; parts of the same name add up."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, part: str) -> Iterator[None]:
        """Count the block's time under `part`."""
        start = time.monotonic()
        try:
            yield
        finally:
            self.seconds[part] = round(self.seconds.get(part, 0.0) + time.monotonic() - start, 1)
