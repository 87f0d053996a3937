"""The picture of a scene's occupancy: one view from above for each horizon, on one scale (extra `plot`)."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hcnaf_cli import picture_scenery
from hcnaf_cli.picture import DOTS_PER_INCH
from hcnaf_runtime import Scene
from hcnaf_runtime.npz import atomic
from hcnaf_runtime.occupancy import Occupancy

Float64 = npt.NDArray[np.float64]

SIDE, EDGE, HEAD, FOOT, TITLE = 3.9, 0.15, 0.4, 0.6, 0.25
"""Inches: the longer side of a panel, margins, the figure's title, what is below the panels, a panel's title."""

MOST_ACROSS = 4
"""Panels beside each other."""

SEEN = 0.01
"""Below this probability nothing is painted; the view is what lies above, and a margin."""

MARGIN = 8.0
NARROWEST = 30.0

TICKS = (0.01, 0.03, 0.1, 0.3, 1.0)


def draw(path: Path, name: str, scene: Scene, found: Occupancy) -> None:
    """Draw `found` over `scene` into the file at `path`; either all of it appears or nothing does."""
    figure = paint(name, scene, found)
    with atomic(path) as stream:
        figure.savefig(stream, format=path.suffix.lower()[1:], dpi=DOTS_PER_INCH)


def paint(name: str, scene: Scene, found: Occupancy) -> Any:
    """The matplotlib figure: for each horizon the map, the boxes now, the probability, and the truth if known."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    low, high = view(found)
    count = len(found.horizons)
    across = min(count, MOST_ACROSS)
    down = math.ceil(count / across)
    width, height = SIDE * (high - low) / (high - low).max()
    full = (
        max(across * (width + EDGE) + EDGE, 6.5),
        down * (height + TITLE) + (down - 1) * EDGE + HEAD + FOOT,
    )
    figure = Figure(figsize=full, facecolor="white")
    FigureCanvasAgg(figure)
    indent = (full[0] - across * (width + EDGE) + EDGE) / 2
    marks: list[Any] = []
    for t in range(count):
        left = indent + (t % across) * (width + EDGE)
        bottom = full[1] - HEAD - (t // across) * (height + TITLE + EDGE) - height - TITLE
        place = (left / full[0], bottom / full[1], width / full[0], height / full[1])
        axes: Any = figure.add_axes(place, aspect="equal", facecolor="white")
        marks = _panel(axes, scene, found, t, low, high)
    figure.suptitle(
        f"{name}: how likely somebody is there",
        x=EDGE / full[0],
        y=1 - 0.1 / full[1],
        ha="left",
        va="top",
        fontsize=12,
        parse_math=False,
    )
    figure.legend(
        handles=marks,
        loc="lower left",
        bbox_to_anchor=(EDGE / full[0], 0.0),
        ncols=2,
        frameon=False,
        fontsize=7,
    )
    _scale(figure, full)
    return figure


def view(found: Occupancy) -> tuple[Float64, Float64]:
    """Lower-left and upper-right corner (m) of what is occupied at any horizon; never beyond the grid."""
    rows, columns = np.nonzero(found.probability.max(axis=0) > SEEN)
    height, width = found.probability.shape[1:]
    if not len(rows):
        rows, columns = np.array([0, height - 1]), np.array([0, width - 1])
    low = found.origin + found.resolution * np.array([columns.min(), rows.min()]) - MARGIN
    high = found.origin + found.resolution * np.array([columns.max() + 1, rows.max() + 1]) + MARGIN
    middle, size = (low + high) / 2, np.maximum(high - low, NARROWEST)
    size = np.maximum(size, size.max() / 2)
    end = found.origin + found.resolution * np.array([width, height])
    return np.maximum(middle - size / 2, found.origin), np.minimum(middle + size / 2, end)


def _panel(axes: Any, scene: Scene, found: Occupancy, t: int, low: Float64, high: Float64) -> list[Any]:
    """One horizon. Returns handles for the legend."""
    from matplotlib.patches import Patch

    picture_scenery.ground(axes, scene)
    _boxes(axes, scene, found)
    _heat(axes, found, t)
    _futures(axes, scene, found, float(found.horizons[t]))
    picture_scenery.scale_bar(axes, low, high)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xticks=[], yticks=[])
    axes.set_title(f"in {found.horizons[t]:g} s", fontsize=10, loc="left", pad=3)
    marks: list[Any] = [
        Patch(facecolor="none", edgecolor=picture_scenery.FORECAST, label="forecast, where it is now")
    ]
    if len(found.present):
        marks.append(Patch(facecolor="none", edgecolor=picture_scenery.OTHER, label="no forecast: taken to stay"))
    if scene.future is not None:
        from matplotlib.lines import Line2D

        marker = Line2D([], [], linestyle="", marker="D", markersize=4, markeredgecolor="black")
        marker.set(markerfacecolor="white", label="where a centre truly was then")
        marks.append(marker)
    return marks


