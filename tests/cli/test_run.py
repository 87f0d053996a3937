import json
import re

import numpy as np
import pytest

from hcnaf_runtime import Forecaster, Grid, Scene, __version__
from hcnaf_runtime.maps import SAVED

SMALL = ("--grid", "80x60@0.5")


def test_forecast_json_says_what_the_maps_say(run, bundle, scene_path):
    result = run("forecast", scene_path, "--model", bundle, *SMALL, "--horizons", "0.5,2", "--json")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    maps = Forecaster(bundle).pom(Scene.load(scene_path), Grid.parse(SMALL[1]), [0.5, 2])
    assert found["frame"] == "agent"
    assert found["grid"]["columns"], found["grid"]["rows"] == (80, 60)
    assert [agent["agent"] for agent in found["agents"]] == [0, 1]
    for a, agent in enumerate(found["agents"]):
        assert [h["horizon"] for h in agent["horizons"]] == [0.5, 2.0]
        np.testing.assert_allclose(agent["pose"], maps.pose[a])
        for t, horizon in enumerate(agent["horizons"]):
            assert horizon["window_mass"] == pytest.approx(maps.window_mass[a, t])
            peak = horizon["peak"]
            assert (peak["x"], peak["y"], peak["mass"]) == pytest.approx(maps.peak(a, t))
    assert found["seconds"]["hypernet"] > 0
    assert found["seconds"]["maps"] > 0


def test_forecast_text_has_a_line_per_agent_and_horizon(run, bundle, scene_path):
    result = run("forecast", scene_path, "--model", bundle, *SMALL, "--horizons", "1,2,4")
    lines = result.stdout.splitlines()
    assert len(lines) == 2 + 2 * 3
    assert lines[0].startswith("crossing: 80x60 cells of 0.5 m")
    assert "hyper-network" in result.stderr


@pytest.mark.parametrize("frame", ["agent", "scene"])
def test_forecast_writes_the_maps(run, bundle, scene_path, tmp_path, frame):
    out = tmp_path / "forecast.npz"
    args = ("forecast", scene_path, "--model", bundle, "-o", out, *SMALL, "--frame", frame, "--threads", "1")
    assert run(*args).exit_code == 0
    maps = Forecaster(bundle).pom(Scene.load(scene_path), Grid.parse(SMALL[1]), frame=frame)
    with np.load(out, allow_pickle=False) as saved:
        assert set(saved.files) == set(SAVED)
        assert saved["mass"].shape == (2, 4, 60, 80)
        np.testing.assert_allclose(saved["mass"], maps.mass, atol=1e-6)
        assert str(saved["frame"]) == frame
        np.testing.assert_allclose(saved["origin"], maps.origin)


def test_an_absent_optional_channel_is_noted_on_stderr(run, bundle, fields, tmp_path):
    fields |= {"raster": fields["raster"][:1], "channels": ("left",)}
    Scene(**fields).save(tmp_path / "scene.npz")
    result = run("forecast", tmp_path / "scene.npz", "--model", bundle, *SMALL, "--json")
    assert "note: raster channel 'shift'" in result.stderr
    assert json.loads(result.stdout)["notes"]


@pytest.mark.parametrize(("sample", "expected"), [((), "bend"), (("crossing",), "crossing")])
def test_forecast_of_a_sample_with_the_embedded_model(run, embedded, sample, expected):
    result = run("forecast", "--sample", *sample, *SMALL, "--json")
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["scene"] == expected


@pytest.mark.parametrize("suffix", [".npy", ".csv"])
def test_logprob_is_the_density_at_the_points(run, bundle, scene_path, tmp_path, suffix):
    points = np.array([[1.0, 0.5], [4.0, -0.25], [30.0, 3.0]])
    path = tmp_path / f"points{suffix}"
    if suffix == ".npy":
        np.save(path, points)
    else:
        path.write_text("x, y\n# in metres\n" + "\n".join(f"{x}, {y}" for x, y in points))
    scene = Scene.load(scene_path)
    expected = Forecaster(bundle).log_prob(scene, points, [1, 2])
    result = run("logprob", scene_path, "--points", path, "--model", bundle, "--horizons", "1,2", "--json")
    assert result.exit_code == 0, result.output
    agents = json.loads(result.stdout)["agents"]
    found = [[h["log_prob"] for h in agent["horizons"]] for agent in agents]
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    text = run("logprob", scene_path, "--points", path, "--model", bundle, "--horizons", "1,2").stdout
    rows = np.loadtxt(text.splitlines(), delimiter=",", skiprows=1)
    np.testing.assert_allclose(rows[:, -1], expected.ravel(), rtol=1e-5)
    np.testing.assert_allclose(rows[:, 2:4], np.tile(points, (4, 1)))


def test_logprob_in_the_scene_frame_is_the_same_number(run, bundle, scene_path, tmp_path):
    scene = Scene.load(scene_path)
    x, y, yaw = scene.pose[0]
    np.save(tmp_path / "here.npy", [[x + 3 * np.cos(yaw), y + 3 * np.sin(yaw)]])
    np.save(tmp_path / "ahead.npy", [[3.0, 0.0]])
    values = []
    for points, frame in (("here.npy", "scene"), ("ahead.npy", "agent")):
        args = ("--points", tmp_path / points, "--frame", frame, "--model", bundle, "--json")
        result = run("logprob", scene_path, *args)
        values.append(json.loads(result.stdout)["agents"][0]["horizons"][0]["log_prob"][0])
    assert values[0] == pytest.approx(values[1], abs=1e-4)


def test_info(run, bundle):
    assert "gaussian" in run("info", bundle).stdout
    found = json.loads(run("info", bundle, "--json").stdout)
    assert found["flow"]["dims"] == 2
    assert found["scene"]["optional_channels"] == ["shift"]


def test_verify_passes(run, bundle):
    result = run("verify", bundle)
    assert result.exit_code == 0, result.output
    assert "FAILED" not in result.stdout
    assert json.loads(run("verify", bundle, "--json").stdout)["passed"] is True


def test_verify_fails_with_1(run, own_bundle):
    with np.load(own_bundle / "golden.npz") as file:
        golden = dict(file)
    golden["out.flow.log_prob"] = golden["out.flow.log_prob"] + np.float32(0.1)
    np.savez(own_bundle / "golden.npz", **golden)
    result = run("verify", own_bundle)
    assert result.exit_code == 1
    assert re.search(r"1 of \d+ outputs differ", result.stderr)
    assert len(result.stderr.splitlines()) == 1
    assert "FAILED" in result.stdout
    assert json.loads(run("verify", own_bundle, "--json").stdout)["passed"] is False


def test_version(run, train):
    assert __version__ in run("--version").stdout
    assert __version__ in train("--version").stdout
