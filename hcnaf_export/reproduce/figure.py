"""Pictures of densities over the plane, target and model side by side (extra `plot`).

Figures are made without pyplot, so that nothing global changes.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hcnaf_export.data.toys import Toy
from hcnaf_export.reproduce.toys import Density
from hcnaf_runtime.errors import MissingExtraError
from hcnaf_runtime.npz import atomic

Array = NDArray[np.float64]

DOTS_PER_INCH = 130
SIDE = 2.7
"""Inches of a panel."""
CELLS = 300
"""Points per axis at which a density is drawn."""


@dataclass(frozen=True)
class View:
    """A square of the plane, by its lowest and highest coordinate on both axes."""

    low: float
    high: float

    def points(self) -> Array:
        """CELLS x CELLS points, row by row from the lowest y: [CELLS^2, 2]."""
        axis = np.linspace(self.low, self.high, CELLS)
        return np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)


class Target:
    """A toy's own density."""

    def __init__(self, toy: Toy) -> None:
        self.toy = toy

    def log_prob(self, index: int, x: Array) -> Array:
        """log p [N] at points [N, 2], nats."""
        return self.toy.log_prob(index, x)


@dataclass(frozen=True)
class Panel:
    """A density as an image: `values` [CELLS, CELLS], row 0 at the lowest y."""

    title: str
    values: Array


def panel(title: str, density: Density, indices: Sequence[int], view: View) -> Panel:
    """The mean of the densities under some conditions."""
    x = view.points()
    values = np.mean([np.exp(density.log_prob(i, x)) for i in indices], axis=0)
    return Panel(title, values.reshape(CELLS, CELLS))


def check_matplotlib() -> None:
    """Raise MissingExtraError where it is not installed."""
    if importlib.util.find_spec("matplotlib") is None:
        raise MissingExtraError('figures need matplotlib, which is not installed; run: pip install "hcnaf[plot]"')


def draw(path: Path, title: str, rows: Sequence[Sequence[Panel]], view: View) -> None:
    """Write a grid of panels to a PNG file; panels of a column share their colours, the palest is 0."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = len(rows[0])
    figure = Figure(
        figsize=(SIDE * columns + 0.4, SIDE * len(rows) + 0.9), layout="constrained", facecolor="white"
    )
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=11)
    grid = figure.subplots(len(rows), columns, squeeze=False)
    highest = [max(float(row[k].values.max()) for row in rows) for k in range(columns)]
    for axes_row, row in zip(grid, rows, strict=True):
        for k, (axes, each) in enumerate(zip(axes_row, row, strict=True)):
            axes.imshow(
                each.values,
                origin="lower",
                extent=(view.low, view.high, view.low, view.high),
                cmap="magma_r",
                vmin=0.0,
                vmax=highest[k],
            )
            axes.set_title(each.title, fontsize=9)
            axes.tick_params(labelsize=7)
    with atomic(path) as stream:
        figure.savefig(stream, format="png", dpi=DOTS_PER_INCH)
