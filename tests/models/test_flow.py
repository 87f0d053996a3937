"""Laws of the flow: Jacobian, triangularity, limits, normalisation, batching, range."""

import math

import pytest
import torch
from scipy import integrate

from hcnaf_models import FlowSpec, flow
from hcnaf_models.reference import forward_and_log_det, log_prob_published
from tests.models.flows import SPECS, name, random_theta

pytestmark = pytest.mark.parametrize("spec", SPECS, ids=name)


def points(spec, count=12, spread=3.0, seed=1):
    generator = torch.Generator().manual_seed(seed)
    return spread * torch.randn(count, spec.dims, generator=generator, dtype=torch.float64)


def jacobian(spec, theta, x):
    def image(v):
        return flow.forward(spec, theta, v.unsqueeze(0)).z[0]

    return torch.stack([torch.autograd.functional.jacobian(image, row) for row in x])


def test_log_determinant_is_that_of_the_autograd_jacobian(spec):
    theta, x = random_theta(spec, 0), points(spec)
    log_dz = flow.forward(spec, theta, x).log_dz
    expected = torch.log(torch.diagonal(jacobian(spec, theta, x), dim1=-2, dim2=-1))
    torch.testing.assert_close(log_dz, expected, rtol=0, atol=1e-9)


def test_jacobian_is_lower_triangular_with_positive_diagonal(spec):
    J = jacobian(spec, random_theta(spec, 3), points(spec))
    assert torch.equal(torch.triu(J, 1), torch.zeros_like(J))
    assert (torch.diagonal(J, dim1=-2, dim2=-1) > 0).all()


def test_agrees_with_the_published_log_sum_exp_form(spec):
    theta, x = random_theta(spec, 4), points(spec)
    image = flow.forward(spec, theta, x)
    z, log_dz = forward_and_log_det(spec, theta, x)
    torch.testing.assert_close(image.z, z, rtol=0, atol=1e-9)
    torch.testing.assert_close(image.log_dz, log_dz, rtol=0, atol=1e-9)
    paper = FlowSpec(dims=spec.dims, layers=spec.layers, hidden=spec.hidden, support="paper")
    torch.testing.assert_close(
        flow.log_prob(paper, theta, x), log_prob_published(spec, theta, x), rtol=0, atol=1e-8
    )


def test_limits_are_the_images_of_infinity(spec):
    theta, x = random_theta(spec, 5), points(spec)
    image = flow.forward(spec, theta, x)
    for d in range(spec.dims):
        for sign, limit in ((1.0, image.z_plus), (-1.0, image.z_minus)):
            far = x.clone()
            far[:, d] = sign * 1e9
            z = flow.forward(spec, theta, far).z[:, d]
            torch.testing.assert_close(z, limit[:, d], rtol=0, atol=1e-12)
    assert (image.z_minus < image.z).all()
    assert (image.z < image.z_plus).all()


def test_batch_equals_stacked_singles(spec):
    thetas = torch.stack([random_theta(spec, s) for s in (6, 7, 8)])
    x = torch.stack([points(spec, seed=s) for s in (6, 7, 8)])
    batch = flow.log_prob(spec, thetas, x)
    single = torch.stack([flow.log_prob(spec, t, row) for t, row in zip(thetas, x, strict=True)])
    torch.testing.assert_close(batch, single, rtol=0, atol=1e-12)
    alone = torch.cat([flow.log_prob(spec, thetas[0], row.unsqueeze(0)) for row in x[0]])
    torch.testing.assert_close(batch[0], alone, rtol=0, atol=1e-12)


def test_finite_everywhere_in_float32(spec):
    theta = random_theta(spec, 9, roughness=1.5, scale=0.05).float()
    extremes = torch.tensor([0.0, 1e-40, 1.0, -30.0, 1e4, -1e6, 1e6])
    x = torch.cartesian_prod(*[extremes] * min(spec.dims, 3))
    x = x.reshape(len(x), -1)
    x = torch.cat([x, x[:, :1].expand(-1, spec.dims - x.shape[1])], dim=1).requires_grad_()
    log_prob = flow.log_prob(spec, theta, x)
    assert torch.isfinite(log_prob).all()
    (gradient,) = torch.autograd.grad(log_prob.sum(), x)
    assert torch.isfinite(gradient).all()


def test_normalised_density_integrates_to_one(spec):
    if spec.dims > 2 or spec.support == "paper":
        spec = FlowSpec(dims=2, layers=spec.layers, hidden=spec.hidden, weight_norm=spec.weight_norm)
    theta = random_theta(spec, 10)

    def line(prefix):
        def density(x):
            row = torch.tensor([[*prefix, x]], dtype=torch.float64)
            padded = torch.cat([row, torch.zeros(1, spec.dims - row.shape[1], dtype=torch.float64)], dim=1)
            return math.exp(float(flow.log_prob_terms(spec, flow.forward(spec, theta, padded))[0, len(prefix)]))

        return sum(integrate.quad(density, a, b, limit=400)[0] for a, b in SPANS)

    assert line([]) == pytest.approx(1.0, abs=1e-3)
    if spec.dims == 2:
        assert line([0.7]) == pytest.approx(1.0, abs=1e-3)
        assert line([-4.0]) == pytest.approx(1.0, abs=1e-3)


SPANS = [(-1e5, -1e3), (-1e3, -50.0), (-50.0, -5.0), (-5.0, 0.0), (0.0, 5.0), (5.0, 50.0), (50.0, 1e3), (1e3, 1e5)]
