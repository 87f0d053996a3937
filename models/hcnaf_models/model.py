"""A whole model: the hyper-network of a configuration and the density of its flow."""

from __future__ import annotations

from torch import Tensor, nn

from hcnaf_models import flow
from hcnaf_models.config import ConditionConfig, ModelConfig
from hcnaf_models.mlp import ConditionHyperNet
from hcnaf_models.pom import PomHyperNet


class Hcnaf(nn.Module):
    """f_H and f of one configuration: `hypernet(...)` gives theta, `log_prob` evaluates it."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        self.hypernet: ConditionHyperNet | PomHyperNet = (
            ConditionHyperNet(config) if isinstance(config, ConditionConfig) else PomHyperNet(config)
        )

    def log_prob(self, theta: Tensor, x: Tensor) -> Tensor:
        """log p(x | theta) [..., N] for theta [..., P] and x [..., N, D]: nats per unit of x to the D (eq. 1)."""
        return flow.log_prob(self.config.flow, theta, x)


def build(config: ModelConfig) -> Hcnaf:
    """A freshly initialised model (draws from torch's global generator)."""
    return Hcnaf(config)
