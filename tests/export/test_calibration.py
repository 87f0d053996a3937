"""Calibration: labels drawn from a forecast pass, labels drawn from anything else do not.

The forecast is a Gaussian bundle, so that its density is known without any of the code under test.
"""

import importlib.util
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import stats

from hcnaf_export.checkpoint import Checkpoint
from hcnaf_export.evaluation import BundlePredictor, CheckpointPredictor, temperature
from hcnaf_export.evaluation.calibrate import calibrate
from hcnaf_export.evaluation.pit import BINS, critical_value, ks_statistic, summarise_pit
from hcnaf_export.evaluation.progress import Stages
from hcnaf_export.evaluation.regions import DRAWS, LEVELS, denser, summarise_regions
from hcnaf_export.evaluation.reliability import GRID, LEAST, joined, summarise_reliability, tally
from hcnaf_export.evaluation.subset import cluster_of, fewer, parts
from hcnaf_export.evaluation.temperature import fit_temperature, tempered, with_temperature
from hcnaf_export.recipe import read_recipe
from hcnaf_models import flow
from hcnaf_models.config import PomConfig
from hcnaf_models.model import build
from hcnaf_models.spec import FlowSpec
from hcnaf_runtime import Forecaster, Grid
from hcnaf_runtime import manifest as m
from tests.export import synthetic

# pytest runs in importlib mode, where a test's neighbours are not importable by themselves.
_PATH = Path(__file__).parents[1] / "runtime" / "gaussian_bundle.py"
_spec = importlib.util.spec_from_file_location("calibration_gaussian_bundle", _PATH)
_gaussian = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(_gaussian)

HORIZONS = (1.0, 3.5)
"""So far apart that no row of a track is the label of two windows."""


@pytest.fixture(scope="module")
def predictor(tmp_path_factory):
    contract = m.SceneContract(step=0.1, history=10, channels=["left"], optional_channels=["left"])
    folder = _gaussian.write_gaussian_bundle(tmp_path_factory.mktemp("gaussian") / "bundle", scene=contract)
    return BundlePredictor(Forecaster(folder, threads=1))


@pytest.fixture(scope="module")
def tracks():
    return synthetic.tracks(seed=8, count=60)


def gaussian(tracks, rng, wider=1.0, ahead=0.0):
    """Labels [W, Q, 2] in the network's frame, drawn from the bundle's density (`write_gaussian_bundle`)."""
    track, step = tracks.windows.T
    x, y, yaw, speed = tracks.observed[tracks.rows(track, step)].astype(float).T[..., None]
    t = np.array(HORIZONS)
    along = wider * (0.3 + 0.4 * t)
    z = rng.standard_normal((2, len(track), len(t)))
    u = speed * t + ahead * along + along * z[0]
    v = 0.4 * along * (0.6 * z[0] + 0.8 * z[1])
    return np.stack([x + np.cos(yaw) * u - np.sin(yaw) * v, y + np.sin(yaw) * u + np.cos(yaw) * v], axis=-1)


def labelled(tracks, points):
    """The tracks with the labels `points` [W, Q, 2] at HORIZONS of their windows."""
    track, step = tracks.windows.T
    label = tracks.label.copy()
    for q, t in enumerate(HORIZONS):
        label[tracks.rows(track, step + round(10 * t))] = points[:, q]
    return replace(tracks, label=label)


def measured(predictor, tracks, limit):
    """Calibration on some windows, each a cluster of its own: their labels were drawn independently."""
    some = fewer(parts([tracks]), limit)
    first = np.cumsum([0] + [len(part.windows) for part in some])
    apart = [p._replace(cluster=k + np.arange(len(p.windows))) for k, p in zip(first, some, strict=False)]
    return calibrate(predictor, apart, HORIZONS, Stages(None, 1))


def test_labels_of_the_forecast_pass(predictor, tracks):
    found = measured(predictor, labelled(tracks, gaussian(tracks, np.random.default_rng(0))), 300)
    for row in found.pit.rows:
        for part in (row.along, row.across):
            assert part.ks < part.critical
            assert sum(part.histogram) == pytest.approx(1.0)
    assert len(found.regions.rows) == len(HORIZONS) * len(LEVELS)
    for row in found.regions.rows:
        assert abs(row.covered - row.level) < 3.0 * row.error
    for row in found.reliability.rows:
        assert row.ece < 2.0 * row.ece_noise < 0.06
        assert row.ece_all < 1e-3
        assert row.outside == 0.0


