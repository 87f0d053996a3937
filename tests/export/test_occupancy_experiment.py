"""The occupancy experiment on made-up tracks: cells differ in what their grid says, resume, and add up."""

import json

import numpy as np
import pytest
import torch

from hcnaf_export.checkpoint import load_checkpoint
from hcnaf_export.evaluation.evaluate import HORIZONS, evaluate_checkpoint
from hcnaf_export.experiments import occupancy as experiment
from hcnaf_export.experiments.lost_mass import lost
from hcnaf_export.experiments.occupancy_bundle import BundleFacts, load_bundle
from hcnaf_export.experiments.occupancy_grids import GRIDS
from hcnaf_export.experiments.occupancy_report import CONSTANT_VELOCITY, markdown, plot, record_of, tables
from hcnaf_export.experiments.tables import markdown_table
from hcnaf_export.recipe import read_recipe, to_plain
from hcnaf_models import flow
from hcnaf_models.spec import FlowSpec
from tests.export import synthetic
from tests.models.flows import random_theta

CELLS = [(grid, cell) for grid, about in GRIDS.items() for cell in about.cells]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return synthetic.write(tmp_path_factory.mktemp("data") / "set")


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    return tmp_path_factory.mktemp("out")


def done(grid, cells, data, out, seeds=(0,)):
    """A plan of so small models that its cells are done at once."""
    recipe = read_recipe("pom-tiny")
    plan = experiment.Plan(grid=grid, data=data, out=out, cells=cells, seeds=seeds, recipe=recipe, threads=1)
    assert all(experiment.run_cell(plan, *run) for run in experiment.runs(plan))
    return plan


@pytest.fixture(scope="module")
def heads(data, out):
    return done("heads", ("C5", "mixture"), data, out, seeds=(0, 1))


@pytest.fixture(scope="module")
def norms(data, out, heads):
    return done("norms", ("C5", "paper", "row-gain"), data, out)


def flat(table, path=""):
    """Settings by dotted path."""
    found = {}
    for key, value in table.items():
        found |= flat(value, f"{path}{key}.") if isinstance(value, dict) else {path + key: value}
    return found


@pytest.mark.parametrize(("grid", "cell"), CELLS)
def test_cells_differ_in_what_their_grid_says_and_in_nothing_else(grid, cell):
    plan = experiment.Plan(grid=grid, data=".", out=".")
    found = flat(to_plain(experiment.cell_recipe(plan, cell, 3)))
    before = flat(to_plain(experiment.shipped_recipe()))
    changed = {key: value for key, value in found.items() if before[key] != value}
    said = {key: tuple(v) if isinstance(v, list) else v for key, v in GRIDS[grid].cells[cell].changes.items()}
    said = {key: value for key, value in said.items() if before[key] != value}
    assert changed == {**said, "name": f"pom-compare-{cell}", "seed": 3}
    assert said or cell == "C5"


def test_cells_of_one_name_are_the_same_in_every_grid():
    for name in {cell for _, cell in CELLS}:
        found = [GRIDS[grid].cells[name].changes for grid, cell in CELLS if cell == name]
        assert all(changes == found[0] for changes in found)


def test_every_reference_is_a_cell():
    assert all(grid.reference in grid.cells for grid in GRIDS.values())


def test_a_cell_that_is_done_is_left_alone_and_scores_what_its_checkpoint_says(heads):
    folder = experiment.cell_folder(heads.out, "mixture", 1)
    before = (folder / "model.pt").stat().st_mtime_ns
    assert experiment.run_cell(heads, "mixture", 1)
    assert (folder / "model.pt").stat().st_mtime_ns == before
    expected = evaluate_checkpoint(folder / "model.pt", heads.data, samples=0, calibrated=0, extra=False)
    scores = experiment.load_cell(folder)
    np.testing.assert_allclose(scores.nll.mean(axis=0), [row.nll for row in expected.rows], rtol=1e-6)
    assert scores.facts["steps"] == 20
    assert not scores.lost.any()


