"""The sizes of a wide flow (`hcnaf_models.wide`) and the layout of its theta, as plain frozen data."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from itertools import pairwise
from typing import Any, Literal

from hcnaf_models.spec import FlowSpec


@dataclass(frozen=True, kw_only=True)
class WideConfig:
    """What a wide flow is made of.

    Args:
        flow: sizes; one hidden layer, no weight normalisation.
        classes: how many conditions there are, given as one-hot vectors.
        names: of the classes.
        stripes: into how many the matrices are cut.
    """

    flow: FlowSpec = field(default_factory=lambda: FlowSpec(dims=784, layers=1, hidden=8))
    classes: int = 10
    names: tuple[str, ...] = ()
    stripes: int = 14
    kind: Literal["wide"] = "wide"

    def __post_init__(self) -> None:
        if self.flow.layers != 1 or self.flow.weight_norm != "none":
            raise ValueError(
                f"a wide flow has one hidden layer and no weight normalisation, found layers="
                f"{self.flow.layers}, weight_norm={self.flow.weight_norm!r}"
            )
        if not 1 <= self.stripes <= self.flow.dims or self.classes < 1:
            raise ValueError(
                f"stripes must be from 1 to {self.flow.dims} and classes at least 1, found {self.stripes} and "
                f"{self.classes}"
            )
        if self.names and len(self.names) != self.classes:
            raise ValueError(f"{self.classes} classes have {len(self.names)} names")

    @property
    def cuts(self) -> tuple[tuple[int, int], ...]:
        """First dimension and end of each stripe."""
        edges = [self.flow.dims * i // self.stripes for i in range(self.stripes + 1)]
        return tuple(pairwise(edges))

    @property
    def groups(self) -> tuple[int, ...]:
        """Sizes of the parts of theta, in the order of `Factors`."""
        D, H = self.flow.dims, self.flow.hidden
        return (D, D, D * H, D * H, D * H, D * H, D * H, D, D)

    @property
    def parameters(self) -> int:
        """P, the length of theta."""
        return sum(self.groups)

    @property
    def shared(self) -> int:
        """Numbers in the shared matrices, the masked triangles of the stripes included."""
        H = self.flow.hidden
        return sum(2 * H * (b - a) * b for a, b in self.cuts)


def from_dict(data: dict[str, Any]) -> WideConfig:
    """The configuration that `dataclasses.asdict` made plain. Raises ValueError for another kind or key."""
    known = {f.name for f in fields(WideConfig)}
    if data.get("kind") != "wide" or set(data) - known:
        raise ValueError(f"a wide flow has kind 'wide' and the keys {sorted(known)}, found {sorted(data)}")
    flow = FlowSpec(**data["flow"])
    return WideConfig(**{**data, "flow": flow, "names": tuple(data.get("names", ()))})