@pytest.mark.parametrize(("wider", "ahead"), [(1.6, 0.0), (0.6, 0.0), (1.0, 0.8)])
def test_other_labels_fail(predictor, tracks, wider, ahead):
    found = measured(predictor, labelled(tracks, gaussian(tracks, np.random.default_rng(0), wider, ahead)), 160)
    for row in found.pit.rows:
        assert row.along.ks > 1.2 * row.along.critical
    middle = [row for row in found.regions.rows if row.level == LEVELS[0]]
    for row in middle:
        side = 1.0 if wider < 1.0 else -1.0
        assert side * (row.covered - row.level) > 3.0 * row.error
    # Cells are 2 m wide, as wide as the far forecast along, and it is the far ones that tell.
    far = found.reliability.rows[-1]
    assert far.ece > 1.5 * far.ece_noise


def test_paths_of_a_bundle_are_labels_that_pass(predictor, tracks):
    made = predictor.paths(tracks, tracks.windows, HORIZONS, 1)[:, 0]
    u = predictor.pit(labelled(tracks, made), tracks.windows, HORIZONS)
    assert (np.array([ks_statistic(u[:, q, d]) for q in (0, 1) for d in (0, 1)]) < 1.6 / np.sqrt(len(u))).all()
    # Horizons are coupled by quantiles: the same u for both.
    np.testing.assert_allclose(u[:, 0], u[:, 1], atol=2e-3)


@pytest.fixture(scope="module")
def checkpoint():
    tiny = read_recipe("pom-tiny").model
    config = PomConfig(flow=tiny.flow, crop=tiny.crop, widths=(6, 8), trunk=(16, 8))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = build(config).eval().requires_grad_(False)
        for linear in (model.hypernet.head.weights, model.hypernet.head.units):
            linear.weight.normal_(0.0, 0.2)
    return CheckpointPredictor(Checkpoint(config, model, {}, {}))


def test_paths_of_a_checkpoint_are_labels_that_pass(checkpoint, tracks):
    made = labelled(tracks, checkpoint.paths(tracks, tracks.windows, HORIZONS, 1)[:, 0])
    found = measured(checkpoint, made, 200)
    for row in found.reliability.rows:
        assert row.ece < 2.5 * row.ece_noise
    for row in found.pit.rows:
        assert max(row.along.ks / row.along.critical, row.across.ks / row.across.critical) < 1.3
    for row in found.regions.rows:
        assert abs(row.covered - row.level) < 3.5 * row.error


@pytest.mark.parametrize("weight_norm", ["none", "row", "frobenius", "row-gain"])
def test_a_temperature_is_in_the_weights(weight_norm):
    config = PomConfig(flow=FlowSpec(hidden=6, weight_norm=weight_norm), channels=(), draw_actors=False)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = build(config).eval().requires_grad_(False)
        model.hypernet.head.weights.weight.normal_(0.0, 0.2)
        features = torch.randn(4, config.trunk[-1])
        x = 2.0 * torch.randn(4, 7, 2)
    before = Checkpoint(config, model, {}, {"validation": {"mean": 1.0}})
    after = with_temperature(before, 1.3)
    anchor, spread = torch.zeros(4, 2), torch.ones(4, 2)
    thetas = [k.model.head(features, anchor, spread) for k in (before, after)]
    torch.testing.assert_close(thetas[1], tempered(config.flow, thetas[0], 1.3))
    z = [flow.forward(config.flow, theta, x).z for theta in thetas]
    torch.testing.assert_close(z[1], z[0] / 1.3)
    assert (after.training, after.scores) == ({"temperature": 1.3}, {})
    assert with_temperature(after, 2.0).training["temperature"] == pytest.approx(2.6)


