"""Laws of samples, trajectories and quantiles, on a bundle whose forecasts are Gaussians."""

import numpy as np
import pytest
from scipy import stats

from hcnaf_runtime import Bundle, Condition, Forecaster, Grid, Scene, flow, frames
from hcnaf_runtime.errors import BundleError, InputError
from hcnaf_runtime.flow import RARE
from hcnaf_runtime.manifest import FILE, encode, read

SEEDS = range(20)


def uniforms(forecaster, scene, samples):
    """F_1 and F_2 at samples given in the agents' frames."""
    return forecaster.cdf(scene, samples.points, samples.horizons).astype(np.float64)


@pytest.mark.parametrize("horizon", [1.0, 4.0])
def test_samples_agree_with_the_map(forecaster, scene, horizon):
    grid = Grid(40, 40, 0.4, origin=(horizon * 5.0 - 8.0, -7.0))
    maps = forecaster.pom(scene, grid, [horizon])
    expected = 100_000 * maps.mass[0, 0].astype(np.float64)
    kept = expected > 5.0
    least = 1.0
    for seed in SEEDS:
        points = forecaster.sample(scene, 100_000, [horizon], seed).points[0, 0]
        column, row = np.floor((points - grid.corners[0]) / grid.resolution).astype(int).T
        inside = (column >= 0) & (column < 40) & (row >= 0) & (row < 40)
        counts = np.zeros((40, 40))
        np.add.at(counts, (row[inside], column[inside]), 1.0)
        seen = np.append(counts[kept], 100_000 - counts[kept].sum())
        wanted = np.append(expected[kept], 100_000 - expected[kept].sum())
        least = min(least, stats.chisquare(seen, wanted).pvalue)
    assert kept.sum() > 50
    assert least > 0.001 / len(SEEDS)


def test_the_log_density_is_that_of_the_flow(forecaster, scene):
    for made in (forecaster.sample(scene, 500, [0.5, 2.0]), forecaster.trajectories(scene, 500, [0.5, 2.0])):
        again = forecaster.log_prob(scene, made.points, made.horizons)
        np.testing.assert_allclose(made.log_prob, again, atol=2e-4)


@pytest.mark.parametrize("draw", ["sample", "trajectories"])
def test_values_of_the_distribution_functions_are_uniform(forecaster, scene, draw):
    made = getattr(forecaster, draw)(scene, 4000, [1.0, 3.0], seed=5)
    u = uniforms(forecaster, scene, made)
    for a, t, d in np.ndindex(*u.shape[:2], 2):
        assert stats.kstest(u[a, t, :, d], "uniform").pvalue > 1e-4


def test_agents_are_independent_and_so_are_horizons_of_samples(forecaster, scene):
    u = uniforms(forecaster, scene, forecaster.sample(scene, 4000, [1.0, 3.0]))
    flat = u.transpose(0, 1, 3, 2).reshape(-1, 4000)
    off = np.corrcoef(flat) - np.eye(len(flat))
    assert np.abs(off).max() < 0.08


def test_trajectories_keep_their_quantiles_over_time(forecaster, scene):
    made = forecaster.trajectories(scene, 300, [0.5, 1.0, 4.0], seed=2)
    u = uniforms(forecaster, scene, made)
    np.testing.assert_allclose(u, np.broadcast_to(u[:, :1], u.shape), atol=1e-5)
    assert np.abs(u[0] - u[1]).max() > 0.5  # agents do not share theirs
    alone = forecaster.trajectories(scene, 300, [4.0], seed=2)
    np.testing.assert_array_equal(alone.points[:, 0], made.points[:, 2])


@pytest.mark.parametrize("draw", ["sample", "trajectories"])
def test_a_seed_decides_whatever_the_threads(bundle, scene, draw):
    made = [getattr(Forecaster(bundle, threads=k), draw)(scene, 9000, [1.0, 2.0], seed=3) for k in (1, 2)]
    np.testing.assert_array_equal(made[0].points, made[1].points)
    np.testing.assert_array_equal(made[0].log_prob, made[1].log_prob)
    other = getattr(Forecaster(bundle, threads=1), draw)(scene, 9000, [1.0, 2.0], seed=4)
    assert (other.points != made[0].points).mean() > 0.99


def test_both_frames_hold_the_same_points(forecaster, scene):
    local, placed = (forecaster.sample(scene, 50, [1.0, 2.0], 1, frame) for frame in ("agent", "scene"))
    assert placed.frame == "scene"
    for a, pose in enumerate(placed.pose):
        np.testing.assert_allclose(frames.to_scene(local.points[a], pose), placed.points[a], atol=1e-9)
    np.testing.assert_array_equal(local.log_prob, placed.log_prob)


