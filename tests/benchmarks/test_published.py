"""The published form that we are compared with computes the published density, whole or in parts."""

import math

import pytest
import torch

from hcnaf_models.emission import Emission, initial_raw
from hcnaf_models.reference import log_prob_published
from hcnaf_models.spec import FlowSpec
from tests.benchmarks import published


@pytest.fixture(params=[(1, 5), (2, 8), (3, 20)])
def flow(request):
    L, H = request.param
    spec = FlowSpec(layers=L, hidden=H)
    generator = torch.Generator().manual_seed(0)
    raw = initial_raw(spec, generator) + 0.3 * torch.randn(spec.weights, generator=generator)
    theta = Emission(spec)(raw, torch.zeros(2), torch.full((2,), 3.0)).detach()
    return spec, theta, 5.0 * torch.randn(60, 2, generator=generator)


def test_it_is_the_reference_in_float32(flow):
    spec, theta, x = flow
    found = published.log_prob(spec, theta, x)
    assert found.dtype == torch.float32
    torch.testing.assert_close(found.double(), log_prob_published(spec, theta, x), rtol=1e-4, atol=1e-4)


def test_weights_for_every_point_change_nothing(flow):
    spec, theta, x = flow
    found = published.log_prob_each(spec, theta, x)
    torch.testing.assert_close(found, published.log_prob(spec, theta, x), rtol=1e-4, atol=1e-4)


def test_parts_make_the_whole_and_stay_within_the_limit(flow, monkeypatch):
    spec, theta, x = flow
    monkeypatch.setattr(published, "MOST", 17 * spec.dims * spec.hidden**2)
    sizes = []

    def part(x):
        sizes.append(len(x))
        return published.log_prob(spec, theta, x)

    torch.testing.assert_close(published.in_parts(part, spec, x), published.log_prob(spec, theta, x))
    assert len(sizes) == math.ceil(60 / 17)
    assert max(sizes) <= 17
