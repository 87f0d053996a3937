"""PRECOG-CARLA episodes on the command line: scored, converted, and refused with one line."""

import json

import pytest

pytest.importorskip("torch")

from hcnaf_runtime.scene import Scene
from tests.data import episodes


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return episodes.write(tmp_path_factory.mktemp("precog") / "set", (3, 1, 2))


def test_a_folder_of_episodes_is_scored_at_the_rows_it_has(train, data):
    """The embedded bundle takes rows 0.1 s apart; what it makes of these is of no interest here."""
    result = train("evaluate", "--data", data, "--threads", 1, "--horizons", "0.5,1", "--json")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert (found["predictor"], found["windows"], found["floor"]) == ("bundle", 2, None)
    assert [row["horizon"] for row in found["rows"]] == [0.5, 1.0]
    assert {e["protocol"]: e["sigma"] for e in found["extra_nats"]} == {"normalised": 0.5, "metres": 0.01}
    text = train("evaluate", "--data", data, "--threads", 1, "--horizons", "1", "--limit", 1)
    assert "extra nats" in text.stdout


def test_a_horizon_between_rows_is_refused(train, data):
    result = train("evaluate", "--data", data, "--threads", 1, "--horizons", "0.25")
    assert result.exit_code == 2
    assert "multiples of 0.1 s" in result.stderr


def test_a_broken_file_is_named(train, data, tmp_path):
    (tmp_path / "test").mkdir()
    (tmp_path / "test" / "ma_datum_00000000.json").write_text("{}")
    result = train("evaluate", "--data", tmp_path, "--threads", 1)
    assert result.exit_code == 2
    assert "ma_datum_00000000.json: episode without" in result.stderr


def test_a_scene_can_keep_the_files_time_step(train, data, tmp_path):
    file = data / "test" / "ma_datum_00000000.json"
    result = train("convert", "precog", file, "-o", tmp_path / "scene.npz", "--history-step", 0.2)
    assert result.exit_code == 0, result.output
    scene = Scene.load(tmp_path / "scene.npz")
    assert (scene.step, scene.past.shape) == (0.2, (5, 10, 5))
    assert abs(scene.past[0, 0, :2]).max() > 0.0


def test_comparing_runs_needs_runs(train, data, tmp_path):
    result = train("experiment", "precog", "--data", data, "--run", tmp_path / "a", "--twin", tmp_path / "b")
    assert result.exit_code == 2
    assert "model.pt" in result.stderr


def test_simulated_episodes_need_a_new_directory(train, data):
    result = train("simulate", "--format", "precog", "-o", data)
    assert result.exit_code == 2
    assert "already exists" in result.stderr
