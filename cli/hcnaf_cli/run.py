"""`hcnaf-run`: forecasts on the vehicle, with numpy and onnxruntime alone.

Imports are inside the commands: a forecast loads only what it uses.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

from hcnaf_cli import options
from hcnaf_cli.bench import bench
from hcnaf_cli.errors import Commands
from hcnaf_cli.occupancy import occupancy
from hcnaf_cli.risk import risk
from hcnaf_cli.sample import sample
from hcnaf_runtime._version import __version__

if TYPE_CHECKING:
    from hcnaf_runtime import Maps, Scene

_bundle = click.argument("bundle", type=options.FILE, required=False)


@click.group(cls=Commands, name="hcnaf-run", context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="hcnaf-run")
def main() -> None:
    """Forecast where vehicles will be, with exact probabilities. Needs no PyTorch."""


@main.command()
@options.scene
@options.sample
@options.model
@click.option("-o", "--out", type=options.FILE, metavar="FORECAST.npz", help="Write the maps.")
@click.option("--plot", type=options.FILE, metavar="OUT.png", help="Draw the maps over the scene (extra `plot`).")
@click.option("--grid", metavar="COLSxROWS@M", help="Cells of each map [default: 200x200@0.5].")
@click.option(
    "--lost-mass",
    type=float,
    default=0.0,
    show_default=True,
    help="Leave cells empty while they hold less together.",
)
@options.horizons
@options.frame
@options.threads
@options.as_json
def forecast(
    scene: Path | None,
    sample: str | None,
    model: Path | None,
    out: Path | None,
    plot: Path | None,
    grid: str | None,
    lost_mass: float,
    horizons: str | None,
    frame: Literal["agent", "scene"],
    threads: int | None,
    as_json: bool,
) -> None:
    """Occupancy maps of SCENE: the probability of every cell, per agent and horizon."""
    from hcnaf_cli import report
    from hcnaf_cli.inputs import open_scene, parse_horizons
    from hcnaf_cli.output import check_target, show_json, talk
    from hcnaf_runtime import Forecaster, Grid

    check_target(out)
    check_target(plot)
    if plot is not None:
        _check_picture(plot)
    name, given = open_scene(scene, sample)
    forecaster = Forecaster(model, threads)
    cells = None if grid is None else Grid.parse(grid)
    maps = forecaster.pom(given, cells, parse_horizons(horizons), frame, lost_mass=lost_mass)
    for note in maps.notes:
        talk(f"note: {note}")
    _write(out, plot, name, given, maps)
    if as_json:
        show_json(report.forecast_json(name, forecaster.bundle, maps))
    else:
        click.echo(report.forecast_text(name, maps))
        talk(f"hyper-network {maps.timings.hypernet * 1e3:.1f} ms, maps {maps.timings.maps * 1e3:.1f} ms")


def _check_picture(path: Path) -> None:
    from hcnaf_cli.picture import check_picture

    check_picture(path)


def _write(out: Path | None, plot: Path | None, name: str, scene: "Scene", maps: "Maps") -> None:
    from hcnaf_cli.output import talk, writing

    if out is not None:
        with writing(out):
            maps.save(out)
        talk(f"wrote {click.format_filename(out)}")
    if plot is not None:
        from hcnaf_cli.picture import draw

        with writing(plot):
            draw(plot, name, scene, maps)
        talk(f"wrote {click.format_filename(plot)}")


@main.command()
@options.scene
@options.sample
@click.option(
    "--points", type=options.FILE, required=True, metavar="FILE", help="x,y in metres: .npy, or lines of text."
)
@options.model
@options.horizons
@options.frame
@options.threads
@options.as_json
def logprob(
    scene: Path | None,
    sample: str | None,
    points: Path,
    model: Path | None,
    horizons: str | None,
    frame: Literal["agent", "scene"],
    threads: int | None,
    as_json: bool,
) -> None:
    """Log-density (nats per square metre) of each agent of SCENE at given points."""
    from hcnaf_cli import report
    from hcnaf_cli.inputs import open_scene, parse_horizons, read_points
    from hcnaf_cli.output import show_json, talk
    from hcnaf_runtime import Forecaster

    places = read_points(points)
    _, given = open_scene(scene, sample)
    forecaster = Forecaster(model, threads)
    times = parse_horizons(horizons)
    values = forecaster.log_prob(given, places, times, frame)
    theta = forecaster.theta(given, times)
    for note in theta.notes:
        talk(f"note: {note}")
    if as_json:
        show_json(report.log_prob_json(frame, theta, values))
    else:
        click.echo(report.log_prob_text(theta, places, values))


@main.command()
@_bundle
@options.as_json
def info(bundle: Path | None, as_json: bool) -> None:
    """What BUNDLE (default: the embedded model) is, needs and scores."""
    from hcnaf_cli import report
    from hcnaf_cli.output import show_json
    from hcnaf_runtime import Bundle

    opened = Bundle.open(bundle)
    if as_json:
        show_json(report.info_json(opened))
    else:
        click.echo(report.info_text(opened))


@main.command()
@_bundle
@options.threads
@options.as_json
def verify(bundle: Path | None, threads: int | None, as_json: bool) -> None:
    """Check that BUNDLE (default: the embedded model) computes here what it computed where it was made."""
    from hcnaf_cli import report
    from hcnaf_cli.output import show_json
    from hcnaf_runtime import Bundle
    from hcnaf_runtime import verify as check
    from hcnaf_runtime.errors import VerifyError

    opened = Bundle.open(bundle)
    rows = check(opened, threads)
    if as_json:
        show_json(report.verify_json(opened, rows))
    else:
        click.echo(report.verify_text(rows))
    failed = sum(not row.passed for row in rows)
    if failed:
        raise VerifyError(
            f"{opened.path}: {failed} of {len(rows)} outputs differ from their golden values; "
            "do not use it on this machine"
        )


main.add_command(bench)
main.add_command(occupancy)
main.add_command(risk)
main.add_command(sample)
