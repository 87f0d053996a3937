"""Scores: exact where they can be, the same on every path, with errors that know about dependence."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from hcnaf_export.baselines import ConstantVelocityGaussian, labels
from hcnaf_export.checkpoint import Checkpoint, load_checkpoint
from hcnaf_export.data.tracks import Dataset
from hcnaf_export.evaluation import (
    HORIZONS,
    BundlePredictor,
    CheckpointPredictor,
    evaluate,
    evaluate_checkpoint,
    evaluate_toy_checkpoint,
)
from hcnaf_export.evaluation.extra_nats import PROTOCOLS, extra_nats, perturbed, summarise_extra_nats
from hcnaf_export.evaluation.reliability import GRID
from hcnaf_export.evaluation.scores import mean_and_error
from hcnaf_export.recipe import read_recipe
from hcnaf_models.config import PomConfig
from hcnaf_models.model import build
from hcnaf_runtime import Forecaster
from hcnaf_runtime.errors import CheckpointError, DataError, HorizonError
from tests.export import synthetic


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return synthetic.write(tmp_path_factory.mktemp("data") / "set")


@pytest.fixture(scope="module")
def checkpoint():
    """A random model that reads everything a scene has."""
    tiny = read_recipe("pom-tiny").model
    config = PomConfig(
        flow=tiny.flow, crop=tiny.crop, widths=(6, 8), trunk=(16, 8), actors="history", max_actors=2, max_drawn=3
    )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = build(config).eval().requires_grad_(False)
        for linear in (model.hypernet.head.weights, model.hypernet.head.units):
            linear.weight.normal_(0.0, 0.2)
    return Checkpoint(config, model, {}, {})


def test_errors_of_independent_values_are_the_usual_ones():
    values = np.random.default_rng(0).normal(2.0, 3.0, (500, 2))
    mean, error = mean_and_error(values, np.arange(500))
    assert np.allclose(mean, values.mean(axis=0))
    assert np.allclose(error, values.std(axis=0, ddof=1) / math.sqrt(500))


def test_repeating_values_makes_no_error_smaller():
    values = np.random.default_rng(0).normal(size=(60, 1))
    cluster = np.arange(60)
    _, error = mean_and_error(values, cluster)
    _, again = mean_and_error(np.repeat(values, 9, axis=0), np.repeat(cluster, 9))
    assert np.allclose(error, again)


def test_a_single_cluster_has_no_error():
    assert np.isnan(mean_and_error(np.ones((5, 1)), np.zeros(5))[1]).all()


def test_the_baseline_scores_its_own_entropy_where_it_was_fitted():
    tracks = synthetic.tracks(3)
    baseline = ConstantVelocityGaussian.fit([tracks], HORIZONS)
    nll = baseline.nll(tracks, tracks.windows, HORIZONS).mean(axis=0)
    assert np.allclose(nll, 1.0 + math.log(2.0 * math.pi) + 0.5 * np.log(baseline.variance).sum(axis=-1))
    other = ConstantVelocityGaussian(HORIZONS, 1.5 * baseline.variance)
    assert (other.nll(tracks, tracks.windows, HORIZONS).mean(axis=0) > nll).all()


def test_the_baseline_is_the_published_formula():
    tracks = synthetic.tracks(3)
    baseline = ConstantVelocityGaussian((1.0,), np.array([[4.0, 0.25]]))
    track, step = tracks.windows[0]
    x, y, yaw, speed = tracks.observed[tracks.rows(track, step)].astype(float)
    dx, dy = tracks.label_future(track, step)[9] - [x, y]
    along = dx * math.cos(yaw) + dy * math.sin(yaw) - speed
    across = dy * math.cos(yaw) - dx * math.sin(yaw)
    expected = along**2 / 8.0 + across**2 / 0.5 + math.log(2.0 * math.pi * 2.0 * 0.5)
    assert baseline.nll(tracks, tracks.windows[:1], [1.0])[0, 0] == pytest.approx(expected, abs=1e-6)


def test_horizons_without_labels_are_refused():
    tracks = synthetic.tracks(3)
    with pytest.raises(HorizonError, match="multiples"):
        ConstantVelocityGaussian.fit([tracks], [0.25])
    with pytest.raises(HorizonError, match="ends before"):
        ConstantVelocityGaussian.fit([tracks], [4.5])
    with pytest.raises(HorizonError, match="not fitted at 2 s"):
        ConstantVelocityGaussian.fit([tracks], [1.0]).nll(tracks, tracks.windows, [1.0, 2.0])


def test_scores_have_a_row_per_horizon(data, checkpoint):
    told = []
    scores = evaluate_checkpoint(checkpoint, data, horizons=(0.5, 4.0), report=told.append)
    assert [row.horizon for row in scores.rows] == [0.5, 4.0]
    tracks = Dataset(data).split("test")[0]
    assert scores.windows == len(tracks.windows)
    assert 1 < scores.clusters < scores.windows
    assert told == sorted(told)
    assert told[-1] == pytest.approx(1.0)
    assert scores.floor == pytest.approx(Dataset(data).manifest.nll_floor)
    assert scores.mean == pytest.approx(np.mean([row.nll for row in scores.rows]))
    for row in scores.rows:
        assert row.gain == pytest.approx(row.baseline - row.nll)
        assert row.error > 0.0
    assert json.loads(json.dumps(scores.as_dict()))["rows"][1]["nll"] == scores.rows[1].nll
    assert len(scores.table()) == 3


def test_a_limit_takes_windows_from_everywhere(data, checkpoint):
    scores = evaluate_checkpoint(checkpoint, data, horizons=(1.0,), limit=20)
    assert scores.windows == 20
    assert scores.clusters == evaluate_checkpoint(checkpoint, data, horizons=(1.0,)).clusters


def test_a_baseline_scored_as_predictor_gains_nothing(data):
    dataset = Dataset(data)
    baseline = ConstantVelocityGaussian.fit(dataset.split("train"), HORIZONS)
    scores = evaluate(baseline, dataset)
    assert all(row.gain == 0.0 for row in scores.rows)


def test_batches_and_windows_alone_score_alike(checkpoint):
    tracks = synthetic.tracks(5)
    predictor = CheckpointPredictor(checkpoint)
    together = predictor.nll(tracks, tracks.windows, HORIZONS)
    some = [0, 17, len(tracks.windows) - 1]
    alone = np.concatenate([predictor.nll(tracks, tracks.windows[i : i + 1], HORIZONS) for i in some])
    assert np.allclose(together[some], alone, atol=1e-3)


class GaussianForecaster:
    """The baseline, told from a scene."""

    def __init__(self, baseline):
        self.baseline = baseline

    def log_prob(self, scene, points, horizons, frame):
        assert frame == "scene"
        x, y, sine, cosine, speed = scene.past[scene.target[0], -1].astype(float)
        d = points[0, :, 0] - [x, y]
        error = np.stack([cosine * d[:, 0] + sine * d[:, 1], cosine * d[:, 1] - sine * d[:, 0]], axis=-1)
        error[:, 0] -= speed * np.asarray(horizons)
        variance = self.baseline.variance
        terms = 0.5 * (error**2 / variance + np.log(2.0 * np.pi * variance))
        return -terms.sum(axis=-1)[None, :, None]


def test_scenes_carry_labels_in_the_right_frame():
    tracks = synthetic.tracks(6)
    baseline = ConstantVelocityGaussian.fit([tracks], HORIZONS)
    through_scenes = BundlePredictor(GaussianForecaster(baseline)).nll(tracks, tracks.windows, HORIZONS)
    assert np.allclose(through_scenes, baseline.nll(tracks, tracks.windows, HORIZONS), atol=1e-2)


def test_a_bundle_scores_as_its_checkpoint(pom):
    tracks = synthetic.tracks(7)
    windows = tracks.windows[::40]
    one = CheckpointPredictor(load_checkpoint(pom.checkpoint)).nll(tracks, windows, HORIZONS)
    other = BundlePredictor(Forecaster(pom.path, threads=1)).nll(tracks, windows, HORIZONS)
    assert np.allclose(one, other, atol=2e-3)


def test_a_bundle_transforms_as_its_checkpoint(pom):
    tracks = synthetic.tracks(7)
    windows = tracks.windows[::40]
    one = CheckpointPredictor(load_checkpoint(pom.checkpoint)).pit(tracks, windows, HORIZONS)
    other = BundlePredictor(Forecaster(pom.path, threads=1)).pit(tracks, windows, HORIZONS)
    assert np.allclose(one, other, atol=1e-3)


def test_a_bundle_maps_as_its_checkpoint(pom):
    tracks = synthetic.tracks(7)
    one = CheckpointPredictor(load_checkpoint(pom.checkpoint)).cells(tracks, tracks.windows[:3], HORIZONS, GRID)
    other = BundlePredictor(Forecaster(pom.path, threads=1)).cells(tracks, tracks.windows[:3], HORIZONS, GRID)
    assert np.allclose(one[0], other[0], atol=5e-4)
    assert np.array_equal(one[1], other[1])


class Oracle:
    """Knows where the label would be without noise, and spreads a Gaussian of variance `spread` around it."""

    name = "oracle"

    def __init__(self, clean, spread):
        self.clean, self.spread = clean, spread

    def nll(self, tracks, windows, horizons):
        clean = replace(tracks, label=self.clean[len(tracks.label)])
        error = labels(tracks, windows, horizons) - labels(clean, windows, horizons)
        return 0.5 * np.square(error).sum(axis=-1) / self.spread + math.log(2.0 * math.pi * self.spread)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_the_best_forecast_has_as_many_extra_nats_as_label_noise_leaves(protocol):
    tracks = synthetic.tracks(seed=3, count=150)
    truth, noise = tracks.truth[:, :2].astype(np.float64), synthetic.NOISE.label
    for label, spread, floor in (
        (truth, protocol.sigma**2, 0.0),
        (tracks.label, protocol.sigma**2 + noise**2, 0.5 * math.log1p((noise / protocol.sigma) ** 2)),
    ):
        moved = perturbed(replace(tracks, label=np.asarray(label, np.float32)), protocol)
        oracle = Oracle({len(truth): truth.astype(np.float32)}, spread)
        nll = oracle.nll(moved, tracks.windows, HORIZONS)
        found = summarise_extra_nats(HORIZONS, nll, tracks.windows[:, 0], protocol, noise * (floor > 0.0))
        assert found.floor == pytest.approx(floor)
        assert found.mean == pytest.approx(floor, abs=4.0 * found.mean_error)
        assert found.mean_error < 0.02


def test_extra_nats_do_not_depend_on_units():
    """HCNAF's code divides metres by 50 and has an entropy of -6.372463 per step."""
    normalised, metres = PROTOCOLS
    nll = np.array([[2.5, -0.3]])
    theirs = (nll - 2.0 * math.log(50.0) + 6.372463) / 2.0
    assert np.allclose(extra_nats(nll, normalised), theirs, atol=1e-6)
    assert np.allclose(extra_nats(nll, metres), (nll + 6.372463) / 2.0, atol=1e-6)


