"""Heads that only comparisons need: affine and spline flows from zuko (extra `bench`), conditioned on features.

`build` makes a model of any head. theta of these heads holds location, scale and the features themselves: a
zuko flow has weights of its own and reads the condition as an input, where HCNAF's weights are the condition's.

References:
    Papamakarios et al., Masked autoregressive flow, 2017 (cMAF, stacked affine transformations).
    Durkan et al., Neural spline flows, 2019.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from hcnaf_models import model
from hcnaf_models.config import HeadKind, ModelConfig
from hcnaf_models.heads import UnitsHead, make_head
from hcnaf_models.spec import FlowSpec
from hcnaf_runtime.errors import MissingExtraError

if TYPE_CHECKING:
    from hcnaf_models.model import Hcnaf

AFFINE_TRANSFORMS = 5
SPLINE_TRANSFORMS, SPLINE_BINS = 3, 8
WIDTHS = (64, 64)
"""Hidden layers of every transformation's network."""


class ZukoHead(UnitsHead):
    """A conditional flow of zuko's over u, with the features as its context."""

    uniforms = 2

    def __init__(self, flow: Any, features: int) -> None:
        super().__init__(features)
        self.flow = flow

    def emit(self, features: Tensor) -> Tensor:
        """The features."""
        return features

    def unit_log_prob(self, rest: Tensor, u: Tensor) -> Tensor:
        """See `UnitsHead`."""
        log_p: Tensor = self.flow(rest.unsqueeze(-2).expand(*u.shape[:-1], -1)).log_prob(u)
        return log_p

    def unit_sample(self, rest: Tensor, uniform: Tensor) -> Tensor:
        """See `UnitsHead`: the image of base points under the inverse flow."""
        z = torch.special.ndtri(uniform.clamp(1e-7, 1.0 - 1e-7))
        u: Tensor = self.flow(rest.unsqueeze(-2).expand(*z.shape[:-1], -1)).transform.inv(z)
        return u


def make_any_head(kind: HeadKind, spec: FlowSpec, features: int) -> nn.Module:
    """`hcnaf_models.heads.HeadMaker` for all kinds. Raises MissingExtraError where zuko is needed and missing."""
    if kind in ("hcnaf", "mixture"):
        return make_head(kind, spec, features)
    try:
        from zuko import flows
    except ModuleNotFoundError as error:
        raise MissingExtraError(f'head {kind} needs zuko; run: pip install "hcnaf[bench]"') from error
    if kind == "affine":
        flow = flows.MAF(2, features, transforms=AFFINE_TRANSFORMS, hidden_features=WIDTHS)
    else:
        flow = flows.NSF(2, features, bins=SPLINE_BINS, transforms=SPLINE_TRANSFORMS, hidden_features=WIDTHS)
    return ZukoHead(flow, features)


def build(config: ModelConfig) -> Hcnaf:
    """A freshly initialised model with any head (draws from torch's global generator)."""
    return model.build(config, make_any_head)
