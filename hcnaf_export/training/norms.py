"""Batch norm over the batches of all processes, so that N processes compute what one does.

On a GPU this is `torch.nn.SyncBatchNorm`, which exists there alone; `SharedBatchNorm` is the same for processes on
CPUs. Both take over weights and buffers, so that states and averages of a run know nothing of them.
"""

from __future__ import annotations

from typing import Any, cast

import torch
import torch.distributed as dist
from torch import Tensor, nn


def share_norms(model: nn.Module, device: torch.device) -> None:
    """Replace batch norms inside `model`, in place, for training by all processes of the default group."""
    if device.type == "cuda":
        nn.SyncBatchNorm.convert_sync_batchnorm(model)  # type: ignore[no-untyped-call]
        return
    for module in list(model.modules()):
        for name, child in module.named_children():
            if type(child) is nn.BatchNorm2d:
                setattr(module, name, SharedBatchNorm(child))


class SharedBatchNorm(nn.BatchNorm2d):
    """A batch norm whose mean and variance are those of all processes' images, which are as many in each."""

    def __init__(self, norm: nn.BatchNorm2d) -> None:
        super().__init__(norm.num_features, norm.eps, norm.momentum)
        self.weight, self.bias = norm.weight, norm.bias
        self.running_mean, self.running_var = norm.running_mean, norm.running_var
        self.num_batches_tracked = norm.num_batches_tracked
        self.train(norm.training)

    def forward(self, image: Tensor) -> Tensor:
        """image [B, C, rows, columns], normalised per channel."""
        if not self.training:
            return super().forward(image)
        # In float64 the squares of the means cancel without loss, so that one exchange is enough.
        variance, mean = (v.double() for v in torch.var_mean(image, (0, 2, 3), correction=0))
        mean, square = _mean(torch.stack([mean, variance + mean * mean])).unbind()
        variance = square - mean * mean
        self._follow(mean.detach(), variance.detach(), image.numel() // image.shape[1] * dist.get_world_size())
        scale = self.weight * torch.rsqrt(variance + self.eps).to(image.dtype)
        shift = self.bias - mean.to(image.dtype) * scale
        return image * scale[:, None, None] + shift[:, None, None]

    @torch.no_grad()
    def _follow(self, mean: Tensor, variance: Tensor, count: int) -> None:
        """Running statistics, as nn.BatchNorm2d keeps them: the variance is the unbiased one."""
        assert self.running_mean is not None
        assert self.running_var is not None
        assert self.num_batches_tracked is not None
        self.num_batches_tracked.add_(1)
        share = 1.0 / float(self.num_batches_tracked) if self.momentum is None else self.momentum
        self.running_mean.lerp_(mean.to(self.running_mean.dtype), share)
        unbiased = variance * (count / max(count - 1, 1))
        self.running_var.lerp_(unbiased.to(self.running_var.dtype), share)


class _Mean(torch.autograd.Function):
    """The mean over processes, and in the derivative too: each process's value counts in every loss."""

    @staticmethod
    def forward(ctx: Any, value: Tensor) -> Tensor:
        return _reduced(value)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:  # type: ignore[override]
        return _reduced(gradient)


def _mean(value: Tensor) -> Tensor:
    return cast("Tensor", _Mean.apply(value))  # type: ignore[no-untyped-call]


def _reduced(value: Tensor) -> Tensor:
    total = value.clone(memory_format=torch.contiguous_format)
    dist.all_reduce(total)
    return total.div_(dist.get_world_size())
