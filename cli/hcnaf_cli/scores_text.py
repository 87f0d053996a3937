"""What an evaluation looks like as text: a table per question that it answers."""

from collections.abc import Iterable
from typing import TYPE_CHECKING

from hcnaf_cli.output import table

if TYPE_CHECKING:
    from hcnaf_export.evaluation import (
        ExtraNats,
        PitScores,
        RegionScores,
        ReliabilityScores,
        SampleScores,
        Scores,
    )


def scores_text(scores: "Scores") -> str:
    """NLL per horizon and what it is held against; extra nats, calibration and samples where there are any."""
    head, *rows = scores.table()
    lines = [scores.title, table(head, rows), _mean(scores)]
    if scores.extra_nats:
        lines += ["", *_extra_nats(scores.extra_nats)]
    if scores.pit:
        lines += ["", *_pit(scores.pit)]
    if scores.hdr_coverage:
        lines += ["", *_coverage(scores.hdr_coverage)]
    if scores.reliability:
        lines += ["", *_reliability(scores.reliability)]
    if scores.samples:
        lines += ["", *_samples(scores.samples)]
    return "\n".join(lines)


def _mean(scores: "Scores") -> str:
    mean = f"mean NLL {scores.mean:.3f} ± {scores.mean_error:.3f}"
    return mean if scores.floor is None else f"{mean}; label noise alone has {scores.floor:.3f}"


def _extra_nats(found: "Iterable[ExtraNats]") -> list[str]:
    some = list(found)
    head = ["horizon (s)", *(e.protocol for e in some)]
    rows = [
        [f"{first.horizon:g}", *(f"{e.rows[q].extra_nats:.3f} ± {e.rows[q].error:.3f}" for e in some)]
        for q, first in enumerate(some[0].rows)
    ]
    rows.append(["mean", *(f"{e.mean:.3f} ± {e.mean_error:.3f}" for e in some)])
    rows.append(["floor", *(f"{e.floor:.3f}" for e in some)])
    notes = [f"{e.protocol}: {e.definition}" for e in some]
    return ["extra nats, per dimension, of the labels with noise added", table(head, rows), *notes]


def _pit(found: "PitScores") -> list[str]:
    rows = [
        [f"{r.horizon:g}", *(f"{c.ks:.3f} ({c.critical:.3f})" for c in (r.along, r.across))] for r in found.rows
    ]
    what = "probability integral transform: Kolmogorov-Smirnov statistics (a calibrated model's, 95 % below)"
    head = ["horizon (s)", "F_1(x), along", "F_2(y | x), across"]
    return [f"{what}; {_counted(found)}", table(head, rows)]


def _coverage(found: "RegionScores") -> list[str]:
    levels = sorted({r.level for r in found.rows})
    horizons = sorted({r.horizon for r in found.rows})
    cells = {(r.horizon, r.level): f"{r.covered:.3f} ± {r.error:.3f}" for r in found.rows}
    rows = [[f"{t:g}", *(cells[t, level] for level in levels)] for t in horizons]
    what = f"share of labels in highest-density regions, from {found.draws} samples"
    return [f"{what}; {_counted(found)}", table(["horizon (s)", *(f"{level:.0%}" for level in levels)], rows)]


def _reliability(found: "ReliabilityScores") -> list[str]:
    rows = [
        [
            f"{r.horizon:g}",
            f"{r.ece:.4f} ({r.ece_noise:.4f})",
            f"{r.ece_top:.4f} ({r.ece_top_noise:.4f})",
            f"{r.ece_all:.1e}",
        ]
        for r in found.rows
    ]
    what = f"expected calibration error of {found.cell:g} m cells (about a calibrated model's)"
    head = ["horizon (s)", "cells of 1 % and more", "likeliest cell", "all cells"]
    return [f"{what}; {_counted(found)}", table(head, rows)]


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
        f"paths coupled by quantiles, {scores.draws} each; {_counted(scores)}",
        table(["best of k", "min_ade (m)", "min_fde (m)", "miss_rate (2 m)"], best),
        table(["horizon (s)", "energy_score (m)"], energy),
    ]


def _counted(found: "PitScores | RegionScores | ReliabilityScores | SampleScores") -> str:
    return f"{found.windows} windows in {found.clusters} scenes"
