import json

import numpy as np
import pytest


@pytest.fixture
def recordings(tmp_path):
    """Walkers in the files of ETH/UCY, as plain text."""
    pytest.importorskip("torch")
    from hcnaf_export.data.eth_ucy import RECORDINGS

    for number, name in enumerate(RECORDINGS):
        rng = np.random.default_rng(number)
        track = np.cumsum(0.4 * rng.normal(size=2) + 0.05 * rng.normal(size=(22, 2)), axis=0)
        rows = [f"{10 * k}\t1\t{x}\t{y}" for k, (x, y) in enumerate(track)]
        (tmp_path / f"{name}.txt").write_text("\n".join(rows) + "\n")
    return tmp_path


@pytest.fixture
def recipe(tmp_path):
    from hcnaf_export.recipe import read_recipe, to_toml

    text = to_toml(read_recipe("eth-ucy"))
    for name, value in (("steps", 2), ("batch", 4), ("validate_every", 2), ("compile", "false"), ("rank", 4)):
        text = "\n".join(f"{name} = {value}" if s.startswith(f"{name} = ") else s for s in text.splitlines())
    path = tmp_path / "small.toml"
    path.write_text(text)
    return path


def test_an_experiment_writes_its_record_and_goes_on(train, recordings, recipe, tmp_path):
    pytest.importorskip("matplotlib")
    out = tmp_path / "run"
    command = ("experiment", "eth-ucy", "--data", recordings, "--out", out, "--recipe", recipe, "--threads", "1")
    result = train(*command, "--splits", "zara1,eth", "--models", "mixture,hcnaf", "--json")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert found == json.loads((out / "record.json").read_text())
    assert list(found["splits"]) == ["eth", "zara1"]
    assert set(found["splits"]["eth"]["models"]) == {"hcnaf", "mixture", "constant velocity"}
    assert (out / "README.md").read_text().startswith("# ETH/UCY")
    assert (out / "nll.png").is_file()
    again = train(*command, "--splits", "eth", "--models", "hcnaf")
    assert again.exit_code == 0, again.output
    assert f"{found['splits']['eth']['models']['hcnaf']['nll']:.3f}" in again.stdout


@pytest.mark.parametrize(("options", "message"), [
    (("--splits", "zara3"), "--splits has 'zara3'"),
    (("--models", "oracle"), "--models has 'oracle'"),
    (("--recipe", "pom-tiny"), "pom-tiny is for pom"),
])  # fmt: skip
def test_bad_usage(train, recordings, tmp_path, options, message):
    result = train("experiment", "eth-ucy", "--data", recordings, "--out", tmp_path / "run", *options)
    assert result.exit_code == 2
    assert message in result.stderr


def test_missing_recordings(train, recordings, recipe, tmp_path):
    (tmp_path / "biwi_eth.txt").unlink()
    result = train(
        "experiment",
        "eth-ucy",
        "--data",
        recordings,
        "--out",
        tmp_path / "run",
        "--recipe",
        recipe,
        "--splits",
        "eth",
    )
    assert (result.exit_code, len(result.stderr.splitlines())) == (2, 1)
    assert "biwi_eth" in result.stderr


def test_grids_are_those_there_are():
    pytest.importorskip("torch")
    from hcnaf_cli.experiment import GRIDS
    from hcnaf_export.experiments import occupancy_grids

    assert tuple(occupancy_grids.GRIDS) == GRIDS


def test_an_occupancy_grid_is_run_and_recorded(train, tmp_path):
    pytest.importorskip("matplotlib")
    from tests.export import synthetic

    data, out = synthetic.write(tmp_path / "data"), tmp_path / "run"
    command = ("experiment", "occupancy", "--data", data, "--out", out, "--recipe", "pom-tiny", "--threads", "1")
    result = train(*command, "--grid", "conditions", "--cells", "C2", "--json")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert found == json.loads((out / "conditions.json").read_text())
    assert list(found["cells"]) == ["C2"]
    assert (out / "cells" / "C1-0" / "scores.npz").is_file(), "the reference is run too"
    assert (out / "conditions.md").read_text().startswith("# What the forecast sees")
    assert (out / "conditions.png").is_file()
    again = train(*command, "--grid", "conditions", "--cells", "C2")
    assert f"{found['cells']['C2']['nll']['4 s']:.3f}" in again.stdout


@pytest.mark.parametrize(("options", "message"), [
    (("--grid", "colours"), "'colours' is not one of"),
    (("--grid", "heads", "--cells", "C1"), "--cells has 'C1'"),
    (("--grid", "heads", "--recipe", "eth-ucy"), "eth-ucy is for eth-ucy"),
])  # fmt: skip
def test_bad_usage_of_grids(train, tmp_path, options, message):
    result = train("experiment", "occupancy", "--data", tmp_path, "--out", tmp_path / "run", *options)
    assert result.exit_code == 2
    assert message in result.stderr


def test_a_cell_whose_export_is_refused_is_told_and_the_others_go_on(monkeypatch, capsys, tmp_path):
    pytest.importorskip("torch")
    from hcnaf_cli import experiment
    from hcnaf_export.experiments import occupancy, occupancy_bundle
    from hcnaf_runtime.errors import ParityError

    tried = []

    def run_bundle(plan, cell, seed):
        tried.append(cell)
        if cell == "H20-L2":
            raise ParityError("inverse.error is 0.1")

    monkeypatch.setattr(occupancy, "run_cell", lambda *args: True)
    monkeypatch.setattr(occupancy_bundle, "run_bundle", run_bundle)
    plan = occupancy.Plan(grid="size", data=tmp_path, out=tmp_path, cells=("H10-L2", "H20-L2", "H50-L2"))
    experiment._run_occupancy(plan)
    assert tried == ["H10-L2", "H20-L2", "H50-L2"]
    assert "H20-L2 is not exported: inverse.error is 0.1" in capsys.readouterr().err
