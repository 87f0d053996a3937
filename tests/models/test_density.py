"""The layout that ships gives the numbers of the flow's one primitive, near and far."""

import pytest
import torch

from hcnaf_models import FlowSpec, flow
from hcnaf_models.density import density, fast_log_interval
from hcnaf_models.normal import log_interval
from tests.models.flows import name, random_theta

SPECS = [
    FlowSpec(layers=1, hidden=3),
    FlowSpec(layers=2, hidden=20),
    FlowSpec(layers=3, hidden=20, weight_norm="row"),
    FlowSpec(layers=2, hidden=20, support="paper"),
    FlowSpec(layers=3, hidden=100),
]


@pytest.mark.parametrize("spec", SPECS, ids=name)
@pytest.mark.parametrize("scale", [1.0, 30.0, 1e6])
def test_equals_the_primitive(spec, scale):
    theta = torch.stack([random_theta(spec, s) for s in (1, 2, 3)])
    points = scale * torch.randn(3, 40, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    image = flow.forward(spec, theta, points)
    found = density(spec, theta, points)
    expected = flow.log_prob_terms(spec, image).sum(-1)
    torch.testing.assert_close(found.log_prob, expected, rtol=1e-9, atol=1e-8)
    torch.testing.assert_close(found.z, image.z, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(found.log_det, image.log_dz.sum(-1), rtol=1e-9, atol=1e-8)
    assert found.log_prob.shape == (3, 40)


@pytest.mark.parametrize("spec", SPECS, ids=name)
def test_finite_in_single_precision(spec):
    theta = torch.stack([random_theta(spec, s) for s in (1, 2)]).float()
    points = torch.tensor([[0.0, 0.0], [1e6, -1e6], [-1e6, 3.0], [2.0, 1e6]]).expand(2, -1, -1)
    assert torch.isfinite(density(spec, theta, points).log_prob).all()


def test_fast_log_interval_where_the_interval_holds_much():
    a, b = torch.linspace(-3.0, 0.5, 50), torch.linspace(1.0, 6.0, 50)
    torch.testing.assert_close(fast_log_interval(a, b), log_interval(a, b), rtol=0, atol=2e-6)
