"""HCNAF in PyTorch as the runtime's maps see it: the same cells as a bundle's, without a bundle."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hcnaf_models import planar
from hcnaf_models.spec import FlowSpec
from hcnaf_runtime.plane import Distribution

Float32 = NDArray[np.float32]


class TorchPlane(Distribution):
    """The distribution functions of a flow with D = 2. Shapes and units as in `hcnaf_runtime.plane`."""

    def __init__(self, spec: FlowSpec, device: torch.device) -> None:
        self._spec, self._device = spec, device

    @property
    def hidden(self) -> int:
        """H."""
        return self._spec.hidden

    def marginal_cdf(self, theta: Float32, x: Float32) -> Float32:
        """F_1."""
        return _array(planar.marginal_cdf(self._spec, self._tensor(theta), self._tensor(x)))

    def conditional_cdf(self, theta: Float32, x: Float32, y: Float32) -> Float32:
        """F_2 at points of their own."""
        return _array(planar.conditional_cdf(self._spec, self._tensor(theta), self._tensor(x), self._tensor(y)))

    def grid_cdf(self, theta: Float32, x: Float32, y: Float32) -> Float32:
        """F_2 on a grid."""
        return _array(planar.grid_cdf(self._spec, self._tensor(theta), self._tensor(x), self._tensor(y)))

    def cell_mass(
        self, theta: Float32, x: Float32, weight: Float32, doubt: Float32, y: Float32
    ) -> tuple[Float32, Float32]:
        """Masses and errors."""
        p, s, w, d, e = (self._tensor(v) for v in (theta, x, weight, doubt, y))
        found = planar.cell_mass(self._spec, p, s, w, d, e)
        return _array(found.mass), _array(found.error)

    def each(self, work: Callable[[Any], object], items: Iterable[Any]) -> None:
        """One after the other: PyTorch has threads of its own."""
        for item in items:
            work(item)

    def _tensor(self, value: Float32) -> Tensor:
        return torch.from_numpy(np.require(value, requirements=("C", "W"))).to(self._device)


def _array(value: Tensor) -> Float32:
    found: Float32 = value.cpu().numpy()
    return found
