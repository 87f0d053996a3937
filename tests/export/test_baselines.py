"""Baselines: the same interface and the same laws as HCNAF's head."""

import sys

import numpy as np
import pytest
import torch

from hcnaf_export.baselines import build, make_any_head
from hcnaf_export.baselines.tracks import TrackGaussian, constant_velocity
from hcnaf_models.config import HistoryConfig
from hcnaf_models.spec import FlowSpec
from hcnaf_runtime.errors import MissingExtraError

KINDS = ("affine", "spline")


@pytest.fixture(params=KINDS)
def head_and_theta(request):
    pytest.importorskip("zuko")
    torch.manual_seed(0)
    head = make_any_head(request.param, FlowSpec(), 4).eval()
    with torch.no_grad():
        for p in head.parameters():
            p.add_(0.1 * torch.randn_like(p))
        return head, head(torch.randn(3, 4), torch.ones(3, 2), torch.full((3, 2), 0.7))


def test_density_integrates_to_one(head_and_theta):
    head, theta = head_and_theta
    axis = torch.linspace(-12.0, 12.0, 401)
    points = torch.stack(torch.meshgrid(axis, axis, indexing="ij"), dim=-1).reshape(1, -1, 2).expand(3, -1, -1)
    with torch.no_grad():
        mass = head.log_prob(theta, points).double().exp().sum(-1) * float(axis[1] - axis[0]) ** 2
    torch.testing.assert_close(mass, torch.ones_like(mass), atol=0.02, rtol=0.0)


def test_samples_are_images_of_the_base(head_and_theta):
    head, theta = head_and_theta
    uniform = torch.rand(3, 200, 2, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        x = head.sample(theta, uniform)
        location, scale, rest = torch.split(theta, [2, 2, theta.shape[-1] - 4], dim=-1)
        u = (x - location.unsqueeze(1)) / scale.unsqueeze(1)
        z = head.flow(rest.unsqueeze(1).expand(-1, 200, -1)).transform(u)
    torch.testing.assert_close(torch.special.ndtr(z), uniform, atol=2e-3, rtol=0.0)


@pytest.mark.parametrize("kind", ["hcnaf", "mixture", *KINDS])
def test_every_head_learns_on_the_encoder_of_tracks(kind):
    if kind in KINDS:
        pytest.importorskip("zuko")
    torch.manual_seed(0)
    model = build(HistoryConfig(head=kind, flow=FlowSpec(hidden=4), trunk=(16,), rank=8, dropout=0.0))
    tracks, horizons = torch.cumsum(torch.randn(64, 8, 2), dim=1), torch.full((64, 1), 0.4)
    target = torch.tensor([0.3, -0.2]).expand(64, 1, 1, 2) + 0.05 * torch.randn(64, 1, 1, 2)
    optimiser = torch.optim.Adam(model.parameters(), lr=1e-2)
    losses = []
    for _ in range(40):
        optimiser.zero_grad()
        loss = -model.log_prob(model.hypernet(tracks, horizons), target).mean()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < losses[0] - 1.0


def test_a_missing_library_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "zuko", None)
    with pytest.raises(MissingExtraError, match=r"needs zuko.*hcnaf\[bench\]"):
        make_any_head("spline", FlowSpec(), 4)


def test_the_gaussian_of_tracks_is_fitted_and_normalised():
    rng = np.random.default_rng(0)
    history = np.cumsum(rng.normal(size=(4000, 8, 2)), axis=1)
    spread = np.array([[0.1, 0.3], [0.5, 0.2]])
    points = constant_velocity(history, 2) + spread * rng.normal(size=(4000, 2, 2))
    gaussian = TrackGaussian.fit(history, points)
    np.testing.assert_allclose(np.sqrt(gaussian.variance), spread, rtol=0.05)
    normal = torch.distributions.Normal(
        torch.from_numpy(constant_velocity(history, 2)), torch.from_numpy(np.sqrt(gaussian.variance))
    )
    expected = -normal.log_prob(torch.from_numpy(points)).sum(-1).numpy()
    np.testing.assert_allclose(gaussian.nll(history, points), expected, rtol=1e-9)
    paths = gaussian.paths(history[:50], rng.normal(size=(50, 500, 2)))
    np.testing.assert_allclose(
        (paths - constant_velocity(history[:50], 2)[:, None]).std((0, 1)), spread, rtol=0.05
    )
