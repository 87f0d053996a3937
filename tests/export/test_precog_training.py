"""PRECOG-CARLA from files to forecasts: batches, training, scores through PyTorch and through a bundle."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
import torch

from hcnaf_export.checkpoint import load_checkpoint
from hcnaf_export.data.precog import LIDAR_CHANNELS, convert_precog
from hcnaf_export.data.precog_set import episode_files, load_episodes
from hcnaf_export.evaluation.extra_nats import PROTOCOLS, noise_entropy
from hcnaf_export.evaluation.precog import (
    constant_velocity,
    evaluate_episodes_bundle,
    evaluate_episodes_checkpoint,
)
from hcnaf_export.export import export_bundle
from hcnaf_export.recipe import Episodes, Optimiser, PrecogRecipe, parse_recipe, read_recipe, shipped, to_toml
from hcnaf_export.training.precog import EpisodeBatches, horizons_of
from hcnaf_export.training.run import make_task, run_training
from hcnaf_export.training.share import Share
from hcnaf_models.config import Crop, PomConfig
from hcnaf_models.raster import crop_raster
from hcnaf_models.spec import FlowSpec
from hcnaf_runtime import Forecaster
from hcnaf_runtime.errors import DataError, HorizonError, RecipeError
from tests.data import episodes

CPU = torch.device("cpu")
NATIVE = Crop(behind=50.0, ahead=50.0, side=50.0, resolution=0.5)
MODEL = PomConfig(
    flow=FlowSpec(layers=1, hidden=6),
    step=0.2,
    actors="history",
    channels=("lidar_above", "lidar_below"),
    draw_actors=False,
    crop=Crop(behind=16.0, ahead=48.0, side=32.0, resolution=2.0),
    widths=(4, 6),
    trunk=(24, 12),
)
TINY = PrecogRecipe(
    name="tiny",
    about="A test's.",
    task="precog",
    optimiser=Optimiser(steps=40, batch=8, learning_rate=1e-2, warm_up=5, average=0.9, validate_every=20),
    model=MODEL,
    episodes=Episodes(draws=2, horizons=4),
)


def changed(**settings):
    """TINY with another model."""
    return msgspec.structs.replace(TINY, model=replace(MODEL, **settings))


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return episodes.write(tmp_path_factory.mktemp("precog") / "set", (12, 4, 4))


@pytest.fixture(scope="module")
def run(tmp_path_factory, data):
    return run_training(TINY, data, tmp_path_factory.mktemp("run") / "out", threads=1)


@pytest.fixture(scope="module")
def bundle(run):
    return export_bundle(run.out / "model.pt", run.out.parent / "bundle", density_only=True).path


@pytest.mark.parametrize("crop", [NATIVE, Crop(behind=20.0, ahead=60.0, side=30.0, resolution=1.0)])
def test_the_encoder_sees_what_the_exported_graph_will_crop(data, crop):
    config = replace(MODEL, channels=("lidar_above", "lidar_hits"), crop=crop)
    pool = EpisodeBatches(load_episodes(data, "test", 0.2), config)
    seen = pool.crop(np.array([2, 0]))
    for k, number in enumerate((2, 0)):
        scene = convert_precog(episode_files(data, "test")[number], target_step=0.2)
        planes = scene.raster[[LIDAR_CHANNELS.index(name) for name in config.channels]]
        whole = torch.from_numpy(planes).float() / 127.0
        origin, resolution = torch.tensor(scene.origin.tolist()), torch.tensor([scene.resolution])
        expected = crop_raster(whole, origin, resolution, torch.zeros(1, 3), crop)[0]
        torch.testing.assert_close(seen[k], expected, atol=1e-4, rtol=0.0)


def test_batches_follow_from_the_step_and_shares_make_up_the_whole(data):
    task = make_task(TINY, data, CPU)
    task.batch(0)
    whole = task.batch(3)
    again = make_task(TINY, data, CPU).batch(3)
    parts = [make_task(TINY, data, CPU).batch(3, Share(k, 2)) for k in range(2)]
    for name, value in whole._asdict().items():
        if value is not None:
            torch.testing.assert_close(value, getattr(again, name), equal_nan=True)
            joined = torch.cat([getattr(part, name) for part in parts])
            torch.testing.assert_close(value, joined, equal_nan=True)


def test_thinning_takes_overhead_pixels_alone(data):
    thin = msgspec.structs.replace(TINY, model=replace(MODEL, crop=NATIVE), episodes=Episodes(thin=0.6))
    whole = make_task(msgspec.structs.replace(thin, episodes=Episodes()), data, CPU).batch(2)
    thinned = make_task(thin, data, CPU).batch(2)
    assert torch.equal(whole.points, thinned.points)
    assert torch.equal(whole.crop[:, -1], thinned.crop[:, -1])
    left = thinned.crop[:, :-1].sum(dim=(1, 2, 3)) / whole.crop[:, :-1].sum(dim=(1, 2, 3))
    assert 0.3 < left.min() < left.max() <= 1.0
    assert torch.equal(make_task(thin, data, CPU).batch(2, Share(1, 2)).crop, thinned.crop[4:])


def test_labels_are_the_future_rows_with_the_noise_asked_for(data):
    quiet = msgspec.structs.replace(TINY, episodes=Episodes(noise=0.0, draws=1, horizons=20))
    task = make_task(quiet, data, CPU)
    batch = task.batch(0)
    assert batch.horizons[0].tolist() == pytest.approx(list(horizons_of(MODEL)))
    known = torch.from_numpy(load_episodes(data, "train", 0.2).future[:, 0, :20])
    for label in batch.points[:, :, 0]:
        assert (label == known).all(dim=(1, 2)).any()
    spread = make_task(msgspec.structs.replace(quiet, episodes=Episodes(noise=0.5, draws=400)), data, CPU)
    assert spread.batch(0).points.std(dim=2).mean() == pytest.approx(0.5, rel=0.05)


def test_a_run_learns_and_says_what_from(run, data):
    assert run.finished
    loaded = load_checkpoint(run.out / "model.pt")
    assert loaded.config == MODEL
    assert {"label_noise": 0.5, "time_step": 0.2, "windows": 12}.items() <= loaded.training.items()
    assert set(run.scores) == {"1 s", "2 s", "3 s", "4 s", "mean"}
    lines = [msgspec.json.decode(line) for line in (run.out / "metrics.jsonl").read_bytes().splitlines()]
    first, *_, last = [line["validation"]["mean"] for line in lines if "validation" in line]
    assert last < first


def test_the_bundle_scores_as_the_checkpoint_does(run, bundle, data):
    told: list[float] = []
    one = evaluate_episodes_checkpoint(load_checkpoint(run.out / "model.pt"), data, report=told.append)
    other = evaluate_episodes_bundle(bundle, data, threads=1)
    assert one.nll.shape == (1 + len(PROTOCOLS), 4, 20)
    np.testing.assert_allclose(one.nll, other.nll, atol=2e-3)
    assert [row.baseline for row in one.scores.rows] == [row.baseline for row in other.scores.rows]
    assert told[-1] == 1.0
    assert [row.horizon for row in one.scores.rows] == pytest.approx(list(horizons_of(MODEL)))


def test_extra_nats_are_of_perturbed_labels(run, data):
    found = evaluate_episodes_checkpoint(load_checkpoint(run.out / "model.pt"), data, horizons=(1.0, 4.0))
    for k, (extra, protocol) in enumerate(zip(found.scores.extra_nats, PROTOCOLS, strict=True), start=1):
        expected = (found.nll[k].mean() - noise_entropy(protocol.sigma)) / 2.0
        assert extra.mean == pytest.approx(expected)
        assert (extra.protocol, extra.floor) == (protocol.name, 0.0)
    plain = found.scores.mean
    assert plain == pytest.approx(found.nll[0].mean())


def test_scoring_some_episodes_scores_them_as_among_all(run, data):
    checkpoint = load_checkpoint(run.out / "model.pt")
    whole = evaluate_episodes_checkpoint(checkpoint, data)
    some = evaluate_episodes_checkpoint(checkpoint, data, limit=2, horizons=(0.4, 2.0))
    np.testing.assert_allclose(some.nll, whole.nll[:, some.episode][..., [1, 9]], atol=1e-5)


def test_a_scene_made_from_a_file_is_forecast(bundle, data):
    scene = convert_precog(episode_files(data, "test")[0], target_step=0.2, targets="all")
    points = np.zeros((5, 2, 1, 2), np.float32)
    found = Forecaster(bundle, threads=1).log_prob(scene, points, horizons=[1.0, 4.0])
    assert found.shape == (5, 2, 1)
    assert np.isfinite(found).all()


def test_the_baseline_is_fitted_on_the_training_split(data):
    train = load_episodes(data, "train", 0.2)
    rows = np.array([0, 19])
    speed = train.past[:, 0, -1, 4:5].astype(np.float64)
    straight = np.stack([speed * [0.2, 4.0], np.zeros((12, 2))], axis=-1)
    errors = train.future[:, 0, rows] - straight
    found = constant_velocity(train, rows)
    np.testing.assert_allclose(found.variance, np.square(errors).mean(axis=0), rtol=1e-6)
    normal = torch.distributions.Normal(0.0, torch.from_numpy(np.sqrt(found.variance)))
    expected = -normal.log_prob(torch.from_numpy(errors)).sum(-1).numpy()
    np.testing.assert_allclose(found.nll_of(errors), expected)


def test_what_cannot_be_trained_or_scored_is_refused(run, data):
    with pytest.raises(RecipeError, match="'drivable', episodes have lidar_hits"):
        make_task(changed(channels=("drivable",)), data, CPU)
    with pytest.raises(RecipeError, match="episodes have no stop lines"):
        make_task(changed(stops=True), data, CPU)
    with pytest.raises(DataError, match=r"has 10 past and 40 future rows 0\.2 s apart"):
        make_task(changed(horizon=9.0), data, CPU)
    with pytest.raises(RecipeError, match="download PRECOG-CARLA"):
        make_task(TINY, None, CPU)
    checkpoint = load_checkpoint(run.out / "model.pt")
    for horizons in ((0.5,), (5.0,), (0.0,)):
        with pytest.raises(HorizonError, match=r"at multiples of 0\.2 s up to 4 s"):
            evaluate_episodes_checkpoint(checkpoint, data, horizons=horizons)


@pytest.mark.parametrize("name", [name for name in shipped() if name.startswith("precog")])
def test_shipped_recipes_are_for_episodes_and_come_in_pairs(name):
    recipe = read_recipe(name)
    assert isinstance(recipe, PrecogRecipe)
    assert parse_recipe(to_toml(recipe)) == recipe
    assert (recipe.model.step, recipe.model.history, len(horizons_of(recipe.model))) == (0.2, 10, 20)
    twin = read_recipe(name.removesuffix("-nolidar") + "-nolidar")
    assert twin.model.channels == ()
    assert (recipe.optimiser, recipe.episodes, recipe.seed) == (twin.optimiser, twin.episodes, twin.seed)
