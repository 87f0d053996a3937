"""The wide flow against the general one, against autograd, and against what a density must do."""

import dataclasses

import numpy as np
import pytest
import torch

from hcnaf_models import flow
from hcnaf_models.spec import FlowSpec, lower_pairs
from hcnaf_models.wide import Factors, WideFlow, below_diagonal, factors, forward, log_slope
from hcnaf_models.wide_config import WideConfig, from_dict
from hcnaf_models.wide_inverse import inverse
from hcnaf_models.wide_loss import mean_nll


def config(dims=7, hidden=3, classes=2, stripes=3, support="normalised"):
    spec = FlowSpec(dims=dims, layers=1, hidden=hidden, support=support)
    return WideConfig(flow=spec, classes=classes, stripes=stripes)


def model(seed=0, dtype=torch.float64, **sizes):
    """A flow with random weights of every kind."""
    generator = torch.Generator().manual_seed(seed)
    made = WideFlow(config(**sizes)).to(dtype)
    made.fit_units(points(made, 50, seed))
    with torch.no_grad():
        for p in made.parameters():
            p += 0.2 * torch.randn(p.shape, generator=generator, dtype=dtype)
        for (a, b), first, second in zip(made.config.cuts, made.first, made.second, strict=True):
            H = made.config.flow.hidden
            first[:, a:] *= below_diagonal(b - a, H, 1)
            second[:, a * H :] *= below_diagonal(b - a, 1, H)
    return made


def points(made, count, seed=0):
    generator = torch.Generator().manual_seed(100 + seed)
    shape = (count, made.config.flow.dims)
    return 1.0 + 3.0 * torch.randn(shape, generator=generator, dtype=made.location.dtype)


def thetas(made):
    return made.theta(torch.eye(made.config.classes, dtype=made.location.dtype))


def whole(config, stripes, out, into):
    """The stripes of a matrix as blocks [D, D, out, into]."""
    D = config.flow.dims
    matrix = torch.zeros(D * out, D * into, dtype=torch.float64)
    for (a, b), stripe in zip(config.cuts, stripes, strict=True):
        matrix[a * out : b * out, : b * into] = stripe
    return matrix.reshape(D, out, D, into).transpose(1, 2)


def general_theta(made, theta):
    """theta [B, P] of the general flow (`hcnaf_models.spec`) with the weights diag(r) W diag(k)."""
    D, H = made.config.flow.dims, made.config.flow.hidden
    rows, columns = (list(v) for v in lower_pairs(D))
    W_1, W_2 = whole(made.config, made.first, H, 1), whole(made.config, made.second, 1, H)
    out = []
    for row in theta:
        f = factors(made.config, row)
        below_1 = f.r_1[rows, :, None] * W_1[rows, columns] * f.k_1[columns, None, None]
        below_2 = f.r_2[rows, None, None] * W_2[rows, columns] * f.k_2[columns, None, :]
        parts = [f.m, f.w, below_1, f.B_1, f.v, below_2, f.B_2]
        out.append(torch.cat([p.flatten() for p in parts]))
    return torch.stack(out)


@pytest.mark.parametrize("sizes", [{}, {"hidden": 1}, {"stripes": 1}, {"dims": 1, "stripes": 1}, {"stripes": 7}])
def test_it_is_the_general_flow_with_weights_of_every_class(sizes):
    made = model(**sizes)
    theta, x = thetas(made), points(made, 5).expand(2, 5, -1)
    expected = flow.forward(made.config.flow, general_theta(made, theta), x)
    for found, wanted in zip(made(theta, x), expected, strict=True):
        assert torch.allclose(found, wanted, rtol=1e-10, atol=1e-10)


def test_the_jacobian_is_triangular_with_the_slopes_on_its_diagonal():
    made = model()
    theta, x = thetas(made)[:1], points(made, 1)
    jacobian = torch.autograd.functional.jacobian(lambda v: made(theta, v[None]).z[0, 0], x)[:, 0]
    assert torch.equal(jacobian.triu(1), torch.zeros_like(jacobian))
    assert torch.allclose(jacobian.diagonal().log(), made(theta, x[None]).log_dz[0, 0])


