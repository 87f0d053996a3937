"""`hcnaf experiment`: comparisons on recordings and in simulated traffic, each by one command."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from hcnaf_cli.errors import INTERRUPTED
from hcnaf_cli.output import ProgressLine, show_json, table, talk, writing

if TYPE_CHECKING:
    from hcnaf_export.experiments.eth_ucy import Plan
    from hcnaf_export.experiments.occupancy import Plan as OccupancyPlan
    from hcnaf_export.training.loop import Progress

_PATH = click.Path(path_type=Path)
SPLITS = ("eth", "hotel", "univ", "zara1", "zara2")
MODELS = ("hcnaf", "mixture", "affine", "spline")
GRIDS = ("conditions", "heads", "rates", "size", "norms")


@click.group()
def experiment() -> None:
    """Compare models on recordings: HCNAF with its baselines, or with less to see."""


@experiment.command(name="eth-ucy")
@click.option("--data", type=_PATH, required=True, metavar="DIR", help="Folder of the eight ETH/UCY recordings.")
@click.option("--out", type=_PATH, required=True, metavar="DIR", help="Folder to write to, or to go on in.")
@click.option("--splits", metavar="eth,zara1", help="Splits to run [default: all five].")
@click.option(
    "--models", metavar="hcnaf,spline", help="Models to run [default: all four], beside constant velocity."
)
@click.option("--seeds", type=click.IntRange(min=1), default=1, show_default=True, help="Runs of every model.")
@click.option("--recipe", default="eth-ucy", show_default=True, metavar="TOML", help="What every cell trains by.")
@click.option("--minutes", type=click.FloatRange(min=0), default=0.0, help="Longest training of a cell.")
@click.option("--threads", type=click.IntRange(min=1), help="CPU threads [default: PyTorch's choice].")
@click.option("--bundles", is_flag=True, help="Also export HCNAF's models and score the bundles.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of text.")
def eth_ucy(
    data: Path,
    out: Path,
    splits: str | None,
    models: str | None,
    seeds: int,
    recipe: str,
    minutes: float,
    threads: int | None,
    bundles: bool,
    as_json: bool,
) -> None:
    """Pedestrians of ETH/UCY, leave one scene out: exact NLL and samples of HCNAF and four baselines.

    Trains one model after the other; what is done is not done again, so the same command goes on where it stopped.
    """
    from hcnaf_export.experiments.eth_ucy import Plan
    from hcnaf_export.recipe import TrackRecipe, read_recipe

    plan_recipe = read_recipe(recipe)
    if not isinstance(plan_recipe, TrackRecipe):
        raise click.UsageError(f"--recipe {recipe} is for {plan_recipe.task}, give one whose task is eth-ucy")
    plan = Plan(
        data=data,
        out=out,
        splits=_chosen(splits, SPLITS, "--splits"),
        models=_chosen(models, MODELS, "--models"),
        seeds=tuple(range(seeds)),
        recipe=plan_recipe,
        minutes=minutes,
        threads=threads,
    )
    _run(plan, bundles)
    _show(plan, as_json)


@experiment.command(name="occupancy")
@click.option("--grid", type=click.Choice(GRIDS), required=True, help="What is compared.")
@click.option("--data", type=_PATH, required=True, metavar="DIR", help="A data set of hcnaf simulate.")
@click.option("--out", type=_PATH, required=True, metavar="DIR", help="Folder to write to, or to go on in.")
@click.option("--cells", metavar="C1,C5", help="Models of the grid to run [default: all].")
@click.option("--seeds", type=click.IntRange(min=1), default=1, show_default=True, help="Runs of every model.")
@click.option(
    "--recipe", default="pom-compare", show_default=True, metavar="TOML", help="What cells are changes to."
)
@click.option("--threads", type=click.IntRange(min=1), help="CPU threads [default: PyTorch's choice].")
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of text.")
def occupancy(
    grid: str,
    data: Path,
    out: Path,
    cells: str | None,
    seeds: int,
    recipe: str,
    threads: int | None,
    as_json: bool,
) -> None:
    """Simulated traffic, one thing changed at a time, scored on networks that no model has seen.

    conditions: what the forecast sees, the paper's C1 to C6. heads: HCNAF and its baselines under C5. rates: the
    learning rate of each of these, under C2. size: H and L of the flow against bytes and time. norms: support,
    units and weight normalisation.

    Trains one model after the other; what is done is not done again, so the same command goes on where it stopped.
    Grids share a folder, and the models they have in common.
    """
    from hcnaf_export.experiments import occupancy_grids
    from hcnaf_export.experiments.occupancy import Plan
    from hcnaf_export.recipe import PomRecipe, read_recipe

    plan_recipe = read_recipe(recipe)
    if not isinstance(plan_recipe, PomRecipe):
        raise click.UsageError(f"--recipe {recipe} is for {plan_recipe.task}, give one whose task is pom")
    plan = Plan(
        grid=grid,
        data=data,
        out=out,
        cells=_chosen(cells, tuple(occupancy_grids.GRIDS[grid].cells), "--cells"),
        seeds=tuple(range(seeds)),
        recipe=plan_recipe,
        threads=threads,
    )
    _run_occupancy(plan)
    _show_occupancy(plan, as_json)


@experiment.command(name="precog")
@click.option("--data", type=_PATH, required=True, metavar="DIR", help="Folder of PRECOG-CARLA episodes.")
@click.option("--run", type=_PATH, required=True, metavar="RUN", help="Run directory of the model.")
@click.option(
    "--twin", type=_PATH, required=True, metavar="RUN", help="Run directory of its twin, such as no-lidar."
)
@click.option("--split", type=click.Choice(["train", "val", "test"]), default="test", show_default=True)
@click.option("--device", default="cpu", show_default=True, metavar="cpu|cuda|cuda:N")
@click.option("--threads", type=click.IntRange(min=1), help="CPU threads [default: PyTorch's choice].")
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of text.")
def precog(
    data: Path,
    run: Path,
    twin: Path,
    split: Literal["train", "val", "test"],
    device: str,
    threads: int | None,
    as_json: bool,
) -> None:
    """Two trained models of PRECOG-CARLA's player on the same episodes: scores and paired differences."""
    import torch

    from hcnaf_cli.scores_text import scores_text
    from hcnaf_export.experiments.precog import compare

    if threads:
        torch.set_num_threads(threads)
    with ProgressLine() as line:
        found = compare(run, twin, data, split, device=device, report=lambda share: line(f"{share:4.0%}"))
    if as_json:
        show_json(found.as_dict())
        return
    rows = [[d.measure, f"{d.mean:.4f} ± {d.mean_error:.4f}"] for d in found.differences]
    click.echo(f"{run}: {scores_text(found.model)}\n\n{twin}: {scores_text(found.twin)}\n")
    click.echo(table(["twin minus model, mean", "paired difference"], rows))