def test_a_fit_finds_the_temperature_that_labels_were_drawn_at(checkpoint, tracks, monkeypatch):
    monkeypatch.setattr(temperature, "STEPS", 5)
    true = Checkpoint(checkpoint.config, checkpoint.model, {}, {})
    hot = CheckpointPredictor(with_temperature(true, 1.4))
    # Only windows of which no row is the label of two at 1, 2 and 4 s.
    track, step = tracks.windows[tracks.windows[:, 1] - tracks.track_step[tracks.windows[:, 0]] < 19].T
    some = replace(tracks, windows=np.stack([track, step], axis=1))
    label = some.label.copy()
    for t in (1.0, 2.0, 4.0):
        label[some.rows(track, step + round(10 * t))] = hot.paths(some, some.windows, (t,), 1)[:, 0, 0]
    found = fit_temperature(true, Single(replace(some, label=label)), limit=120)
    # 120 windows tell a share of 95 % to 2 %, which is this much of temperature.
    assert 1.15 < found.temperature < 1.75
    assert found.before < 0.93
    assert found.after == pytest.approx(0.95, abs=0.01)


class Single:
    """A data set of one network."""

    def __init__(self, tracks):
        self.tracks = tracks

    def split(self, name):
        assert name == "val"
        return [self.tracks]


def test_draws_do_not_depend_on_other_windows(checkpoint, tracks):
    whole = checkpoint.drawn_log_prob(tracks, tracks.windows[:70], HORIZONS, 5)
    np.testing.assert_allclose(
        whole[66:69], checkpoint.drawn_log_prob(tracks, tracks.windows[66:69], HORIZONS, 5), atol=1e-3
    )


def test_ks_is_the_textbooks():
    u = np.random.default_rng(0).beta(1.2, 1.0, 500)
    assert ks_statistic(u) == pytest.approx(stats.kstest(u, "uniform").statistic)
    assert ks_statistic(np.array([0.5])) == 0.5


def test_critical_values_of_independent_windows_are_the_textbooks():
    u = np.random.default_rng(0).random(1000)
    assert critical_value(u, np.arange(1000)) == pytest.approx(1.358 / np.sqrt(1000), rel=0.1)


def test_repeating_windows_makes_no_critical_value_smaller():
    u = np.random.default_rng(0).random(200)
    once = critical_value(u, np.arange(200))
    assert critical_value(np.repeat(u, 9), np.repeat(np.arange(200), 9)) == pytest.approx(once)
    assert np.isnan(critical_value(u, np.zeros(200)))


def test_calibrated_clusters_exceed_the_critical_value_rarely():
    rng = np.random.default_rng(1)
    cluster = np.repeat(np.arange(60), 5)
    # The windows of a cluster share most of what decides their u, and each u is uniform.
    beyond = []
    for _ in range(200):
        z = np.sqrt(0.8) * rng.standard_normal(60)[cluster] + np.sqrt(0.2) * rng.standard_normal(300)
        u = stats.norm.cdf(z)
        beyond.append((ks_statistic(u) > critical_value(u, cluster), ks_statistic(u) > 1.358 / np.sqrt(300)))
    ours, naive = np.mean(beyond, axis=0)
    assert 0.0 < ours < 0.12
    assert naive > 0.3


def test_pit_summary_counts():
    u = np.random.default_rng(0).random((40, 2, 2))
    found = summarise_pit(HORIZONS, u, np.repeat(np.arange(10), 4))
    assert (found.windows, found.clusters, len(found.rows)) == (40, 10, 2)
    assert found.rows[1].across.ks == ks_statistic(u[:, 1, 1])
    assert len(found.rows[0].along.histogram) == BINS


@pytest.mark.parametrize("draws", [19, DRAWS])
def test_coverage_is_exact_for_any_number_of_draws(draws):
    rng = np.random.default_rng(0)
    # Whatever the density of a sample is, the label's is one more.
    drawn, label = rng.gamma(2.0, size=(20_000, 1, draws)), rng.gamma(2.0, size=(20_000, 1))
    found = summarise_regions((1.0,), denser(drawn, label), np.arange(20_000), draws)
    for row in found.rows:
        assert row.covered == pytest.approx(row.level, abs=4.0 * row.error)
        assert row.error == pytest.approx(np.sqrt(row.level * (1 - row.level) / 20_000), rel=0.05)


