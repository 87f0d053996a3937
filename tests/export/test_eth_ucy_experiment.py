"""The ETH/UCY experiment on made-up recordings: nothing leaks, cells resume, and the record is what cells say."""

import gzip
import json

import msgspec
import numpy as np
import pytest
import torch

from hcnaf_export.baselines.tracks import constant_velocity
from hcnaf_export.data import eth_ucy as data
from hcnaf_export.experiments import eth_ucy as experiment
from hcnaf_export.experiments.eth_ucy_report import markdown, plot, record_of, tables
from hcnaf_export.recipe import TrackRecipe, from_plain, parse_recipe, read_recipe, to_plain, to_toml
from hcnaf_export.training.eth_ucy import HORIZONS, TrackTask, batches, score, track_batch
from hcnaf_models.config import HistoryConfig
from hcnaf_models.spec import FlowSpec
from hcnaf_runtime.errors import RecipeError


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Eight recordings of walkers, each in its own corner of the world."""
    folder = tmp_path_factory.mktemp("eth_ucy")
    for number, name in enumerate(data.RECORDINGS):
        rng = np.random.default_rng(number)
        rows = []
        for pedestrian in range(4):
            step = 0.5 * rng.normal(size=2)
            place = 100.0 * number + np.cumsum(step + 0.05 * rng.normal(size=(24, 2)), axis=0)
            rows += [(10.0 * k, pedestrian, *xy) for k, xy in enumerate(place)]
        with gzip.open(folder / f"{name}.txt.gz", "wt") as file:
            file.write("\n".join("\t".join(map(str, row)) for row in rows) + "\n")
    return folder


def small(**changes) -> TrackRecipe:
    recipe = read_recipe("eth-ucy")
    settings = {"steps": 4, "batch": 16, "validate_every": 2, "minutes": 0.0}
    return msgspec.structs.replace(
        recipe,
        optimiser=msgspec.structs.replace(recipe.optimiser, **settings),
        model=HistoryConfig(flow=FlowSpec(hidden=4), trunk=(16,), rank=8),
        tracks=msgspec.structs.replace(recipe.tracks, compile=False),
        **changes,
    )


@pytest.fixture(scope="module")
def plan(recordings, tmp_path_factory):
    """A plan whose cells are done."""
    made = experiment.Plan(
        data=recordings,
        out=tmp_path_factory.mktemp("out") / "run",
        splits=("eth", "univ"),
        models=("hcnaf", "mixture"),
        seeds=(0, 1),
        recipe=small(),
        threads=1,
    )
    assert all(experiment.run_cell(made, *cell) for cell in experiment.cells(made))
    return made


def test_cells_differ_in_split_head_and_seed_only():
    plan = experiment.Plan(data=".", out=".", recipe=small())
    cells = [to_plain(experiment.cell_recipe(plan, *cell)) for cell in experiment.cells(plan)]
    assert len(cells) == 5 * 4
    for cell in cells:
        cell["model"].pop("head"), cell["tracks"].pop("split"), cell.pop("name")
    assert all(cell == cells[0] for cell in cells)


def test_what_is_tested_on_neither_trains_nor_validates(recordings):
    for name, tested in data.TEST.items():
        recipe = small()
        recipe = msgspec.structs.replace(recipe, tracks=msgspec.structs.replace(recipe.tracks, split=name))
        task = TrackTask(recipe, recordings, torch.device("cpu"))
        held_out = set(task.held_out.scene.tolist())
        assert held_out == {data.RECORDINGS.index(r) for r in recipe.tracks.validation}
        assert task.facts["windows"] == 4 * 5 * (8 - len(tested) - len(held_out))


def test_validation_recordings_are_tested_on_by_no_split():
    recipe = read_recipe("eth-ucy")
    assert not set(recipe.tracks.validation) & {r for tested in data.TEST.values() for r in tested}


def test_batches_follow_from_the_step_and_are_the_same_for_every_head(recordings):
    recipe = small()
    tasks = [
        TrackTask(msgspec.structs.replace(recipe, model=HistoryConfig(head=h)), recordings, torch.device("cpu"))
        for h in ("hcnaf", "mixture")
    ]
    for a, b in zip(tasks[0].batch(7), tasks[1].batch(7), strict=True):
        assert torch.equal(a, b)
    assert not torch.equal(tasks[0].batch(7).points, tasks[0].batch(8).points)


def test_labels_lie_in_the_frame_of_their_history():
    k = np.arange(20)[:, None]
    track = np.array([5.0, -3.0]) + k * np.array([0.3, 0.4])
    rows = np.arange(12)[None]
    batch = track_batch(track[None, :8], rows, track[None, 8:], 0.0, np.random.default_rng(0))
    expected = constant_velocity(track[None, :8], 12)
    np.testing.assert_allclose(batch.points.numpy(), expected, atol=1e-4)
    np.testing.assert_allclose(batch.horizons.numpy(), [HORIZONS], rtol=1e-6)


def test_scores_are_means_over_cells(plan):
    record = record_of(plan)
    for name, split in record.splits.items():
        for model in plan.models:
            found = [experiment.load_cell(experiment.cell_folder(plan.out, name, model, s)) for s in plan.seeds]
            assert split.models[model].nll == pytest.approx(np.mean([c.nll.mean() for c in found]))
            assert split.models[model].seeds == pytest.approx([c.nll.mean() for c in found])
            assert all(c.facts["steps"] == 4 for c in found)
        ours = split.models["hcnaf"]
        assert (ours.behind, ours.behind_error) == (0.0, 0.0)
        other = split.models["mixture"]
        assert other.behind == pytest.approx(other.nll - ours.nll)
    assert record.mean["mixture"] == pytest.approx(
        np.mean([s.models["mixture"].nll for s in record.splits.values()])
    )
    assert set(record.mean) == {"hcnaf", "mixture", experiment.CONSTANT_VELOCITY}
    assert json.loads(json.dumps(record.as_dict()))["splits"]["univ"]["windows"] == 2 * 4 * 5


def test_a_cell_that_is_done_is_left_alone_and_scores_what_its_checkpoint_says(plan):
    from hcnaf_export.checkpoint import load_checkpoint

    folder = experiment.cell_folder(plan.out, "eth", "mixture", 0)
    before = (folder / "model.pt").stat().st_mtime_ns
    assert experiment.run_cell(plan, "eth", "mixture", 0)
    assert (folder / "model.pt").stat().st_mtime_ns == before
    model = load_checkpoint(folder / "model.pt").model
    test = data.split(plan.data, "eth").test
    np.testing.assert_allclose(experiment.load_cell(folder).nll, score(model, test), rtol=1e-6)


def test_paths_of_a_model_are_drawn_by_it(plan):
    from hcnaf_export.checkpoint import load_checkpoint

    folder = experiment.cell_folder(plan.out, "eth", "hcnaf", 0)
    model = load_checkpoint(folder / "model.pt").model
    windows = data.split(plan.data, "eth").test
    paths, truth = experiment.sample_paths(model, windows)
    assert paths.shape == (len(windows), experiment.PATHS, 12, 2)
    np.testing.assert_allclose(truth, np.concatenate([b.points.numpy() for b in batches(windows)]), rtol=1e-6)
    again, _ = experiment.sample_paths(model, windows)
    np.testing.assert_array_equal(paths, again)


def test_tables_text_and_picture(plan):
    pytest.importorskip("matplotlib")
    record = record_of(plan)
    for head, *rows in tables(record).values():
        assert head == ("", "eth", "univ", "mean")
        assert all(len(row) == 4 for row in rows)
    text = markdown(record)
    assert f"| HCNAF | {record.splits['eth'].models['hcnaf'].nll:.3f} ±" in text
    assert "4 steps of 16 windows" in text
    plot(record, plan.out / "nll.png")
    assert (plan.out / "nll.png").stat().st_size > 5000


def test_the_recipe_is_strict_and_survives_a_round_trip():
    recipe = read_recipe("eth-ucy")
    assert from_plain(to_plain(recipe)) == recipe
    assert parse_recipe(to_toml(recipe)) == recipe
    with pytest.raises(RecipeError, match="horizons must be 1 to 12"):
        parse_recipe(to_toml(recipe).replace("horizons = 4", "horizons = 13"))
    with pytest.raises(RecipeError, match="unknown key 'tracks"):
        parse_recipe(to_toml(recipe).replace("stretch", "strech"))


@pytest.mark.parametrize(("text", "other", "message"), [
    ('split = "zara1"', 'split = "zara3"', "zara3"),
    ("history = 8", "history = 9", "ETH/UCY has"),
    ('validation = ["crowds_zara03", "uni_examples"]', 'validation = ["crowds_zara01"]', "nothing is left"),
])  # fmt: skip
def test_a_recipe_that_does_not_fit_is_refused(recordings, text, other, message):
    recipe = parse_recipe(to_toml(small()).replace(text, other))
    with pytest.raises(RecipeError, match=message):
        TrackTask(recipe, recordings, torch.device("cpu"))
