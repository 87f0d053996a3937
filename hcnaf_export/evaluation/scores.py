"""Mean scores with honest standard errors, as data: what tables and model cards are written from."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from hcnaf_export.evaluation.extra_nats import ExtraNats
from hcnaf_export.evaluation.paths import SampleScores
from hcnaf_export.evaluation.pit import PitScores
from hcnaf_export.evaluation.regions import RegionScores
from hcnaf_export.evaluation.reliability import ReliabilityScores
from hcnaf_export.evaluation.spread import mean_and_error as mean_and_error


class Score(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One horizon.

    Attributes:
        horizon: s.
        nll: mean negative log-likelihood of the labels, nats per m². error: its standard error.
        baseline, baseline_error: the same of the constant-velocity Gaussian.
        gain: baseline - nll of the same windows. gain_error: its standard error (paired: much smaller than
            the two errors apart).
    """

    horizon: float
    nll: float
    error: float
    baseline: float
    baseline_error: float
    gain: float
    gain_error: float


class Scores(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Scores of one predictor on one split.

    Attributes:
        predictor: what was scored. data: the data set. split: of it.
        windows: snippets scored. clusters: groups of them that are taken as independent.
        rows: one per horizon.
        mean: mean NLL over the horizons, nats per m². mean_error: its standard error.
        floor: entropy of the label noise, nats per m²; no predictor's expected NLL lies below it. None where the
            labels' noise is not known.
        extra_nats: of each protocol; the plain NLL in nats per m² and step that goes with them is `rows`.
        pit, hdr_coverage, reliability: calibration, each where the predictor allows it.
        network: the one network of the split that was scored, None for all of them.
        samples: scores of samples and paths, of a predictor that draws them.
    """

    predictor: str
    data: str
    split: str
    windows: int
    clusters: int
    rows: tuple[Score, ...]
    mean: float
    mean_error: float
    floor: float | None
    samples: SampleScores | None = None
    extra_nats: tuple[ExtraNats, ...] = ()
    pit: PitScores | None = None
    hdr_coverage: RegionScores | None = None
    reliability: ReliabilityScores | None = None
    network: str | None = None

    @property
    def title(self) -> str:
        """Such as: bundle on simdata, test: 5000 windows in 240 scenes."""
        where = self.split if self.network is None else f"{self.split}, {self.network}"
        return f"{self.predictor} on {self.data}, {where}: {self.windows} windows in {self.clusters} scenes"

    def as_dict(self) -> dict[str, Any]:
        """Plain data, fit for JSON."""
        plain: dict[str, Any] = msgspec.to_builtins(self)
        return plain

    def record(self) -> dict[str, Any]:
        """What a checkpoint keeps of it: columns by horizon, and what they rest on."""

        def column(field: str, mean: float | None = None) -> dict[str, float]:
            values = {f"{r.horizon:g} s": float(getattr(r, field)) for r in self.rows}
            return values if mean is None else values | {"mean": mean}

        return {
            f"{self.split} NLL (nats/m²)": column("nll", self.mean),
            f"{self.split} standard error": column("error", self.mean_error),
            f"{self.split} constant velocity": column("baseline"),
            f"{self.split} windows": self.windows,
            f"{self.split} floor of the label noise": self.floor,
            **self._calibration(),
            **(self.samples.record(self.split) if self.samples else {}),
        }

    def _calibration(self) -> dict[str, dict[str, float]]:
        """Columns by horizon: the larger KS statistic, coverage of the widest regions, the ECE."""
        found = {}
        if self.pit:
            found["PIT KS"] = {f"{r.horizon:g} s": max(r.along.ks, r.across.ks) for r in self.pit.rows}
        if self.hdr_coverage:
            widest = max(r.level for r in self.hdr_coverage.rows)
            inside = [r for r in self.hdr_coverage.rows if r.level == widest]
            found[f"coverage of {widest:.0%} regions"] = {f"{r.horizon:g} s": r.covered for r in inside}
        if self.reliability:
            found["ECE"] = {f"{r.horizon:g} s": r.ece for r in self.reliability.rows}
        return {f"{self.split} {name}": column for name, column in found.items()}

    def table(self) -> list[tuple[str, ...]]:
        """Header and rows of text, one row per horizon: NLLs and gain with their standard errors."""
        head = ("horizon (s)", "NLL (nats/m²)", "constant velocity", "gain")
        rows = [
            (
                f"{r.horizon:g}",
                f"{r.nll:.3f} ± {r.error:.3f}",
                f"{r.baseline:.3f} ± {r.baseline_error:.3f}",
                f"{r.gain:.3f} ± {r.gain_error:.3f}",
            )
            for r in self.rows
        ]
        return [head, *rows]


def summarise(
    horizons: tuple[float, ...],
    nll: NDArray[np.float64],
    baseline: NDArray[np.float64],
    cluster: NDArray[np.int64],
    **about: Any,
) -> Scores:
    """Scores from the NLL [W, Q] of a predictor and of the baseline, and each window's cluster [W]."""
    columns = [column for v in (nll, baseline, baseline - nll) for column in mean_and_error(v, cluster)]
    rows = tuple(Score(t, *(float(v) for v in row)) for t, *row in zip(horizons, *columns, strict=True))
    mean, error = mean_and_error(nll.mean(axis=1, keepdims=True), cluster)
    return Scores(
        windows=len(nll),
        clusters=len(np.unique(cluster)),
        rows=rows,
        mean=float(mean[0]),
        mean_error=float(error[0]),
        **about,
    )