def test_a_record_adds_up(heads):
    record = record_of(heads)
    found = {
        name: [experiment.load_cell(experiment.cell_folder(heads.out, name, seed)).nll for seed in heads.seeds]
        for name in ("C5", "mixture")
    }
    for name, nll in found.items():
        cell = record.cells[name]
        assert list(cell.nll) == [*(f"{t:g} s" for t in HORIZONS), "mean"]
        assert cell.nll["mean"] == pytest.approx(np.mean(nll))
        assert cell.seeds == pytest.approx([v.mean() for v in nll])
        apart = np.mean(nll, axis=0)[:, -1] - np.mean(found["C5"], axis=0)[:, -1]
        assert cell.behind["4 s"] == pytest.approx(apart.mean())
    assert set(record.cells["C5"].behind.values()) == set(record.cells["C5"].behind_error.values()) == {0.0}
    assert 0.0 < record.cells["mixture"].behind_error["mean"] < record.cells["mixture"].error["mean"]
    still = evaluate_checkpoint(
        experiment.cell_folder(heads.out, "C5", 0) / "model.pt", heads.data, samples=0, calibrated=0, extra=False
    )
    assert record.cells[CONSTANT_VELOCITY].nll["2 s"] == pytest.approx(still.rows[3].baseline)
    assert json.loads(record.as_json()) == json.loads(json.dumps(record.as_dict()))


def test_only_the_paper_support_loses_mass(norms):
    record = record_of(norms)
    assert record.cells["C5"].most_lost == record.cells["row-gain"].most_lost == 0.0
    assert 0.0 < record.cells["paper"].lost["mean"] <= record.cells["paper"].most_lost < 1.0
    captions = list(tables(record))
    assert len(captions) == 3
    assert "falls short" in captions[2]
    model = load_checkpoint(experiment.cell_folder(norms.out, "paper", 0) / "model.pt")
    assert model.config.flow.support == "paper"


def test_lost_mass_is_what_the_density_does_not_integrate_to():
    spec = FlowSpec(hidden=6, support="paper")
    theta = random_theta(spec, 1)
    edges = torch.linspace(-60.0, 60.0, 1201, dtype=torch.float64)
    x = torch.cartesian_prod(edges, edges)
    mass = torch.exp(flow.log_prob(spec, theta, x)).sum() * (edges[1] - edges[0]) ** 2
    assert mass < 0.995
    torch.testing.assert_close(lost(spec, theta), 1.0 - mass, rtol=0.02, atol=0.0)


def test_tables_text_and_picture(heads):
    pytest.importorskip("matplotlib")
    record = record_of(heads)
    for head, *rows in tables(record).values():
        assert all(len(row) == len(head) for row in rows)
    text = markdown(record)
    assert text.startswith("# HCNAF and its baselines")
    assert f"| HCNAF | {record.cells['C5'].nll['1 s']:.3f} ±" in text
    assert "20 steps of 16 windows" in text
    plot(record, heads.out / "heads.png")
    assert (heads.out / "heads.png").stat().st_size > 5000


def test_an_exported_cell_has_its_bytes_and_times_in_the_tables(heads):
    folder = experiment.cell_folder(heads.out, "C5", 0)
    assert load_bundle(folder) is None
    facts = BundleFacts(
        bytes=3_900_000, hypernet=700_000, flow=20_000, theta_ms=1.5, dense_ms=1.25, forecast_ms=17.0, threads=2
    )
    (folder / "bundle.json").write_text(
        '{"bytes":3900000,"hypernet":700000,"flow":20000,"theta_ms":1.5,"dense_ms":1.25,"forecast_ms":17.0,"threads":2}'
    )
    try:
        found = tables(record_of(heads))
    finally:
        (folder / "bundle.json").unlink()
    *_, (caption, (head, row)) = found.items()
    assert caption.startswith("Bundles")
    assert len(row) == len(head)
    assert row == ("HCNAF", *facts.row()) == ("HCNAF", "3.90", "0.70", "1.50", "1.25", "17.00")


def test_empty_columns_are_left_out():
    assert markdown_table(("", "a", ""), [("x", "1", ""), ("y", "2", "")]) == [
        "|  | a |", "| --- | --- |", "| x | 1 |", "| y | 2 |",
    ]  # fmt: skip
