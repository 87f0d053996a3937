"""What is folded into theta: units, slopes and gains."""

import torch

from hcnaf_models import FlowSpec
from hcnaf_models.emission import LOG_GAIN_BOUND, Emission, initial_raw
from hcnaf_models.flow import log_prob, split
from hcnaf_models.mlp import Head
from hcnaf_models.spec import lower_pairs


def test_units_are_a_change_of_variables():
    spec = FlowSpec(hidden=6, shear=True)
    with torch.random.fork_rng():
        torch.manual_seed(2)
        emission = Emission(spec).double()
        raw = (initial_raw(spec) + 0.3 * torch.randn(spec.raw)).double()
        m, s = torch.randn(spec.dims).double(), torch.exp(torch.randn(spec.dims)).double()
        k = 2.0 * torch.randn(spec.pairs).double()
        v = torch.randn(9, spec.dims).double()
    x = m + s * v
    slope = torch.zeros(spec.dims, spec.dims, dtype=torch.float64)
    slope[lower_pairs(spec.dims)] = k
    plain = emission(raw, torch.zeros_like(m), torch.ones_like(s))
    expected = log_prob(spec, plain, v - v @ slope.T) - torch.log(s).sum()
    torch.testing.assert_close(log_prob(spec, emission(raw, m, s, k), x), expected)


def test_slanted_units_start_straight():
    head = Head(FlowSpec(hidden=6, shear=True), 5)
    features, anchor, spread = torch.randn(3, 5), torch.randn(3, 2), torch.ones(3, 2)
    raw = head.weights(features)
    torch.testing.assert_close(head(features, anchor, spread), head.emission(raw, anchor, spread))
    assert head.units.out_features == 5


def test_emitted_gains_scale_rows_within_bounds():
    spec = FlowSpec(hidden=6, weight_norm="row-gain")
    emission, unit = Emission(spec), torch.ones(2)
    raw = initial_raw(spec)
    before = split(spec, emission(raw, 0.0 * unit, unit))[1]
    raw[: sum(spec.gains)] = 1e6
    after = split(spec, emission(raw, 0.0 * unit, unit))[1]
    factor = torch.exp(torch.tensor(LOG_GAIN_BOUND))
    for one, other in zip(before, after, strict=True):
        torch.testing.assert_close(other.diagonal, factor * one.diagonal)
        torch.testing.assert_close(other.lower, factor * one.lower)
        torch.testing.assert_close(other.bias, one.bias)
