"""`hcnaf-run risk`: how likely a trajectory meets somebody."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from hcnaf_cli import options

if TYPE_CHECKING:
    from hcnaf_runtime import Bundle, Scene
    from hcnaf_runtime.risk import Risk

MOST_ROWS = 30
"""Trajectories listed one by one."""

LEAST = 1e-6
"""Lesser probabilities are not told apart."""

ITSELF = 0.5
"""An agent this likely to be hit at the first step may be the own vehicle."""


@click.command()
@options.scene
@options.sample
@click.option(
    "--trajectory",
    type=options.FILE,
    required=True,
    metavar="FILE",
    help="t, x, y, yaw (s, m, rad; scene frame): lines of .csv, or [T, 4] or [K, T, 4] in .npy, .npz or .json.",
)
@click.option(
    "--ego-size", default="4.6x1.9", show_default=True, metavar="LxW", help="The own box in metres, about x, y."
)
@click.option(
    "--heading",
    type=click.Choice(["motion", "present"]),
    default="motion",
    show_default=True,
    help="Other boxes turn as their way implies, or stay as they are.",
)
@options.exclude
@click.option("--draws", type=click.IntRange(0, 100_000), default=0, help="Estimate from so many coupled samples.")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of the samples.")
@options.model
@click.option("--plot", type=options.FILE, metavar="OUT.png", help="Draw the risk over the scene (extra `plot`).")
@options.threads
@options.as_json
def risk(
    scene: Path | None,
    sample: str | None,
    trajectory: Path,
    ego_size: str,
    heading: Literal["motion", "present"],
    exclude: str | None,
    draws: int,
    seed: int,
    model: Path | None,
    plot: Path | None,
    threads: int | None,
    as_json: bool,
) -> None:
    """Risk of a trajectory through SCENE: how likely the own box meets another, at each time and overall."""
    from hcnaf_cli.inputs import open_scene
    from hcnaf_cli.output import check_target, show_json, talk, writing
    from hcnaf_cli.trajectories import parse_agents, parse_size, read_trajectories
    from hcnaf_runtime import Forecaster

    check_target(plot)
    if plot is not None:
        from hcnaf_cli.picture import check_picture

        check_picture(plot)
    size, left_out = parse_size(ego_size), parse_agents(exclude)
    times, poses = read_trajectories(trajectory)
    name, given = open_scene(scene, sample)
    forecaster = Forecaster(model, threads)
    found = forecaster.collision_probability(
        given, poses, size, times, heading, exclude=left_out, draws=draws, seed=seed
    )
    for note in (*found.notes, *_suspicious(found)):
        talk(f"note: {note}")
    if plot is not None:
        from hcnaf_cli.picture_risk import draw

        with writing(plot):
            draw(plot, name, given, poses, size, found)
        talk(f"wrote {click.format_filename(plot)}")
    if as_json:
        show_json(risk_json(name, forecaster.bundle, given, heading, found))
    else:
        click.echo(risk_text(name, poses, found))
        talk(f"hyper-network {found.timings.hypernet * 1e3:.1f} ms, risk {found.timings.maps * 1e3:.1f} ms")


def _suspicious(found: "Risk") -> list[str]:
    """A word where every trajectory starts inside of an agent."""
    inside = found.agents[(found.per_agent[:, 0] > ITSELF).all(axis=0)]
    return [f"agent {i} is hit from the start; if it is the own vehicle, use --exclude {i}" for i in inside]


def risk_json(scene: str, bundle: "Bundle", given: "Scene", heading: str, found: "Risk") -> dict[str, Any]:
    """Per trajectory the bounds and the estimate over all times, and the probabilities at each time."""
    estimate = [None] * len(found.per_agent) if found.estimate is None else found.estimate.tolist()
    rows = zip(found.lower, found.upper, estimate, found.per_step, found.per_agent, strict=True)
    return {
        "scene": scene,
        "model": bundle.manifest.name,
        "frame": given.frame,
        "heading": heading,
        "horizons": [float(f"{t:g}") for t in found.horizons],
        "agents": found.agents.tolist(),
        "forecast": found.forecast.tolist(),
        "trajectories": [
            {
                "lower_bound": float(lower),
                "upper_bound": float(upper),
                "estimate": estimated,
                "per_step": step.tolist(),
                "per_agent": agents.T.tolist(),
            }
            for lower, upper, estimated, step, agents in rows
        ],
        "largest_error": float(found.error.max(initial=0.0)),
        "seconds": {"hypernet": found.timings.hypernet, "risk": found.timings.maps},
        "notes": list(found.notes),
    }


def risk_text(scene: str, poses: Any, found: "Risk") -> str:
    """A heading and a line per time, or per trajectory if there are several."""
    who = f"{int(found.forecast.sum())} agents forecast, {int((~found.forecast).sum())} at their present box"
    if len(poses) == 1:
        return "\n".join([f"{scene}: one trajectory, {who}", _steps(poses[0], found), _overall(found, 0)])
    return "\n".join([f"{scene}: {len(poses)} trajectories, {who}", _overview(found)])


def _steps(poses: Any, found: "Risk") -> str:
    from hcnaf_cli.output import table

    rows = []
    for t, horizon in enumerate(found.horizons):
        worst, share = _worst(found, 0, t)
        x, y, _ = poses[t]
        rows.append([f"{horizon:g} s", f"{x:.1f}", f"{y:.1f}", _short(found.per_step[0, t]), worst, share])
    return table(["ahead", "x (m)", "y (m)", "collision", "worst agent", "with it"], rows)


def _worst(found: "Risk", k: int, t: int) -> tuple[str, str]:
    """The agent most likely to be hit, and how likely; blank where nobody is."""
    p = found.per_agent[k, t]
    if not p.size or p.max() < LEAST:
        return "-", "-"
    return str(found.agents[p.argmax()]), _short(p.max())


def _short(p: float) -> str:
    return f"< {LEAST:g}" if p < LEAST else f"{p:.2e}"


def _overall(found: "Risk", k: int) -> str:
    text = f"at any of these times: at least {_short(found.lower[k])}, at most {_short(found.upper[k])}"
    if found.estimate is not None:
        text += f"; estimate from coupled samples {_short(found.estimate[k])}"
    return text


def _overview(found: "Risk") -> str:
    """A line per trajectory: bounds, estimate, and its worst time."""
    from hcnaf_cli.output import table

    rows = []
    for k in range(min(len(found.per_agent), MOST_ROWS)):
        t = int(found.per_step[k].argmax())
        estimate = "" if found.estimate is None else _short(found.estimate[k])
        bounds = [_short(found.lower[k]), _short(found.upper[k])]
        rows.append([str(k), *bounds, estimate, f"{found.horizons[t]:g} s", _worst(found, k, t)[0]])
    head = ["trajectory", "at least", "at most", "estimate", "worst time", "worst agent"]
    if found.estimate is None:
        head.remove("estimate")
        rows = [[*row[:3], *row[4:]] for row in rows]
    more = len(found.per_agent) - len(rows)
    return table(head, rows) + (f"\nand {more} more; --json has all" if more else "")
