"""Laws of the distribution functions: against quadrature of the density, telescoping, tails."""

import itertools

import numpy as np
import pytest
import torch
from scipy import integrate, stats

from hcnaf_models import FlowSpec, flow, planar
from hcnaf_models.normal import erf_fraction, interval_fraction, log_interval
from tests.models.flows import name, random_theta

SPECS = [
    FlowSpec(layers=2, hidden=20),
    FlowSpec(layers=3, hidden=20, weight_norm="row"),
    FlowSpec(layers=2, hidden=20, support="paper"),
    FlowSpec(layers=3, hidden=100),
]


def gauss_mass(spec, theta, x0, x1, y0, y1, order=48):
    """Mass of one cell by a Gauss-Legendre product rule on the density."""
    nodes, weights = (torch.from_numpy(v) for v in np.polynomial.legendre.leggauss(order))
    x = 0.5 * (x1 - x0) * nodes + 0.5 * (x0 + x1)
    y = 0.5 * (y1 - y0) * nodes + 0.5 * (y0 + y1)
    p = flow.log_prob(spec, theta, torch.cartesian_prod(x, y)).exp().reshape(order, order)
    return float(weights @ p @ weights) * 0.25 * (x1 - x0) * (y1 - y0)


def columns(edges, parts):
    """Nodes, exact-increment weights' rows and finer edges for cells with `parts` sub-columns each."""
    fine = torch.from_numpy(
        np.concatenate([np.linspace(a, b, parts, endpoint=False) for a, b in itertools.pairwise(edges)])
    )
    return torch.cat([fine, torch.tensor([edges[-1]], dtype=torch.float64)])


def masses(spec, theta, edges, parts=512):
    fine = columns(edges, parts)
    F = planar.marginal_cdf(spec, theta[None], fine[None])[0]
    count = len(edges) - 1
    weight = torch.zeros(1, count * parts, count, dtype=torch.float64)
    for c in range(count):
        weight[0, c * parts : (c + 1) * parts, c] = (F[1:] - F[:-1])[c * parts : (c + 1) * parts]
    nodes = 0.5 * (fine[1:] + fine[:-1])
    y = torch.tensor(edges, dtype=torch.float64)
    found = planar.cell_mass(spec, theta[None], nodes[None], weight, weight, y[None])
    torch.testing.assert_close(found.error[0], found.mass[0].amax(0), rtol=0, atol=1e-12)
    return found.mass[0], F, nodes, y


@pytest.mark.parametrize("spec", SPECS, ids=name)
def test_cell_masses_are_integrals_of_the_density(spec):
    theta = random_theta(spec, 11, scale=1.0)
    edges = [-2.0, -1.0, -0.25, 0.25, 1.0, 2.5]
    mass, *_ = masses(spec, theta, edges)
    for row, (y0, y1) in enumerate(itertools.pairwise(edges)):
        for column, (x0, x1) in enumerate(itertools.pairwise(edges)):
            expected = gauss_mass(spec, theta, x0, x1, y0, y1)
            assert float(mass[row, column]) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("spec", SPECS, ids=name)
def test_columns_telescope(spec):
    theta = random_theta(spec, 12, scale=1.0)
    edges = [-1e5, -2.0, 0.0, 1.0, 1e5]
    mass, F, nodes, _ = masses(spec, theta, edges, parts=3)
    increments = (F[1:] - F[:-1]).reshape(-1, 3)
    if spec.support == "paper":
        ends = torch.tensor([[-1e5, 1e5]], dtype=torch.float64)
        top = planar.grid_cdf(spec, theta[None], nodes[None], ends)
        increments = increments * (top[0, 1] - top[0, 0]).reshape(-1, 3)
    torch.testing.assert_close(mass.sum(0), increments.sum(1), rtol=0, atol=1e-9)


@pytest.mark.parametrize("spec", SPECS[:2], ids=name)
def test_marginal_cdf_is_the_integral_of_the_marginal(spec):
    theta = random_theta(spec, 13)

    def density(x):
        row = torch.tensor([[x, 0.0]], dtype=torch.float64)
        return float(flow.log_prob_terms(spec, flow.forward(spec, theta, row))[0, 0].exp())

    x = torch.tensor([[-1.0, 2.0]], dtype=torch.float64)
    F = planar.marginal_cdf(spec, theta[None], x)[0]
    expected = integrate.quad(density, -1.0, 2.0, limit=200)[0]
    assert float(F[1] - F[0]) == pytest.approx(expected, abs=1e-6)


