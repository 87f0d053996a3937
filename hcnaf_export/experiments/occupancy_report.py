"""From the cells of an occupancy grid to a record, tables and a picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray

from hcnaf_export.evaluation.evaluate import HORIZONS
from hcnaf_export.evaluation.spread import mean_and_error
from hcnaf_export.experiments.cells import band, over_seeds
from hcnaf_export.experiments.occupancy import (
    CellScores,
    Plan,
    cell_folder,
    clusters,
    load_cell,
    score_constant_velocity,
)
from hcnaf_export.experiments.occupancy_bundle import BundleFacts, load_bundle
from hcnaf_export.experiments.tables import markdown_table
from hcnaf_export.recipe import to_plain
from hcnaf_runtime.measure import machine

Float = NDArray[np.float64]
Column = dict[str, float]
"""Numbers by horizon, such as "2 s", and their mean."""

CONSTANT_VELOCITY = "constant velocity"
SHOWN = ("1 s", "2 s", "4 s", "mean")


class CellRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One cell, the mean over its seeds; errors are standard errors over scenes.

    Attributes:
        label: what tables call it. nll, error: of recorded labels, nats per m².
        behind, behind_error: nll minus the reference cell's on the same windows (paired).
        lost, most_lost: mass that the density falls short of 1 by, mean over windows and the most of any.
        seeds: the mean of each seed. training: facts of each, see `CellScores`.
        bundle: bytes and times of the exported model, of grids that export.
    """

    label: str
    nll: Column
    error: Column
    behind: Column
    behind_error: Column
    lost: Column
    most_lost: float
    seeds: tuple[float, ...]
    training: tuple[dict[str, Any], ...]
    bundle: BundleFacts | None = None


class GridRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One grid.

    Attributes:
        grid, title, reference: of `occupancy_grids`.
        windows, scenes: what was scored: windows, and groups of them taken as independent.
        cells: by name. changes: of each to the recipe.
        recipe: of all cells, before changes. about: machine, versions, date, seeds.
    """

    grid: str
    title: str
    reference: str
    windows: int
    scenes: int
    cells: dict[str, CellRecord]
    changes: dict[str, dict[str, Any]]
    recipe: dict[str, Any]
    about: dict[str, Any]

    def as_dict(self) -> dict[str, Any]:
        """Plain data, fit for JSON."""
        plain: dict[str, Any] = msgspec.to_builtins(self)
        return plain

    def as_json(self) -> str:
        """The record file."""
        return msgspec.json.format(msgspec.json.encode(self), indent=1).decode() + "\n"


def record_of(plan: Plan) -> GridRecord:
    """The record of a plan whose cells are done."""
    grid, cluster = plan.about, clusters(plan.data)
    found = {
        name: [load_cell(cell_folder(plan.out, name, seed)) for seed in plan.seeds]
        for name in dict.fromkeys((grid.reference, *grid.cells))
    }
    ours = over_seeds(found[grid.reference], "nll")
    cells = {
        name: msgspec.structs.replace(
            cell_record(cell.label, found[name], ours, cluster),
            bundle=load_bundle(cell_folder(plan.out, name, plan.seeds[0])),
        )
        for name, cell in grid.cells.items()
    }
    if plan.grid == "heads":
        still = [score_constant_velocity(plan.data)]
        cells[CONSTANT_VELOCITY] = cell_record(CONSTANT_VELOCITY, still, ours, cluster)
    about = machine(plan.threads or torch.get_num_threads())
    return GridRecord(
        grid=plan.grid,
        title=grid.title,
        reference=grid.reference,
        windows=len(ours),
        scenes=len(np.unique(cluster)),
        cells=cells,
        changes={name: dict(cell.changes) for name, cell in grid.cells.items()},
        recipe=to_plain(plan.recipe),
        about=about | {"seeds": len(plan.seeds), "torch": str(torch.__version__)},
    )


def cell_record(
    label: str, cells: Sequence[CellScores], reference: Float, cluster: NDArray[np.int64]
) -> CellRecord:
    """Scores of one cell's seeds on windows of clusters [W]; `reference` [W, 8] is the NLL to hold it against."""
    nll, lost = over_seeds(cells, "nll"), over_seeds(cells, "lost")
    score, error = _columns(nll, cluster)
    behind, behind_error = _columns(nll - reference, cluster)
    return CellRecord(
        label=label,
        nll=score,
        error=error,
        behind=behind,
        behind_error=behind_error,
        lost=_columns(lost, cluster)[0],
        most_lost=float(max(cell.lost.max() for cell in cells)),
        seeds=tuple(float(cell.nll.mean()) for cell in cells),
        training=tuple(cell.facts for cell in cells),
    )


