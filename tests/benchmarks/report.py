"""performance.json as Markdown: tables of what was measured, and of what it should be."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tests.benchmarks import cost
from tests.benchmarks.targets import TARGETS, dense, times_ours

Json = dict[str, Any]

F_2 = {"cells": "F_2 for cells", "meshes": "F_2 on meshes, landmarks", "checks": "F_2 checked"}
"""What points are evaluated for, as `evaluations` counts them."""

BEGIN, END = "<!-- measured: begin -->", "<!-- measured: end -->"


def markdown(results: Json) -> str:
    """Everything that `results` has, section by section."""
    parts = [
        "# Measured performance",
        "Written by `python -m tests.benchmarks`; see [performance](../performance.md).",
    ]
    parts += [_machine(results), "## What must hold", targets(results), "## The floor", floors(results)]
    for name, title, maker in (
        ("dense", "Maps after theta, 200 x 200 cells, L = 3", _dense),
        ("published", "PyTorch at the 40,000 cell centres, L = 3", _published),
        ("libraries", "Other libraries' `log_prob` at 40,000 points", _libraries),
        ("graphs", "Single graphs, one map", _graphs),
        ("vehicle", "`hcnaf-run bench`", _vehicle),
        ("sweep", "Cost against size", _sweep),
        ("memory", "Memory", _memory),
    ):
        if name in results:
            parts += [f"## {title}", maker(results)]
    if "pace" in results:
        parts += ["## When, and how fast the machine was", _pace(results)]
    return "\n\n".join(parts) + "\n"


def _pace(results: Json) -> str:
    """When each section was measured, and the machine's speed then as a share of the fastest it was seen."""
    fastest = results["fastest"]
    rows = [[name, results["measured"][name], f"{pace / fastest:.2f}"] for name, pace in results["pace"].items()]
    return table(["section", "measured", "pace"], rows)


def splice(page: Path, results: Json) -> None:
    """Put the targets and the floors between the markers of docs/performance.md."""
    text = page.read_text(encoding="utf-8")
    before, rest = text.split(BEGIN)
    after = rest.split(END)[1]
    middle = "\n\n".join([BEGIN, _machine(results), targets(results), floors(results), END])
    page.write_text(before + middle + after, encoding="utf-8")


def targets(results: Json) -> str:
    """One row per target: met, missed, or not measured."""
    words = {True: "met", False: "**missed**", None: "not measured"}
    rows = []
    for row in (target.row(results) for target in TARGETS):
        sign = "≥" if row["least"] else "≤"
        found = "-" if row["found"] is None else f"{row['found']:.3g}"
        share = "-" if row["share"] is None else f"{row['share']:.2f}"
        limit = f"{sign} {row['limit']:g} {row['unit']}".strip()
        rows.append([row["name"], limit, row["prototype"], found, share, words[row["met"]]])
    return table(["", "target", "prototype", "found", "found / target", ""], rows)


def floors(results: Json) -> str:
    """What the machine's rates imply for a dense map, and how far above it we are."""
    if "rates" not in results:
        return "Rates were not measured."
    tanh, rows = results["rates"]["tanh"], []
    for H, shapes in results["rates"]["gemm"].items():
        need = cost.dense(3, int(H), 200, 200)
        gemm = max(shapes.values())
        least = cost.floor(need, gemm, tanh)
        ours = dense(results, int(H)) if "dense" in results else None
        rows.append(
            [H, f"{need.gemm / 1e6:.0f}", f"{need.flops / 1e6:.0f}", f"{need.tanh / 1e6:.2f}"]
            + [
                f"{need.activations / 1e6:.1f}",
                f"{need.result / 1e6:.2f}",
                f"{gemm / 1e9:.0f}",
                f"{tanh / 1e9:.2f}",
            ]
            + [f"{least * 1e3:.2f}"]
            + (["-", "-"] if ours is None else [f"{ours * 1e3:.2f}", f"{ours / least:.2f}"])
        )
    head = ["H (L = 3)", "GEMM Mflop", "all Mflop", "M tanh", "activations MB", "map MB"]
    edges = table([*head, "GEMM Gflop/s", "G tanh/s", "floor ms", "dense map ms", "above"], rows)
    return f"{edges}\n\n{_evaluated(results)}" if "dense" in results else edges


def _evaluated(results: Json) -> str:
    """What the rates imply for the points that are evaluated once rows are interpolated."""
    tanh, rows = results["rates"]["tanh"], []
    for name, case in results["dense"].items():
        H, points = int(name.split()[0].removeprefix("H=")), case.get("evaluations")
        if points is None:
            continue
        gemm = max(results["rates"]["gemm"][str(H)].values())
        least = cost.floor(cost.evaluated(3, H, sum(points[k] for k in F_2), points["F_1"]), gemm, tanh)
        ours = case[f"dense x{case['maps']}"]["median"] / case["maps"]
        counts = (f"{points[k]:,.0f}" for k in (*F_2, "F_1"))
        rows.append([name, *counts, f"{least * 1e3:.2f}", f"{ours * 1e3:.2f}", f"{ours / least:.2f}"])
    head = ["dense map", *F_2.values(), "F_1", "floor of these ms", "map ms", "above"]
    return table(head, rows)


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _machine(results: Json) -> str:
    m = results["machine"]
    versions = ", ".join(f"{n} {m[n]}" for n in ("onnxruntime", "numpy", "torch", "zuko", "nflows", "openvino"))
    return f"{m['cpu']}, {m['threads']} threads of {m['cores']} cores, {m['date']}; {versions}."


