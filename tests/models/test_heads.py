"""Every head is a normalised density, and what it samples is distributed by it."""

import math

import pytest
import torch

from hcnaf_models.config import PomConfig, from_dict, to_dict
from hcnaf_models.heads import COMPONENTS, MixtureHead, make_head
from hcnaf_models.model import build
from hcnaf_models.spec import FlowSpec

KINDS = ("hcnaf", "mixture")


def trained(kind: str, seed: int = 0) -> tuple[torch.nn.Module, torch.Tensor]:
    """A head with weights that depend on its features, and theta [3, P] of three of them."""
    torch.manual_seed(seed)
    head = make_head(kind, FlowSpec(layers=2, hidden=6), 4).eval()
    with torch.no_grad():
        for p in head.parameters():
            p.add_(0.15 * torch.randn_like(p))
        anchor = torch.tensor([[1.0, -2.0]]).expand(3, 2)
        return head, head(torch.randn(3, 4), anchor, torch.full((3, 2), 0.7))


def grid(theta_count: int, half: float = 12.0, count: int = 481) -> tuple[torch.Tensor, float]:
    axis = torch.linspace(-half, half, count)
    points = torch.stack(torch.meshgrid(axis + 1.0, axis - 2.0, indexing="ij"), dim=-1).reshape(1, -1, 2)
    return points.expand(theta_count, -1, -1), float(axis[1] - axis[0]) ** 2


@pytest.mark.parametrize("kind", KINDS)
def test_density_integrates_to_one(kind):
    head, theta = trained(kind)
    points, cell = grid(len(theta))
    with torch.no_grad():
        mass = head.log_prob(theta, points).double().exp().sum(-1) * cell
    torch.testing.assert_close(mass, torch.ones_like(mass), atol=0.01, rtol=0.0)


@pytest.mark.parametrize("kind", KINDS)
def test_samples_fall_where_the_mass_is(kind):
    head, theta = trained(kind)
    points, cell = grid(len(theta))
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        x = head.sample(theta, torch.rand(3, 4000, head.uniforms, generator=generator))
        p = head.log_prob(theta, points).double().exp() * cell
        for inside in (lambda v: v[..., 0] < 1.0, lambda v: v[..., 1] < -2.0, lambda v: v.sum(-1) < -0.5):
            expected = (p * inside(points)).sum(-1)
            found = inside(x).double().mean(-1)
            assert (found - expected).abs().max() < 0.035


def test_mixture_is_that_of_torch_distributions():
    head, theta = trained("mixture")
    x = torch.randn(3, 50, 2) * 2.0
    _, scale, rest = torch.split(theta, [2, 2, 6 * COMPONENTS], dim=-1)
    logits, m_1, m_2, a, c, b = (v.squeeze(-2) for v in MixtureHead._parts(rest))
    factors = torch.stack([a.exp(), torch.zeros_like(b), b, c.exp()], dim=-1).unflatten(-1, (2, 2))
    gaussians = torch.distributions.MultivariateNormal(torch.stack([m_1, m_2], dim=-1), scale_tril=factors)
    mixture = torch.distributions.MixtureSameFamily(torch.distributions.Categorical(logits=logits), gaussians)
    u = (x - theta[:, None, :2]) / scale[:, None]
    expected = mixture.log_prob(u.transpose(0, 1)).transpose(0, 1) - scale.log().sum(-1, keepdim=True)
    torch.testing.assert_close(head.log_prob(theta, x), expected, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_theta_starts_independent_of_the_features_and_around_the_anchor(kind):
    head = make_head(kind, FlowSpec(), 4)
    anchor = torch.tensor([[3.0, 1.0]]).expand(5, 2)
    theta = head(torch.randn(5, 4), anchor, torch.ones(5, 2))
    torch.testing.assert_close(theta, theta[:1].expand_as(theta))
    torch.testing.assert_close(theta[:, :2], anchor)


@pytest.mark.parametrize("kind", KINDS)
def test_the_anchor_moves_the_density_and_the_spread_scales_it(kind):
    head, _ = trained(kind)
    features, x = torch.randn(1, 4), torch.randn(1, 30, 2)
    zero, one = torch.zeros(1, 2), torch.ones(1, 2)
    plain = head.log_prob(head(features, zero, one), x)
    moved = head.log_prob(head(features, zero + 5.0, one), x + 5.0)
    wide = head.log_prob(head(features, zero, 4.0 * one), 4.0 * x)
    torch.testing.assert_close(moved, plain, atol=1e-3, rtol=1e-3)
    torch.testing.assert_close(wide, plain - 2.0 * math.log(4.0), atol=1e-3, rtol=1e-3)


def test_a_forecast_of_scenes_takes_any_head():
    config = PomConfig(head="mixture", channels=(), draw_actors=False)
    model = build(from_dict(to_dict(config)))
    theta = model.hypernet(torch.randn(2, 10, 5), torch.ones(2, 2), torch.ones(2, 3))
    assert model.log_prob(theta, torch.zeros(2, 3, 4, 2)).shape == (2, 3, 4)


def test_heads_of_other_packages_are_refused_by_name():
    with pytest.raises(ValueError, match=r"head 'spline'.*hcnaf_export\.baselines"):
        make_head("spline", FlowSpec(), 4)
