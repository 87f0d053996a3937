"""`hcnaf-run occupancy` and its picture."""

import json

import numpy as np
import pytest

from hcnaf_runtime import Forecaster, Grid, Scene
from hcnaf_runtime.occupancy import SAVED

SMALL = ("--grid", "80x60@0.5")


@pytest.fixture
def found(bundle, scene_path):
    return Forecaster(bundle).occupancy(Scene.load(scene_path), Grid.parse(SMALL[1]), [0.5, 2])


def test_json_says_what_the_occupancy_says(run, bundle, scene_path, found):
    result = run("occupancy", scene_path, "--model", bundle, *SMALL, "--horizons", "0.5,2", "--json")
    assert result.exit_code == 0, result.output
    said = json.loads(result.stdout)
    assert (said["grid"]["columns"], said["grid"]["rows"], said["heading"]) == (80, 60, "motion")
    np.testing.assert_allclose(said["grid"]["origin"], found.origin)
    assert (said["forecast"], said["present"]) == ([0, 1], [])
    for t, horizon in enumerate(said["horizons"]):
        assert horizon["horizon"] == found.horizons[t]
        assert horizon["covered_area"] == pytest.approx(found.expected[t].sum() / 4, rel=1e-4)
        assert horizon["area_above"]["0.1"] == pytest.approx((found.probability[t] > 0.1).sum() / 4)
    assert said["seconds"]["occupancy"] > 0


def test_text_has_a_line_per_horizon(run, bundle, scene_path):
    result = run("occupancy", scene_path, "--model", bundle, *SMALL, "--horizons", "1,2,4", "--exclude", "1")
    lines = result.stdout.splitlines()
    assert len(lines) == 2 + 3
    assert lines[0] == "crossing: 80x60 cells of 0.5 m, 1 forecast, 0 at their present box"
    assert "hyper-network" in result.stderr


def test_writes_the_occupancy(run, bundle, scene_path, tmp_path, found):
    out = tmp_path / "out.npz"
    args = ("occupancy", scene_path, "--model", bundle, "-o", out, *SMALL, "--horizons", "0.5,2", "--threads", "1")
    assert run(*args).exit_code == 0
    with np.load(out, allow_pickle=False) as saved:
        assert set(saved.files) == set(SAVED)
        np.testing.assert_allclose(saved["probability"], found.probability, atol=1e-6)
    assert run(*args, "--heading", "present").exit_code == 0
    with np.load(out, allow_pickle=False) as saved:
        assert np.abs(saved["probability"] - found.probability).max() > 0.01


def test_a_sample_with_the_embedded_model(run, embedded):
    result = run("occupancy", "--sample", "bend", *SMALL, "--json")
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["scene"] == "bend"


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (("--exclude", "one"), "exclude is 'one'"),
        (("--exclude", "7"), "indices of agents from 0 to 1"),
        (("--grid", "much"), "grid is 'much'"),
        (("--plot", "out.jpg"), "pictures end with"),
    ],
)
def test_bad_input_is_one_line(run, bundle, scene_path, args, words):
    result = run("occupancy", scene_path, "--model", bundle, *args)
    assert result.exit_code == 2
    assert result.stdout == ""
    assert len(result.stderr.splitlines()) == 1
    assert words in result.stderr


def test_the_command_draws(run, bundle, fields, tmp_path):
    pytest.importorskip("matplotlib")
    fields |= {
        "past": np.concatenate([fields["past"], fields["past"][:1] + np.float32([-6, 4, 0, 0, 0])]),
        "size": np.tile(fields["size"][:1], (3, 1)),
        "kind": np.ones(3, np.uint8),
        "future": np.concatenate([fields["future"], np.full((1, 40, 2), np.nan, np.float32)]),
    }
    Scene(**fields).save(tmp_path / "scene.npz")
    out = tmp_path / "out.png"
    result = run("occupancy", tmp_path / "scene.npz", "--model", bundle, "--plot", out, *SMALL, "--horizons", "1")
    assert result.exit_code == 0, result.output
    assert "note: agents without a forecast are taken to stay where they are: 2" in result.stderr
    assert out.read_bytes().startswith(b"\x89PNG")


def test_a_panel_for_each_horizon(scene_path, found):
    pytest.importorskip("matplotlib")
    from hcnaf_cli import picture_occupancy

    figure = picture_occupancy.paint("a $strange_name", Scene.load(scene_path), found)
    figure.canvas.draw()
    *panels, scale = figure.axes
    assert [axes.get_title(loc="left") for axes in panels] == ["in 0.5 s", "in 2 s"]
    assert "probability" in scale.get_title()
    low, high = picture_occupancy.view(found)
    rows, columns = np.nonzero(found.probability.max(axis=0) > 0.05)
    points = found.origin + (np.column_stack([columns, rows]) + 0.5) * found.resolution
    assert ((points > low) & (points < high)).all()
    heat = panels[0].images[-1].get_array()
    np.testing.assert_array_equal(heat[..., 3] > 0, found.probability[0] > picture_occupancy.SEEN)
