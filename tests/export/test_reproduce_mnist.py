"""`hcnaf reproduce mnist`: the quick run, the bundle it makes, what it is compared with, and the paper's size."""

import dataclasses
import json
from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch
from click.testing import CliRunner
from scipy import stats

from hcnaf_cli.train import main as hcnaf
from hcnaf_export.checkpoint import load_checkpoint, save_checkpoint
from hcnaf_export.data.mnist import CLASSES, Images, dequantise, load, log_jacobian
from hcnaf_export.data.segments import segments
from hcnaf_export.export import export_bundle
from hcnaf_export.recipe import parse_recipe, read_recipe, to_toml
from hcnaf_export.reproduce import mnist, record, sizes
from hcnaf_export.reproduce.digits import BundleScores, ModelScores, score
from hcnaf_export.reproduce.gaussians import Gaussians, marginal
from hcnaf_export.reproduce.histograms import Histograms
from hcnaf_export.training.mnist import MnistTask, fresh, start
from hcnaf_export.training.run import run_training
from hcnaf_export.wide_export import export_wide, load_wide
from hcnaf_runtime import Bundle, Condition, Forecaster
from hcnaf_runtime.errors import BundleError, CheckpointError, DataError, InputError, RecipeError
from hcnaf_runtime.verify import verify

ROOT = Path(__file__).parents[2]
DATA = ROOT.parent / "shared" / "data" / "mnist"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="MNIST is not in ../shared/data")


def reproduce(*args):
    return CliRunner().invoke(hcnaf, ["reproduce", "mnist", *map(str, args)], prog_name="hcnaf")


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    """The directory of a quick run, and its printed record."""
    out = tmp_path_factory.mktemp("mnist") / "quick"
    result = reproduce("--quick", "--out", out, "--json")
    assert result.exit_code == 0, result.output
    return out, json.loads(result.stdout)


def test_a_quick_run_holds_its_bounds_and_writes_everything(quick):
    out, printed = quick
    assert {"record.json", "figure.png", "run", "bundle"} == {p.name for p in out.iterdir()}
    found = record.read(out / record.FILE)
    assert json.loads(json.dumps(found.as_dict())) == printed
    assert found.quick
    assert [bound.holds for bound in found.bounds] == [True, True]
    assert {row.model for row in found.rows} == {"HCNAF, L = 1, H = 3", "independent pixels per class"}
    assert (out / "figure.png").read_bytes().startswith(b"\x89PNG")


def test_a_model_without_couplings_breaks_the_quick_bound(quick):
    out, printed = quick
    model = load_wide(out / "run" / "model.pt").model
    with torch.no_grad():
        for stripe in (*model.first, *model.second):
            stripe.zero_()
    data = segments(0, *mnist.STAND_IN)
    x = dequantise(data.test.pixels, np.random.default_rng((0, 4)))
    pixels = score(Histograms.fit(data.train), x, data.test.labels)
    broken = score(ModelScores(model), x, data.test.labels)
    assert broken.nll - pixels.nll > -mnist.LEAST_GAIN_QUICK
    by_model = {row["model"]: row["figures"]["NLL (nats)"]["value"] for row in printed["rows"]}
    assert by_model["independent pixels per class"] == pytest.approx(pixels.nll)


def test_the_bundle_is_one_like_any_other(quick):
    out, _ = quick
    bundle = Bundle.open(out / "bundle")
    assert all(row.passed for row in verify(bundle, 1))
    assert all(row.passed for row in bundle.manifest.parity)
    assert bundle.manifest.kind == "condition"
    assert bundle.manifest.condition.names == [str(k) for k in range(CLASSES)]
    x = dequantise(segments(0, 1, 1, 30).test.pixels, np.random.default_rng(1))
    public = Forecaster(out / "bundle", 1).log_prob(Condition(np.eye(CLASSES, dtype=np.float32)), x)[:, 0]
    assert np.allclose(public, BundleScores.of(out / "bundle", 1).log_prob(x), rtol=1e-5)
    assert np.abs(public - ModelScores(load_wide(out / "run" / "model.pt").model).log_prob(x)).max() < 1e-3


