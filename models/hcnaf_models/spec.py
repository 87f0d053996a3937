"""The shape of a flow and the layout of its parameter vector theta.

    D   flow dimensions            x, z in R^D
    L   hidden layers              hence L + 1 weight matrices, k = 1 .. L + 1
    H   hidden units per dimension and layer
    P   length of theta

theta holds the location m_1 .. m_D that is subtracted from x first (so that sharp densities far from the
origin keep float32 accuracy) and then, layer after layer, the diagonal blocks W_11 .. W_DD, the blocks below
the diagonal W_21, W_31, W_32, W_41, ... (row-major, [H_out, H_in] each) and the biases B_1 .. B_D ([H_out]
each), so that every group is one slice and one reshape. Blocks above the diagonal are zero and are not
emitted: (D + 1) / 2D of the paper's N_W numbers remain (three quarters for D = 2).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, get_args

Support = Literal["normalised", "paper"]
WeightNorm = Literal["none", "row", "frobenius", "row-gain"]
WEIGHT_NORMS = get_args(WeightNorm)


@dataclass(frozen=True, kw_only=True)
class FlowSpec:
    """Sizes and conventions of one conditional autoregressive flow.

    Args:
        dims: flow dimensions D.
        layers: hidden layers L, at least 1.
        hidden: hidden units H per dimension and layer.
        support: `normalised` divides by the mass that tanh lets the base reach, so that the density
            integrates to one; `paper` does not, for comparison with published numbers.
        weight_norm: applied to whole rows (`row`), whole layers (`frobenius`) or not at all, after exp. `row-gain`
            is `row` with a factor per row that depends on the condition, within bounds.
        shear: whether the units that x is taken to before the first layer are slanted: x_2 along the slope that
            Gaussians with a full covariance have. Folded into theta like the scale.
    """

    dims: int = 2
    layers: int = 2
    hidden: int = 20
    support: Support = "normalised"
    weight_norm: WeightNorm = "none"
    shear: bool = False

    def __post_init__(self) -> None:
        if min(self.dims, self.layers, self.hidden) < 1:
            raise ValueError(
                f"flow sizes must be at least 1, found dims={self.dims}, layers={self.layers}, "
                f"hidden={self.hidden}"
            )
        if self.support not in ("normalised", "paper"):
            raise ValueError(f"support must be normalised or paper, found {self.support!r}")
        if self.weight_norm not in WEIGHT_NORMS:
            raise ValueError(f"weight_norm must be one of {WEIGHT_NORMS}, found {self.weight_norm!r}")

    @property
    def pairs(self) -> int:
        """Blocks below the diagonal in one layer, D (D - 1) / 2."""
        return self.dims * (self.dims - 1) // 2

    @property
    def groups(self) -> tuple[int, ...]:
        """Sizes of the groups of theta in order: location; (diagonal, lower, bias) of layers 1 .. L + 1."""
        return _groups(self)

    @property
    def weights(self) -> int:
        """Length of theta without the location."""
        return self.parameters - self.dims

    @property
    def gains(self) -> tuple[int, ...]:
        """Gains that depend on the condition, one per output row of layers 1 .. L + 1; none but for `row-gain`."""
        if self.weight_norm != "row-gain":
            return ()
        return tuple(self.dims * self.fan_out(k) for k in range(1, self.layers + 2))

    @property
    def units(self) -> int:
        """Numbers that say where the flow is: location and scale per dimension, and slopes if there are any."""
        return 2 * self.dims + self.shear * self.pairs

    @property
    def raw(self) -> int:
        """How many raw numbers a hyper-network emits, beside location and scale: gains, then weights."""
        return sum(self.gains) + self.weights

    @property
    def parameters(self) -> int:
        """P, the length of theta."""
        return sum(self.groups)

    def fan_in(self, k: int) -> int:
        """Inputs per dimension of layer k (1-based)."""
        return 1 if k == 1 else self.hidden

    def fan_out(self, k: int) -> int:
        """Outputs per dimension of layer k (1-based)."""
        return 1 if k == self.layers + 1 else self.hidden


@lru_cache(maxsize=64)
def _groups(spec: FlowSpec) -> tuple[int, ...]:
    sizes = [spec.dims]
    for k in range(1, spec.layers + 2):
        rows, cols = spec.fan_out(k), spec.fan_in(k)
        sizes += [spec.dims * rows * cols, spec.pairs * rows * cols, spec.dims * rows]
    return tuple(sizes)


@lru_cache(maxsize=64)
def lower_pairs(dims: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Rows d and columns r (0-based, r < d) of the blocks below the diagonal, in theta's order."""
    pairs = [(d, r) for d in range(dims) for r in range(d)]
    return tuple(d for d, _ in pairs), tuple(r for _, r in pairs)
