"""The picture of samples: the scene from above with a dot per sample, or a line per path (extra `plot`)."""

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hcnaf_cli import picture_scenery
from hcnaf_cli.picture import DOTS_PER_INCH, EDGE, HEAD, horizon_hues
from hcnaf_runtime import Scene, frames
from hcnaf_runtime.npz import atomic
from hcnaf_runtime.samples import Samples

Float64 = npt.NDArray[np.float64]

SIDE, FOOT = 8.0, 0.35
"""Inches: the longer side of the view, and the legend below."""

SHOWN = 0.98
"""Share of the coordinates that the view holds."""

MARGIN, NARROWEST = 6.0, 40.0
MOST_PATHS = 300
"""Paths and samples drawn of each agent."""


def draw(path: Path, name: str, scene: Scene, made: Samples) -> None:
    """Draw samples over `scene` into the file at `path`; either all of it appears or nothing does."""
    figure = paint(name, scene, made)
    with atomic(path) as stream:
        figure.savefig(stream, format=path.suffix.lower()[1:], dpi=DOTS_PER_INCH)


def paint(name: str, scene: Scene, made: Samples) -> Any:
    """The matplotlib figure: map, histories, boxes, a hue per horizon, the truth where it is known."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    places = in_scene(made)
    low, high = view(scene, made, places)
    width, height = SIDE * (high - low) / (high - low).max()
    full = width + 2 * EDGE, height + HEAD + FOOT
    figure = Figure(figsize=full, facecolor="white")
    FigureCanvasAgg(figure)
    place = (EDGE / full[0], FOOT / full[1], width / full[0], height / full[1])
    axes: Any = figure.add_axes(place, aspect="equal", facecolor="white")
    hues = horizon_hues(len(made.horizons))
    picture_scenery.ground(axes, scene)
    picture_scenery.agents(axes, scene, low, high)
    if made.coupled:
        _paths(axes, made, places)
    _dots(axes, places, hues)
    picture_scenery.truth(axes, scene, made.agents, made.horizons, hues)
    picture_scenery.labels(axes, scene, made.agents)
    picture_scenery.scale_bar(axes, low, high)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xticks=[], yticks=[])
    figure.suptitle(title(name, made), x=EDGE / full[0], ha="left", fontsize=12, parse_math=False)
    _legend(figure, made, hues)
    return figure


def in_scene(made: Samples) -> Float64:
    """[A, T, at most MOST_PATHS, 2]: points in the scene frame (m)."""
    some = made.points[:, :, :MOST_PATHS]
    if made.frame == "scene":
        return some
    return np.stack([frames.to_scene(p, pose) for p, pose in zip(some, made.pose, strict=True)])


def view(scene: Scene, made: Samples, places: Float64) -> tuple[Float64, Float64]:
    """Lower-left and upper-right corner (m): the forecast agents and nearly all that was drawn of them."""
    edges = (1.0 - SHOWN) / 2.0, (1.0 + SHOWN) / 2.0
    far = np.quantile(places.reshape(*places.shape[:2], -1, 2), edges, axis=2).reshape(-1, 2)
    past = scene.past[made.agents, :, :2].reshape(-1, 2).astype(np.float64)
    points = np.concatenate([far, made.pose[:, :2], past])
    low, high = np.nanmin(points, axis=0) - MARGIN, np.nanmax(points, axis=0) + MARGIN
    middle, size = (low + high) / 2, np.maximum(high - low, NARROWEST)
    size = np.maximum(size, size.max() / 2)
    return middle - size / 2, middle + size / 2


def title(name: str, made: Samples) -> str:
    """Such as: crossing: 100 paths of each of 3 agents, up to 4 s ahead."""
    A, _, n = made.log_prob.shape
    what = "paths" if made.coupled else "samples"
    who = "of one agent" if A == 1 else f"of each of {A} agents"
    shown = f" ({MOST_PATHS} shown)" if n > MOST_PATHS else ""
    return f"{name}: {n} {what} {who}, up to {made.horizons.max():g} s ahead{shown}"


def _paths(axes: Any, made: Samples, places: Float64) -> None:
    """A line from each agent now through its sample at every horizon, in order of time."""
    from matplotlib.collections import LineCollection

    order = np.argsort(made.horizons, kind="stable")
    for a in range(len(places)):
        now = np.broadcast_to(made.pose[a, :2], (1, places.shape[2], 2))
        lines = np.concatenate([now, places[a, order]]).transpose(1, 0, 2)
        faint = max(0.06, min(0.5, 20.0 / len(lines)))
        axes.add_collection(LineCollection(list(lines), colors="0.25", linewidths=0.6, alpha=faint, zorder=4.5))


def _dots(axes: Any, places: Float64, hues: list[Any]) -> None:
    """Far horizons first: the near ones lie closer together."""
    for t in reversed(range(places.shape[1])):
        x, y = places[:, t].reshape(-1, 2).T
        axes.scatter(x, y, s=5, color=[hues[t]], alpha=0.55, linewidths=0, zorder=5)


def _legend(figure: Any, made: Samples, hues: list[Any]) -> None:
    from matplotlib.lines import Line2D

    shown = range(len(hues)) if len(hues) <= 8 else sorted({0, len(hues) // 2, len(hues) - 1})
    handles = [
        Line2D([], [], linestyle="", marker="o", markersize=5, color=hues[t], label=f"{made.horizons[t]:g} s")
        for t in shown
    ]
    figure.legend(
        handles=handles,
        loc="lower left",
        ncols=len(handles),
        frameon=False,
        fontsize=8,
        columnspacing=1.2,
        handletextpad=0.1,
    )
