"""performance.png: cost against every size, and memory against scenes served."""

from pathlib import Path
from typing import Any

Json = dict[str, Any]

PANELS = {
    "cells": "cells each way (L=3, H=20)",
    "H": "hidden units H (L=3)",
    "L": "hidden layers L (H=20)",
    "horizons": "horizons (whole forecast, 1 agent)",
    "agents": "agents (whole forecast, 20 horizons)",
}


def draw(results: Json, path: Path) -> None:
    """Six panels; one that was not measured is left out."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 6), layout="constrained")
    axes = figure.subplots(2, 3).ravel()
    for ax, (key, title) in zip(axes, PANELS.items(), strict=False):
        _cost(ax, title, results.get("sweep", {}).get(key, []))
    _memory(axes[-1], results.get("memory", {}).get("memory"))
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def _cost(ax: Any, title: str, cases: list[Json]) -> None:
    from matplotlib.ticker import LogFormatter

    if not cases:
        ax.set_axis_off()
        return
    for kind, mark in (("dense", "o-"), ("certified", "s--")):
        ax.loglog([c["value"] for c in cases], [c[kind] * 1e3 for c in cases], mark, label=kind)
    values = [c["value"] for c in cases]
    ax.set_xticks(values, [str(v) for v in values])
    ax.set_xticks([], minor=True)
    for formatter in (ax.yaxis.set_major_formatter, ax.yaxis.set_minor_formatter):
        formatter(LogFormatter(minor_thresholds=(2.0, 0.5)))
    ax.set_xlabel(title)
    ax.set_ylabel("median ms")
    ax.grid(alpha=0.3)
    ax.legend()


def _memory(ax: Any, memory: Json | None) -> None:
    if memory is None:
        ax.set_axis_off()
        return
    scenes, resident = zip(*memory["samples"], strict=True)
    ax.plot(scenes, [b / 2**20 for b in resident])
    ax.axhline(150, color="grey", ls=":")
    ax.set_ylim(0)
    ax.set_xlabel("scenes served")
    ax.set_ylabel("MiB resident")
    ax.grid(alpha=0.3)