def _heat(axes: Any, found: Occupancy, t: int) -> None:
    probability = found.probability[t].astype(np.float64)
    height, width = probability.shape
    x, y = found.origin
    extent = (x, x + width * found.resolution, y, y + height * found.resolution)
    axes.imshow(_tinted(probability), extent=extent, origin="lower", interpolation="nearest", zorder=4)


def _tinted(probability: Float64) -> Float64:
    """Colours [..., 4] of probabilities [...], by their logarithm; nothing below SEEN or where unknown."""
    import matplotlib

    p = np.nan_to_num(probability)
    place = np.clip(1.0 - np.log(np.maximum(p, SEEN)) / math.log(SEEN), 0.0, 1.0)
    tint = np.asarray(matplotlib.colormaps["YlOrRd"](0.15 + 0.85 * place))
    tint[..., 3] = np.where(p > SEEN, 0.35 + 0.6 * place, 0.0)
    return tint


def _boxes(axes: Any, scene: Scene, found: Occupancy) -> None:
    """Everybody's box now, with a line from the middle to the front."""
    for agents, colour in ((found.present, picture_scenery.OTHER), (found.forecast, picture_scenery.FORECAST)):
        for i in agents:
            length, width = scene.size[i] / 2
            corners = np.array([[length, width], [length, -width], [-length, -width], [-length, width]])
            box, nose = (
                _placed(corners, scene.past[i, -1]),
                _placed(np.array([[0, 0], [length, 0]]), scene.past[i, -1]),
            )
            axes.fill(*box.T, facecolor="none", edgecolor=colour, linewidth=0.9, zorder=6)
            axes.plot(*nose.T, color=colour, linewidth=0.9, zorder=6)


def _placed(points: Float64, state: npt.NDArray[np.float32]) -> Float64:
    x, y, s, c = state[:4].astype(np.float64)
    return np.asarray(points @ np.array([[c, s], [-s, c]]) / math.hypot(s, c) + [x, y])


def _futures(axes: Any, scene: Scene, found: Occupancy, horizon: float) -> None:
    for agent in found.forecast:
        x, y = picture_scenery.true_position(scene, int(agent), horizon)
        style = {"color": "white", "markeredgecolor": "black", "markeredgewidth": 0.8}
        axes.plot(x, y, marker="D", markersize=3.5, zorder=7, **style)


def _scale(figure: Any, full: tuple[float, float]) -> None:
    """The colours and what they mean, below the panels on the right."""
    length = min(2.6, full[0] / 2.4)
    axes = figure.add_axes((1 - (length + 2 * EDGE) / full[0], 0.22 / full[1], length / full[0], 0.14 / full[1]))
    values = np.geomspace(SEEN * 1.0001, 1.0, 256)[None]
    axes.imshow(_tinted(values), extent=(math.log10(SEEN), 0, 0, 1), aspect="auto")
    axes.set_xticks([math.log10(v) for v in TICKS], [f"{v:.0%}" for v in TICKS], fontsize=7)
    axes.set(yticks=[])
    axes.set_title("probability that a cell's centre is covered", fontsize=7, pad=3)
