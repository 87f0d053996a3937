"""A whole model: the hyper-network of a configuration and the density of its head."""

from __future__ import annotations

from typing import cast

from torch import Tensor, nn

from hcnaf_models.config import ConditionConfig, ModelConfig, PomConfig
from hcnaf_models.heads import DensityHead, HeadMaker, make_head
from hcnaf_models.history import HistoryHyperNet, TrackCondition
from hcnaf_models.mlp import ConditionHyperNet
from hcnaf_models.pom import PomHyperNet

HyperNet = ConditionHyperNet | PomHyperNet | HistoryHyperNet | TrackCondition


class Hcnaf(nn.Module):
    """f_H and f of one configuration: `hypernet(...)` gives theta, `log_prob` evaluates it."""

    def __init__(self, config: ModelConfig, make: HeadMaker = make_head) -> None:
        super().__init__()
        self.config = config
        self.hypernet: HyperNet = _hypernet(config, make)

    @property
    def head(self) -> DensityHead:
        """The density that theta is of."""
        return cast("DensityHead", self.hypernet.head)

    def log_prob(self, theta: Tensor, x: Tensor) -> Tensor:
        """log p(x | theta) [..., N] for theta [..., P] and x [..., N, D]: nats per unit of x to the D (eq. 1)."""
        return self.head.log_prob(theta, x)


def build(config: ModelConfig, make: HeadMaker = make_head) -> Hcnaf:
    """A freshly initialised model (draws from torch's global generator); `make` makes its head."""
    return Hcnaf(config, make)


def _hypernet(config: ModelConfig, make: HeadMaker) -> HyperNet:
    if isinstance(config, ConditionConfig):
        return ConditionHyperNet(config)
    return PomHyperNet(config, make) if isinstance(config, PomConfig) else HistoryHyperNet(config, make)