def test_scores_do_not_depend_on_how_many_images_are_held_at_once(quick):
    out, _ = quick
    x = dequantise(segments(0, 1, 1, 7).test.pixels, np.random.default_rng(1))
    whole = BundleScores.of(out / "bundle", 1)
    assert np.allclose(whole.log_prob(x), dataclasses.replace(whole, images=3).log_prob(x), rtol=1e-5)


def test_a_finished_run_is_taken_up_as_it_is_on_resume(quick):
    out, printed = quick
    before = load_wide(out / "run" / "model.pt")
    data = segments(0, *mnist.STAND_IN)
    request = record.Request(out=out, quick=True, resume=True)
    assert sizes.train(sizes.recipe_for("mnist-quick", 0), data, out / "run", request, record.Clock()) > 0.0
    after = load_wide(out / "run" / "model.pt")
    assert after.scores["validation"]["mean"] == pytest.approx(before.scores["validation"]["mean"], abs=0.1)
    assert printed["settings"]["training_seconds"] > 0.0


def test_what_cannot_be_done_is_refused_in_a_line(quick, tmp_path):
    out, _ = quick
    for args, message in (
        (("--out", tmp_path / "a"), "give their directory as --data"),
        (("--out", tmp_path / "b", "--data", tmp_path), "has neither train-images-idx3-ubyte"),
        (("--out", out, "--quick"), "is not empty"),
    ):
        result = reproduce(*args)
        assert (result.exit_code, len(result.stderr.splitlines())) == (2, 1)
        assert message in result.stderr


def test_training_and_export_take_the_recipe_and_the_checkpoint_too(quick, tmp_path):
    out, _ = quick
    recipe = read_recipe("mnist-quick")
    with pytest.raises(RecipeError, match="needs the four idx files"):
        run_training(recipe, None, tmp_path / "run")
    with pytest.raises(DataError, match="has neither"):
        run_training(recipe, tmp_path, tmp_path / "run")
    with pytest.raises(InputError, match="fp32 only"):
        export_bundle(out / "run" / "model.pt", tmp_path / "bundle", precision="fp16")
    with pytest.raises(BundleError, match="is not empty"):
        export_bundle(out / "run" / "model.pt", out / "bundle")
    with pytest.raises(CheckpointError, match="fit the configuration"):
        load_checkpoint(out / "run" / "model.pt")


def test_checkpoints_of_another_kind_are_refused(tmp_path):
    save_checkpoint(tmp_path / "model.pt", read_recipe("toy1").model, {}, {}, {})
    with pytest.raises(CheckpointError, match="not the checkpoint of a wide flow"):
        export_wide(tmp_path / "model.pt", tmp_path / "bundle")
    assert not (tmp_path / "bundle").exists()


def test_batches_follow_from_the_step_and_go_through_all_images():
    recipe = read_recipe("mnist-quick")
    data = segments(0, 250, 20, 1)
    numbered = Images(data.train.pixels, np.arange(250))  # to see which images a batch has
    one, two = (MnistTask(recipe, numbered, data.validation) for _ in range(2))
    for step in (0, 5, 1):
        assert torch.equal(one.batch(step).x, two.batch(step).x)
    epochs = [torch.cat([one.batch(2 * e + k).labels for k in range(2)]).tolist() for e in range(2)]
    assert len(set(epochs[0])) == 200
    assert epochs[0] != epochs[1]
    with pytest.raises(RecipeError, match="there are 5 training images"):
        MnistTask(recipe, numbered.part(slice(0, 5)), data.validation)
    with pytest.raises(RecipeError, match="images have 3"):
        fresh(recipe, Images(np.zeros((4, 3), np.uint8), np.zeros(4, np.int64)))


@pytest.mark.parametrize("name", ["mnist", "mnist-small", "mnist-quick"])
def test_recipes_survive_toml_and_have_the_sizes_of_images(name):
    recipe = read_recipe(name)
    assert parse_recipe(to_toml(recipe)) == recipe
    assert (recipe.model.flow.dims, recipe.model.flow.layers, recipe.model.classes) == (784, 1, CLASSES)