def tables(record: GridRecord) -> dict[str, list[tuple[str, ...]]]:
    """Header and rows of the tables, by their captions."""
    cells = record.cells
    against = f"minus {cells[record.reference].label}" if record.reference in cells else "minus the reference"
    found = {
        "NLL of recorded labels (nats per m²)": [
            (c.label, *(_pair(c.nll, c.error, h) for h in SHOWN), _size(c)) for c in cells.values()
        ],
        f"NLL {against}, same windows (nats per m²)": [
            (c.label, *(_pair(c.behind, c.behind_error, h) for h in SHOWN), "")
            for name, c in cells.items()
            if name != record.reference
        ],
    }
    if any(c.most_lost for c in cells.values()):
        found["Mass that the density falls short of 1 by, mean over windows"] = [
            (c.label, *(f"{c.lost[h]:.2e}" for h in SHOWN), f"most {c.most_lost:.2g}")
            for c in cells.values()
            if c.most_lost
        ]
    head = ("", *SHOWN, "")
    named = {caption: [(head[0], *SHOWN, _last(caption)), *rows] for caption, rows in found.items()}
    exported = [(c.label, *c.bundle.row()) for c in cells.values() if c.bundle]
    if exported:
        named["Bundles: bytes, and medians of one agent and 20 horizons on 200 x 200 cells"] = [
            ("", *BundleFacts.HEAD),
            *exported,
        ]
    return named


def markdown(record: GridRecord) -> str:
    """GRID.md of the result: tables, and what they rest on."""
    parts = [f"# {record.title}", ""]
    for caption, (head, *rows) in tables(record).items():
        parts += [f"{caption}:", "", *markdown_table(head, rows), ""]
    about = record.about
    parts += [
        f"{record.windows} windows in {record.scenes} scenes of networks that no model has seen; standard errors "
        f"are over scenes. Every cell trains by `pom-compare` but for the changes in `{record.grid}.json`: "
        f"{_budget(record)} Seeds: {about['seeds']}.",
        "",
        f"Made on {about['date'][:10]} with hcnaf {about['hcnaf']}, torch {about['torch']}, on {about['cpu']}, a "
        f"thread per run. `{record.grid}.png` shows NLL against horizon.",
    ]
    return "\n".join(parts) + "\n"


def _budget(record: GridRecord) -> str:
    """Steps and times of the cells' trainings, as a sentence."""
    trained = [facts for c in record.cells.values() for facts in c.training if facts]
    steps = sorted({facts["steps"] for facts in trained})
    minutes = [facts["seconds"] / 60.0 for facts in trained]
    batch = record.recipe["optimiser"]["batch"]
    return (
        f"{' or '.join(f'{s:,}' for s in steps)} steps of {batch} windows, {min(minutes):.0f} to "
        f"{max(minutes):.0f} minutes each."
    )


def plot(record: GridRecord, path: Path) -> None:
    """NLL against horizon, and how far each cell is behind the reference (extra `plot`)."""
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    palette = colormaps["tab10" if len(record.cells) <= 10 else "tab20"]
    colors = {name: palette(number) for number, name in enumerate(record.cells)}
    for name, cell in record.cells.items():
        _band(left, cell.nll, cell.error, cell.label, colors[name])
        if name not in (record.reference, CONSTANT_VELOCITY):
            _band(right, cell.behind, cell.behind_error, cell.label, colors[name])
    reference = record.cells.get(record.reference)
    right.axhline(0.0, color=colors.get(record.reference, "k"), lw=2.0)
    left.set(xlabel="seconds ahead", ylabel="NLL (nats/m²)", title=record.title)
    right.set(xlabel="seconds ahead", ylabel="NLL minus the reference's (nats/m²)")
    right.set_title(f"behind {reference.label if reference else record.reference}")
    for ax in (left, right):
        ax.grid(alpha=0.3)
    left.legend(fontsize=7)
    figure.savefig(path, dpi=110)


def _band(ax: Any, values: Column, errors: Column, label: str, color: Any) -> None:
    names = [f"{t:g} s" for t in HORIZONS]
    band(ax, HORIZONS, [values[n] for n in names], [errors[n] for n in names], label=label, color=color)


def _columns(values: Float, cluster: NDArray[np.int64]) -> tuple[Column, Column]:
    """Means and standard errors of values [W, 8] by horizon, and of their mean over the horizons."""
    found = mean_and_error(np.concatenate([values, values.mean(axis=1, keepdims=True)], axis=1), cluster)
    names = [*(f"{t:g} s" for t in HORIZONS), "mean"]
    mean, error = (dict(zip(names, map(float, v), strict=True)) for v in found)
    return mean, error


def _pair(values: Column, errors: Column, name: str) -> str:
    return f"{values[name]:.3f} ± {errors[name]:.3f}"


def _last(caption: str) -> str:
    """Title of the last column of a table."""
    return "parameters" if caption.startswith("NLL of") else ""


def _size(cell: CellRecord) -> str:
    return f"{cell.training[0]['parameters']:,}" if cell.training and cell.training[0] else ""