def test_the_limits_are_the_images_of_infinity():
    made = model()
    theta, x = thetas(made)[:1], points(made, 1)
    image = made(theta, x[None])
    for d in range(7):
        for end, limit in ((-1e6, image.z_minus), (1e6, image.z_plus)):
            far = x.clone()
            far[0, d] = end
            assert torch.allclose(made(theta, far[None]).z[..., d], limit[..., d])


def test_each_class_integrates_to_one():
    made = model(dims=2, stripes=2)
    axis = torch.linspace(-60.0, 60.0, 601, dtype=torch.float64)
    grid = torch.cartesian_prod(axis, axis)
    with torch.no_grad():
        mass = made.log_prob(thetas(made), grid.expand(2, -1, -1)).exp().sum(-1) * (axis[1] - axis[0]) ** 2
    assert torch.allclose(mass, torch.ones_like(mass), atol=2e-3)
    assert not torch.allclose(*made.log_prob(thetas(made), grid[:9].expand(2, -1, -1)))


def test_the_slope_is_finite_and_right_far_from_the_data():
    a = torch.tensor([[1e6, 1e6 + 1.0], [-300.0, 250.0], [0.0, 0.3], [44.0, 60.0]])
    found = log_slope(torch.tensor([0.5, 2.0]), a)
    wide = a.double()
    log_tangent = -2.0 * wide.abs() + np.log(4.0) - 2.0 * torch.log1p(torch.exp(-2.0 * wide.abs()))
    wanted = torch.logsumexp(log_tangent + torch.tensor([0.5, 2.0]).log(), -1)
    assert torch.allclose(found.double(), wanted, rtol=1e-6)


@pytest.mark.parametrize("support", ["normalised", "paper"])
@pytest.mark.parametrize("sizes", [{}, {"hidden": 1, "stripes": 1}, {"stripes": 7}])
def test_the_fused_loss_has_the_value_and_the_gradient_of_autograd(support, sizes):
    made = model(support=support, **sizes)
    x, labels = points(made, 11), torch.arange(11) % 2
    plain = -made.log_prob(thetas(made)[labels], x.unsqueeze(1)).mean()
    fused = mean_nll(made.config, list(made.first), list(made.second), thetas(made), labels, x)
    assert torch.allclose(plain, fused)
    names = [name for name, _ in made.named_parameters()]
    wanted = torch.autograd.grad(plain, list(made.parameters()))
    found = torch.autograd.grad(2.0 * fused, list(made.parameters()))
    for name, a, b in zip(names, wanted, found, strict=True):
        allowed = _mask(made, name)
        # The fit behind the normal tails has a derivative of its own, hence not to the last bit.
        assert torch.allclose(2.0 * a * allowed, b, rtol=1e-6, atol=1e-6), name


def _mask(made, name):
    """Which numbers of a parameter are learnt."""
    kind, _, index = name.partition(".")
    if kind not in ("first", "second"):
        return 1.0
    (a, b), H = made.config.cuts[int(index)], made.config.flow.hidden
    out, into = (H, 1) if kind == "first" else (1, H)
    before = torch.ones(out * (b - a), into * a)
    return torch.cat([before, below_diagonal(b - a, out, into)], dim=1)


def test_without_gradients_the_fused_loss_is_the_same():
    made = model()
    x, labels = points(made, 5), torch.tensor([0, 1, 1, 0, 1])
    with torch.no_grad():
        loss = mean_nll(made.config, list(made.first), list(made.second), thetas(made), labels, x)
        plain = -made.log_prob(thetas(made)[labels], x.unsqueeze(1)).mean()
    assert torch.allclose(loss, plain)


def test_dropping_leaves_own_paths_and_has_the_gradient_of_what_is_left():
    made, labels = model(), torch.arange(11) % 2
    x = points(made, 11)

    def loss():
        torch.manual_seed(5)  # the same share is dropped
        return mean_nll(made.config, list(made.first), list(made.second), thetas(made), labels, x, 0.5)

    with torch.random.fork_rng():
        found = torch.autograd.grad(loss(), [made.first[1], made.gains[2], made.gains[0]])
        for p, g in zip((made.first[1], made.gains[2], made.gains[0]), found, strict=True):
            at, step = (1, 0), 1e-6
            with torch.no_grad():
                p[at] += step
                above = loss()
                p[at] -= 2 * step
                below = loss()
                p[at] += step
            assert torch.allclose((above - below) / (2 * step), g[at], rtol=1e-4, atol=1e-7)
        alone = [torch.zeros_like(s) for s in (*made.first, *made.second)]
        half = len(alone) // 2
        parts = (alone[:half], alone[half:], thetas(made), labels, x)
        assert torch.allclose(mean_nll(made.config, *parts, 0.5), mean_nll(made.config, *parts))