def test_the_papers_size_trains_in_bounded_memory():
    config = read_recipe("mnist").model
    D, H = config.flow.dims, config.flow.hidden
    assert round(D * D * H * 2 / 1e6, 1) == 46.7  # N_W as the paper counts, zeros above the diagonal included
    assert config.shared < 0.52 * D * D * H * 2
    found = sizes.paper_size(segments(0, 300, 1, 1), record.Request(out=Path()), record.Clock())
    assert found["shared_weights"] == config.shared
    # Weights, their average, gradient and two moments, and what a batch needs.
    assert found["memory_mib"] < 2000


def test_a_step_learns_with_the_optimiser_of_the_recipe():
    recipe = read_recipe("mnist-quick")
    data = segments(0, 300, 20, 1)
    state = start(fresh(recipe, data.train), recipe.optimiser)
    task = MnistTask(recipe, data.train, data.validation)
    decayed, plain = state.optimiser.param_groups
    assert len(decayed["params"]) == 2 * recipe.model.stripes
    assert sum(p.numel() for g in (decayed, plain) for p in g["params"]) == sum(
        p.numel() for p in state.model.parameters()
    )
    first = task.validate(state.model)["mean"]
    for group in state.optimiser.param_groups:
        group["lr"] = 2e-3  # no warm-up here
    for step in range(20):
        sizes._step(task, state, step)
    assert task.validate(state.model)["mean"] < first - 10.0


def test_gaussians_are_those_of_scipy():
    rng = np.random.default_rng(0)
    labels = np.arange(200) % 2
    x = rng.normal(size=(200, 5)) @ rng.normal(size=(5, 5)) + labels[:, None]
    fitted = Gaussians.fit(x, labels, 2).log_prob(x[:9])
    for k in range(2):
        own = x[labels == k]
        expected = stats.multivariate_normal(own.mean(0), np.cov(own.T, bias=True)).logpdf(x[:9])
        assert np.allclose(fitted[k], expected)
    with pytest.raises(DataError, match="more than the 5 dimensions"):
        Gaussians.fit(x[:10], labels[:10], 2)


def test_the_marginal_is_the_mean_of_densities():
    log_prob = np.array([[-1000.0, 0.0], [-1001.0, -5.0]])
    expected = np.array([-1000.0 + np.log((1 + np.exp(-1.0)) / 2), np.log((1 + np.exp(-5.0)) / 2)])
    assert np.allclose(marginal(log_prob), expected)


def test_histograms_are_densities_of_single_pixels():
    levels = np.repeat(np.arange(256, dtype=np.uint8), 4)
    data = Images(np.random.default_rng(0).choice(levels[:40], (500, 1)), np.arange(500) % CLASSES)
    model = Histograms.fit(data)
    assert np.allclose(np.exp(model.log_density).mean(-1), 1.0)
    x = dequantise(np.arange(256, dtype=np.uint8)[:, None], np.random.default_rng(0))
    expected = model.log_density[:, 0] - log_jacobian(x)
    assert np.allclose(model.log_prob(x), expected)


@needs_data
def test_a_gaussian_per_class_reproduces_the_published_score():
    data = load(DATA)
    assert [len(s) for s in (data.train, data.validation, data.test)] == [50_000, 10_000, 10_000]
    known = dequantise(data.train.pixels, np.random.default_rng(0))
    x = dequantise(data.test.pixels, np.random.default_rng(1))
    found = score(Gaussians.fit(known, data.train.labels, CLASSES), x, data.test.labels)
    assert abs(found.nll - mnist.GAUSSIAN) < mnist.MOST_AWAY


def test_the_record_of_the_full_run_holds_its_bounds():
    found = record.read(ROOT / "docs" / "results" / "mnist" / record.FILE)
    assert not found.quick
    assert found.settings["images"] == {"train": 50_000, "validation": 10_000, "test": 10_000}
    assert all(bound.holds for bound in found.bounds)
    recipe = msgspec.convert(found.settings["recipe"], type(read_recipe("mnist-small")))
    assert recipe == read_recipe("mnist-small")
