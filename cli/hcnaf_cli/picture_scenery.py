"""What a forecast is drawn on: the map or the lidar, everyone's box and history, and the truth if it is known."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from hcnaf_runtime import Scene

Float64 = npt.NDArray[np.float64]

ROAD, JUNCTION, STOP = "#e4e4e4", "#d3d7de", "#b3261e"
LIDAR = "#8a8a8a"
FORECAST, OTHER = "#1b2a41", "#a9adb3"


def ground(axes: Any, scene: Scene) -> list[Any]:
    """The map's channels, or the lidar's where there is no map. Returns handles for the legend."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    if "drivable" not in scene.channels:
        returns = [name for name in scene.channels if name.startswith("lidar")]
        for name in returns:
            _tint(axes, scene, name, LIDAR, 0.35)
        dot = Line2D([], [], linestyle="", marker="s", markersize=4, color=LIDAR, label="lidar returns")
        return [dot] if returns else []
    handles: list[Any] = []
    for name, colour, label in (("drivable", ROAD, "road"), ("junction", JUNCTION, "junction")):
        if _tint(axes, scene, name, colour, 1.0):
            handles.append(Patch(facecolor=colour, edgecolor="0.75", label=label))
    if _tint(axes, scene, "stop_line", STOP, 0.8) or _stops(axes, scene):
        handles.append(Line2D([], [], color=STOP, linewidth=2, label="stop line"))
    return handles


def _tint(axes: Any, scene: Scene, name: str, colour: str, strength: float) -> bool:
    """Paint a channel; True if there was anything to paint."""
    from matplotlib.colors import to_rgb

    if name not in scene.channels:
        return False
    value = np.clip(scene.raster[scene.channels.index(name)] / 127.0, 0.0, 1.0)
    rows, columns = value.shape
    tint = np.empty((rows, columns, 4))
    tint[..., :3] = to_rgb(colour)
    tint[..., 3] = strength * value
    x, y = scene.origin
    box = (x, x + columns * scene.resolution, y, y + rows * scene.resolution)
    axes.imshow(tint, extent=box, origin="lower", interpolation="bilinear", zorder=1)
    return bool(value.any())


def _stops(axes: Any, scene: Scene) -> bool:
    """Stop lines as bars across a lane's width, for scenes without a raster of them."""
    for x, y, yaw in scene.stops:
        across = 1.6 * np.array([-np.sin(yaw), np.cos(yaw)])
        ends = np.array([x, y]) + np.outer([-1.0, 1.0], across)
        axes.plot(*ends.T, color=STOP, linewidth=2, zorder=2)
    return bool(len(scene.stops))


