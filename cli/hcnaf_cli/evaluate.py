"""`hcnaf evaluate`: how good a model is on held-out data."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from hcnaf_cli import options
from hcnaf_cli.output import ProgressLine, check_target, show_json, talk, writing

if TYPE_CHECKING:
    from hcnaf_export.checkpoint import Checkpoint
    from hcnaf_export.evaluation import Scores

_count = click.IntRange(min=0)


@click.command()
@click.option(
    "--bundle",
    type=options.FILE,
    metavar="BUNDLE",
    help="Score a bundle [default: the embedded one].",
)
@click.option("--ckpt", type=options.FILE, metavar="model.pt", help="Score a checkpoint, through PyTorch.")
@click.option(
    "--data",
    type=options.FILE,
    metavar="DIR",
    help="Data set of `hcnaf simulate`, or PRECOG-CARLA; toys need none.",
)
@click.option("--split", type=click.Choice(["train", "val", "test"]), default="test", show_default=True)
@click.option("--network", type=_count, help="Score this network of the split, from 0 [default: all].")
@click.option("--horizons", metavar="0.5,1,4", help="Seconds ahead [default: every half second].")
@click.option("--limit", type=_count, default=0, help="Score at most about so many windows [default: all].")
@click.option(
    "--samples-windows",
    type=_count,
    default=400,
    show_default=True,
    help="Score samples on at most about so many windows (min_ade_k, miss_rate, energy_score).",
)
@click.option(
    "--calibration-windows",
    type=_count,
    default=2000,
    show_default=True,
    help="Measure calibration on at most about so many windows (PIT, coverage, ECE).",
)
@click.option("--extra-nats/--no-extra-nats", default=True, show_default=True, help="Score perturbed labels too.")
@click.option("--plot", type=options.FILE, metavar="OUT.png", help="Draw scores and calibration (extra `plot`).")
@click.option(
    "--record", is_flag=True, help="Keep the scores in the checkpoint; exports carry them in their card."
)
@click.option("--device", default="cpu", show_default=True, metavar="cpu|cuda|cuda:N", help="Of a checkpoint.")
@options.threads
@options.as_json
def evaluate(
    bundle: Path | None,
    ckpt: Path | None,
    data: Path | None,
    split: Literal["train", "val", "test"],
    network: int | None,
    horizons: str | None,
    limit: int,
    samples_windows: int,
    calibration_windows: int,
    extra_nats: bool,
    plot: Path | None,
    record: bool,
    device: str,
    threads: int | None,
    as_json: bool,
) -> None:
    """Score a model on held-out traffic: negative log-likelihood, extra nats, calibration and samples.

    Beside it stands a Gaussian around the constant-velocity prediction, fitted on the data set's training split.
    A folder of PRECOG-CARLA episodes is scored at every row up to the model's horizon, NLL and extra nats only.
    """
    from hcnaf_cli.inputs import parse_horizons
    from hcnaf_cli.scores_text import scores_text
    from hcnaf_export import evaluation
    from hcnaf_export.data.precog_set import is_precog

    _check(bundle, ckpt, record, plot)
    loaded = _checkpoint(ckpt, threads) if ckpt else None
    if loaded and str(loaded.training.get("task")).startswith("toy"):
        _toy(loaded, record, plot, as_json)
        return
    if data is None:
        raise click.UsageError("give the data set to score on as --data")
    with ProgressLine() as line:
        wanted = parse_horizons(horizons)
        common: dict[str, Any] = {
            "network": network,
            "horizons": wanted or evaluation.HORIZONS,
            "limit": limit,
            "samples": samples_windows,
            "calibrated": calibration_windows,
            "extra": extra_nats,
            "report": lambda share: line(f"{share:4.0%}"),
        }
        if is_precog(data):
            some = {key: common[key] for key in ("limit", "report")} | {"horizons": wanted}
            scores = _episodes(loaded, bundle, data, split, device=device, threads=threads, **some)
        elif loaded:
            scores = evaluation.evaluate_checkpoint(loaded, data, split, device=device, **common)
        else:
            scores = evaluation.evaluate_bundle(bundle, data, split, threads=threads, **common)
    if ckpt and loaded and record:
        _record(ckpt, loaded, scores.record())
    if plot is not None:
        from hcnaf_cli import picture_evaluation

        with writing(plot):
            picture_evaluation.draw(plot, scores)
        talk(f"wrote {click.format_filename(plot)}")
    show_json(scores.as_dict()) if as_json else click.echo(scores_text(scores))


def _check(bundle: Path | None, ckpt: Path | None, record: bool, plot: Path | None) -> None:
    """Refuse what cannot be done before anything is computed."""
    if bundle and ckpt:
        raise click.UsageError("give --bundle or --ckpt, not both")
    if record and not ckpt:
        raise click.UsageError("--record needs --ckpt: scores are kept in a checkpoint")
    if plot is not None:
        from hcnaf_cli.picture import check_picture

        check_picture(plot)
        check_target(plot)


def _episodes(
    loaded: "Checkpoint | None",
    bundle: Path | None,
    data: Path,
    split: Literal["train", "val", "test"],
    *,
    device: str,
    threads: int | None,
    **some: Any,
) -> "Scores":
    """Scores on PRECOG-CARLA episodes."""
    from hcnaf_export.evaluation import precog

    if loaded:
        return precog.evaluate_episodes_checkpoint(loaded, data, split, device=device, **some).scores
    return precog.evaluate_episodes_bundle(bundle, data, split, threads=threads, **some).scores


def _toy(loaded: "Checkpoint", record: bool, plot: Path | None, as_json: bool) -> None:
    """Divergences from the known densities of a toy."""
    from hcnaf_cli import tables
    from hcnaf_export import evaluation

    if record or plot:
        raise click.UsageError("--record and --plot are for forecasts; a toy's divergences are printed only")
    found = evaluation.evaluate_toy_checkpoint(loaded)
    show_json(tables.toy_json(found)) if as_json else click.echo(tables.toy_text(found))


def _record(path: Path, checkpoint: "Checkpoint", scores: dict[str, Any]) -> None:
    from hcnaf_export.checkpoint import save_checkpoint

    state = checkpoint.model.state_dict()
    save_checkpoint(path, checkpoint.config, state, checkpoint.training, {**checkpoint.scores, **scores})


def _checkpoint(path: Path, threads: int | None) -> "Checkpoint":
    import torch

    from hcnaf_export.checkpoint import load_checkpoint

    if threads:
        torch.set_num_threads(threads)
    return load_checkpoint(path)
