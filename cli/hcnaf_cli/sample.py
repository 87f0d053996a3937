"""`hcnaf-run sample`: what might happen next, as points or as paths."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from hcnaf_cli import options

if TYPE_CHECKING:
    from hcnaf_runtime import Bundle
    from hcnaf_runtime.samples import Samples

MOST_PRINTED = 1_000_000
"""Points printed as JSON; more are for a file."""


@click.command()
@options.scene
@options.sample
@options.model
@click.option("-n", "count", type=click.IntRange(min=1), default=100, show_default=True, help="Samples per agent.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@click.option("--trajectories", is_flag=True, help="Couple the horizons by their quantiles: samples are paths.")
@click.option("-o", "--out", type=options.FILE, metavar="OUT.npz", help="Write the samples.")
@click.option(
    "--plot", type=options.FILE, metavar="OUT.png", help="Draw the samples over the scene (extra `plot`)."
)
@options.horizons
@options.frame
@options.threads
@options.as_json
def sample(
    scene: Path | None,
    sample: str | None,
    model: Path | None,
    count: int,
    seed: int,
    trajectories: bool,
    out: Path | None,
    plot: Path | None,
    horizons: str | None,
    frame: Literal["agent", "scene"],
    threads: int | None,
    as_json: bool,
) -> None:
    """Samples of where each agent of SCENE may be, with their log-densities."""
    from hcnaf_cli.inputs import open_scene, parse_horizons
    from hcnaf_cli.output import check_target, show_json, talk, writing
    from hcnaf_runtime import Forecaster

    for target in (out, plot):
        check_target(target)
    if plot is not None:
        from hcnaf_cli.picture import check_picture

        check_picture(plot)
    name, given = open_scene(scene, sample)
    forecaster = Forecaster(model, threads)
    draw = forecaster.trajectories if trajectories else forecaster.sample
    made = draw(given, count, parse_horizons(horizons), seed, frame)
    if as_json:
        _check_size(made)
    for note in made.notes:
        talk(f"note: {note}")
    if out is not None:
        with writing(out):
            made.save(out)
        talk(f"wrote {click.format_filename(out)}")
    if plot is not None:
        from hcnaf_cli import picture_samples

        with writing(plot):
            picture_samples.draw(plot, name, given, made)
        talk(f"wrote {click.format_filename(plot)}")
    if as_json:
        show_json(samples_json(name, forecaster.bundle, seed, made))
    else:
        click.echo(samples_text(name, made))


def _check_size(made: "Samples") -> None:
    from hcnaf_runtime.errors import InputError

    if made.log_prob.size > MOST_PRINTED:
        raise InputError(f"{made.log_prob.size} points, at most {MOST_PRINTED} are printed; write them with -o")


def samples_json(scene: str, bundle: "Bundle", seed: int, made: "Samples") -> dict[str, Any]:
    """Per agent and horizon all points and their log-densities."""
    agents = [
        {
            "agent": int(agent),
            "pose": made.pose[a].tolist(),
            "horizons": [
                {
                    "horizon": float(f"{horizon:g}"),
                    "points": made.points[a, t].tolist(),
                    "log_prob": made.log_prob[a, t].tolist(),
                }
                for t, horizon in enumerate(made.horizons)
            ],
        }
        for a, agent in enumerate(made.agents)
    ]
    about = {"scene": scene, "model": bundle.manifest.name, "frame": made.frame, "seed": seed}
    return {**about, "coupled": made.coupled, "agents": agents, "notes": list(made.notes)}


def samples_text(scene: str, made: "Samples") -> str:
    """A heading, and per agent and horizon the mean, the spread and the mean log-density."""
    from hcnaf_cli.output import table
    from hcnaf_cli.report import FRAMES

    A, T, n = made.log_prob.shape
    rows = []
    for a in range(A):
        for t in range(T):
            (x, y), (sx, sy) = made.points[a, t].mean(axis=0), made.points[a, t].std(axis=0)
            agent = str(made.agents[a]) if t == 0 else ""
            spread = [f"{sx:.2f}", f"{sy:.2f}", f"{made.log_prob[a, t].mean():.2f}"]
            rows.append([agent, f"{made.horizons[t]:g} s", f"{x:+.2f}", f"{y:+.2f}", *spread])
    what = "paths" if made.coupled else "samples"
    head = ["agent", "ahead", "mean x", "y (m)", "spread in x", "y (m)", "mean log-density"]
    return f"{scene}: {n} {what} of each agent, {FRAMES[made.frame]}\n{table(head, rows)}"
