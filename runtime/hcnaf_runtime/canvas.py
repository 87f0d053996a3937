"""The maps that are being filled, and what their columns hold."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hcnaf_runtime.plane import Distribution, Window

Float32 = npt.NDArray[np.float32]
Indices = npt.NDArray[np.intp]


ROUNDED = 5e-7
"""What float32 rounds off the sum of a map."""


@dataclass(frozen=True)
class Canvas:
    """The maps that are filled: theta [B, P], their window, mass [., R, C] to be written, which of it is theirs
    [B], and the most numbers in an intermediate of a run."""

    flow: Distribution
    theta: Float32
    window: Window
    mass: Float32
    maps: Indices
    chunk: int

    @property
    def rows(self) -> int:
        """R."""
        return len(self.window.y) - 1


def column_sums(mass: Float32) -> Float32:
    """[..., w] from [..., rows, w]: as a product, several times as fast as a sum."""
    return np.asarray((np.ones((1, mass.shape[-2]), np.float32) @ mass)[..., 0, :])


def settle(mass: Float32, total: Float32, out: Float32) -> Float32:
    """`mass` [..., rows, w] without what is below 0, in `out`, which may be `mass`. Where that is more than
    rounding in a map the other rows give way, so that columns keep their sums, `total` [..., w].

    Returns how far below 0 it was [...].
    """
    below = np.maximum(-mass.min(axis=(-2, -1)), 0.0)
    np.maximum(mass, 0.0, out=out)
    kept = column_sums(out)
    much = (kept - total).sum(axis=-1) > ROUNDED
    if much.any():
        share = np.maximum(total, 0.0) / np.maximum(kept, 1e-30)
        out *= np.where(much[..., None], share, np.float32(1.0))[..., None, :]
    return np.asarray(below)
