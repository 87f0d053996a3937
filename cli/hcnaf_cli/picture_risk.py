"""The picture of a risk: the scene from above, and the own way in the colour of its risk (extra `plot`)."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hcnaf_cli import picture_scenery
from hcnaf_cli.picture import DOTS_PER_INCH
from hcnaf_runtime import Scene
from hcnaf_runtime.npz import atomic
from hcnaf_runtime.regions import rectangle_corners
from hcnaf_runtime.risk import Risk

Float64 = npt.NDArray[np.float64]

SIDE, EDGE, HEAD, FOOT = 7.0, 0.15, 0.45, 0.6
"""Inches: the longer side of the view, margins, the title, and the scale below."""

LEAST = 1e-6
"""Below this risk all is the same colour; that and more are on one logarithmic scale up to 1."""

MARGIN, NARROWEST = 8.0, 40.0
MOST_BOXES = 400
"""Own boxes drawn, one for each time; of more trajectories only the lines."""

_TICKS = (1e-6, 1e-4, 1e-2, 1.0)


def draw(path: Path, name: str, scene: Scene, poses: Float64, size: tuple[float, float], found: Risk) -> None:
    """Draw the risk of `poses` [K, T, 3] into the file at `path`; either all of it appears or nothing does."""
    figure = paint(name, scene, poses, size, found)
    with atomic(path) as stream:
        figure.savefig(stream, format=path.suffix.lower()[1:], dpi=DOTS_PER_INCH)


def paint(name: str, scene: Scene, poses: Float64, size: tuple[float, float], found: Risk) -> Any:
    """The matplotlib figure: map, agents, the own boxes and way in the colour of the risk, a scale, a caption."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    low, high = view(scene, poses, found)
    width, height = SIDE * (high - low) / (high - low).max()
    full = max(width, 5.0) + 2 * EDGE, height + HEAD + FOOT
    figure = Figure(figsize=full, facecolor="white")
    FigureCanvasAgg(figure)
    place = ((full[0] - width) / 2 / full[0], FOOT / full[1], width / full[0], height / full[1])
    axes: Any = figure.add_axes(place, aspect="equal", facecolor="white")
    picture_scenery.ground(axes, scene)
    picture_scenery.agents(axes, scene, low, high)
    picture_scenery.labels(axes, scene, found.agents[found.forecast])
    _ways(axes, poses, size, found)
    picture_scenery.scale_bar(axes, low, high)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xticks=[], yticks=[])
    figure.suptitle(f"{name}: {caption(found)}", x=EDGE / full[0], ha="left", fontsize=11, parse_math=False)
    _scale(figure, full)
    return figure


def caption(found: Risk) -> str:
    """The bounds, of the least risky trajectory if there are several."""
    k = int(found.upper.argmin())
    which = (
        "risk of a collision" if len(found.upper) == 1 else f"least risk of {len(found.upper)}, trajectory {k},"
    )
    return f"{which} at least {found.lower[k]:.2g}, at most {found.upper[k]:.2g}"


def view(scene: Scene, poses: Float64, found: Risk) -> tuple[Float64, Float64]:
    """Lower-left and upper-right corner (m): the ways and the agents that are forecast."""
    agents = scene.past[found.agents[found.forecast], -1, :2].astype(np.float64)
    points = np.concatenate([poses[..., :2].reshape(-1, 2), agents])
    low, high = points.min(axis=0) - MARGIN, points.max(axis=0) + MARGIN
    middle, size = (low + high) / 2, np.maximum(high - low, NARROWEST)
    size = np.maximum(size, size.max() / 2)
    return middle - size / 2, middle + size / 2


def colours(p: Float64) -> Float64:
    """[..., 4] of probabilities [...], by their logarithm."""
    import matplotlib

    place = np.clip(1.0 - np.log(np.maximum(p, LEAST)) / math.log(LEAST), 0.0, 1.0)
    return np.asarray(matplotlib.colormaps["plasma"](0.95 * place))


def _ways(axes: Any, poses: Float64, size: tuple[float, float], found: Risk) -> None:
    """Own boxes at each time, and lines between their centres; the risky on top."""
    from matplotlib.collections import LineCollection, PolyCollection

    tints = colours(found.per_step)
    order = np.argsort(found.upper, kind="stable")
    if poses.shape[1] > 1:
        lines = np.stack([poses[order, :-1, :2], poses[order, 1:, :2]], axis=-2).reshape(-1, 2, 2)
        ahead = tints[order, 1:].reshape(-1, 4)
        axes.add_collection(LineCollection(list(lines), colors=ahead, linewidths=1.6, zorder=7))
    if poses.shape[0] * poses.shape[1] <= MOST_BOXES:
        flat = poses[order].reshape(-1, 3)
        boxes = rectangle_corners(np.column_stack([flat, np.tile(size, (len(flat), 1))]))
        edges = tints[order].reshape(-1, 4)
        fill = edges * [1.0, 1.0, 1.0, 0.25]
        axes.add_collection(
            PolyCollection(list(boxes), facecolors=fill, edgecolors=edges, linewidths=1.0, zorder=6.5)
        )


def _scale(figure: Any, full: tuple[float, float]) -> None:
    length = min(2.6, full[0] / 2)
    axes = figure.add_axes((1 - (length + 2 * EDGE) / full[0], 0.22 / full[1], length / full[0], 0.14 / full[1]))
    values = np.geomspace(LEAST, 1.0, 256)[None]
    axes.imshow(colours(values), extent=(math.log10(LEAST), 0, 0, 1), aspect="auto")
    axes.set_xticks([math.log10(v) for v in _TICKS], [f"{v:g}" for v in _TICKS], fontsize=7)
    axes.set(yticks=[])
    axes.set_title("probability of a collision at that time", fontsize=7, pad=3)
