"""What the occupancy experiment compares: grids of cells, each a change to one recipe.

conditions   what the hyper-network sees: the paper's ablation C1-C6
heads        the density it emits: HCNAF and its baselines under C5
rates        the learning rate of either, without rasters: what the recipe's own rate rests on
size         the flow's H and L: score against bytes and time
norms        the support, and the normalisation of weights
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

Changes = Mapping[str, Any]
"""Settings by dotted path, such as {"model.flow.hidden": 50}."""

NO_RASTER: Changes = {"model.channels": [], "model.draw_actors": False}
ACTORS: Changes = {"model.actors": "history"}
STOPS: Changes = {"model.stops": True}

SHORT: Changes = {"optimiser.steps": 1500, "windows.horizons": 4}
"""The budget of flows of many sizes: the largest take ten times as long for a step."""

SIZES = tuple((hidden, layers) for layers in (2, 3) for hidden in (10, 20, 50, 100))


@dataclass(frozen=True)
class Cell:
    """One model: what it is called in tables, and how it differs from the recipe."""

    label: str
    changes: Changes = field(default_factory=dict)


@dataclass(frozen=True)
class ExperimentGrid:
    """Models that are compared: what the comparison is about, the cell the others are held against, and all cells.

    `bundles`: cells are exported too, for their bytes and times.
    """

    title: str
    reference: str
    cells: Mapping[str, Cell]
    bundles: bool = False


RATES = (3e-3, 6e-3, 12e-3)
HEADS = {
    "hcnaf": "HCNAF",
    "mixture": "mixture of 6 Gaussians",
    "affine": "affine flow (MAF, 5)",
    "spline": "spline flow (NSF, 3)",
}

C5 = Cell("C5: C1 and rasters")
C2: Changes = {**NO_RASTER, "model.actors": "now"}
SHEAR: Changes = {"model.flow.shear": True}

GRIDS: dict[str, ExperimentGrid] = {
    "conditions": ExperimentGrid(
        "What the forecast sees (C1-C6)",
        "C1",
        {
            "C1": Cell("C1: the agent's history", NO_RASTER),
            "C2": Cell("C2: C1 and others now", C2),
            "C3": Cell("C3: C1 and others' histories", {**NO_RASTER, **ACTORS}),
            "C4": Cell("C4: C3 and stop lines", {**NO_RASTER, **ACTORS, **STOPS}),
            "C5": C5,
            "C6": Cell("C6: C4 and rasters", {**ACTORS, **STOPS}),
        },
    ),
    "heads": ExperimentGrid(
        "HCNAF and its baselines under C5",
        "C5",
        {"C5": Cell(HEADS["hcnaf"])}
        | {head: Cell(label, {"model.head": head}) for head, label in HEADS.items() if head != "hcnaf"},
    ),
    "rates": ExperimentGrid(
        "The learning rate of every head under C2",
        "hcnaf-0.006",
        {
            f"{head}-{rate:g}": Cell(
                f"{label}, {rate:g}", {**C2, "model.head": head, "optimiser.learning_rate": rate}
            )
            for head, label in HEADS.items()
            for rate in RATES
        },
    ),
    "size": ExperimentGrid(
        "The size of the flow under C5",
        "H20-L2",
        {
            f"H{hidden}-L{layers}": Cell(
                f"H = {hidden}, L = {layers}",
                {**SHORT, "model.flow.hidden": hidden, "model.flow.layers": layers},
            )
            for hidden, layers in SIZES
        },
        bundles=True,
    ),
    "norms": ExperimentGrid(
        "Support, units and weight normalisation under C5",
        "C5",
        {
            "C5": Cell("normalised, no weight norm"),
            "paper": Cell("paper support, no weight norm", {"model.flow.support": "paper"}),
            "shear": Cell("normalised, no weight norm, slanted units", SHEAR),
            "row": Cell("normalised, row norm", {"model.flow.weight_norm": "row"}),
            "frobenius": Cell("normalised, Frobenius norm", {"model.flow.weight_norm": "frobenius"}),
            "row-gain": Cell("normalised, row norm, emitted gains", {"model.flow.weight_norm": "row-gain"}),
        },
    ),
}
