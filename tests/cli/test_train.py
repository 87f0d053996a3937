import json
from pathlib import Path

import pytest

from hcnaf_cli.output import ProgressLine
from hcnaf_cli.settings import sim_settings
from hcnaf_runtime import Scene
from hcnaf_runtime.errors import InputError

DATA = Path(__file__).parents[3] / "shared" / "data"


def test_options_override_the_settings_file(tmp_path):
    path = tmp_path / "sim.toml"
    path.write_text("seed = 3\ndensity = 5.0\ntest_networks = 9\n[noise]\nposition = 0.2\n")
    found = sim_settings(path, {"seed": 4, "windows": (30, 20, 10), "val_nets": (Path("town.net.xml"),)})
    assert (found.seed, found.density, found.noise.position) == (4, 5.0, 0.2)
    assert (found.train_windows, found.val_windows, found.test_windows) == (30, 20, 10)
    assert (found.val_nets, found.test_networks) == (("town.net.xml",), 9)


@pytest.mark.parametrize("text", ["speed = 1", "seed = 'one'", "seed = ", "[noise]\ncolour = 1"])
def test_bad_settings(tmp_path, text):
    path = tmp_path / "sim.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=r"sim\.toml"):
        sim_settings(path, {})
    with pytest.raises(InputError, match="cannot be read"):
        sim_settings(tmp_path / "none.toml", {})


def test_train_and_evaluate_a_toy(train, tmp_path):
    pytest.importorskip("torch")
    from hcnaf_export.recipe import read_recipe, to_toml

    plan = to_toml(read_recipe("toy1"))
    for name, value in (("steps", 5), ("validate_every", 5), ("batch", 8), ("validation", 100)):
        plan = "\n".join(f"{name} = {value}" if s.startswith(f"{name} = ") else s for s in plan.splitlines())
    (tmp_path / "toy.toml").write_text(plan)
    run = tmp_path / "run"
    result = train("train", tmp_path / "toy.toml", "--out", run, "--threads", "1", "--json")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert (found["finished"], found["step"]) == (True, 5)
    assert {"model.pt", "metrics.jsonl", "recipe.toml"} <= {p.name for p in run.iterdir()}
    again = train("train", tmp_path / "toy.toml", "--out", run)
    assert (again.exit_code, len(again.stderr.splitlines())) == (2, 1)
    scores = train("evaluate", "--ckpt", run / "model.pt", "--json")
    assert scores.exit_code == 0, scores.output
    assert all(row["kl"] > -0.1 for row in json.loads(scores.stdout))


def test_progress_is_quiet_without_a_terminal(capsys):
    with ProgressLine() as line:
        for k in range(100):
            line(f"step {k}")
    assert capsys.readouterr().err == ""


def test_parity_table():
    from hcnaf_cli import tables
    from hcnaf_runtime.manifest import ParityRow

    values = {"max_abs": 1e-6, "max_rel": 2e-6, "rms": 3e-7, "worst_index": [0, 1], "torch": 1.0, "onnx": 1.5}
    rows = [
        ParityRow(graph="flow", output=name, **values, tolerance=1e-4, passed=passed)
        for name, passed in (("z", True), ("log_det", False))
    ]
    lines = tables.parity_text(rows).splitlines()
    assert len(lines) == 3
    assert lines[1].endswith("passed")
    assert lines[2].endswith("FAILED")
    assert tables.parity_json(rows)[1]["output"] == "log_det"


@pytest.mark.skipif(not (DATA / "precog_carla").is_dir(), reason="no genuine PRECOG episode at ../shared/data")
def test_convert_precog(train, tmp_path):
    source = next((DATA / "precog_carla").glob("*.json"))
    result = train("convert", "precog", source, "-o", tmp_path / "scene.npz", "--targets", "all")
    assert result.exit_code == 0, result.output
    scene = Scene.load(tmp_path / "scene.npz")
    assert len(scene.target) == len(scene.past)
    assert f"{len(scene.past)} agents" in result.stdout


@pytest.mark.skipif(not (DATA / "argoverse2").is_dir(), reason="no Argoverse 2 scenario at ../shared/data")
def test_convert_argoverse2(train, tmp_path):
    pytest.importorskip("pyarrow")
    result = train("convert", "argoverse2", DATA / "argoverse2", "-o", tmp_path / "scene.npz")
    assert result.exit_code == 0, result.output
    assert "drivable" in Scene.load(tmp_path / "scene.npz").channels


def test_toy_table():
    pytest.importorskip("torch")
    from hcnaf_cli import tables
    from hcnaf_export.training.toy import Divergence

    lines = tables.toy_text(
        [Divergence("seen", True, 0.01, 0.001), Divergence("new", False, 0.2, 0.01)]
    ).splitlines()
    assert len(lines) == 3
    assert "0.0100" in lines[1]
    assert "no" in lines[2].split()
