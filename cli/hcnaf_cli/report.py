"""What a forecast, densities and a bundle look like as JSON and as text."""

from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from hcnaf_cli.output import table
from hcnaf_runtime import Bundle, Maps, Theta, VerifyRow

FRAMES = {"agent": "x forward and y left of each agent", "scene": "x and y of the scene"}


def forecast_json(scene: str, bundle: Bundle, maps: Maps) -> dict[str, Any]:
    """Per agent and horizon the window mass and the most probable cell; and the time spent."""
    _, _, rows, columns = maps.mass.shape
    return {
        "scene": scene,
        "model": bundle.manifest.name,
        "frame": maps.frame,
        "grid": {
            "columns": columns,
            "rows": rows,
            "resolution": maps.resolution,
            "origin": [float(v) for v in maps.origin],
        },
        "agents": [_agent_json(maps, a) for a in range(len(maps.agents))],
        "seconds": {"hypernet": maps.timings.hypernet, "maps": maps.timings.maps},
        "notes": list(maps.notes),
    }


def _agent_json(maps: Maps, a: int) -> dict[str, Any]:
    horizons = []
    for t, horizon in enumerate(maps.horizons):
        x, y, mass = maps.peak(a, t)
        window = float(maps.window_mass[a, t])
        peak = {"x": x, "y": y, "mass": mass}
        horizons.append({"horizon": _short(horizon), "window_mass": window, "peak": peak})
    pose = [float(v) for v in maps.pose[a]]
    return {"agent": int(maps.agents[a]), "pose": pose, "horizons": horizons}


def forecast_text(scene: str, maps: Maps) -> str:
    """A heading and a table."""
    A, T, rows, columns = maps.mass.shape
    cells = []
    for a in range(A):
        for t in range(T):
            x, y, mass = maps.peak(a, t)
            agent = str(maps.agents[a]) if t == 0 else ""
            window = f"{maps.window_mass[a, t]:.4f}"
            cells.append([agent, f"{maps.horizons[t]:g} s", window, f"{x:+.2f}", f"{y:+.2f}", f"{mass:.4f}"])
    head = ["agent", "ahead", "in window", "likeliest x", "y (m)", "its cell"]
    grid = f"{columns}x{rows} cells of {maps.resolution:g} m"
    return f"{scene}: {grid}, {FRAMES[maps.frame]}\n{table(head, cells)}"


def log_prob_json(frame: str, theta: Theta, values: npt.NDArray[np.float32]) -> dict[str, Any]:
    """Log-densities per agent and horizon, in the points' order."""
    agents = [
        {
            "agent": int(agent),
            "horizons": [
                {"horizon": _short(theta.horizons[t]), "log_prob": [float(v) for v in values[a, t]]}
                for t in range(len(theta.horizons))
            ],
        }
        for a, agent in enumerate(theta.agents)
    ]
    return {"frame": frame, "unit": "nats per square metre", "agents": agents}


def log_prob_text(theta: Theta, points: npt.NDArray[np.float64], values: npt.NDArray[np.float32]) -> str:
    """CSV: one line per agent, horizon and point."""
    A, T, N = values.shape
    spread = points[:, None] if points.ndim == 3 else points
    places = np.broadcast_to(spread, (A, T, N, points.shape[-1]))
    lines = ["agent,horizon,x,y,log_prob"]
    for a, t, n in np.ndindex(A, T, N):
        x, y = places[a, t, n]
        lines.append(f"{theta.agents[a]},{theta.horizons[t]:g},{x:g},{y:g},{values[a, t, n]:.6g}")
    return "\n".join(lines)


def info_json(bundle: Bundle) -> dict[str, Any]:
    """The whole manifest, and where it was found."""
    plain: dict[str, Any] = msgspec.to_builtins(bundle.manifest)
    return {"path": str(bundle.path)} | plain


def info_text(bundle: Bundle) -> str:
    """What the bundle is, needs and was found to be worth."""
    m = bundle.manifest
    size = sum(f.bytes for f in m.files.values()) / 1e6
    lines = [
        f"{m.name}: {m.kind} bundle of format {m.format}, made by hcnaf {m.version} on {m.created}",
        f"  place     {bundle.path} ({size:.1f} MB)",
        f"  flow      D = {m.flow.dims}, L = {m.flow.layers}, H = {m.flow.hidden}, {m.flow.support}, "
        f"{m.flow.parameters} weights per map",
        f"  graphs    {', '.join(m.graphs)} (opset {m.opset}, onnxruntime {m.onnxruntime_min} or later)",
    ]
    if m.horizons is not None:
        lines.append(f"  horizons  above {m.horizons.min:g} s, up to {m.horizons.max:g} s")
    if m.scene is not None:
        lines.append(f"  history   {m.scene.history} rows, {m.scene.step:g} s apart")
        marks = [c + ("?" if c in m.scene.optional_channels else "") for c in m.scene.channels]
        lines.append(f"  raster    {', '.join(marks) or 'none'}{' (? optional)' if '?' in ''.join(marks) else ''}")
    if m.condition is not None:
        lines.append(f"  condition {', '.join(m.condition.names)}")
    for title, facts in (("training", m.training), ("scores", m.scores)):
        lines += [f"  {title}", *(f"    {line}" for line in _facts(facts))] if facts else []
    return "\n".join(lines)


def _facts(facts: dict[str, Any], prefix: str = "") -> list[str]:
    lines = []
    for name, value in facts.items():
        if isinstance(value, dict):
            lines += _facts(value, f"{prefix}{name}.")
        else:
            shown = f"{value:.4g}" if isinstance(value, float) else str(value)
            lines.append(f"{prefix}{name} = {' '.join(shown.split())}")
    return lines


def verify_json(bundle: Bundle, rows: list[VerifyRow]) -> dict[str, Any]:
    """Every row, and whether all passed."""
    plain = [msgspec.to_builtins(row) | {"passed": row.passed} for row in rows]
    return {"path": str(bundle.path), "passed": all(row.passed for row in rows), "outputs": plain}


def verify_text(rows: list[VerifyRow]) -> str:
    """A table with a line per output."""
    head = ["graph ", "output ", "largest difference", "in units of max(1, |value|)", "tolerance", "verdict "]
    return table(
        head,
        [
            [r.graph, r.output, f"{r.max_abs:.2e}", f"{r.max_error:.2e}", f"{r.tolerance:.0e}", _word(r.passed)]
            for r in rows
        ],
    )


def _word(passed: bool) -> str:
    return "passed" if passed else "FAILED"


def _short(value: Any) -> float:
    """A float32 number as the short decimal it was written as."""
    return float(str(np.float32(value)))
