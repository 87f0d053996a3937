"""What an export's parity and an evaluation look like as JSON and as text."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import msgspec

from hcnaf_cli.output import table
from hcnaf_runtime.manifest import ParityRow

if TYPE_CHECKING:
    from hcnaf_export.evaluation import SampleScores, Scores
    from hcnaf_export.training.toy import Divergence


def parity_json(rows: Sequence[ParityRow]) -> list[dict[str, Any]]:
    """Every row."""
    return [msgspec.to_builtins(row) for row in rows]


def parity_text(rows: Sequence[ParityRow]) -> str:
    """PyTorch against onnxruntime: a line per graph and output."""
    head = ["graph ", "output ", "max abs", "max rel", "rms", "tolerance", "PyTorch", "onnxruntime", "verdict "]
    return table(head, [_parity_row(row) for row in rows])


def _parity_row(row: ParityRow) -> list[str]:
    differences = [f"{value:.2e}" for value in (row.max_abs, row.max_rel, row.rms)]
    worst = [f"{value:.7g}" for value in (row.torch, row.onnx)]
    return [
        row.graph,
        row.output,
        *differences,
        f"{row.tolerance:.0e}",
        *worst,
        "passed" if row.passed else "FAILED",
    ]


_COSTS = {
    "nats": "|change of log p| (nats)",
    "cell_mass": "|change of a cell|",
    "total_variation": "total variation",
}


def size_text(files: Mapping[str, int], cost: Mapping[str, Any]) -> str:
    """Bytes of every file, and what the precision costs where it is below fp32."""
    before = cost.get("bytes_fp32", {})
    rows = [[name, f"{size:,}", f"{before[name]:,}" if name in before else ""] for name, size in files.items()]
    rows.append(["all", f"{sum(files.values()):,}", ""])
    lines = [table(["file ", "bytes", "as fp32" if before else ""], rows)]
    if "nats" in cost:
        found = [
            [text, *(f"{cost[name][k]:.2e}" if k in cost[name] else "" for k in ("mean", "max"))]
            for name, text in _COSTS.items()
            if name in cost
        ]
        lines.append(table([f"against fp32, {cost['maps']} forecasts ", "mean", "max"], found))
    return "\n".join(lines)


def scores_text(scores: "Scores") -> str:
    """A heading, a line per horizon, and what the numbers can be held against."""
    head, *rows = scores.table()
    what = f"{scores.predictor} on {scores.data}, {scores.split}"
    title = f"{what}: {scores.windows} windows in {scores.clusters} scenes"
    last = f"mean NLL {scores.mean:.3f} ± {scores.mean_error:.3f}; label noise alone has {scores.floor:.3f}"
    return "\n".join([title, table(head, rows), last, *(_samples(scores.samples) if scores.samples else [])])


def _samples(scores: "SampleScores") -> list[str]:
    """Scores of the best of k paths, and of samples per horizon."""
    best = [
        [
            f"{p.k}",
            f"{p.min_ade:.3f} ± {p.min_ade_error:.3f}",
            f"{p.min_fde:.3f} ± {p.min_fde_error:.3f}",
            f"{p.miss_rate:.3f} ± {p.miss_rate_error:.3f}",
        ]
        for p in scores.paths
    ]
    energy = [[f"{e.horizon:g}", f"{e.energy_score:.3f} ± {e.error:.3f}"] for e in scores.energy]
    return [
        f"paths coupled by quantiles: {scores.windows} windows in {scores.clusters} scenes, {scores.draws} each",
        table(["best of k", "min_ade (m)", "min_fde (m)", "miss_rate (2 m)"], best),
        table(["horizon (s)", "energy_score (m)"], energy),
    ]


def toy_json(found: Sequence["Divergence"]) -> list[dict[str, Any]]:
    """Every condition."""
    return [row._asdict() for row in found]


def toy_text(found: Sequence["Divergence"]) -> str:
    """Divergence from the known density: a line per condition."""
    rows = [[r.name, "yes" if r.seen else "no", f"{r.kl:.4f} ± {r.error:.4f}"] for r in found]
    return table(["condition ", "trained on", "KL (nats)"], rows)