def test_training_keeps_what_is_on_and_above_the_diagonal_at_zero():
    made = WideFlow(config())
    optimiser = torch.optim.AdamW(made.parameters(), lr=0.1)
    for step in range(3):
        x, labels = points(made, 8, step), torch.arange(8) % 2
        optimiser.zero_grad()
        mean_nll(made.config, list(made.first), list(made.second), thetas(made), labels, x).backward()
        optimiser.step()
    for name, p in made.named_parameters():
        if name.startswith(("first", "second")):
            assert torch.equal(p * (1.0 - _mask(made, name)), torch.zeros_like(p))
    assert made.second[2].abs().max() > 0.0


def test_samples_go_back_to_their_uniforms():
    made = model(dims=6, stripes=2)
    theta = thetas(made).detach()
    u = torch.rand(2, 40, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    u[0, 0], u[0, 1] = 1e-9, 1.0 - 1e-9
    x = inverse(made.config, list(made.first), list(made.second), theta, u)
    with torch.no_grad():
        image = made(theta, x)
    back = flow.distribution(made.config.flow, image.z, image.z_minus, image.z_plus)
    assert torch.allclose(back, u, atol=1e-6)


def test_units_start_at_the_quantiles_of_the_data():
    made = WideFlow(config(hidden=8, classes=1))
    x = points(made, 4000)
    x[:, 2] = torch.where(x[:, 2] > 1.0, x[:, 2] + 30.0, x[:, 2])  # two modes, far apart
    before = made.log_prob(thetas(made), x[None]).mean()
    made.fit_units(x)
    after = made.log_prob(thetas(made), x[None]).mean()
    assert after > before + 5.0
    f = factors(made.config, thetas(made)[0])
    middle = (f.m.unsqueeze(-1) - f.B_1 / f.w).detach()
    assert torch.all((x.unsqueeze(-1) < middle).float().mean(0).diff(dim=-1) > 0.1)


def test_interpolated_conditions_have_interpolated_raw_numbers():
    made = model()
    half = factors(made.config, made.theta(torch.tensor([[0.5, 0.5]], dtype=torch.float64)))
    both = factors(made.config, thetas(made))
    assert torch.allclose(half.B_1[0], both.B_1.mean(0))
    assert torch.allclose(half.w[0].log(), both.w.log().mean(0))


def test_the_number_of_stripes_changes_nothing():
    made = model(stripes=1)
    other = config(stripes=4)
    H = made.config.flow.hidden
    W_1 = [made.first[0][a * H : b * H, :b] for a, b in other.cuts]
    W_2 = [made.second[0][a:b, : b * H] for a, b in other.cuts]
    theta, x = thetas(made), points(made, 3).expand(2, 3, -1)
    for found, wanted in zip(forward(other, W_1, W_2, theta, x), made(theta, x), strict=True):
        assert torch.allclose(found, wanted)


def test_sizes_are_those_of_the_tensors():
    made = WideFlow(config())
    assert sum(p.numel() for p in (*made.first, *made.second)) == made.config.shared
    assert thetas(made).shape == (2, made.config.parameters)
    assert len(Factors._fields) == len(made.config.groups)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"flow": FlowSpec(dims=5, layers=2)}, "one hidden layer"),
        ({"flow": FlowSpec(dims=5, layers=1, weight_norm="row")}, "no weight normalisation"),
        ({"stripes": 8}, "stripes must be from 1 to 7"),
        ({"names": ("a",)}, "2 classes have 1 names"),
    ],
)
def test_impossible_sizes_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(config(), **change)


def test_configurations_go_through_plain_data():
    made = dataclasses.replace(config(), names=("a", "b"))
    assert from_dict(dataclasses.asdict(made)) == made
    with pytest.raises(ValueError, match="kind 'wide'"):
        from_dict(dataclasses.asdict(made) | {"depth": 2})