def test_a_grid_is_its_points():
    spec = SPECS[0]
    theta = torch.stack([random_theta(spec, s) for s in (1, 2)])
    x, y = torch.randn(2, 5, dtype=torch.float64), torch.linspace(-3, 3, 7, dtype=torch.float64)
    grid = planar.grid_cdf(spec, theta, x, y.expand(2, 7))
    points = planar.conditional_cdf(spec, theta, x, y.expand(2, 5, 7))
    torch.testing.assert_close(grid.transpose(1, 2), points, rtol=0, atol=1e-14)
    assert grid.shape == (2, 7, 5)


def test_columns_keep_their_mass_where_weights_of_both_signs_make_cells_negative():
    spec = SPECS[0]
    theta = random_theta(spec, 15, scale=1.0)
    x, y = torch.tensor([[-1.0, 0.0, 1.0]], dtype=torch.float64), torch.linspace(-6, 6, 60, dtype=torch.float64)
    weight = torch.tensor([[[-0.3], [1.6], [-0.3]]], dtype=torch.float64)
    found = planar.cell_mass(spec, theta[None], x, weight, 0.0 * weight, y[None])
    F = planar.grid_cdf(spec, theta[None], x, y[None])
    raw = (F[:, 1:] - F[:, :-1]) @ weight
    assert raw.min() < -1e-4
    assert found.mass.min() >= 0
    torch.testing.assert_close(found.mass.sum(1), raw.sum(1), rtol=0, atol=1e-12)
    torch.testing.assert_close(found.error[0, 0], -raw.clamp(max=0).sum(), rtol=0, atol=1e-12)


@pytest.mark.parametrize("spec", SPECS, ids=name)
def test_distribution_functions_come_from_the_images_of_forward(spec):
    """The hot path, with contexts folded into the weights, against the flow's one primitive."""
    theta = random_theta(spec, 14)
    x = torch.randn(1, 6, dtype=torch.float64) + 1.0
    y = 2.0 * torch.randn(1, 6, 9, dtype=torch.float64)
    pairs = torch.stack([x.unsqueeze(-1).expand_as(y), y], dim=-1).reshape(1, -1, 2)
    image = flow.forward(spec, theta[None], pairs)
    F = flow.distribution(spec, image.z, image.z_minus, image.z_plus)
    torch.testing.assert_close(
        planar.conditional_cdf(spec, theta[None], x, y).reshape(1, -1), F[..., 1], rtol=0, atol=1e-9
    )
    torch.testing.assert_close(planar.marginal_cdf(spec, theta[None], pairs[..., 0]), F[..., 0], rtol=0, atol=1e-9)


BOUNDS = [(-1.0, 2.0), (-12.0, -11.0), (5.0, 30.0), (-30.0, 30.0), (-40.0, -39.9), (0.0, 0.5), (9.0, 9.001)]


@pytest.mark.parametrize(("a", "b"), BOUNDS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_log_interval_in_either_tail(a, b, dtype):
    lo, hi = (a, b) if a + b <= 0 else (-b, -a)
    expected = stats.norm.logcdf(hi) + np.log1p(-np.exp(stats.norm.logcdf(lo) - stats.norm.logcdf(hi)))
    value = log_interval(torch.tensor(a, dtype=dtype), torch.tensor(b, dtype=dtype))
    assert float(value) == pytest.approx(expected, rel=3e-7, abs=2e-5 if b - a > 0.01 else 2e-3)


@pytest.mark.parametrize(("a", "b"), BOUNDS)
def test_interval_fraction_runs_from_zero_to_one(a, b):
    z = torch.linspace(a, b, 33, dtype=torch.float64)
    F = interval_fraction(z, z[0], z[-1])
    expected = stats.truncnorm.cdf(z.numpy(), a, b)
    np.testing.assert_allclose(F.numpy(), expected, atol=3e-7)
    assert float(F[0]) == 0.0
    assert float(F[-1]) == 1.0


def test_erf_fraction_is_accurate_where_the_interval_holds_much():
    z = torch.linspace(-2.0, 3.0, 33)
    expected = stats.truncnorm.cdf(z.double().numpy(), -2.0, 3.0)
    np.testing.assert_allclose(erf_fraction(z, z[0], z[-1]).numpy(), expected, atol=3e-7)