def test_perturbed_labels_are_as_far_away_as_they_should_be():
    tracks = synthetic.tracks(seed=3, count=60)
    for protocol in PROTOCOLS:
        moved = perturbed(tracks, protocol)
        away = moved.label.astype(float) - tracks.label
        assert away.std() == pytest.approx(protocol.sigma, rel=0.05)
        assert np.array_equal(perturbed(tracks, protocol).label, moved.label)
        assert np.array_equal(moved.observed, tracks.observed)


def test_a_network_alone(data, checkpoint):
    dataset = Dataset(data)
    predictor = CheckpointPredictor(checkpoint)
    kept = {"horizons": (1.0,), "calibrated": 0, "samples": 0, "extra": False}
    both = evaluate(predictor, dataset, "train", **kept)
    alone = [evaluate(predictor, dataset, "train", network=k, **kept) for k in (0, 1)]
    assert sum(scores.windows for scores in alone) == both.windows
    together = sum(scores.windows * scores.rows[0].nll for scores in alone) / both.windows
    assert together == pytest.approx(both.rows[0].nll)
    assert (both.network, alone[1].network) == (None, "circles")
    assert "train, circles" in alone[1].title
    with pytest.raises(DataError, match="has 2 in train"):
        evaluate(predictor, dataset, "train", network=2)


