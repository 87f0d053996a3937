"""Occupancy forecasts in simulated traffic, one thing changed at a time: what they see, their density, their size.

    recipe + changes of a cell ── run_cell ──> OUT/cells/CELL-SEED/   a training run and, once scored, scores.npz
    OUT/GRID.json, GRID.md, GRID.png   made from all cells of a grid (`occupancy_report`)

Every cell of a grid trains on the same windows in the same order, for the same number of steps, and is scored on
networks that none has seen. A cell that is done is not done again, one that was interrupted goes on; grids share
the cells they have in common.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np
from numpy.typing import NDArray

from hcnaf_export.baselines import ConstantVelocityGaussian
from hcnaf_export.checkpoint import Checkpoint
from hcnaf_export.data.tracks import Dataset
from hcnaf_export.evaluation.checkpoint_predictor import CheckpointPredictor
from hcnaf_export.evaluation.evaluate import HORIZONS
from hcnaf_export.evaluation.subset import Part, cluster_of, parts
from hcnaf_export.experiments.cells import train_cell
from hcnaf_export.experiments.lost_mass import lost_mass
from hcnaf_export.experiments.occupancy_grids import GRIDS, ExperimentGrid
from hcnaf_export.recipe import PomRecipe, from_plain, read_recipe, to_plain
from hcnaf_export.training.loop import Progress
from hcnaf_runtime.npz import write_npz

Float = NDArray[np.float64]

FILE = "scores.npz"


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What to run.

    Attributes:
        grid: a name of `GRIDS`. cells: those of it to run, all if empty. seeds: runs of each.
        data: a data set of `hcnaf simulate`; its test split is scored. out: folder to write to, or to go on in.
        recipe: of every cell, before its changes.
        threads: of PyTorch.
    """

    grid: str
    data: Path
    out: Path
    cells: Sequence[str] = ()
    seeds: Sequence[int] = (0,)
    recipe: PomRecipe = field(default_factory=lambda: shipped_recipe())
    threads: int | None = None

    @property
    def about(self) -> ExperimentGrid:
        """What is compared, with the chosen cells alone."""
        grid = GRIDS[self.grid]
        return replace(grid, cells={name: grid.cells[name] for name in self.cells or grid.cells})


@dataclass(frozen=True, eq=False)
class CellScores:
    """Scores of one model on the windows of unseen networks, in the order of the windows.

    Attributes:
        nll: [W, 8] of recorded labels at `HORIZONS`, nats per m².
        lost: [W, 8], the mass that the density falls short of 1 by (see `lost_mass`); 0 for normalised densities.
        facts: of the training: steps, seconds (wall time), validation score, and the model's parameters.
    """

    nll: Float
    lost: Float
    facts: dict[str, Any]


def shipped_recipe() -> PomRecipe:
    """The recipe `pom-compare`."""
    recipe = read_recipe("pom-compare")
    assert isinstance(recipe, PomRecipe)
    return recipe


def cell_recipe(plan: Plan, cell: str, seed: int) -> PomRecipe:
    """The plan's recipe with the changes and the seed of a cell."""
    plain = to_plain(plan.recipe)
    for path, value in GRIDS[plan.grid].cells[cell].changes.items():
        *tables, key = path.split(".")
        place = plain
        for table in tables:
            place = place[table]
        place[key] = value
    recipe = from_plain({**plain, "name": f"{plan.recipe.name}-{cell}", "seed": seed}, plan.recipe.name)
    assert isinstance(recipe, PomRecipe)
    return recipe


def runs(plan: Plan) -> Iterator[tuple[str, int]]:
    """Cell and seed of every run, in the order they are done."""
    return ((cell, seed) for seed in plan.seeds for cell in plan.about.cells)


def run_cell(plan: Plan, cell: str, seed: int, report: Callable[[Progress], None] | None = None) -> bool:
    """Train and score a cell unless it is done. Returns False if interrupted.

    Raises:
        RecipeError, DataError, CheckpointError, TrainingError: see `train_cell`.
    """
    folder = cell_folder(plan.out, cell, seed)
    if (folder / FILE).is_file():
        return True
    trained = train_cell(cell_recipe(plan, cell, seed), plan.data, folder, plan.threads, report)
    if trained is None:
        return False
    loaded, facts = trained
    facts["parameters"] = sum(p.numel() for p in loaded.model.parameters())
    save_cell(folder, score_model(loaded, test_windows(plan.data), facts))
    return True


def test_windows(data: Path) -> list[Part]:
    """All windows of the test networks."""
    return parts(Dataset(data).split("test"))


def clusters(data: Path) -> NDArray[np.int64]:
    """Which of them see the same traffic, [W]."""
    return cluster_of(test_windows(data))


def score_model(checkpoint: Checkpoint, windows: Sequence[Part], facts: dict[str, Any]) -> CellScores:
    """NLL of every window and horizon, and what the density's mass falls short of."""
    predictor = CheckpointPredictor(checkpoint)
    nll = [predictor.nll(part.tracks, part.windows, HORIZONS) for part in windows]
    lost = [lost_mass(predictor, part.tracks, part.windows, HORIZONS) for part in windows]
    return CellScores(np.concatenate(nll), np.concatenate(lost), facts)


def score_constant_velocity(data: Path) -> CellScores:
    """The same of a Gaussian around constant velocity, fitted on the training networks."""
    baseline = ConstantVelocityGaussian.fit(Dataset(data).split("train"), HORIZONS)
    nll = np.concatenate([baseline.nll(p.tracks, p.windows, HORIZONS) for p in test_windows(data)])
    return CellScores(nll, np.zeros_like(nll), {})


def cell_folder(out: Path, cell: str, seed: int) -> Path:
    """Where a cell's run lies."""
    return out / "cells" / f"{cell}-{seed}"


def save_cell(folder: Path, scores: CellScores) -> None:
    """Write what `load_cell` reads."""
    facts = np.frombuffer(msgspec.json.encode(scores.facts), dtype=np.uint8)
    write_npz(folder / FILE, {"nll": scores.nll, "lost": scores.lost, "facts": facts})


def load_cell(folder: Path) -> CellScores:
    """Scores of a cell that is done."""
    with np.load(folder / FILE, allow_pickle=False) as found:
        facts = cast("dict[str, Any]", msgspec.json.decode(found["facts"].tobytes()))
        return CellScores(found["nll"], found["lost"], facts)