def agents(axes: Any, scene: Scene, low: Float64, high: Float64) -> list[Any]:
    """Boxes with their headings and dotted histories that fade into the past. Returns handles for the legend."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    seen = np.isfinite(scene.past[:, -1, 0])
    inside = ((scene.past[:, -1, :2] > low) & (scene.past[:, -1, :2] < high)).all(axis=1)
    forecast = np.isin(np.arange(len(scene.past)), scene.target)
    for i in np.flatnonzero(seen & inside):
        _box(axes, scene.past[i, -1], scene.size[i], forecast[i])
        _history(axes, scene.past[i], FORECAST if forecast[i] else OTHER, 3.8 if forecast[i] else 3.0)
    span = (scene.past.shape[1] - 1) * scene.step
    handles: list[Any] = [
        Patch(facecolor="white", edgecolor=FORECAST, linewidth=1.6, label="forecast, with its number"),
        Line2D([], [], linestyle="", marker=".", markersize=4, color=FORECAST, label=f"its last {span:.1f} s"),
    ]
    if (seen & inside & ~forecast).any():
        handles.append(Patch(facecolor=OTHER, edgecolor="0.4", label="others"))
    return handles


def _history(axes: Any, past: npt.NDArray[np.float32], colour: str, zorder: float) -> None:
    from matplotlib.colors import to_rgb

    fade = np.empty((len(past), 4))
    fade[:, :3] = to_rgb(colour)
    fade[:, 3] = np.linspace(0.25, 1.0, len(past))
    axes.scatter(past[:, 0], past[:, 1], s=5, c=fade, linewidths=0, zorder=zorder)


def _box(axes: Any, state: npt.NDArray[np.float32], size: npt.NDArray[np.float32], forecast: bool) -> None:
    """The box, and a wedge that points forward; hollow if it is forecast, so that no map is hidden."""
    half_length, half_width = size.astype(np.float64) / 2
    corners = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * (half_length, half_width)
    wedge = np.array([[0.9, 0.0], [0.25, 0.75], [0.25, -0.75]]) * (half_length, half_width)
    box, tip = _placed(corners, state), _placed(wedge, state)
    if not forecast:
        axes.fill(*box.T, facecolor=OTHER, edgecolor="0.4", linewidth=0.8, zorder=3.5)
        axes.fill(*tip.T, facecolor="white", linewidth=0, zorder=3.6)
        return
    axes.fill(*box.T, facecolor="white", linewidth=0, zorder=3.7)
    axes.fill(*box.T, facecolor="none", edgecolor=FORECAST, linewidth=1.6, zorder=6)
    axes.fill(*tip.T, facecolor=FORECAST, linewidth=0, zorder=6)


def _placed(points: Float64, state: npt.NDArray[np.float32]) -> Float64:
    x, y, sin, cos = state[:4].astype(np.float64) / np.array([1, 1, *[np.hypot(*state[2:4])] * 2])
    return np.asarray(points @ np.array([[cos, sin], [-sin, cos]]) + np.array([x, y]))


def true_path(scene: Scene, agent: int, horizon: float) -> Float64:
    """[F', 2]: the agent's true positions (m) up to `horizon` seconds ahead; empty if they are not known."""
    if scene.future is None:
        return np.empty((0, 2))
    rows = int(np.floor(horizon / scene.step + 1e-3))
    return scene.future[agent, :rows].astype(np.float64)


def true_position(scene: Scene, agent: int, horizon: float) -> Float64:
    """[2]: where the agent truly was `horizon` seconds ahead, between two rows if need be; NaN if not known."""
    future = np.empty((0, 2)) if scene.future is None else scene.future[agent].astype(np.float64)
    path = np.concatenate([scene.past[agent, -1:, :2].astype(np.float64), future])
    place = round(horizon / scene.step, 3)
    before = int(place)
    if before >= len(path) or (before + 1 >= len(path) and place > before):
        return np.full(2, np.nan)
    share = place - before
    after = path[before + 1] if share > 0 else path[before]
    return np.asarray((1.0 - share) * path[before] + share * after)


def truth(
    axes: Any,
    scene: Scene,
    forecast: npt.NDArray[np.int64],
    horizons: npt.NDArray[np.float32],
    hues: Sequence[Any],
) -> list[Any]:
    """The true paths up to the last horizon, marked at each horizon. Returns handles for the legend."""
    from matplotlib.lines import Line2D

    if scene.future is None:
        return []
    for agent in forecast:
        path = true_path(scene, int(agent), float(horizons.max()))
        axes.plot(*path.T, color="black", alpha=0.6, linewidth=0.7, zorder=5.5)
        for horizon, hue in zip(horizons, hues, strict=True):
            x, y = true_position(scene, int(agent), float(horizon))
            axes.plot(
                x, y, marker="D", markersize=4, color=hue, markeredgecolor="black", markeredgewidth=0.8, zorder=7
            )
    line = Line2D([], [], color="black", linewidth=0.7, marker="D", markersize=4, markerfacecolor="white")
    line.set_label("where it truly went, and was then")
    return [line]


def labels(axes: Any, scene: Scene, forecast: npt.NDArray[np.int64]) -> None:
    """The number of each forecast agent, in the rear of its box."""
    from matplotlib.patheffects import withStroke

    for agent in forecast:
        state, length = scene.past[agent, -1], float(scene.size[agent, 0])
        axes.annotate(
            str(agent),
            _placed(np.array([[-0.27 * length, 0.0]]), state)[0],
            ha="center",
            va="center",
            fontsize=8,
            fontweight="bold",
            color=FORECAST,
            path_effects=[withStroke(linewidth=2.0, foreground="white")],
            zorder=8,
        )


def scale_bar(axes: Any, low: Float64, high: Float64) -> None:
    """A bar of a round length, about a sixth of the view's width, in the lower left corner."""
    from matplotlib.patheffects import withStroke

    wanted = float(high[0] - low[0]) / 6
    length = max((n for n in (1, 2, 5, 10, 20, 50, 100, 200, 500) if n <= wanted), default=1)
    x, y = low + 0.03 * (high - low).max()
    halo = [withStroke(linewidth=5, foreground="white")]
    axes.plot([x, x + length], [y, y], color="black", linewidth=2.5, path_effects=halo, zorder=9)
    axes.annotate(
        f"{length} m",
        (x + length / 2, y),
        xytext=(0, 5),
        textcoords="offset points",
        ha="center",
        fontsize=9,
        path_effects=[withStroke(linewidth=3, foreground="white")],
        zorder=9,
    )