def test_extra_nats_can_be_left_out(data, checkpoint):
    scores = evaluate_checkpoint(checkpoint, data, horizons=(1.0,), limit=20, calibrated=0, samples=0, extra=False)
    assert (scores.extra_nats, scores.pit, scores.hdr_coverage, scores.reliability) == ((), None, None, None)
    whole = evaluate_checkpoint(checkpoint, data, horizons=(1.0,), limit=20, calibrated=10, samples=5)
    assert whole.rows == scores.rows
    assert (whole.pit.windows, whole.hdr_coverage.windows, whole.samples.windows) == (10, 10, 5)
    assert whole.reliability.windows == 10
    noisy = [e.mean for e in whole.extra_nats]
    assert noisy[1] > noisy[0]
    record = whole.record()
    assert record["test PIT KS"]["1 s"] == max(whole.pit.rows[0].along.ks, whole.pit.rows[0].across.ks)
    assert record["test coverage of 95% regions"]["1 s"] == whole.hdr_coverage.rows[-1].covered


def test_a_horizon_beyond_the_model_is_refused(checkpoint):
    tracks = synthetic.tracks(5)
    short = replace(checkpoint, config=replace(checkpoint.config, horizon=2.0))
    with pytest.raises(HorizonError, match="up to 2 s"):
        CheckpointPredictor(short).nll(tracks, tracks.windows, [3.0])


def test_models_of_the_other_kind_are_refused(data, checkpoint):
    toy = build(read_recipe("toy1").model)
    with pytest.raises(CheckpointError, match="kind condition"):
        evaluate_checkpoint(Checkpoint(toy.config, toy, {"task": "toy1"}, {}), data)
    with pytest.raises(CheckpointError, match="toy1 or toy2"):
        evaluate_toy_checkpoint(checkpoint)
