"""`hcnaf`: from data to a trained model to a bundle that ships.

Imports are inside the commands, so that each needs only the extra it uses.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from hcnaf_cli.errors import INTERRUPTED, Commands
from hcnaf_cli.evaluate import evaluate
from hcnaf_cli.experiment import experiment
from hcnaf_cli.output import ProgressLine, check_target, duration, show_json, talk, writing
from hcnaf_cli.reproduce import reproduce
from hcnaf_cli.temper import temper
from hcnaf_runtime._version import __version__

if TYPE_CHECKING:
    from hcnaf_export.training.loop import Progress
    from hcnaf_runtime import Scene

_PATH = click.Path(path_type=Path)
_json = click.option("--json", "as_json", is_flag=True, help="Print JSON instead of text.")
_device = click.option("--device", default="cpu", show_default=True, metavar="cpu|cuda|cuda:N")
_threads = click.option("--threads", type=click.IntRange(min=1), help="CPU threads [default: PyTorch's choice].")


@click.group(cls=Commands, name="hcnaf", context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="hcnaf")
def main() -> None:
    """Train forecasts of where vehicles will be, and export them to run without PyTorch."""


@main.command()
@click.argument("recipe")
@click.option("--data", type=_PATH, metavar="DIR", help="Data set of `hcnaf simulate`; toy recipes need none.")
@click.option("--out", type=_PATH, required=True, metavar="RUN", help="Run directory to make.")
@click.option("--resume", is_flag=True, help="Go on with an interrupted run, exactly where it stopped.")
@_device
@_threads
@_json
def train(
    recipe: str, data: Path | None, out: Path, resume: bool, device: str, threads: int | None, as_json: bool
) -> None:
    """Train by RECIPE: a TOML file, or the name of a recipe that comes with the package."""
    from hcnaf_export.recipe import read_recipe
    from hcnaf_export.training.distributed import leads
    from hcnaf_export.training.run import run_training

    plan = read_recipe(recipe)
    with ProgressLine() as line:
        result = run_training(
            plan,
            data,
            out,
            resume=resume,
            device=device,
            threads=threads,
            progress=lambda p: line(progress_text(p)),
        )
    if not leads():
        pass  # of several processes one speaks
    elif as_json:
        show_json(
            {
                "run": str(result.out),
                "finished": result.finished,
                "step": result.step,
                "seconds": result.seconds,
                "bad_steps": result.bad,
                "scores": result.scores,
            }
        )
    else:
        scores = ", ".join(f"{name}: {value:.4f}" for name, value in result.scores.items())
        click.echo(f"{out}: {result.step} steps in {duration(result.seconds)}; validation: {scores or 'none'}")
    if not result.finished:
        if leads():
            talk("interrupted; go on with the same command and --resume")
        raise click.exceptions.Exit(INTERRUPTED)


def progress_text(progress: "Progress") -> str:
    """Step, loss, speed, validation and time left, in a line."""
    parts = [
        f"step {progress.step}/{progress.steps}",
        f"loss {progress.loss:.4f}",
        f"{progress.rate:.0f} examples/s",
    ]
    if progress.scores and "mean" in progress.scores:
        parts.append(f"validation {progress.scores['mean']:.4f}")
    if progress.bad:
        parts.append(f"{progress.bad} bad steps")
    return ", ".join([*parts, f"{duration(progress.left)} left"])


main.add_command(experiment)
main.add_command(reproduce)

_THREE = click.Tuple([click.IntRange(min=1)] * 3)


@main.command()
@click.option("-o", "--out", type=_PATH, required=True, metavar="DIR", help="Directory to make.")
@click.option("--seed", type=click.IntRange(min=0), help="Everything random follows from it [default: 0].")
@click.option("--windows", type=_THREE, metavar="TRAIN VAL TEST", help="Snippets [default: 50000 5000 5000].")
@click.option("--networks", type=_THREE, metavar="TRAIN VAL TEST", help="Networks [default: 16 4 4].")
@click.option("--seconds", type=click.FloatRange(min=0), help="Recorded time per network [default: 300].")
@click.option("--train-net", "train_nets", type=_PATH, multiple=True, help="A .net.xml to train on; repeatable.")
@click.option("--val-net", "val_nets", type=_PATH, multiple=True, help="A .net.xml to validate on; repeatable.")
@click.option("--test-net", "test_nets", type=_PATH, multiple=True, help="A .net.xml to test on; repeatable.")
@click.option("--jobs", type=click.IntRange(min=1), help="Networks simulated at the same time [default: 1].")
@click.option("--settings", type=_PATH, metavar="TOML", help="All settings, as a file; options override it.")
@click.option(
    "--format",
    "layout",
    type=click.Choice(["tracks", "precog"]),
    default="tracks",
    show_default=True,
    help="precog: one JSON file per snippet, as PRECOG-CARLA.",
)
def simulate(out: Path, settings: Path | None, layout: Literal["tracks", "precog"], **options: Any) -> None:
    """Make a data set of SUMO traffic on generated or given road networks (extra `sim`).

    As precog, snippets have 10 rows of history and 40 of future, 0.2 s apart, the four nearest other cars, and
    overhead channels that are rendered from the roads and the cars, not scanned.
    """
    from hcnaf_cli.settings import sim_settings
    from hcnaf_export.data.sim import simulate as make

    chosen = sim_settings(settings, options)
    if layout == "precog":
        from hcnaf_export.data.precog_write import simulate_precog

        with ProgressLine() as line:
            made = simulate_precog(out, chosen, lambda text, share: line(f"{share:4.0%}  {text}"))
        click.echo(f"{out}: " + ", ".join(f"{count} {split} episodes" for split, count in made.items()))
        return
    with ProgressLine() as line:
        data = make(out, chosen, lambda text, share: line(f"{share:4.0%}  {text}"))
    counts = {split: sum(e.windows for e in sets) for split, sets in data.manifest.splits.items()}
    click.echo(f"{out}: " + ", ".join(f"{count} {split} windows" for split, count in counts.items()))


@main.group()
def convert() -> None:
    """Turn a public recording into a scene."""


_recording = click.argument("recording", metavar="IN", type=_PATH)
_scene = click.option("-o", "--out", type=_PATH, required=True, metavar="SCENE.npz", help="Scene to write.")


@convert.command()
@_recording
@_scene
@click.option(
    "--step",
    type=click.FloatRange(min=0, min_open=True),
    default=0.2,
    show_default=True,
    help="Seconds between recorded rows; the files do not say.",
)
@click.option("--targets", type=click.Choice(["player", "all"]), default="player", show_default=True)
@click.option(
    "--history-step",
    type=click.FloatRange(min=0, min_open=True),
    default=0.1,
    show_default=True,
    help="Seconds between the scene's rows: 0.2 for a model trained on these episodes.",
)
def precog(
    recording: Path, out: Path, step: float, targets: Literal["player", "all"], history_step: float
) -> None:
    """A PRECOG-CARLA episode (one JSON file)."""
    from hcnaf_export.data.precog import convert_precog

    check_target(out)
    _save(convert_precog(recording, step=step, targets=targets, target_step=history_step), out)


@convert.command()
@_recording
@_scene
@click.option("--targets", type=click.Choice(["scored", "focal", "vehicles"]), default="scored", show_default=True)
def argoverse2(recording: Path, out: Path, targets: Literal["scored", "focal", "vehicles"]) -> None:
    """An Argoverse 2 motion-forecasting scenario: its parquet file or its directory (extra `data`)."""
    from hcnaf_export.data.argoverse2 import convert_argoverse2

    check_target(out)
    _save(convert_argoverse2(recording, targets=targets), out)


@convert.command()
@click.argument("data", type=_PATH)
@_scene
@click.option("--split", type=click.Choice(["train", "val", "test"]), default="test", show_default=True)
@click.option(
    "--network", type=click.IntRange(min=0), default=0, show_default=True, help="Which network of the split."
)
@click.option("--window", type=click.IntRange(min=0), default=0, show_default=True, help="Which of its snippets.")
@click.option(
    "--targets", type=click.IntRange(min=1), default=8, show_default=True, help="Forecast at most so many."
)
def simulated(
    data: Path, out: Path, split: Literal["train", "val", "test"], network: int, window: int, targets: int
) -> None:
    """A scene from a snippet of a data set that `hcnaf simulate` made."""
    from hcnaf_export.data.tracks import Dataset
    from hcnaf_runtime.errors import DataError

    check_target(out)
    networks = Dataset(data).split(split)
    if network >= len(networks):
        raise DataError(f"--network is {network}, {data} has {len(networks)} in {split}; count from 0")
    windows = networks[network].windows
    if window >= len(windows):
        raise DataError(f"--window is {window}, network {network} has {len(windows)} snippets; count from 0")
    track, step = (int(v) for v in windows[window])
    _save(networks[network].scene(track, step, max_targets=targets), out)


def _save(scene: "Scene", out: Path) -> None:
    with writing(out):
        scene.save(out)
    N, T, _ = scene.past.shape
    click.echo(
        f"{click.format_filename(out)}: {N} agents, {len(scene.target)} to forecast, "
        f"{T} rows of history {scene.step:g} s apart, raster {', '.join(scene.channels) or 'none'}"
    )


@main.command()
@click.option("--ckpt", type=_PATH, required=True, metavar="model.pt", help="Checkpoint of a training run.")
@click.option("-o", "--out", type=_PATH, required=True, metavar="BUNDLE", help="Bundle directory to write.")
@click.option("--force", is_flag=True, help="Replace a bundle that is already there.")
@click.option(
    "--precision",
    type=click.Choice(["fp32", "fp16", "int8"]),
    default="fp32",
    show_default=True,
    help="Of the hyper-network's weights; the flow keeps fp32.",
)
@click.option("--calibration", type=_PATH, metavar="DIR", help="Data set of `hcnaf simulate`, which int8 needs.")
@_json
def export(
    ckpt: Path,
    out: Path,
    force: bool,
    precision: Literal["fp32", "fp16", "int8"],
    calibration: Path | None,
    as_json: bool,
) -> None:
    """Export a checkpoint to a bundle, checked against PyTorch output by output."""
    from hcnaf_cli import tables
    from hcnaf_export.export import export_bundle
    from hcnaf_runtime.errors import ParityError

    try:
        with ProgressLine() as line:
            result = export_bundle(
                ckpt,
                out,
                force=force,
                precision=precision,
                calibration=calibration,
                progress=lambda name, k, steps: line(f"{k + 1}/{steps}  {name}"),
            )
    except ParityError as error:
        if rows := getattr(error, "rows", ()):
            click.echo(tables.parity_text(rows))
        raise
    if as_json:
        show_json(
            {
                "path": str(result.path),
                "bytes": result.bytes,
                "files": result.files,
                "precision": result.precision,
                "precision_cost": result.cost,
                "parity": tables.parity_json(result.rows),
            }
        )
    else:
        click.echo(tables.parity_text(result.rows))
        click.echo(tables.size_text(result.files, result.cost))
    talk(f"wrote {click.format_filename(out)} ({result.precision}, {result.bytes / 1e6:.2f} MB)")


main.add_command(evaluate)
main.add_command(temper)

if __name__ == "__main__":  # torchrun -m hcnaf_cli.train
    main()
