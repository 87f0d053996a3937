"""From the cells of the ETH/UCY experiment to a record, tables and a picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray

from hcnaf_export.data.eth_ucy import Windows, split
from hcnaf_export.evaluation.spread import mean_and_error
from hcnaf_export.experiments.cells import band, over_seeds
from hcnaf_export.experiments.eth_ucy import (
    CONSTANT_VELOCITY,
    CellScores,
    Plan,
    cell_folder,
    load_cell,
    score_constant_velocity,
)
from hcnaf_export.experiments.eth_ucy_bundle import FILE as BUNDLE_FILE
from hcnaf_export.experiments.eth_ucy_bundle import load_bundle
from hcnaf_export.experiments.tables import markdown_table
from hcnaf_export.recipe import to_plain
from hcnaf_export.training.eth_ucy import HORIZONS
from hcnaf_runtime.measure import machine

Float = NDArray[np.float64]
Cells = Mapping[str, Sequence[CellScores]]
"""Scores by model, one per seed."""

OURS = "hcnaf"

LABELS = {
    "hcnaf": "HCNAF",
    "mixture": "mixture of 6 Gaussians",
    "affine": "affine flow (MAF, 5)",
    "spline": "spline flow (NSF, 3)",
    CONSTANT_VELOCITY: "constant velocity",
}


class ModelScore(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One model on one split, the mean over its seeds; errors are standard errors over pedestrians.

    Attributes:
        nll, error: mean over the horizons of recorded labels, nats per m². by_horizon: and at each.
        seeds: the mean of each seed.
        noisy, noisy_error: labels with 0.01 m of noise.
        behind, behind_error: nll minus HCNAF's on the same windows (paired), None without HCNAF.
        behind_by_horizon, behind_by_horizon_error: and at each horizon, empty without HCNAF.
        min_ade, min_ade_error, min_fde, min_fde_error: best of 20 paths, m.
        training: steps, seconds and validation of each seed, see `CellScores`.
    """

    nll: float
    error: float
    by_horizon: dict[str, float]
    by_horizon_error: dict[str, float]
    seeds: tuple[float, ...]
    noisy: float
    noisy_error: float
    behind: float | None
    behind_error: float | None
    behind_by_horizon: dict[str, float]
    behind_by_horizon_error: dict[str, float]
    min_ade: float
    min_ade_error: float
    min_fde: float
    min_fde_error: float
    training: tuple[dict[str, Any], ...]


