"""The bird's-eye-view encoder: coordconv residual stages (paper: section 4 and figure 5).

References:
    Liu et al., An intriguing failing of convolutional neural networks and the CoordConv solution, 2018.
    He et al., Deep residual learning, 2016.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn


class CoordConv(nn.Module):
    """A 2-D convolution that also sees its own x and y coordinates in [-1, 1].

    A convolution is linear, so the coordinates' part is one small map added to every image of the batch: nothing
    is concatenated, and an exported graph holds it as a constant.
    """

    def __init__(self, channels: int, out: int, kernel: int = 3, stride: int = 1) -> None:
        super().__init__()
        self.image = nn.Conv2d(channels, out, kernel, stride, kernel // 2, bias=False)
        self.place = nn.Conv2d(2, out, kernel, stride, kernel // 2, bias=False)

    def forward(self, image: Tensor) -> Tensor:
        rows, columns = image.shape[-2:]
        y = torch.linspace(-1.0, 1.0, rows, dtype=image.dtype, device=image.device)
        x = torch.linspace(-1.0, 1.0, columns, dtype=image.dtype, device=image.device)
        plane = torch.stack([x.expand(rows, columns), y.unsqueeze(-1).expand(rows, columns)])
        place = self.place(plane.unsqueeze(0))
        if self.training:
            sums: Tensor = _OverBatch.apply(self.image(image), place)  # type: ignore[no-untyped-call]
            return sums
        out: Tensor = self.image(image) + place
        return out


class _OverBatch(torch.autograd.Function):
    """images [B, ...] + one image [1, ...], whose gradient, a sum over the batch, is taken as a product: several
    times as fast as a sum where channels come last."""

    @staticmethod
    def forward(ctx: Any, images: Tensor, one: Tensor) -> Tensor:
        return images + one

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor]:
        (gradient,) = gradients
        flat = gradient.movedim(1, -1)  # without a copy where channels come last
        total = flat.new_ones(1, len(flat)) @ flat.reshape(len(flat), -1)
        return gradient, total.reshape(1, *flat.shape[1:]).movedim(-1, 1)


class ResidualBlock(nn.Module):
    """Two 3 x 3 coordconvs with batch norm; a 1 x 1 coordconv carries the residual when channels change."""

    def __init__(self, channels: int, out: int) -> None:
        super().__init__()
        self.first, self.first_norm = CoordConv(channels, out), nn.BatchNorm2d(out)
        self.second, self.second_norm = CoordConv(out, out), nn.BatchNorm2d(out)
        self.skip = CoordConv(channels, out, kernel=1) if channels != out else nn.Identity()

    def forward(self, image: Tensor) -> Tensor:
        h = torch.relu(self.first_norm(self.first(image)))
        return torch.relu(self.second_norm(self.second(h)) + self.skip(image))


class Encoder(nn.Module):
    """image [B, C, rows, columns] -> features [B, size].

    A strided stem, then per further width max-pooling and a residual block; what remains of the image is
    read by one linear layer, so that places keep their identity.
    """

    def __init__(self, channels: int, rows: int, columns: int, widths: tuple[int, ...], size: int) -> None:
        super().__init__()
        self.stem, self.stem_norm = CoordConv(channels, widths[0], stride=2), nn.BatchNorm2d(widths[0])
        stages = [nn.Sequential(nn.MaxPool2d(2), ResidualBlock(a, b)) for a, b in pairwise(widths)]
        self.stages = nn.Sequential(*stages)
        factor = 2 ** len(widths)
        self.out = nn.Linear(widths[-1] * (rows // factor) * (columns // factor), size)

    def forward(self, image: Tensor) -> Tensor:
        if self.training:  # on a CPU a training step is a third faster with channels last
            image = image.contiguous(memory_format=torch.channels_last)
        h = self.stages(torch.relu(self.stem_norm(self.stem(image))))
        return torch.relu(self.out(h.flatten(1)))
