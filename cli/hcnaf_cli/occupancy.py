"""`hcnaf-run occupancy`: where anybody's box may be."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from hcnaf_cli import options

if TYPE_CHECKING:
    from hcnaf_runtime import Bundle, Scene
    from hcnaf_runtime.occupancy import Occupancy

LEVELS = (0.01, 0.1, 0.5)
"""Probabilities for which the covered area is said."""


@click.command()
@options.scene
@options.sample
@options.model
@click.option("-o", "--out", type=options.FILE, metavar="OUT.npz", help="Write the occupancy.")
@click.option("--plot", type=options.FILE, metavar="OUT.png", help="Draw it over the scene (extra `plot`).")
@click.option("--grid", metavar="COLSxROWS@M", help="Cells [default: 200x200@0.5].")
@options.horizons
@click.option(
    "--heading",
    type=click.Choice(["motion", "present"]),
    default="motion",
    show_default=True,
    help="Boxes turn as their way implies, or stay as they are.",
)
@options.exclude
@options.threads
@options.as_json
def occupancy(
    scene: Path | None,
    sample: str | None,
    model: Path | None,
    out: Path | None,
    plot: Path | None,
    grid: str | None,
    horizons: str | None,
    heading: Literal["motion", "present"],
    exclude: str | None,
    threads: int | None,
    as_json: bool,
) -> None:
    """Occupancy of SCENE: the probability that anybody's box covers a cell, per horizon."""
    from hcnaf_cli.inputs import open_scene, parse_horizons
    from hcnaf_cli.output import check_target, show_json, talk
    from hcnaf_cli.trajectories import parse_agents
    from hcnaf_runtime import Forecaster, Grid

    check_target(out)
    check_target(plot)
    if plot is not None:
        from hcnaf_cli.picture import check_picture

        check_picture(plot)
    name, given = open_scene(scene, sample)
    forecaster = Forecaster(model, threads)
    cells = None if grid is None else Grid.parse(grid)
    left_out = parse_agents(exclude)
    found = forecaster.occupancy(given, cells, parse_horizons(horizons), heading, exclude=left_out)
    for note in found.notes:
        talk(f"note: {note}")
    _write(out, plot, name, given, found)
    if as_json:
        show_json(occupancy_json(name, forecaster.bundle, heading, found))
    else:
        click.echo(occupancy_text(name, found))
        talk(f"hyper-network {found.timings.hypernet * 1e3:.1f} ms, occupancy {found.timings.maps * 1e3:.1f} ms")


def _write(out: Path | None, plot: Path | None, name: str, scene: "Scene", found: "Occupancy") -> None:
    from hcnaf_cli.output import talk, writing

    if out is not None:
        with writing(out):
            found.save(out)
        talk(f"wrote {click.format_filename(out)}")
    if plot is not None:
        from hcnaf_cli.picture_occupancy import draw

        with writing(plot):
            draw(plot, name, scene, found)
        talk(f"wrote {click.format_filename(plot)}")


def occupancy_json(scene: str, bundle: "Bundle", heading: str, found: "Occupancy") -> dict[str, Any]:
    """Per horizon how many boxes lie on the grid, and how much of it is covered with what probability."""
    info = found.info
    return {
        "scene": scene,
        "model": bundle.manifest.name,
        "frame": found.frame,
        "grid": {
            "columns": info["width"],
            "rows": info["height"],
            "resolution": info["resolution"],
            "origin": [info["origin"]["x"], info["origin"]["y"]],
        },
        "heading": heading,
        "forecast": found.forecast.tolist(),
        "present": found.present.tolist(),
        "horizons": [_horizon_json(found, t) for t in range(len(found.horizons))],
        "lost_mass": found.lost_mass,
        "seconds": {"hypernet": found.timings.hypernet, "occupancy": found.timings.maps},
        "notes": list(found.notes),
    }


def _horizon_json(found: "Occupancy", t: int) -> dict[str, Any]:
    return {
        "horizon": float(f"{found.horizons[t]:g}"),
        "covered_area": float(found.expected[t].sum(dtype=float)) * found.resolution**2,
        "area_above": {f"{level:g}": area for level, area in _areas(found, t).items()},
    }


def occupancy_text(scene: str, found: "Occupancy") -> str:
    """A heading and a line per horizon."""
    from hcnaf_cli.output import table

    info = found.info
    who = f"{len(found.forecast)} forecast, {len(found.present)} at their present box"
    title = f"{scene}: {info['width']}x{info['height']} cells of {info['resolution']:g} m, {who}"
    rows = []
    for t, horizon in enumerate(found.horizons):
        covered = float(found.expected[t].sum(dtype=float)) * found.resolution**2
        rows.append([f"{horizon:g} s", f"{covered:.1f}", *(f"{area:.1f}" for area in _areas(found, t).values())])
    head = ["ahead", "covered (m²), expected", *(f"above {level:.0%}" for level in LEVELS)]
    return f"{title}\n{table(head, rows)}"


def _areas(found: "Occupancy", t: int) -> dict[float, float]:
    """The area (m²) that is covered with more than each of the LEVELS."""
    area = found.resolution**2
    return {level: float((found.probability[t] > level).sum()) * area for level in LEVELS}
