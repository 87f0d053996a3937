"""`hcnaf-run sample`: what it prints, writes and draws is what the runtime drew."""

import json

import numpy as np
import pytest

from hcnaf_cli import picture_samples
from hcnaf_runtime import Forecaster, Scene

pytest.importorskip("matplotlib")


@pytest.mark.parametrize("flag", [(), ("--trajectories",)])
@pytest.mark.parametrize("frame", ["agent", "scene"])
def test_json_holds_the_samples(run, bundle, scene_path, flag, frame):
    args = ("-n", 7, "--seed", 3, "--horizons", "0.5,2", "--frame", frame, *flag, "--json")
    result = run("sample", scene_path, "--model", bundle, *args)
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    forecaster = Forecaster(bundle)
    draw = forecaster.trajectories if flag else forecaster.sample
    made = draw(Scene.load(scene_path), 7, [0.5, 2], 3, frame)
    assert (found["scene"], found["frame"], found["coupled"]) == ("crossing", frame, bool(flag))
    for a, agent in enumerate(found["agents"]):
        assert agent["agent"] == made.agents[a]
        assert [h["horizon"] for h in agent["horizons"]] == [0.5, 2.0]
        for t, horizon in enumerate(agent["horizons"]):
            np.testing.assert_allclose(horizon["points"], made.points[a, t])
            np.testing.assert_allclose(horizon["log_prob"], made.log_prob[a, t], rtol=1e-6)


def test_text_has_a_line_per_agent_and_horizon(run, bundle, scene_path):
    lines = run("sample", scene_path, "--model", bundle, "--horizons", "1,2,4", "-n", 50).stdout.splitlines()
    assert len(lines) == 2 + 2 * 3
    assert lines[0] == "crossing: 50 samples of each agent, x forward and y left of each agent"


def test_the_file_holds_the_paths(run, bundle, scene_path, tmp_path):
    out = tmp_path / "paths.npz"
    assert run("sample", scene_path, "--model", bundle, "--trajectories", "-n", 9, "-o", out).exit_code == 0
    made = Forecaster(bundle).trajectories(Scene.load(scene_path), 9)
    with np.load(out, allow_pickle=False) as saved:
        np.testing.assert_array_equal(saved["points"], made.points)
        assert bool(saved["coupled"]) is True


@pytest.mark.parametrize("flag", [(), ("--trajectories",)])
@pytest.mark.parametrize("suffix", [".png", ".svg"])
def test_the_command_draws(run, bundle, scene_path, tmp_path, suffix, flag):
    out = tmp_path / f"out{suffix}"
    result = run("sample", scene_path, "--model", bundle, "--plot", out, "--horizons", "1,2", *flag)
    assert result.exit_code == 0, result.output
    assert out.read_bytes().startswith({".png": b"\x89PNG", ".svg": b"<?xml"}[suffix])


def test_the_view_holds_nearly_all_that_was_drawn(bundle, scene_path):
    scene = Scene.load(scene_path)
    made = Forecaster(bundle).trajectories(scene, 400, [1.0, 4.0])
    places = picture_samples.in_scene(made)
    low, high = picture_samples.view(scene, made, places)
    assert ((places > low) & (places < high)).all(axis=-1).mean() > 0.95
    placed = Forecaster(bundle).trajectories(scene, 400, [1.0, 4.0], frame="scene")
    np.testing.assert_allclose(picture_samples.in_scene(placed), places, atol=1e-9)
    figure = picture_samples.paint("crossing", scene, made)
    lines = [c for c in figure.axes[0].collections if hasattr(c, "get_segments")]
    assert len(lines[0].get_segments()) == picture_samples.MOST_PATHS
    assert "400 paths of each of 2 agents, up to 4 s ahead (300 shown)" in figure.get_suptitle()


def test_too_many_points_to_print_are_refused(run, bundle, scene_path):
    result = run("sample", scene_path, "--model", bundle, "-n", 600_000, "--horizons", "1", "--json")
    assert result.exit_code == 2
    assert "1200000 points, at most 1000000 are printed; write them with -o" in result.stderr
