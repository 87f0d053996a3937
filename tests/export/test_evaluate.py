"""Scores: exact where they can be, the same on every path, with errors that know about dependence."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from hcnaf_export.baselines import ConstantVelocityGaussian
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
from hcnaf_export.evaluation.scores import mean_and_error
from hcnaf_export.recipe import read_recipe
from hcnaf_models.config import PomConfig
from hcnaf_models.model import build
from hcnaf_runtime import Forecaster
from hcnaf_runtime.errors import CheckpointError, HorizonError
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
