"""Toy distributions: entropies, normalisation and agreement of samples with densities."""

import numpy as np
import pytest

from hcnaf_export.data.toys import ToyOne, ToyTwo, even

ALL = [(ToyOne(), i) for i in range(3)] + [(ToyTwo(), i) for i in range(9)]


@pytest.mark.parametrize(("index", "entropy"), [(0, 3.8975), (1, 3.9696), (2, 4.2677)])
def test_toy_one_entropies_are_those_of_the_reference(index, entropy):
    assert ToyOne().entropy(index) == pytest.approx(entropy, abs=5e-5)


def test_toy_two_entropy():
    assert ToyTwo().entropy(0) == pytest.approx(1.4516, abs=5e-5)


@pytest.mark.parametrize(("toy", "index"), ALL)
def test_density_integrates_to_one_and_to_its_entropy(toy, index):
    centre = toy.centres()[index] if isinstance(toy, ToyTwo) else np.zeros(2)
    axis, dx = np.linspace(-12.0, 12.0, 801, retstep=True)
    grid = centre + np.stack(np.meshgrid(axis, axis), axis=-1)
    log_p = toy.log_prob(index, grid)
    p = np.exp(log_p) * dx * dx
    assert log_p.shape == (801, 801)
    assert p.sum() == pytest.approx(1.0, abs=1e-9)
    assert -(p * log_p).sum() == pytest.approx(toy.entropy(index), abs=1e-6)


@pytest.mark.parametrize(("toy", "index"), ALL)
def test_samples_have_the_density_s_likelihood_and_mean(toy, index):
    x = toy.sample(np.random.default_rng(index), index, 20_000)
    log_p = toy.log_prob(index, x)
    assert x.shape == (20_000, 2)
    assert abs(-log_p.mean() - toy.entropy(index)) < 4.5 * log_p.std() / np.sqrt(len(x))
    mean = toy.centres()[index] if isinstance(toy, ToyTwo) else np.zeros(2)
    assert (np.abs(x.mean(axis=0) - mean) < 4.5 * x.std(axis=0) / np.sqrt(len(x))).all()


def test_toy_one_is_a_mixture_over_the_grid_of_means():
    toy, x = ToyOne(), np.array([[0.3, -4.1], [5.0, 5.0], [40.0, -2.0]])
    means, v = np.linspace(-5, 5, 5), 1.0 / (5.0 * np.log(5.0))
    centres = np.stack(np.meshgrid(means, means), axis=-1).reshape(-1, 2)
    square = ((x[:, None] - centres) ** 2).sum(axis=-1)
    expected = np.logaddexp.reduce(-0.5 * square / v, axis=1) - np.log(25 * 2 * np.pi * v)
    np.testing.assert_allclose(toy.log_prob(1, x), expected, rtol=1e-12)


def test_sampling_is_seeded():
    for toy in (ToyOne(), ToyTwo()):
        first, again = (toy.sample(np.random.default_rng(5), 1, 8) for _ in range(2))
        np.testing.assert_array_equal(first, again)


def test_conditions_tell_seen_from_unseen():
    one, two = ToyOne(), ToyTwo()
    np.testing.assert_array_equal(one.conditions(), np.eye(3))
    assert (one.seen, one.unseen) == ((0, 1, 2), ())
    assert (two.seen, two.unseen) == ((0, 1, 2, 3, 4), (5, 6, 7, 8))
    assert len({tuple(row) for row in two.conditions().tolist()}) == 9
    assert set(np.unique(two.conditions())) == {-1.0, 0.0, 1.0}
    np.testing.assert_array_equal(two.conditions() * 4.0 + 8.0, two.centres())


@pytest.mark.parametrize(("toy", "index"), ALL)
def test_quantiles_of_even_points_have_the_density_s_moments(toy, index):
    x = toy.quantiles(index, even(np.random.default_rng(index), 10_000))
    drawn = toy.sample(np.random.default_rng(1), index, 40_000)
    assert x.shape == (10_000, 2)
    assert -toy.log_prob(index, x).mean() == pytest.approx(toy.entropy(index), abs=2e-3)  # 0.01 by chance alone
    np.testing.assert_allclose(x.mean(axis=0), drawn.mean(axis=0), atol=0.1)
    np.testing.assert_allclose(np.cov(x.T), np.cov(drawn.T), rtol=0.05, atol=0.1)


@pytest.mark.parametrize("n", [1, 7, 64, 512])
def test_even_points_put_one_into_every_nth_of_both_axes(n):
    u = even(np.random.default_rng(3), n)
    assert u.shape == (n, 2)
    assert ((u > 0.0) & (u < 1.0)).all()
    for axis in u.T:
        assert sorted(np.floor(axis * n)) == list(range(n))


def test_an_even_point_picked_at_random_is_uniform():
    u = np.stack([even(np.random.default_rng(k), 6)[k % 6] for k in range(4000)])
    for axis in u.T:
        share = np.sort(axis) - (np.arange(4000) + 0.5) / 4000
        assert np.abs(share).max() < 0.03  # Kolmogorov and Smirnov: 0.0307 at one in a thousand
