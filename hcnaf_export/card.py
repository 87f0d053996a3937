"""The model card: README.md of a bundle, written for the person who must decide whether to use it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from hcnaf_runtime.manifest import Manifest, ParityRow

FILE = "README.md"

_LIMITS = {
    "pom": (
        "- It has learnt the traffic it was trained on (see Training) and nothing else. Simulated vehicles are "
        "not recorded ones: expect worse forecasts on other roads, in other countries, with other sensors.\n"
        "- It forecasts each agent by itself: maps of two agents are not a joint distribution.\n"
        "- Horizons above {low:g} s and up to {high:g} s only; histories of {history} rows, {step:g} s apart, "
        "only.\n"
        "- Not validated for safety-critical use. Measure it on your own recordings first."
    ),
    "condition": (
        "- It has learnt the distribution it was trained on (see Training), at and between those conditions.\n"
        "- Not validated for safety-critical use."
    ),
}

_SCENE_UNITS = (
    "Scenes are right-handed: x forward, y left, yaw counter-clockwise; metres, seconds, radians, m/s. Forecasts "
    "are in each agent's frame (origin at its box centre now, x forward) unless the scene frame is asked for. "
    "Log-densities are in nats per m², cell masses are probabilities."
)

_USE = {
    "pom": "    hcnaf-run forecast scene.npz --model . -o forecast.npz --plot out.png\n    hcnaf-run verify .",
    "condition": "    hcnaf-run info .\n    hcnaf-run verify .",
}

_PYTHON = {
    "pom": (
        "    from hcnaf_runtime import Forecaster, Scene\n\n"
        '    maps = Forecaster("path/of/this/directory").pom(Scene.load("scene.npz"), horizons=[1.0, 2.0])'
    ),
    "condition": (
        "    from hcnaf_runtime import Condition, Forecaster\n\n"
        '    forecaster = Forecaster("path/of/this/directory")\n'
        "    log_p = forecaster.log_prob(Condition(values), points)  # float32 [A, {size}], [N, {dims}]"
    ),
}


_COSTS = {
    "nats": "change of log p (nats)",
    "cell_mass": "change of a cell",
    "total_variation": "total variation of a map",
}


def card(manifest: Manifest) -> str:
    """The card as Markdown."""
    sections = [
        f"# {manifest.name}",
        _summary(manifest),
        "## Use",
        f"{_USE[manifest.kind]}\n\nor in Python\n\n{_python(manifest)}",
        "## Input and units",
        _input(manifest),
        "## Scores",
        _scores(manifest.scores),
        "## Training",
        _facts(manifest.training),
        "## Size and precision",
        _size(manifest),
        "## Limits",
        _limits(manifest),
        "## Parity",
        _parity(manifest.parity),
    ]
    return "\n\n".join(sections) + "\n"


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def _summary(m: Manifest) -> str:
    flow = m.flow
    what = {
        "pom": "It forecasts where the agents of a scene will be: an exact probability for every cell of a map.",
        "condition": f"It gives the density of a {flow.dims}-dimensional variable under a condition.",
    }[m.kind]
    return (
        f"A hyper-conditioned neural autoregressive flow (HCNAF), written by hcnaf {m.version} on {m.created}. "
        f"{what}\n\nFlow: D = {flow.dims} dimensions, L = {flow.layers} hidden layers, H = {flow.hidden} units "
        f"per dimension, {flow.parameters} weights per map, support `{flow.support}`, weight normalisation "
        f"`{flow.weight_norm}`. Graphs: {', '.join(f'`{g.file}`' for g in m.graphs.values())} (opset {m.opset}, "
        f"onnxruntime {m.onnxruntime_min} or newer)."
    )


def _python(m: Manifest) -> str:
    text = _PYTHON[m.kind]
    if m.condition is not None:
        return text.format(size=m.condition.size, dims=m.flow.dims)
    return text


def _input(m: Manifest) -> str:
    if m.condition is not None:
        names = ", ".join(m.condition.names)
        return f"{m.condition.size} numbers per condition ({names}), in the units of the training data."
    assert m.scene is not None
    required = [c for c in m.scene.channels if c not in m.scene.optional_channels]
    lines = [
        _SCENE_UNITS,
        f"- history: {m.scene.history} rows, {m.scene.step:g} s apart, the last one is now",
        f"- raster channels needed: {', '.join(required) or 'none'}",
        f"- raster channels that may be absent: {', '.join(m.scene.optional_channels) or 'none'}",
        f"- stop lines: {'read' if m.scene.stops else 'not read'}",
    ]
    return lines[0] + "\n\n" + "\n".join(lines[1:])


def _size(m: Manifest) -> str:
    """Bytes of every file, and what a precision below fp32 costs."""
    files = {name: file.bytes for name, file in m.files.items() if name != FILE}
    before = m.precision_cost.get("bytes_fp32", {})
    header = ["file", "bytes", "as fp32"] if before else ["file", "bytes"]
    rows = [[name, f"{size:,}", _bytes(before.get(name))][: len(header)] for name, size in files.items()]
    total = ["all", f"{sum(files.values()):,}", ""][: len(header)]
    text = f"The hyper-network's weights are stored as {m.precision}, the flow's arithmetic is float32."
    parts = [text, table(header, [*rows, total])]
    if "nats" in m.precision_cost:
        parts.append(_cost(m.precision_cost))
    return "\n\n".join(parts)


def _bytes(size: int | None) -> str:
    return "" if size is None else f"{size:,}"


def _cost(cost: Mapping[str, Any]) -> str:
    what = f"Against float32, over {cost['maps']} forecasts of {cost['measured_on']}:"
    rows = [[text, *(_show(cost[n].get(k)) for k in ("mean", "max"))] for n, text in _COSTS.items() if n in cost]
    return f"{what}\n\n{table(['', 'mean', 'max'], rows)}"


def _limits(m: Manifest) -> str:
    if m.scene is None or m.horizons is None:
        return _LIMITS[m.kind]
    return _LIMITS[m.kind].format(
        low=m.horizons.min, high=m.horizons.max, history=m.scene.history, step=m.scene.step
    )


def _scores(scores: Mapping[str, Any]) -> str:
    """One table over all measurements that are themselves tables (by horizon, say), then what else there is."""
    tables = {name: value for name, value in scores.items() if isinstance(value, Mapping) and _flat(value)}
    rest = {name: value for name, value in scores.items() if name not in tables}
    parts = []
    if tables:
        keys = sorted(dict.fromkeys(key for value in tables.values() for key in value), key=_by_horizon)
        rows = [[key, *(_show(value.get(key)) for value in tables.values())] for key in keys]
        parts.append(table(["", *tables], rows))
    if rest:
        parts.append(_facts(rest))
    return "\n\n".join(parts) or "None were recorded with the checkpoint."


def _by_horizon(key: str) -> float:
    """Rows such as "0.5 s" in order, others after them as they came."""
    number = key.removesuffix(" s")
    return float(number) if number.replace(".", "", 1).isdigit() else float("inf")


def _flat(value: Mapping[str, Any]) -> bool:
    return bool(value) and not any(isinstance(v, (Mapping, list)) for v in value.values())


def _facts(facts: Mapping[str, Any]) -> str:
    if not facts:
        return "Nothing was recorded with the checkpoint."
    return table(["fact", "value"], [[name, _show(value)] for name, value in facts.items()])


def _show(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_show(v)}" for name, v in value.items())
    if isinstance(value, list):
        return ", ".join(_show(v) for v in value)
    return f"{value:.4g}" if isinstance(value, float) else " ".join(str(value).split())


def _parity(rows: Sequence[ParityRow]) -> str:
    intro = (
        "Exported graphs against PyTorch over ordinary, extreme and single inputs. Absolute up to a value of 1 "
        "(50 for nats), relative beyond; `path` is from the hyper-network's input to the log-density. F_2 is "
        "compared where the image of y holds at least 0.3 of the normal mass, if it does so for any x: below, "
        "float32 itself does not resolve it."
    )
    header = ["graph", "output", "max abs", "max rel", "rms", "tolerance"]
    return f"{intro}\n\n{table(header, [_parity_row(r) for r in rows])}"


def _parity_row(r: ParityRow) -> list[str]:
    return [r.graph, r.output, *(f"{v:.1e}" for v in (r.max_abs, r.max_rel, r.rms)), f"{r.tolerance:.0e}"]
