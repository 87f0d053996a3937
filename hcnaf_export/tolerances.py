"""How far an exported graph may be from PyTorch, output by output, and why.

The error of a value v against PyTorch's v* is |v - v*| / max(1, |v*| / knee): absolute up to |v*| = knee, relative
beyond. Both sides compute in float32 (24 bits, 6e-8 relative) and sum products in different orders.

From scene to density two hyper-networks' answers are compared as well, and a location that differs by 1e-5 m turns
log p by |z| / s of that: the sharper a forecast, the more, and the more the further from it. So below -knee log p
may differ by the share FAINT, and where p is 0 in float64 by NOTHING: hyper-networks answer absurd scenes with
absurd weights, and there log p is a square of thousands.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.floating]


LEAST = -745.0
"""exp of less is 0 in float64."""

UNITS = 20
"""Rounding of a sum grows with the root of its terms: with three layers of 100 units PyTorch's own F_2 has been
found 2.4e-6 from float64, with 20 units 9e-7."""

FAINT, NOTHING = 1e-5, 1e-4
"""Shares by which a logarithm may differ below -knee, and below LEAST."""


@dataclass(frozen=True)
class Tolerance:
    """`limit` on the error as defined above, for the `reason` given; `logarithm` where v is a log-density from
    scene to density, `sums` where the limit is that of sums over H = UNITS and grows with the root of H."""

    limit: float
    knee: float
    reason: str
    logarithm: bool = False
    sums: bool = False

    def error(self, found: Array, expected: Array) -> npt.NDArray[np.float64]:
        """The error of every value; infinite where either side is not finite."""
        a, b = found.astype(np.float64), expected.astype(np.float64)
        finite = np.isfinite(a) & np.isfinite(b)
        a, b = np.where(finite, a, 0.0), np.where(finite, b, 0.0)
        return np.where(finite, np.abs(a - b) / self.scale(b), np.inf)

    def scale(self, expected: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """max(1, |v*| / knee); of a `logarithm`, what makes `limit` the share that may differ below -knee."""
        size = np.abs(expected)
        scale = np.maximum(1.0, size / self.knee)
        if not self.logarithm:
            return scale
        share = np.where(expected < LEAST, NOTHING, FAINT)
        return np.where(expected < -self.knee, size * share / self.limit, scale)


_PROBABILITY = "a probability; float32 resolves 6e-8 near 1 and z carries a few units in the last place"
_FORECAST = "a probability; theta's own difference moves mass between cells"

TOLERANCES: dict[tuple[str, str], Tolerance] = {
    ("hypernet", "theta"): Tolerance(1e-4, 1.0, "a hundred float32 layers deep, then exp: relative to the weight"),
    ("hypernet", "pose"): Tolerance(1e-5, 1.0, "gathered, and one atan2"),
    ("flow", "log_prob"): Tolerance(
        1e-4, 50.0, "nats; -z^2/2 turns an error e of z into |z| e, with |z| < 10 here"
    ),
    ("flow", "z"): Tolerance(2e-5, 1.0, "a sum over H units of magnitude above |z|"),
    ("flow", "log_det"): Tolerance(1e-4, 50.0, "nats; sums of L + 1 logarithms of positive sums"),
    ("marginal_cdf", "cdf"): Tolerance(2e-6, 1.0, _PROBABILITY, sums=True),
    ("conditional_cdf", "cdf"): Tolerance(2e-6, 1.0, _PROBABILITY, sums=True),
    ("cell_mass", "mass"): Tolerance(1e-6, 1.0, "the promise made for cell masses"),
    ("cell_mass", "error"): Tolerance(2e-6, 1.0, "an estimate, of masses that agree"),
    ("cell_mass", "cdf"): Tolerance(2e-6, 1.0, _PROBABILITY, sums=True),
    ("inverse", "points"): Tolerance(1e-3, 1.0, "z's error over dz/dx, which is small where hardly anything is"),
    ("inverse", "log_prob"): Tolerance(1e-3, 50.0, "nats; the density at a point that is as far off"),
    ("inverse", "error"): Tolerance(1e-5, 1.0, "what is left of F_1 and F_2 by rounding"),
    ("forecast", "mass"): Tolerance(1e-5, 1.0, _FORECAST),
    ("forecast", "window_mass"): Tolerance(1e-5, 1.0, _FORECAST),
    ("forecast", "pose"): Tolerance(1e-5, 1.0, "gathered, and one atan2"),
    ("path", "log_prob"): Tolerance(
        1e-4, 25.0, "nats; the promise made from scene to density, where that is above e^-25", logarithm=True
    ),
}
"""By graph and output. `path` is the hyper-network followed by the flow, as a forecast uses them."""

GOLDEN_FACTOR = 4.0
"""Golden outputs are re-checked on other processors, whose kernels sum in yet another order."""

GOLDEN_INT8 = 0.05
"""Of golden outputs where weights are int8: a rounding that falls the other way moves an output by 1/255."""

MOST_NATS = {"fp16": 0.05, "int8": 0.5}
"""Mean |change of log p| (nats) above which a precision is refused: the export has failed, not merely rounded."""


def tolerance(graph: str, output: str, hidden: int = UNITS) -> Tolerance:
    """The tolerance of one output, for a flow with so many `hidden` units per dimension."""
    found = TOLERANCES[graph, output]
    if not found.sums:
        return found
    return replace(found, limit=found.limit * max(1.0, math.sqrt(hidden / UNITS)))
