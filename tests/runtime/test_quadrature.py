"""Integrals against a distribution function: exact sums, exponential convergence, spikes noticed."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from hcnaf_runtime.quadrature import Rule

RULES = [Rule(1, 1), Rule(1, 2), Rule(1, 4), Rule(8, 4)]


@pytest.mark.parametrize("rule", RULES)
def test_weights_sum_exactly_to_the_increment(rule):
    F = np.random.default_rng(0).random((50, len(rule.support))).cumsum(axis=1)
    weights = rule.weights(F)
    assert weights.shape == (50, rule.size)
    np.testing.assert_allclose(weights.sum(axis=1), F[:, -1] - F[:, 0], atol=1e-12)


@pytest.mark.parametrize("rule", RULES)
def test_polynomials_are_integrated_exactly(rule):
    """F of degree q + 1 and g of degree q - 1 lie within what the rule represents."""
    q, t = rule.order, rule.support
    weights = rule.weights(t ** (q + 1))
    found = (weights * t[rule.nodes] ** (q - 1)).sum()
    assert found == pytest.approx((q + 1) / (2 * q), abs=1e-12)


def test_places():
    rule = Rule(3, 2)
    assert len(rule.support) == 3 * (2 + 1) + 1
    assert (np.diff(rule.support) > 0).all()
    assert rule.support[0] == 0
    assert rule.support[-1] == 1
    assert len(rule.nodes) == rule.size == 6


def test_converges_for_a_narrow_distribution():
    def density(x):
        return norm.pdf(x, 0.4, 0.1) * np.sin(3 * x)

    truth = quad(density, 0, 1, epsabs=1e-13)[0]
    errors = []
    for panels in (1, 2, 4, 8):
        rule = Rule(panels, 4)
        weights = rule.weights(norm.cdf(rule.support, 0.4, 0.1))
        errors.append(abs(weights @ np.sin(3 * rule.support[rule.nodes]) - truth))
    assert errors[-1] < 1e-8
    assert errors[-1] < errors[0] / 1e4


@pytest.mark.parametrize("centre", [0.001, 0.13, 0.5, 0.77, 0.999])
def test_a_spike_between_the_nodes_is_noticed(centre):
    for rule in RULES:
        F, checks = (norm.cdf(t, centre, 1e-4) for t in (rule.support, rule.checks))
        assert rule.misfit(F, checks) > 1e-2
    smooth, at_checks = (norm.cdf(t, centre, 2.0) for t in (RULES[-1].support, RULES[-1].checks))
    assert RULES[-1].misfit(smooth, at_checks) < 1e-12


@pytest.mark.parametrize("rule", [Rule(1, 5), Rule(1, 7), Rule(4, 7)])
def test_doubt_vanishes_for_polynomials_and_not_for_a_step(rule):
    """Also where F is even: a mode that integrates to nothing must not hide the step that it is part of."""
    t = rule.support[rule.nodes]
    weights = rule.weights(rule.support) @ rule.doubt
    assert abs(weights @ t ** (rule.order - 3)) < 1e-12
    for place in (0.31, 0.47, 0.78):
        assert abs(weights @ (t > place)) > 1e-3 / rule.panels


@pytest.mark.parametrize("rule", [Rule(1, 5), Rule(4, 5)])
def test_values_between_nodes(rule):
    places = np.linspace(0, 1, 41)
    nodes = rule.support[rule.nodes]
    np.testing.assert_allclose(rule.at(places) @ nodes**4, places**4, atol=1e-12)
    np.testing.assert_allclose(rule.at(nodes), np.eye(rule.size), atol=1e-12)