def _run(plan: Plan, bundles: bool) -> None:
    from hcnaf_cli.train import progress_text
    from hcnaf_export.experiments.eth_ucy import cells, run_cell
    from hcnaf_export.experiments.eth_ucy_bundle import run_bundle

    grid = cells(plan)
    with ProgressLine() as line:
        for number, (split, model, seed) in enumerate(grid, 1):

            def report(progress: Progress, where: str = f"{number}/{len(grid)} {split} {model} {seed}") -> None:
                line(f"{where}: {progress_text(progress)}")

            if not run_cell(plan, split, model, seed, report):
                talk("interrupted; the same command goes on")
                raise click.exceptions.Exit(INTERRUPTED)
            if bundles and model == "hcnaf":
                line(f"{split} {model} {seed}: export")
                run_bundle(plan, split, seed)


def _show(plan: Plan, as_json: bool) -> None:
    from hcnaf_export.experiments.eth_ucy_report import markdown, plot, record_of, tables

    record = record_of(plan)
    with writing(plan.out):
        (plan.out / "record.json").write_text(record.as_json(), encoding="utf-8")
        (plan.out / "README.md").write_text(markdown(record), encoding="utf-8")
        plot(record, plan.out / "nll.png")
    if as_json:
        show_json(record.as_dict())
        return
    for caption, (head, *rows) in tables(record).items():
        click.echo(f"{caption}\n{table((head[0] + ' ', *head[1:]), rows)}\n")
    talk(f"wrote record.json, README.md and nll.png to {click.format_filename(plan.out)}")


def _run_occupancy(plan: OccupancyPlan) -> None:
    from hcnaf_cli.train import progress_text
    from hcnaf_export.experiments.occupancy import run_cell, runs
    from hcnaf_export.experiments.occupancy_bundle import run_bundle
    from hcnaf_runtime.errors import ParityError

    cells = dict.fromkeys([*runs(plan), *((plan.about.reference, seed) for seed in plan.seeds)])
    with ProgressLine() as line:
        for number, (cell, seed) in enumerate(cells, 1):

            def report(progress: Progress, where: str = f"{number}/{len(cells)} {cell} {seed}") -> None:
                line(f"{where}: {progress_text(progress)}")

            if not run_cell(plan, cell, seed, report):
                talk("interrupted; the same command goes on")
                raise click.exceptions.Exit(INTERRUPTED)
        for cell in plan.about.cells if plan.about.bundles else ():
            line(f"{cell}: export")
            try:
                run_bundle(plan, cell, plan.seeds[0])
            except ParityError as error:  # its scores count, without bytes and times
                talk(f"{cell} is not exported: {error}")


def _show_occupancy(plan: OccupancyPlan, as_json: bool) -> None:
    from hcnaf_export.experiments.occupancy_report import markdown, plot, record_of, tables

    record = record_of(plan)
    with writing(plan.out):
        (plan.out / f"{plan.grid}.json").write_text(record.as_json(), encoding="utf-8")
        (plan.out / f"{plan.grid}.md").write_text(markdown(record), encoding="utf-8")
        plot(record, plan.out / f"{plan.grid}.png")
    if as_json:
        show_json(record.as_dict())
        return
    for caption, (head, *rows) in tables(record).items():
        click.echo(f"{caption}\n{table((head[0] + ' ', *head[1:]), rows)}\n")
    names = ", ".join(f"{plan.grid}.{kind}" for kind in ("json", "md", "png"))
    talk(f"wrote {names} to {click.format_filename(plan.out)}")


def _chosen(text: str | None, known: tuple[str, ...], option: str) -> tuple[Any, ...]:
    """Names of a comma-separated list, each once and in the order of `known`."""
    names = set(known) if text is None else {name.strip() for name in text.split(",")}
    if wrong := sorted(names - set(known)):
        raise click.UsageError(f"{option} has {wrong[0]!r}, expected some of {', '.join(known)}")
    return tuple(name for name in known if name in names)