def test_quantiles_invert_the_distribution_functions(forecaster, scene):
    levels = np.array([[0.5, 0.5], [0.05, 0.95], [1e-6, 0.3], [0.7, 1 - 1e-6]])
    found = forecaster.quantile(scene, levels, [1.0, 2.0])
    assert found.shape == (2, 2, 4, 2)
    np.testing.assert_allclose(
        forecaster.cdf(scene, found, [1.0, 2.0]), np.broadcast_to(levels, found.shape), atol=1e-5
    )
    rising = forecaster.quantile(scene, np.linspace(0.01, 0.99, 50)[:, None].repeat(2, axis=1), [1.0])
    assert (np.diff(rising[0, 0, :, 0]) > 0).all()


def test_a_condition_is_sampled_in_its_own_frame(condition_path):
    forecaster = Forecaster(condition_path, threads=1)
    given = Condition(np.float32([[1.0, 2.0, 0.5, 0.25, 0.3]]))
    made = forecaster.sample(given, 20_000)
    assert made.points.shape == (1, 1, 20_000, 2)
    np.testing.assert_allclose(made.points[0, 0].mean(axis=0), [1.0, 2.0], atol=0.02)
    np.testing.assert_allclose(made.points[0, 0].std(axis=0), [0.5, 0.25], rtol=0.03)
    with pytest.raises(InputError, match="a condition has none"):
        forecaster.sample(given, 5, frame="scene")


def test_saved_samples_are_read_back(forecaster, scene, tmp_path):
    made = forecaster.trajectories(scene, 7, [1.0, 2.0])
    made.save(tmp_path / "samples.npz")
    with np.load(tmp_path / "samples.npz", allow_pickle=False) as saved:
        assert set(saved.files) == {"points", "log_prob", "horizons", "agents", "pose", "frame", "coupled"}
        np.testing.assert_array_equal(saved["points"], made.points)
        assert bool(saved["coupled"]) is True
        assert str(saved["frame"]) == "agent"


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda f, s: f.sample(s, 0), "0 samples asked for, expected at least 1"),
        (lambda f, s: f.sample(s, 10**9), "points asked for, at most"),
        (lambda f, s: f.sample(s, 5, seed=-1), "seed is -1, expected 0 or more"),
        (lambda f, s: f.trajectories(s, 5, frame="map"), "frame is 'map'"),
        (lambda f, s: f.quantile(s, np.array([0.5])), r"levels are float64 \[1\]"),
        (lambda f, s: f.quantile(s, np.array([[0.5, 1.0]])), "above 0 and below 1"),
    ],
)
def test_what_makes_no_sense_is_refused(forecaster, scene, call, message):
    with pytest.raises(InputError, match=message):
        call(forecaster, scene)


@pytest.mark.parametrize("again", [1 << 22, 5])
@pytest.mark.parametrize(("missed", "left"), [(0.5, 0), (1e-5, 80 - 240 // RARE)])
def test_samples_that_miss_are_drawn_again_alone(forecaster, monkeypatch, again, missed, left):
    """All that are lost; of those that miss by little, one in so many."""
    alone = []

    def run(graph, outputs, theta, uniform):
        points = theta[:, None, :2] + uniform
        error = np.zeros(uniform.shape[:2], np.float32)
        if uniform.shape[1] > 1:
            error[:, ::3] = missed
            points[:, ::3] += 1.0
        else:
            alone.append(len(uniform))
        return [points, points.sum(-1), error]

    monkeypatch.setattr(forecaster.flow, "_run", run)
    monkeypatch.setattr(flow, "AGAIN", again)
    theta = np.float32([[1.0, 2.0, 0.0], [3.0, 4.0, 0.0]])
    uniform = np.random.default_rng(1).uniform(0.1, 0.9, (2, 120, 2)).astype(np.float32)
    points, log_prob = forecaster.flow.inverse(theta, uniform)
    wrong = np.abs(points - (theta[:, None, :2] + uniform)).max(axis=-1) > 1e-5
    assert wrong.sum() == left
    np.testing.assert_allclose(log_prob, points.sum(-1), rtol=1e-6)
    assert sum(alone) == 80 - left
    assert max(alone) <= -(-again // theta.shape[1])


def test_a_bundle_from_before_samples_says_so(own_bundle, fields):
    manifest = read(own_bundle / FILE)
    del manifest.graphs["inverse"]
    (own_bundle / FILE).write_bytes(encode(manifest))
    old = Forecaster(Bundle.open(own_bundle), threads=1)
    with pytest.raises(BundleError, match="no graph 'inverse', samples need it; export the bundle again"):
        old.sample(Scene(**fields), 5)
