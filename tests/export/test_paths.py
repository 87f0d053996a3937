"""Scores of samples: by hand where a hand can, their standard errors, and the way from a bundle to them."""

import math

import numpy as np
import pytest

from hcnaf_export.baselines import ConstantVelocityGaussian, labels
from hcnaf_export.data.tracks import Dataset
from hcnaf_export.evaluation import BundlePredictor, evaluate
from hcnaf_export.evaluation.paths import (
    DRAWS,
    PATHS,
    WindowScores,
    energy_scores,
    score_paths,
    summarise_paths,
)
from hcnaf_export.evaluation.predictors import Sampler
from hcnaf_export.evaluation.spread import mean_and_error
from tests.export import synthetic

HORIZONS = (1.0, 2.0)


def paths(*xs):
    """[1, n, Q, 2] on the x axis."""
    return np.array([[[(float(x), 0.0) for x in row] for row in xs]])


TRUTH = np.array([[[1.0, 0.0], [2.0, 0.0]]])


def test_the_best_of_a_group_by_hand():
    made = paths((1.0, 5.0), (2.0, 2.5), (1.0, 2.0), (4.0, 6.0))
    # Mean displacements 1.5, 0.75 | 0, 3.5; last ones 3, 0.5 | 0, 4.
    found = score_paths(made, TRUTH, ks=(1, 2, 4))
    np.testing.assert_allclose(found.min_ade, [[(1.5 + 0.75 + 0.0 + 3.5) / 4, (0.75 + 0.0) / 2, 0.0]])
    np.testing.assert_allclose(found.min_fde, [[(3.0 + 0.5 + 0.0 + 4.0) / 4, (0.5 + 0.0) / 2, 0.0]])
    np.testing.assert_allclose(found.misses, [[0.5, 0.0, 0.0]])


def test_two_metres_are_no_miss_yet():
    for away, missed in ((2.0, 0.0), (2.001, 1.0)):
        made = paths((1.0, 2.0 + away), (1.0, 2.0 - away))
        assert score_paths(made, TRUTH, ks=(1,)).misses[0, 0] == missed


def test_the_best_path_is_best_as_a_whole():
    """min_ade picks one path, not the nearest point of any path at each horizon."""
    made = paths((1.0, 4.0), (3.0, 2.0))
    assert score_paths(made, TRUTH, ks=(2,)).min_ade[0, 0] == pytest.approx(1.0)


def test_energy_by_hand():
    made = paths((0.0, 2.0), (3.0, 2.0), (1.0, 2.0))
    # |X - y| is 1, 2, 0; pairs are 3, 1, 2 apart.
    np.testing.assert_allclose(energy_scores(made, TRUTH), [[1.0 - 0.5 * 2.0, 0.0]], atol=1e-15)


def test_energy_is_least_for_the_truth():
    rng = np.random.default_rng(0)
    truth = rng.normal(size=(3000, 1, 2))
    honest, narrow, moved = (
        energy_scores(shift + scale * rng.normal(size=(3000, 20, 1, 2)), truth).mean()
        for scale, shift in ((1.0, 0.0), (0.4, 0.0), (1.0, 0.7))
    )
    assert honest < min(narrow, moved)
    # E|X - Y| of two standard normals in the plane is sqrt(pi); half of it remains.
    assert honest == pytest.approx(math.sqrt(math.pi) / 2, abs=0.03)


def test_more_paths_are_never_worse():
    rng = np.random.default_rng(1)
    found = score_paths(rng.normal(size=(50, DRAWS, 3, 2)), rng.normal(size=(50, 3, 2)))
    assert all(DRAWS % k == 0 for k in PATHS)
    assert (found.min_ade[:, 1] <= found.min_ade[:, 0]).all()
    assert (found.misses[:, 1] <= found.misses[:, 0]).all()


def test_means_come_with_the_errors_of_clusters():
    rng = np.random.default_rng(2)
    parts = WindowScores(*(rng.normal(size=(40, 2)) for _ in range(4)))
    cluster = np.repeat(np.arange(10), 4)
    scores = summarise_paths(HORIZONS, parts, cluster)
    mean, error = mean_and_error(parts.min_fde, cluster)
    assert (scores.windows, scores.clusters) == (40, 10)
    assert [p.k for p in scores.paths] == list(PATHS)
    assert scores.paths[1].min_fde == pytest.approx(mean[1])
    assert scores.paths[1].min_fde_error == pytest.approx(error[1])
    assert [e.horizon for e in scores.energy] == list(HORIZONS)
    assert scores.energy[0].error == pytest.approx(mean_and_error(parts.energy, cluster)[1][0])


class Fan:
    """Draws paths around the recorded labels: known scores, no bundle."""

    name, draws = "fan", True

    def nll(self, tracks, windows, horizons):
        return np.zeros((len(windows), len(horizons)))

    def paths(self, tracks, windows, horizons, count):
        truth = labels(tracks, windows, horizons)[:, None]
        step = np.zeros((1, count, 1, 2))
        step[0, :, 0, 0] = 3.0 + np.arange(count)
        return truth + step


def test_evaluation_scores_samples_of_some_windows(tmp_path):
    dataset = Dataset(synthetic.write(tmp_path / "set"))
    scores = evaluate(Fan(), dataset, horizons=HORIZONS, samples=30)
    assert scores.samples is not None
    assert scores.samples.windows == 30
    assert scores.windows > 30
    six, twenty = scores.samples.paths
    assert six.min_ade == pytest.approx(3.0 + np.arange(0, DRAWS, 6).mean())
    assert twenty.min_fde == pytest.approx(3.0 + np.arange(0, DRAWS, 20).mean())
    assert (six.miss_rate, twenty.miss_rate) == (1.0, 1.0)
    assert scores.record()["test best of 6 paths"]["min_ade (m)"] == six.min_ade
    assert evaluate(Fan(), dataset, horizons=HORIZONS, samples=0).samples is None
    baseline = ConstantVelocityGaussian.fit(dataset.split("train"), HORIZONS)
    assert not isinstance(baseline, Sampler)
    assert evaluate(baseline, dataset, horizons=HORIZONS).samples is None


class Ahead:
    """A forecaster whose paths drive straight on at the observed speed, in the scene frame."""

    def trajectories(self, scene, n, horizons, seed, frame):
        assert frame == "scene"
        x, y, sine, cosine, speed = scene.past[scene.target[0], -1].astype(float)
        d = speed * np.asarray(horizons)
        points = np.stack([x + d * cosine, y + d * sine], axis=-1)

        class Made:
            pass

        made = Made()
        made.points = np.broadcast_to(points[None, :, None], (1, len(horizons), n, 2))
        return made


def test_paths_of_scenes_come_in_the_frame_of_the_labels():
    tracks = synthetic.tracks(6)
    baseline = ConstantVelocityGaussian(HORIZONS, np.ones((2, 2)))
    found = BundlePredictor(Ahead()).paths(tracks, tracks.windows[:20], HORIZONS, 3)
    away = np.square(found[:, 0] - labels(tracks, tracks.windows[:20], HORIZONS)).sum(axis=-1)
    expected = 2.0 * (baseline.nll(tracks, tracks.windows[:20], HORIZONS) - math.log(2.0 * math.pi))
    np.testing.assert_allclose(away, expected, atol=5e-3)
