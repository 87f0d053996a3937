"""What an export's parity and a toy's scores look like as JSON and as text."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import msgspec

from hcnaf_cli.output import table
from hcnaf_runtime.manifest import ParityRow

if TYPE_CHECKING:
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


def toy_json(found: Sequence["Divergence"]) -> list[dict[str, Any]]:
    """Every condition."""
    return [row._asdict() for row in found]


def toy_text(found: Sequence["Divergence"]) -> str:
    """Divergence from the known density: a line per condition."""
    rows = [[r.name, "yes" if r.seen else "no", f"{r.kl:.4f} ± {r.error:.4f}"] for r in found]
    return table(["condition ", "trained on", "KL (nats)"], rows)
