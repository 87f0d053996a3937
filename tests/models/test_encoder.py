"""The encoder's convolutions see their place, and training takes the same gradients a faster way."""

import pytest
import torch
from torch import Tensor

from hcnaf_models.encoder import CoordConv, Encoder


def _plane(rows: int, columns: int) -> Tensor:
    y, x = torch.meshgrid(torch.linspace(-1, 1, rows), torch.linspace(-1, 1, columns), indexing="ij")
    return torch.stack([x, y])


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("form", [torch.contiguous_format, torch.channels_last])
def test_a_coordconv_is_a_convolution_over_image_and_coordinates(
    training: bool, form: torch.memory_format
) -> None:
    torch.manual_seed(0)
    conv = CoordConv(3, 4, stride=2).train(training)
    image = torch.randn(5, 3, 8, 12).contiguous(memory_format=form).requires_grad_()
    weight = torch.randn(5, 4, 4, 6)

    found = conv(image)
    gradients = torch.autograd.grad((found * weight).sum(), [image, conv.image.weight, conv.place.weight])

    both = torch.cat([image, _plane(8, 12).expand(5, -1, -1, -1)], dim=1)
    kernel = torch.cat([conv.image.weight, conv.place.weight], dim=1)
    expected = torch.nn.functional.conv2d(both, kernel, stride=2, padding=1)
    wanted = torch.autograd.grad((expected * weight).sum(), [image, conv.image.weight, conv.place.weight])
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)
    for mine, other in zip(gradients, wanted, strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-4, atol=1e-5)


def test_what_training_sees_is_what_is_exported() -> None:
    torch.manual_seed(0)
    encoder = Encoder(4, 16, 32, (4, 8, 8), 6)
    image = torch.randn(6, 4, 16, 32)
    for norm in (m for m in encoder.modules() if isinstance(m, torch.nn.BatchNorm2d)):
        norm.momentum = 1.0  # so that evaluation uses this batch's statistics, but for n / (n - 1)
    trained = encoder(image)
    torch.testing.assert_close(encoder.eval()(image), trained, rtol=5e-2, atol=2e-2)
