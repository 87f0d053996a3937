"""The picture of a forecast: one view of the scene from above, with every map laid over it (extra `plot`).

The figure is made without pyplot, so that nothing global changes.
"""

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hcnaf_cli import picture_maps, picture_scenery
from hcnaf_runtime import KINDS, Maps, Scene
from hcnaf_runtime.errors import InputError, MissingExtraError
from hcnaf_runtime.npz import atomic

Float64 = npt.NDArray[np.float64]

FORMATS = (".png", ".pdf", ".svg")
DOTS_PER_INCH = 150
LONG_SIDE, PANEL, EDGE, HEAD = 8.0, 3.1, 0.15, 0.5
"""Inches: the longer side of the view, the column beside it, the margin, and the title's height."""

MOST_LINES = 14
"""Agents named one by one in the caption."""

_HUES = ("#0072b2", "#009e73", "#e69f00", "#d55e00", "#a4348f")


def check_picture(path: Path) -> None:
    """Refuse what cannot be drawn before anything is computed.

    Raises InputError for a format other than FORMATS, MissingExtraError without matplotlib.
    """
    if path.suffix.lower() not in FORMATS:
        raise InputError(f"{path}: pictures end with {', '.join(FORMATS)}; name it so")
    if importlib.util.find_spec("matplotlib") is None:
        raise MissingExtraError('pictures need matplotlib, which is not installed; run: pip install "hcnaf[plot]"')


def draw(path: Path, name: str, scene: Scene, maps: Maps) -> None:
    """Draw `maps` over `scene` into the file at `path`; either all of it appears or nothing does."""
    figure = paint(name, scene, maps)
    with atomic(path) as stream:
        figure.savefig(stream, format=path.suffix.lower()[1:], dpi=DOTS_PER_INCH)


def paint(name: str, scene: Scene, maps: Maps) -> Any:
    """The matplotlib figure: map, histories, boxes, one hue of heat per horizon, truth, legend, scale, caption."""
    hues = horizon_hues(len(maps.horizons))
    low, high = view(scene, maps)
    figure, axes, panel = _layout(high - low)
    marks = picture_scenery.ground(axes, scene)
    marks += picture_scenery.agents(axes, scene, low, high)
    # Far horizons first: they are the widest, and would hide the near ones.
    for t in reversed(range(len(maps.horizons))):
        for a in range(len(maps.agents)):
            picture_maps.heat(axes, maps, a, t, hues[t])
    marks += picture_scenery.truth(axes, scene, maps.agents, maps.horizons, hues)
    picture_scenery.labels(axes, scene, maps.agents)
    picture_scenery.scale_bar(axes, low, high)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xticks=[], yticks=[])
    figure.suptitle(
        title(name, scene, maps), x=EDGE / figure.get_figwidth(), ha="left", fontsize=13, parse_math=False
    )
    _panel(panel, picture_maps.legend(maps.horizons, hues) + marks, caption(maps))
    return figure


def horizon_hues(count: int) -> list[Any]:
    """A colour per horizon."""
    if count <= len(_HUES):
        return list(_HUES[:count])
    import matplotlib

    return list(matplotlib.colormaps["turbo"](np.linspace(0.08, 0.92, count)))


def view(scene: Scene, maps: Maps) -> tuple[Float64, Float64]:
    """Lower-left and upper-right corner (m, scene frame): the forecast agents, where they were and may be."""
    parts: list[npt.NDArray[Any]] = [maps.pose[:, :2], scene.past[maps.agents, :, :2].reshape(-1, 2)]
    parts += [picture_maps.extent(maps, a, t) for a in range(len(maps.agents)) for t in range(len(maps.horizons))]
    parts += [picture_scenery.true_path(scene, int(a), float(maps.horizons.max())) for a in maps.agents]
    points = np.concatenate(parts, dtype=np.float64)
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    size = high - low
    # Never a keyhole, never a ribbon: at least 40 m wide, at most twice as long as wide.
    wanted = np.maximum(size + 10.0 + 0.06 * size.max(), 40.0)
    wanted = np.maximum(wanted, wanted.max() / 2.0)
    middle = (low + high) / 2
    return middle - wanted / 2, middle + wanted / 2


def title(name: str, scene: Scene, maps: Maps) -> str:
    """Such as: crossing: where 3 vehicles may be in 1, 2 and 4 s."""
    count = len(maps.agents)
    who = "vehicle" if (scene.kind[maps.agents] == KINDS.index("vehicle")).all() else "road user"
    times = [f"{t:g}" for t in maps.horizons]
    if len(times) > 6:
        times = [f"{times[0]} to {times[-1]}"]
    when = " and ".join([", ".join(times[:-1]), times[-1]]) if len(times) > 1 else times[0]
    return f"{name}: where {count} {who}{'s' if count > 1 else ''} may be in {when} s"


def caption(maps: Maps) -> str:
    """The window mass of every agent and horizon, in columns."""
    times = [f"{t:g} s" for t in maps.horizons]
    if len(times) > 6:
        return f"Probability inside the maps:\nat least {maps.window_mass.min():.4f}"
    lines = ["Probability inside the maps", "agent " + "".join(f"{t:>8}" for t in times)]
    for agent, masses in list(zip(maps.agents, maps.window_mass, strict=True))[:MOST_LINES]:
        lines.append(f"{agent:>5} " + "".join(f"{m:8.4f}" for m in masses))
    rest = maps.window_mass[MOST_LINES:]
    if len(rest):
        lines.append(f"and {len(rest)} more, at least {rest.min():.4f}")
    return "\n".join(lines)


def _layout(size: Float64) -> tuple[Any, Any, Any]:
    """A figure that fits a view of `size` metres, its axes, and the column beside it."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    width, height = LONG_SIDE * size / size.max()
    full_width = width + PANEL + 3 * EDGE
    full_height = max(height, 5.0) + HEAD + EDGE
    figure = Figure(figsize=(full_width, full_height), facecolor="white")
    FigureCanvasAgg(figure)
    inside = (EDGE / full_width, 1 - (HEAD + height) / full_height, width / full_width, height / full_height)
    axes: Any = figure.add_axes(inside, aspect="equal", facecolor="white")
    beside = ((width + 2 * EDGE) / full_width, 0.0, PANEL / full_width, 1 - HEAD / full_height)
    panel: Any = figure.add_axes(beside)
    panel.axis("off")
    return figure, axes, panel


def _panel(panel: Any, handles: Sequence[Any], text: str) -> None:
    panel.legend(
        handles=handles,
        loc="upper left",
        bbox_to_anchor=(0, 1),
        frameon=False,
        fontsize=9,
        borderaxespad=0,
        title="The darker, the likelier",
        title_fontsize=9,
        alignment="left",
    )
    panel.text(0.0, 0.02, text, fontsize=7, family="monospace", va="bottom", parse_math=False)
