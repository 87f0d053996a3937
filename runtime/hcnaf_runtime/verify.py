"""Does a bundle still compute, on this machine, what it computed where it was made? Needs no torch."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from hcnaf_runtime.bundle import Bundle
from hcnaf_runtime.errors import BundleError
from hcnaf_runtime.npz import read_npz

GOLDEN = "golden.npz"
"""Inputs `in.<graph>.<input>`, expected outputs `out.<graph>.<output>`, tolerances `tol.<graph>.<output>`."""


@dataclass(frozen=True)
class VerifyRow:
    """One output of one graph: how far it is from its golden value, in units of max(1, |expected|)."""

    graph: str
    output: str
    max_abs: float
    max_error: float
    tolerance: float

    @property
    def passed(self) -> bool:
        """Whether every value is within the tolerance."""
        return self.max_error <= self.tolerance


def verify(bundle: Bundle, threads: int | None = None) -> list[VerifyRow]:
    """Run every graph on its golden inputs. Raises BundleError if the golden file lacks what it needs."""
    golden = read_npz(bundle.path / GOLDEN, BundleError)
    rows: list[VerifyRow] = []
    for graph in bundle.manifest.graphs:
        session = bundle.session(graph, threads)
        feeds = {name: _take(bundle, golden, f"in.{graph}.{name}") for name in session.inputs}
        found = session.run(session.outputs, feeds)
        for output, value in zip(session.outputs, found, strict=True):
            expected = _take(bundle, golden, f"out.{graph}.{output}")
            tolerance = float(_take(bundle, golden, f"tol.{graph}.{output}"))
            rows.append(VerifyRow(graph, output, *_distance(value, expected), tolerance))
    return rows


def _take(bundle: Bundle, golden: dict[str, npt.NDArray[Any]], key: str) -> npt.NDArray[Any]:
    if key not in golden:
        raise BundleError(f"{bundle.path / GOLDEN}: no '{key}', which the manifest needs; export it again")
    return golden[key]


def _distance(value: npt.NDArray[Any], expected: npt.NDArray[Any]) -> tuple[float, float]:
    """Largest difference, and largest in units of max(1, |expected|); infinite where they cannot agree."""
    if value.shape != expected.shape:
        return np.inf, np.inf
    a, b = value.astype(np.float64), expected.astype(np.float64)
    same = (a == b) | (np.isnan(a) & np.isnan(b))
    with np.errstate(invalid="ignore"):
        apart = np.where(same, 0.0, np.abs(a - b))
    apart = np.where(np.isnan(apart), np.inf, apart)
    scaled = np.where(apart == 0.0, 0.0, apart / np.maximum(1.0, np.nan_to_num(np.abs(b), nan=1.0)))
    return float(apart.max(initial=0.0)), float(scaled.max(initial=0.0))