_TIMES = ["median", "p95", "p99", "max", "p99 / median", "calls"]


def _times(case: Json) -> list[str]:
    """Milliseconds."""
    if "median" not in case:
        return ["not installed", *[""] * 5]
    numbers = [f"{case[k] * 1e3:.3g}" for k in ("median", "p95", "p99", "max")]
    return [*numbers, f"{case['tail']:.2f}", str(case["repetitions"])]


def _dense(results: Json) -> str:
    rows = []
    for name, case in results["dense"].items():
        for kind in (key for key in case if " x" in key):
            maps = int(kind.split("x")[1])
            lost = f"{case['lost_mass']:.1e}" if "certified" in kind else ""
            rows.append([name, kind, f"{case[kind]['median'] / maps * 1e3:.3f}", *_times(case[kind]), lost])
    shares = ", ".join(f"{name} {case['occupied']:.0%}" for name, case in results["dense"].items())
    errors = ", ".join(
        f"{name} {case['errors']['cell']:.1e} and {case['errors']['map']:.1e}"
        for name, case in results["dense"].items()
        if "errors" in case  # not in records made before it was measured
    )
    note = f"Milliseconds per call. Cells with more than 1e-8: {shares}."
    wrong = f"What the worst cell of a dense map is wrong by, and all cells of one taken together: {errors}."
    return "\n\n".join([table(["flow", "maps", "per map", *_TIMES, "lost mass"], rows), note, wrong])


def _ratio(results: Json, case: Json, H: int) -> str:
    """Beside ours if it was measured there, or by what the section `dense` says."""
    if "ours" in case:
        return f"{times_ours(case):.3g}"
    if "median" not in case or "dense" not in results:
        return ""
    return f"{case['median'] / dense(results, H):.3g}"


def _published(results: Json) -> str:
    rows, notes = [], []
    for name, cases in results["published"].items():
        H = int(name.removeprefix("H="))
        notes.append(f"{name}: {cases['agreement']:.1e} nats")
        rows += [
            [name, form, _ratio(results, case, H), *_times(case)]
            for form, case in cases.items()
            if form != "agreement"
        ]
    note = "Milliseconds. The two forms differ by at most " + ", ".join(notes) + "."
    return table(["flow", "form", "times our map", *_TIMES], rows) + f"\n\n{note}"


def _libraries(results: Json) -> str:
    rows = [[name, _ratio(results, case, 20), *_times(case)] for name, case in results["libraries"].items()]
    return table(["flow", "times our map (H=20)", *_TIMES], rows) + "\n\nMilliseconds."


def _graphs(results: Json) -> str:
    rows = []
    for name, cases in results["graphs"].items():
        H = int(name.split("H=")[1])
        rows += [
            [name, engine, _ratio(results, cases[engine], H), *_times(cases[engine])]
            for engine in ("onnxruntime", "openvino")
        ]
    head = ["graph", "engine", "times our map", *_TIMES]
    note = "`cell_mass` has one node per column here and no choice of rows: less than a map needs to be exact."
    return table(head, rows) + f"\n\nMilliseconds. {note}"


def _vehicle(results: Json) -> str:
    rows = []
    for c in results["vehicle"]["cases"]:
        per_map = f"{c['per_map'] * 1e3:.3f}" if c["maps"] > 1 else ""
        lost = f"{c['facts']['lost_mass']:.1e}" if "lost_mass" in c["facts"] else ""
        rows.append([c["name"], per_map, *_times(c["seconds"]), lost])
    model = results["vehicle"]["machine"]["model"]
    return table(["case", "per map", *_TIMES, "lost mass"], rows) + f"\n\nMilliseconds. Model: {model}."


def _sweep(results: Json) -> str:
    titles = {"cells": "cells each way", "H": "H", "L": "L", "horizons": "horizons", "agents": "agents"}
    parts = []
    for key, title in titles.items():
        cases = results["sweep"].get(key, [])
        rows = [[str(c["value"]), f"{c['dense'] * 1e3:.2f}", f"{c['certified'] * 1e3:.2f}"] for c in cases]
        parts += [table([title, "dense", "certified"], rows)] if rows else []
    base = (
        "L = 3, H = 20, 200 x 200 cells, one map of a wide flow; agents x 20 horizons and 1 agent x horizons are"
    )
    note = f"Median milliseconds. {base} whole forecasts of the served model."
    return "\n\n".join([*parts, note, "![cost against size](../images/performance.png)"])


def _memory(results: Json) -> str:
    m = results["memory"]["memory"]
    numbers = [f"{b / 2**20:.1f}" for b in (m["before"], m["samples"][-1][1], m["peak"], m["growth"])]
    return table(
        ["scenes", "before", "after", "peak", "second half above first"], [[str(m["scenes"]), *numbers]]
    ) + ("\n\nMiB resident while scenes with changing numbers of agents, horizons and cells are forecast.")
