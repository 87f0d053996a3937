r"""What a density of `paper` support loses: its integral over the plane falls short of 1.

tanh is bounded, so that z_d stays within (z_d(-), z_d(+)) and dimension d keeps R_d = Phi(z_d(+)) - Phi(z_d(-)) of
its mass. R_1 depends on theta alone, R_2 on x_1 too:

    integral of p = R_1 E[R_2(x_1)],  x_1 drawn from p(x_1) / R_1

The expectation is taken over DRAWS quantiles of x_1. A `normalised` density loses nothing.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hcnaf_export.data.tracks import TrackSet
from hcnaf_export.evaluation.checkpoint_predictor import CheckpointPredictor
from hcnaf_models import flow
from hcnaf_models.inverse import inverse
from hcnaf_models.mlp import Head
from hcnaf_models.normal import log_interval
from hcnaf_models.spec import FlowSpec

DRAWS = 16
"""Values of x_1, at the quantiles (k + 1/2) / DRAWS."""


@torch.no_grad()
def lost_mass(
    predictor: CheckpointPredictor, tracks: TrackSet, windows: NDArray[np.int32], horizons: Sequence[float]
) -> NDArray[np.float64]:
    """1 - integral of p over the plane for windows [W, 2] (track, step) at horizons (s): [W, Q]."""
    head = predictor.model.head
    if not isinstance(head, Head) or head.spec.support == "normalised":
        return np.zeros((len(windows), len(horizons)))
    found = [
        lost(head.spec, theta).double().cpu().numpy()
        for _, _, theta in predictor.batches(tracks, windows, horizons)
    ]
    return np.concatenate(found)


def lost(spec: FlowSpec, theta: Tensor) -> Tensor:
    """1 - integral of p, [...] for theta [..., P] of D = 2."""
    u = (torch.arange(DRAWS, dtype=theta.dtype, device=theta.device) + 0.5) / DRAWS
    uniform = torch.stack([u, torch.full_like(u, 0.5)], dim=-1).expand(*theta.shape[:-1], DRAWS, 2)
    normalised = FlowSpec(
        dims=spec.dims, layers=spec.layers, hidden=spec.hidden, support="normalised", weight_norm=spec.weight_norm
    )
    image = flow.forward(spec, theta, inverse(normalised, theta, uniform).x)
    kept = torch.exp(log_interval(image.z_minus, image.z_plus))
    return 1.0 - (kept[..., 0] * kept[..., 1]).mean(-1)
