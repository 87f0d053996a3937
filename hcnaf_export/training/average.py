"""An exponential average of a model's weights: smoother, and better in likelihood, than the last iterate."""

from __future__ import annotations

import copy
from typing import Generic, TypeVar

import torch
from torch import Tensor, nn

M = TypeVar("M", bound=nn.Module)


class Average(Generic[M]):
    """w_avg <- d w_avg + (1 - d) w with d = min(decay, (1 + n) / (10 + n)) after n updates; buffers are copied.

    Args:
        model: starts the average.
        decay: in [0, 1).
    """

    def __init__(self, model: M, decay: float) -> None:
        self.model: M = copy.deepcopy(model).eval().requires_grad_(False)
        self.decay, self.count = decay, 0

    @torch.no_grad()
    def update(self, model: M) -> None:
        """Take in the weights of `model` after a step."""
        weight = 1.0 - min(self.decay, (1.0 + self.count) / (10.0 + self.count))
        self.count += 1
        mine: list[Tensor] = [p.detach() for p in self.model.parameters()]
        torch._foreach_lerp_(mine, [p.detach() for p in model.parameters()], weight)
        for old, new in zip(self.model.buffers(), model.buffers(), strict=True):
            old.copy_(new)
