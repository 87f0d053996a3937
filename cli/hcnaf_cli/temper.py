"""`hcnaf temper`: a trained model that is as sure of itself as it may be."""

from pathlib import Path

import click

from hcnaf_cli import options
from hcnaf_cli.output import check_target, show_json, talk, writing


@click.command()
@click.option("--ckpt", type=options.FILE, required=True, metavar="model.pt", help="Checkpoint to start from.")
@click.option("--data", type=options.FILE, required=True, metavar="DIR", help="Data set of `hcnaf simulate`.")
@click.option("--out", "-o", type=options.FILE, required=True, metavar="tempered.pt", help="Checkpoint to write.")
@click.option(
    "--limit",
    type=click.IntRange(min=0),
    default=0,
    help="Fit on about so many windows of the validation split [default: all].",
)
@options.threads
@options.as_json
def temper(ckpt: Path, data: Path, out: Path, limit: int, threads: int | None, as_json: bool) -> None:
    """Fit a temperature on the validation split, so that 95 % regions hold 95 % of what happened there.

    A model that has seen few roads is as sure of others as of these. The temperature divides z, goes into the last
    layer of the flow and costs nothing at run time. Scores kept in the checkpoint are left out: evaluate it anew.
    """
    from hcnaf_export.checkpoint import load_checkpoint, save_checkpoint
    from hcnaf_export.data.tracks import Dataset
    from hcnaf_export.evaluation.temperature import fit_temperature, with_temperature
    from hcnaf_export.training.threads import threads as torch_threads

    check_target(out)
    checkpoint = load_checkpoint(ckpt)
    with torch_threads(threads):
        fitted = fit_temperature(checkpoint, Dataset(data), limit=limit)
    made = with_temperature(checkpoint, fitted.temperature)
    with writing(out):
        save_checkpoint(out, made.config, made.model.state_dict(), made.training, made.scores)
    facts = {"temperature": fitted.temperature, "covered_before": fitted.before, "covered_after": fitted.after}
    if as_json:
        show_json(facts)
    else:
        click.echo(
            f"temperature {fitted.temperature:.3f}: 95 % regions held {100 * fitted.before:.1f} % of the labels, "
            f"hold {100 * fitted.after:.1f} %"
        )
    talk(f"wrote {click.format_filename(out)}")