def test_levels_are_whole_ranks():
    assert all(abs(level * (DRAWS + 1) - round(level * (DRAWS + 1))) < 1e-9 for level in LEVELS)


def test_reliability_by_hand():
    """Two windows, four cells each: 0.5, 0.3, 0.195, 0.005; one label in the first cell, one outside."""
    mass = np.tile(np.array([0.5, 0.3, 0.195, 0.005]).reshape(1, 1, 2, 2), (2, 1, 1, 1))
    found = summarise_reliability(
        (1.0,), tally(mass, np.array([[0], [-1]])), np.arange(2), Grid(2, 2, 2.0, (0, 0))
    )
    row = found.rows[0]
    assert (found.windows, found.clusters, found.cell, found.window) == (2, 2, 2.0, (0.0, 0.0, 4.0, 4.0))
    # Six cells of 1 % and more: three bins of two, gaps 0, 0.3 and 0.195.
    assert row.ece == pytest.approx((0.3 + 0.195) / 3)
    assert [b.cells for b in row.bins] == [2, 2, 2]
    assert [b.observed for b in row.bins] == [0.0, 0.0, 0.5]
    assert row.ece_top == pytest.approx(0.0)
    assert row.ece_all == pytest.approx((0.3 + 0.195 + 0.005) / 4)
    assert row.outside == 0.5
    assert [b.cells for b in row.log_bins] == [2, 2, 4]
    assert all(b.low <= b.predicted <= b.high for b in (*row.bins, *row.log_bins))
    # The hits of the two windows differ by one in the first cell: two clusters, sum of squares 1/2, times 2.
    assert row.bins[2].error == pytest.approx(1.0 / 2.0)


def test_parts_count_as_the_whole():
    rng = np.random.default_rng(0)
    mass = rng.dirichlet(np.full(20, 0.2), (30, 2)).reshape(30, 2, 4, 5)
    where = rng.integers(-1, 20, (30, 2))
    cluster = np.arange(30) // 3
    whole = summarise_reliability(HORIZONS, tally(mass, where), cluster)
    some = joined([tally(mass[:7], where[:7]), tally(mass[7:], where[7:])])
    assert summarise_reliability(HORIZONS, some, cluster) == whole
    strong = (mass >= LEAST).sum(axis=(0, 2, 3))
    assert [sum(b.cells for b in row.bins) for row in whole.rows] == strong.tolist()


def test_confidence_of_the_wrong_size_shows():
    rng = np.random.default_rng(0)
    p = rng.dirichlet(np.full(4, 0.7), 4000).reshape(4000, 1, 2, 2)
    drawn = (p.reshape(-1, 4).cumsum(axis=1) < rng.random((4000, 1))).sum(axis=1)[:, None]
    cluster = np.arange(4000)
    right = summarise_reliability((1.0,), tally(p, drawn), cluster).rows[0]
    sure = p**1.6 / (p**1.6).sum(axis=(2, 3), keepdims=True)
    wrong = summarise_reliability((1.0,), tally(sure, drawn), cluster).rows[0]
    for name in ("ece", "ece_top"):
        assert getattr(right, name) < 2.0 * getattr(right, f"{name}_noise") < 0.04
        assert getattr(wrong, name) > 0.05


def test_the_window_holds_what_a_car_can_reach():
    low, high = GRID.corners[0], GRID.corners[2]
    assert low.tolist() == [-20.0, -50.0]
    assert high.tolist() == [100.0, 50.0]


def test_fewer_windows_are_spread_evenly(tracks):
    whole = parts([tracks, synthetic.tracks(seed=9, count=30)])
    total = sum(len(part.windows) for part in whole)
    some = fewer(whole, 100)
    assert sum(len(part.windows) for part in some) == 100
    places = np.concatenate(
        [
            np.flatnonzero((w.windows[:, None] == s.windows).all(-1).any(1))
            for w, s in zip(whole, some, strict=True)
        ]
    )
    assert len(places) == 100
    assert fewer(whole, total) == whole
    assert len(cluster_of(some)) == 100
    assert set(cluster_of(some)) <= set(cluster_of(whole))
