"""The picture of an evaluation: NLL against the horizon, calibration in three forms, extra nats (extra `plot`)."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hcnaf_cli.picture import DOTS_PER_INCH, horizon_hues
from hcnaf_runtime.npz import atomic

if TYPE_CHECKING:
    from hcnaf_export.evaluation import Scores
    from hcnaf_export.evaluation.reliability import Bin

SHOWN = (1.0, 2.0, 4.0)
"""Horizons (s) drawn where each has a line of its own, if they were scored; else the first, middle and last."""

PANEL = 4.2, 3.5
"""Inches."""

TRUTH = "0.45"
"""Grey of what a calibrated forecast would show."""

FEWEST = 30
"""Cells of a bin that is drawn in the diagram."""


def draw(path: Path, scores: "Scores") -> None:
    """Draw `scores` into the file at `path`; either all of it appears or nothing does."""
    figure = paint(scores)
    with atomic(path) as stream:
        figure.savefig(stream, format=path.suffix.lower()[1:], dpi=DOTS_PER_INCH)


def paint(scores: "Scores") -> Any:
    """The matplotlib figure: a panel for everything that was scored, three in a row.

    Calibration may rest on fewer windows than the rest: its panels say on how many.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    panels = _panels(scores)
    columns = min(len(panels), 3)
    rows = -(-len(panels) // 3)
    figure = Figure(figsize=(PANEL[0] * columns, PANEL[1] * rows + 0.4), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    axes = np.ravel(figure.subplots(rows, columns, squeeze=False))
    for panel, place in zip(panels, axes, strict=False):
        panel(place, scores)
        place.spines[["top", "right"]].set_visible(False)
        place.tick_params(labelsize=8)
    for place in axes[len(panels) :]:
        place.set_visible(False)
    figure.suptitle(scores.title, fontsize=12, parse_math=False)
    return figure


def _panels(scores: "Scores") -> list[Callable[[Any, "Scores"], None]]:
    """What draws each panel, of what was scored."""
    found: list[Callable[[Any, Scores], None]] = [_nll]
    if scores.pit:
        found += [_along, _across]
    if scores.hdr_coverage:
        found.append(_coverage)
    if scores.reliability:
        found.append(_reliability)
    if scores.extra_nats:
        found.append(_extra_nats)
    return found


def _nll(axes: Any, scores: "Scores") -> None:
    """NLL and the baseline's, with two standard errors."""
    t = [r.horizon for r in scores.rows]
    lines = (
        ([r.nll for r in scores.rows], [2.0 * r.error for r in scores.rows], "#0072b2", scores.predictor),
        (
            [r.baseline for r in scores.rows],
            [2.0 * r.baseline_error for r in scores.rows],
            "#d55e00",
            "constant velocity",
        ),
    )
    for values, errors, colour, label in lines:
        axes.errorbar(t, values, errors, color=colour, label=label, marker="o", markersize=3, lw=1.5)
    if scores.floor is not None:
        axes.axhline(scores.floor, color=TRUTH, lw=1.0, ls="--", label="label noise alone")
    _name(axes, "NLL, with two standard errors", "seconds ahead", "nats per m²")
    axes.set_xlim(left=0.0)
    axes.legend(frameon=False, fontsize=8)


def _along(axes: Any, scores: "Scores") -> None:
    _pit(axes, scores, "along", "PIT along: u = F$_1$(x)")


def _across(axes: Any, scores: "Scores") -> None:
    _pit(axes, scores, "across", "PIT across: u = F$_2$(y | x)")


def _pit(axes: Any, scores: "Scores", coordinate: str, name: str) -> None:
    """Histograms of u, one step line per horizon; a calibrated forecast's is flat."""
    assert scores.pit is not None
    some = _shown([r.horizon for r in scores.pit.rows])
    axes.axhline(1.0, color=TRUTH, lw=1.0, ls="--")
    for q, colour in zip(some, horizon_hues(len(some)), strict=True):
        row = scores.pit.rows[q]
        found = getattr(row, coordinate)
        edges = np.linspace(0.0, 1.0, len(found.histogram) + 1)
        heights = np.array(found.histogram) * len(found.histogram)
        axes.stairs(
            heights, edges, baseline=None, color=colour, lw=1.5, label=f"{row.horizon:g} s: KS {found.ks:.3f}"
        )
    _name(axes, f"{name}, {scores.pit.windows} windows", "u", "density of u")
    axes.set(xlim=(0.0, 1.0), ylim=(0.0, max(1.6, 1.25 * axes.get_ylim()[1])))
    axes.legend(
        frameon=False, fontsize=8, loc="upper center", ncols=len(some), columnspacing=1.0, handlelength=1.0
    )


def _coverage(axes: Any, scores: "Scores") -> None:
    """Share of labels in highest-density regions against the horizon, with two standard errors."""
    assert scores.hdr_coverage is not None
    rows = scores.hdr_coverage.rows
    levels = sorted({r.level for r in rows})
    for level, colour in zip(levels, horizon_hues(len(levels)), strict=True):
        mine = [r for r in rows if r.level == level]
        axes.axhline(level, color=TRUTH, lw=1.0, ls="--")
        axes.errorbar(
            [r.horizon for r in mine],
            [r.covered for r in mine],
            [2.0 * r.error for r in mine],
            color=colour,
            marker="o",
            markersize=3,
            lw=1.5,
            label=f"{level:.0%}",
        )
    name = f"labels in highest-density regions, {scores.hdr_coverage.windows} windows"
    _name(axes, name, "seconds ahead", "share of labels")
    axes.set(xlim=(0.0, None), ylim=(min(0.3, *(r.covered - 0.1 for r in rows)), 1.0))
    axes.legend(frameon=False, fontsize=8, loc="lower right", ncols=len(levels))


def _reliability(axes: Any, scores: "Scores") -> None:
    """Share of cells hit against their probability, both logarithmic, with two standard errors."""
    assert scores.reliability is not None
    found = scores.reliability
    some = _shown([r.horizon for r in found.rows])
    filled = [[b for b in found.rows[q].log_bins if b.cells >= FEWEST and b.observed > 0.0] for q in some]
    low = min((min(b.predicted, b.observed) for bins in filled for b in bins), default=1e-4)
    axes.plot([low, 1.0], [low, 1.0], color=TRUTH, lw=1.0, ls="--")
    for q, bins, colour in zip(some, filled, horizon_hues(len(some)), strict=True):
        x, y = ([getattr(b, name) for b in bins] for name in ("predicted", "observed"))
        label = f"{found.rows[q].horizon:g} s: ECE {found.rows[q].ece:.4f}"
        axes.errorbar(x, y, _bars(bins), color=colour, marker="o", markersize=3, lw=1.2, label=label)
    axes.set(xscale="log", yscale="log")
    _name(
        axes, f"cells of {found.cell:g} m, {found.windows} windows", "predicted probability", "share of cells hit"
    )
    axes.legend(frameon=False, fontsize=8, loc="upper left")


def _bars(bins: "list[Bin]") -> Any:
    """Two standard errors each way [2, n], kept above 0."""
    return [[min(2.0 * b.error, 0.9 * b.observed) for b in bins], [2.0 * b.error for b in bins]]


def _extra_nats(axes: Any, scores: "Scores") -> None:
    """Extra nats of each protocol against the horizon, with two standard errors, and their floors."""
    for found, colour in zip(scores.extra_nats, horizon_hues(len(scores.extra_nats)), strict=True):
        t, values = [r.horizon for r in found.rows], [r.extra_nats for r in found.rows]
        errors = [2.0 * r.error for r in found.rows]
        label = f"{found.protocol}: noise of {found.sigma:g} m"
        axes.errorbar(t, values, errors, color=colour, marker="o", markersize=3, lw=1.5, label=label)
        axes.axhline(found.floor, color=colour, lw=1.0, ls="--")
    _name(axes, "extra nats (dashed: what label noise leaves)", "seconds ahead", "nats per dimension")
    axes.set(xlim=(0.0, None), ylim=(0.0, None))
    axes.legend(frameon=False, fontsize=8, loc="upper left")


def _shown(horizons: list[float]) -> list[int]:
    """Positions of the horizons that get lines of their own."""
    wanted = [horizons.index(t) for t in SHOWN if t in horizons]
    return wanted or sorted({0, len(horizons) // 2, len(horizons) - 1})


def _name(axes: Any, title: str, x: str, y: str) -> None:
    axes.set_title(title, fontsize=9)
    axes.set_xlabel(x, fontsize=8)
    axes.set_ylabel(y, fontsize=8)
