"""The written-out derivative is that of the flow's density."""

import pytest
import torch

from hcnaf_models import FlowSpec, flow, fused

from .flows import name, random_theta

SPECS = [
    FlowSpec(dims=2, layers=layers, hidden=7, support=support)
    for layers in (1, 2, 3)
    for support in ("normalised", "paper")
] + [FlowSpec(dims=2, layers=2, hidden=3, weight_norm="row")]


def both(spec, theta, x, weight):
    """log p and the derivative of its weighted sum in theta, by `flow` and by `fused`."""
    for log_prob in (flow.log_prob, fused.log_prob):
        leaf = theta.clone().requires_grad_()
        found = log_prob(spec, leaf, x)
        yield found.detach(), torch.autograd.grad((weight * found).sum(), leaf)[0]


@pytest.mark.parametrize("spec", SPECS, ids=name)
@pytest.mark.parametrize("points", [1, 13])
def test_density_and_derivative_are_those_of_the_flow(spec, points):
    theta = torch.stack([random_theta(spec, seed) for seed in (0, 1, 2)])
    generator = torch.Generator().manual_seed(3)
    x = 1.0 + 2.5 * torch.randn(3, points, 2, generator=generator, dtype=torch.float64)
    weight = torch.randn(3, points, generator=generator, dtype=torch.float64)
    (expected, slope), (found, fused_slope) = both(spec, theta, x, weight)
    torch.testing.assert_close(found, expected, rtol=0.0, atol=1e-11)
    # The polynomial for erfcx has a derivative of its own, 1e-7 off.
    torch.testing.assert_close(fused_slope, slope, rtol=1e-6, atol=1e-6 * float(slope.abs().max()))


def test_far_points_have_finite_derivatives_in_float32():
    spec = FlowSpec(dims=2, layers=2, hidden=16)
    theta = random_theta(spec, 4).float().unsqueeze(0).requires_grad_()
    x = torch.tensor([[[1e4, -3.0], [0.0, 1e6], [-300.0, 300.0], [1.0, 1.0]]])
    found = fused.log_prob(spec, theta, x)
    found.sum().backward()
    assert torch.isfinite(found).all()
    assert torch.isfinite(theta.grad).all()
    torch.testing.assert_close(found, flow.log_prob(spec, theta, x), rtol=1e-4, atol=1e-3)


def test_no_derivative_is_asked_for_in_evaluation():
    spec = FlowSpec(dims=2, layers=2, hidden=5)
    theta, x = random_theta(spec, 0).unsqueeze(0), torch.zeros(1, 3, 2, dtype=torch.float64)
    assert not fused.log_prob(spec, theta, x).requires_grad