class Exported(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """HCNAF through exported bundles and onnxruntime, nats per m².

    Attributes:
        seeds: those exported. nll: the mean of each.
        largest_difference: to PyTorch's, of any window and horizon.
    """

    seeds: tuple[int, ...]
    nll: tuple[float, ...]
    largest_difference: float


class SplitScore(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One split: how many windows and pedestrians are tested, and the models."""

    windows: int
    pedestrians: int
    sampled: int
    models: dict[str, ModelScore]
    exported: Exported | None = None


class Record(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The experiment.

    Attributes:
        splits: by name. mean: NLL by model over all splits, each counting the same; mean_error: its error.
        behind, behind_error: the same of the paired differences to HCNAF.
        recipe: of every cell, but for split, head and seed. about: machine, versions, date, seeds.
    """

    splits: dict[str, SplitScore]
    mean: dict[str, float]
    mean_error: dict[str, float]
    noisy_mean: dict[str, float]
    behind: dict[str, float]
    behind_error: dict[str, float]
    min_ade: dict[str, float]
    min_fde: dict[str, float]
    recipe: dict[str, Any]
    about: dict[str, Any]

    def as_dict(self) -> dict[str, Any]:
        """Plain data, fit for JSON."""
        plain: dict[str, Any] = msgspec.to_builtins(self)
        return plain

    def as_json(self) -> str:
        """The record file; numbers that JSON has no word for become null."""
        return msgspec.json.format(msgspec.json.encode(self), indent=1).decode() + "\n"


def record_of(plan: Plan) -> Record:
    """The record of a plan whose cells are done. Raises DataError for recordings that are missing or bad."""
    splits = {}
    for name in plan.splits:
        found: dict[str, list[CellScores]] = {
            model: [load_cell(cell_folder(plan.out, name, model, seed)) for seed in plan.seeds]
            for model in plan.models
        }
        found[CONSTANT_VELOCITY] = [score_constant_velocity(plan.data, name, plan.recipe.tracks.validation)]
        scores = split_score(found, split(plan.data, name).test)
        splits[name] = msgspec.structs.replace(scores, exported=_exported(plan, name))
    about = machine(plan.threads or torch.get_num_threads()) | {"seeds": len(plan.seeds)}
    return make_record(splits, to_plain(plan.recipe), about)


def _exported(plan: Plan, name: str) -> Exported | None:
    """What the bundles score, if there are any."""
    folders = {seed: cell_folder(plan.out, name, OURS, seed) for seed in plan.seeds}
    found = {seed: load_bundle(f) for seed, f in folders.items() if (f / BUNDLE_FILE).is_file()}
    if not found:
        return None
    largest = max(float(np.abs(nll - load_cell(folders[seed]).nll).max()) for seed, nll in found.items())
    return Exported(tuple(found), tuple(float(nll.mean()) for nll in found.values()), largest)


def split_score(cells: Cells, test: Windows) -> SplitScore:
    """Scores of all models on one split's windows."""
    cluster = test.scene * 10**6 + test.pedestrian
    ours = over_seeds(cells[OURS], "nll") if OURS in cells else None
    models = {name: _model_score(found, cluster, ours) for name, found in cells.items()}
    sampled = len(next(iter(cells.values()))[0].sampled)
    return SplitScore(len(test), len(np.unique(cluster)), sampled, models)


def _model_score(cells: Sequence[CellScores], cluster: NDArray[np.int64], ours: Float | None) -> ModelScore:
    nll, noisy = over_seeds(cells, "nll"), over_seeds(cells, "noisy")
    some = cluster[cells[0].sampled]
    behind = (None, None) if ours is None else _one((nll - ours).mean(axis=1), cluster)
    apart = ({}, {}) if ours is None else tuple(_columns(v) for v in mean_and_error(nll - ours, cluster))
    by_horizon, by_horizon_error = mean_and_error(nll, cluster)
    mean, error = _one(nll.mean(axis=1), cluster)
    noisy_mean, noisy_error = _one(noisy.mean(axis=1), cluster)
    min_ade, min_ade_error = _one(over_seeds(cells, "min_ade"), some)
    min_fde, min_fde_error = _one(over_seeds(cells, "min_fde"), some)
    return ModelScore(
        nll=mean,
        error=error,
        by_horizon=_columns(by_horizon),
        by_horizon_error=_columns(by_horizon_error),
        seeds=tuple(float(c.nll.mean()) for c in cells),
        noisy=noisy_mean,
        noisy_error=noisy_error,
        behind=behind[0],
        behind_error=behind[1],
        behind_by_horizon=apart[0],
        behind_by_horizon_error=apart[1],
        min_ade=min_ade,
        min_ade_error=min_ade_error,
        min_fde=min_fde,
        min_fde_error=min_fde_error,
        training=tuple(c.facts for c in cells),
    )


def make_record(splits: Mapping[str, SplitScore], recipe: Mapping[str, Any], about: Mapping[str, Any]) -> Record:
    """The record; means are over the models that every split has."""
    names = [n for n in LABELS if all(n in s.models for s in splits.values())]

    def over(field: str) -> dict[str, float]:
        return {n: float(np.mean([getattr(s.models[n], field) for s in splits.values()])) for n in names}

    def error(field: str) -> dict[str, float]:
        squares = {n: [getattr(s.models[n], field) ** 2 for s in splits.values()] for n in names}
        return {n: float(np.sqrt(np.sum(v)) / len(v)) for n, v in squares.items()}

    paired = OURS in names
    return Record(
        splits=dict(splits),
        mean=over("nll"),
        mean_error=error("error"),
        noisy_mean=over("noisy"),
        behind=over("behind") if paired else {},
        behind_error=error("behind_error") if paired else {},
        min_ade=over("min_ade"),
        min_fde=over("min_fde"),
        recipe=dict(recipe),
        about=dict(about) | {"torch": str(torch.__version__)},
    )


def tables(record: Record) -> dict[str, list[tuple[str, ...]]]:
    """Header and rows of the tables, by their captions."""
    splits, names = record.splits, list(record.mean)

    def row(name: str, field: str, digits: int, last: str) -> tuple[str, ...]:
        cells = []
        for s in splits.values():
            value, error = getattr(s.models[name], field), getattr(s.models[name], f"{field}_error", None)
            error = s.models[name].error if field == "nll" else error
            cells.append(f"{value:.{digits}f} ± {error:.{digits}f}")
        return (LABELS[name], *cells, last)

    def mean(values: Mapping[str, float], errors: Mapping[str, float] | None, name: str) -> str:
        return f"{values[name]:.3f}" + (f" ± {errors[name]:.3f}" if errors else "")

    head = ("", *splits, "mean")
    found = {
        "NLL of recorded labels (nats per m² and step)": [
            row(n, "nll", 3, mean(record.mean, record.mean_error, n)) for n in names
        ],
        "NLL of labels with 0.01 m of noise (nats per m² and step)": [
            row(n, "noisy", 3, mean(record.noisy_mean, None, n)) for n in names
        ],
        "min_ade_20 (m)": [row(n, "min_ade", 3, mean(record.min_ade, None, n)) for n in names],
        "min_fde_20 (m)": [row(n, "min_fde", 3, mean(record.min_fde, None, n)) for n in names],
    }
    if record.behind:
        found["NLL minus HCNAF's, same windows (nats per m² and step)"] = [
            row(n, "behind", 3, mean(record.behind, record.behind_error, n)) for n in names if n != OURS
        ]
    if any(s.exported for s in splits.values()):
        found["HCNAF through exported bundles (nats per m² and step)"] = _exported_rows(splits)
    return {caption: [head, *rows] for caption, rows in found.items()}


def _exported_rows(splits: Mapping[str, SplitScore]) -> list[tuple[str, ...]]:
    found = [s.exported for s in splits.values()]
    nll = [", ".join(f"{v:.3f}" for v in e.nll) if e else "" for e in found]
    largest = [f"{e.largest_difference:.1e}" if e else "" for e in found]
    return [("NLL", *nll, ""), ("largest difference to PyTorch", *largest, "")]


def markdown(record: Record) -> str:
    """README.md of the result: tables, and what they rest on."""
    parts = ["# ETH/UCY pedestrians, leave one scene out", ""]
    for caption, (head, *rows) in tables(record).items():
        parts += [f"{caption}:", "", *markdown_table(head, rows), ""]
    optimiser, tracks = record.recipe["optimiser"], record.recipe["tracks"]
    windows = ", ".join(f"{name} {s.windows} ({s.pedestrians})" for name, s in record.splits.items())
    sampled = max(s.sampled for s in record.splits.values())
    models = [m for s in record.splits.values() for m in s.models.values()]
    seconds = [facts["cpu_seconds"] for m in models for facts in m.training if facts]
    total = f", {min(seconds):.0f} to {max(seconds):.0f} s of CPU time each" if seconds else ""
    about = record.about
    parts += [
        f"Test windows (pedestrians): {windows}. Standard errors are over pedestrians. Samples: {sampled} windows "
        "per split at most, 20 paths each, whose horizons share their random numbers.",
        "",
        f"Budget, the same for every learned model: {optimiser['steps']} steps of {optimiser['batch']} windows "
        f"with {tracks['horizons']} horizons each{total}. Seeds: {about['seeds']}. Validation, which chooses the "
        f"weights: {', '.join(tracks['validation'])}, left out of training; no split tests on them.",
        "",
        f"Made on {about['date'][:10]} with hcnaf {about['hcnaf']}, torch {about['torch']}, on {about['cpu']}. "
        "Everything is in `record.json`; `nll.png` shows NLL against horizon.",
    ]
    return "\n".join(parts) + "\n"


def plot(record: Record, path: Path) -> None:
    """NLL against horizon for every split, and how far behind HCNAF the others are (extra `plot`)."""
    from matplotlib.figure import Figure

    splits = record.splits
    figure = Figure(figsize=(3.2 * len(splits), 6.0), layout="constrained")
    rows = figure.subplots(2, len(splits), squeeze=False)
    for above, below, (name, scores) in zip(*rows, splits.items(), strict=True):
        for number, model in enumerate(record.mean):
            found = scores.models[model]
            _band(above, found.by_horizon, found.by_horizon_error, model, f"C{number}")
            if model not in (OURS, CONSTANT_VELOCITY) and found.behind_by_horizon:
                _band(below, found.behind_by_horizon, found.behind_by_horizon_error, model, f"C{number}")
        above.set(title=name)
        below.set(xlabel="seconds ahead")
        below.axhline(0.0, color="C0", lw=2.0)
        for ax in (above, below):
            ax.grid(alpha=0.3)
    rows[0][0].set_ylabel("NLL (nats/m²)")
    rows[1][0].set_ylabel("NLL minus HCNAF's (nats/m²)")
    rows[0][-1].legend(fontsize=7)
    figure.savefig(path, dpi=110)


def _band(ax: Any, values: Mapping[str, float], errors: Mapping[str, float], model: str, color: str) -> None:
    width = 2.0 if model == OURS else 1.2
    band(ax, HORIZONS, list(values.values()), list(errors.values()), label=LABELS[model], color=color, width=width)


def _one(values: Float, cluster: NDArray[np.int64]) -> tuple[float, float]:
    mean, error = mean_and_error(values[:, None], cluster)
    return float(mean[0]), float(error[0])


def _columns(values: Float) -> dict[str, float]:
    return {f"{t:g} s": float(v) for t, v in zip(HORIZONS, values, strict=True)}
