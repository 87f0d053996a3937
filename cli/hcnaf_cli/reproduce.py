"""`hcnaf reproduce`: the paper's own experiments, each by one command."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from hcnaf_cli.errors import INTERRUPTED
from hcnaf_cli.output import ProgressLine, duration, show_json, table, talk
from hcnaf_runtime.errors import InputError

if TYPE_CHECKING:
    from hcnaf_export.reproduce.record import Record, Request

F = TypeVar("F", bound=Callable[..., None])

_OPTIONS = (
    click.option(
        "--out", type=click.Path(path_type=Path), required=True, metavar="DIR", help="Directory to make."
    ),
    click.option("--quick", is_flag=True, help="A small version with loose bounds, for continuous integration."),
    click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True),
    click.option("--threads", type=click.IntRange(min=1), default=1, show_default=True, help="CPU threads."),
    click.option("--resume", is_flag=True, help="Go on with what is in DIR, exactly where it stopped."),
    click.option("--json", "as_json", is_flag=True, help="Print the record instead of the table."),
)


def experiment_options(function: F) -> F:
    """The options that all experiments have."""
    for option in reversed(_OPTIONS):
        function = option(function)
    return function


@click.group()
def reproduce() -> None:
    """Repeat an experiment of the paper: train, export, score the bundle, compare.

    DIR gets record.json, figure.png, the trainings and the bundles that were scored. The exit code is 1 if a bound
    does not hold.
    """


@reproduce.command()
@experiment_options
@click.option("--no-peers", is_flag=True, help="Leave out AAF and NAF (which need the extra `bench`).")
def toy1(no_peers: bool, **options: Any) -> None:
    """One model for three distributions: 2 x 2, 5 x 5 and 10 x 10 Gaussians."""
    from hcnaf_export.reproduce import toy1

    run_experiment(lambda request: toy1.run(request, with_peers=not no_peers), **options)


@reproduce.command()
@experiment_options
def toy2(**options: Any) -> None:
    """A Gaussian around its condition, at conditions seen in training and at others; three seeds."""
    from hcnaf_export.reproduce import toy2

    run_experiment(toy2.run, **options)


@reproduce.command()
@experiment_options
@click.option(
    "--data", type=click.Path(path_type=Path), metavar="DIR", help="MNIST's four idx files; --quick does without."
)
@click.option("--no-trend", is_flag=True, help="Leave out the trend over sizes and the steps in the paper's size.")
def mnist(no_trend: bool, **options: Any) -> None:
    """Handwritten digits under their class, 784 dimensions."""
    from hcnaf_export.reproduce import mnist

    run_experiment(lambda request: mnist.run(request, with_trend=not no_trend), **options)


def run_experiment(
    run: "Callable[[Request], Record]",
    *,
    out: Path,
    quick: bool,
    seed: int,
    threads: int,
    resume: bool,
    as_json: bool,
    data: Path | None = None,
) -> None:
    """Run an experiment, write its record and print it; exit as its bounds say."""
    from hcnaf_export.reproduce.record import Request, Stopped

    _make(out, resume)
    with ProgressLine() as line:
        request = Request(out=out, quick=quick, seed=seed, threads=threads, resume=resume, data=data, say=line)
        try:
            record = run(request)
        except Stopped:
            talk("interrupted; go on with the same command and --resume")
            raise click.exceptions.Exit(INTERRUPTED) from None
    path = record.write(out)
    show_json(record.as_dict()) if as_json else click.echo(record_text(record))
    talk(f"wrote {click.format_filename(path)}")
    record.require()


def _make(out: Path, resume: bool) -> None:
    """A new or empty directory, or the one to go on with."""
    if resume and not out.is_dir():
        raise InputError(f"{out} is not there to go on with; leave out --resume")
    if not resume and out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out} is not empty; choose a new directory, or --resume to go on with it")
    out.mkdir(parents=True, exist_ok=True)


def record_text(record: "Record") -> str:
    """What was done, the figures beside the paper's, the bounds, and what to know."""
    spent = ", ".join(f"{part} {duration(seconds)}" for part, seconds in record.seconds.items())
    bounds = [[b.what, f"{b.found:.5f}", f"{b.most:g}", "holds" if b.holds else "BROKEN"] for b in record.bounds]
    parts = [
        f"{record.experiment}{' (quick)' if record.quick else ''}: {record.about}",
        table(*record.table()),
        table(["must hold ", "found", "at most", "verdict "], bounds) if bounds else "",
        *record.notes,
        f"Time: {spent}.",
    ]
    return "\n\n".join(part for part in parts if part)
