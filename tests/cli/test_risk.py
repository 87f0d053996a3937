"""`hcnaf-run risk`: files of every form, what is said and drawn, and one line for what cannot be used."""

import json

import numpy as np
import pytest

from hcnaf_cli.trajectories import read_trajectories
from hcnaf_runtime import Forecaster, Scene

ROWS = np.array([[0.5, 4.0, -1.0, 0.7], [1.0, 6.0, 0.5, 0.7], [2.0, 9.0, 3.5, 0.8]])


def one_line(result):
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    lines = result.stderr.splitlines()
    assert len(lines) == 1, result.stderr
    assert lines[0].startswith("hcnaf")
    return lines[0]


@pytest.fixture
def csv(tmp_path):
    path = tmp_path / "ego.csv"
    path.write_text("t, x, y, yaw\n# the way ahead\n" + "\n".join(",".join(map(str, row)) for row in ROWS) + "\n")
    return path


@pytest.fixture
def risk(run, bundle, scene_path):
    return lambda *args: run("risk", scene_path, "--model", bundle, *args)


def test_every_form_of_file_says_the_same(tmp_path, csv):
    several = np.stack([ROWS, ROWS])
    np.save(tmp_path / "one.npy", ROWS)
    np.save(tmp_path / "two.npy", several.astype(np.float32))
    np.savez(tmp_path / "named.npz", trajectories=several, other=np.zeros(3))
    np.savez(tmp_path / "only.npz", ROWS)
    (tmp_path / "list.json").write_text(json.dumps(ROWS.tolist()))
    (tmp_path / "named.json").write_text(json.dumps({"trajectories": several.tolist(), "planner": "x"}))
    for name in ("ego.csv", "one.npy", "two.npy", "named.npz", "only.npz", "list.json", "named.json"):
        times, poses = read_trajectories(tmp_path / name)
        np.testing.assert_array_equal(times, ROWS[:, 0])
        assert poses.shape == (2 if name in ("two.npy", "named.npz", "named.json") else 1, 3, 3)
        np.testing.assert_allclose(poses[-1], ROWS[:, 1:], rtol=1e-6)


def test_the_present_is_left_out(tmp_path):
    np.save(tmp_path / "ego.npy", np.concatenate([[[0.0, 3.0, -2.0, 0.7]], ROWS]))
    times, poses = read_trajectories(tmp_path / "ego.npy")
    np.testing.assert_array_equal(times, ROWS[:, 0])
    np.testing.assert_array_equal(poses[0], ROWS[:, 1:])


def test_json_says_what_the_forecaster_says(risk, bundle, scene_path, csv):
    result = risk("--trajectory", csv, "--json", "--ego-size", "4x2", "--heading", "present")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    expected = Forecaster(bundle, threads=1).collision_probability(
        Scene.load(scene_path), ROWS[:, 1:], (4.0, 2.0), ROWS[:, 0], "present"
    )
    assert found["horizons"] == [0.5, 1.0, 2.0]
    assert found["agents"] == [0, 1]
    (way,) = found["trajectories"]
    np.testing.assert_allclose(way["per_agent"], expected.per_agent[0].T, atol=1e-6)
    np.testing.assert_allclose(way["per_step"], expected.per_step[0], atol=1e-6)
    assert way["lower_bound"] == pytest.approx(expected.lower[0], abs=1e-6)
    assert way["upper_bound"] == pytest.approx(expected.upper[0], abs=1e-6)
    assert way["estimate"] is None


def test_the_table_has_a_line_per_time(risk, csv):
    result = risk("--trajectory", csv)
    assert result.exit_code == 0, result.output
    lines = result.stdout.splitlines()
    assert "2 agents forecast, 0 at their present box" in lines[0]
    assert [line.split()[0] for line in lines[2:5]] == ["0.5", "1", "2"]
    assert lines[5].startswith("at any of these times: at least ")
    assert "risk" in result.stderr


def test_several_trajectories_have_a_line_each(risk, tmp_path):
    np.save(tmp_path / "ego.npy", np.stack([ROWS + np.array([0, 0, dy, 0]) for dy in range(40)]))
    result = risk("--trajectory", tmp_path / "ego.npy")
    assert result.exit_code == 0, result.output
    lines = result.stdout.splitlines()
    assert "40 trajectories" in lines[0]
    assert lines[-1] == "and 10 more; --json has all"
    assert len(lines) == 1 + 1 + 30 + 1


def test_the_own_vehicle_is_suspected_and_can_be_left_out(risk, tmp_path):
    np.save(tmp_path / "ego.npy", np.array([[0.01, 3.0, -2.0, 0.7], [0.5, 4.9, -0.4, 0.7]]))
    result = risk("--trajectory", tmp_path / "ego.npy")
    assert "--exclude 0" in result.stderr
    result = risk("--trajectory", tmp_path / "ego.npy", "--exclude", "0", "--json")
    assert "--exclude" not in result.stderr
    assert json.loads(result.stdout)["agents"] == [1]


@pytest.mark.parametrize("count", [1, 3])
def test_the_command_draws(risk, tmp_path, count):
    pytest.importorskip("matplotlib")
    np.save(tmp_path / "ego.npy", np.stack([ROWS + np.array([0, 0, dy, 0]) for dy in range(count)]))
    result = risk("--trajectory", tmp_path / "ego.npy", "--plot", tmp_path / "out.png")
    assert result.exit_code == 0, result.output
    assert (tmp_path / "out.png").read_bytes().startswith(b"\x89PNG")


def test_the_picture_shows_the_way_in_the_colours_of_its_risk(bundle, fields):
    pytest.importorskip("matplotlib")
    from hcnaf_cli import picture_risk

    scene, poses = Scene(**fields), np.stack([ROWS[:, 1:], ROWS[:, 1:] + [0, 200, 0]])
    found = Forecaster(bundle, threads=1).collision_probability(scene, poses, (4.0, 2.0), ROWS[:, 0])
    figure = picture_risk.paint("a $strange_name", scene, poses, (4.0, 2.0), found)
    figure.canvas.draw()
    axes, scale = figure.axes
    low, high = picture_risk.view(scene, poses, found)
    assert ((poses[..., :2] > low) & (poses[..., :2] < high)).all()
    lines, boxes = axes.collections[-2:]
    assert len(boxes.get_paths()) == 6
    np.testing.assert_allclose(lines.get_edgecolors()[:2], picture_risk.colours(found.per_step[1, 1:]))
    assert "collision" in scale.get_title()
    assert "trajectory 1" in figure.get_suptitle()
    p = np.array([0.0, 1e-6, 1e-3, 1.0])
    assert (np.diff(picture_risk.colours(p)[:, 0]) >= 0).all()


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("ego.csv", b"", "shape"),
        ("ego.csv", b"t,x,y,yaw\n", "shape"),
        ("ego.csv", b"1,2,3\n", "t, x, y, yaw"),
        ("ego.csv", b"1,2,3,4\n1,2\n", "t, x, y, yaw"),
        ("ego.csv", b"time;x\n", "t, x, y, yaw"),
        ("ego.csv", b"\xff\xfe\x00", "not a trajectory"),
        ("ego.csv", b"1,2,3,nan\n", "NaN"),
        ("ego.csv", b"1,2,3,90\n", "radians"),
        ("ego.csv", b"1,2,3,0\n1,2,3,0\n", "ascend"),
        ("ego.csv", b"1,2,3,0\n9,2,3,0\n", "horizon"),
        ("ego.json", b"{", "not a trajectory"),
        ("ego.json", b"3", "shape"),
        ("ego.json", b'{"a": [], "b": []}', "trajectories"),
        ("ego.json", b'[["1", 2, 3, "x"]]', "not a trajectory"),
        ("ego.npy", b"nothing of the kind", "not a trajectory"),
        ("ego.npz", b"nothing of the kind", "not a readable .npz"),
    ],
)
def test_files_that_cannot_be_used(risk, tmp_path, name, content, words):
    (tmp_path / name).write_bytes(content)
    line = one_line(risk("--trajectory", tmp_path / name))
    assert words in line


@pytest.mark.parametrize(
    ("array", "words"),
    [
        (np.array([{}], dtype=object), "not a trajectory"),
        (np.zeros((2, 3)), "shape"),
        (np.zeros((0, 4)), "shape"),
        (np.array([["a"] * 4]), "instead of numbers"),
        (np.array([[[1.0, 0, 0, 0]], [[2.0, 0, 0, 0]]]), "different times"),
    ],
)
def test_arrays_that_cannot_be_used(risk, tmp_path, array, words):
    np.save(tmp_path / "ego.npy", array, allow_pickle=True)
    assert words in one_line(risk("--trajectory", tmp_path / "ego.npy"))


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (("--ego-size", "4"), "4.6x1.9"),
        (("--ego-size", "0x2"), "4.6x1.9"),
        (("--ego-size", "4.6.1x2"), "4.6x1.9"),
        (("--exclude", "first"), "exclude"),
        (("--exclude", "9"), "exclude"),
        (("--draws", "-1"), "--help"),
        (("--heading", "north"), "--help"),
    ],
)
def test_options_that_cannot_be_used(risk, csv, args, words):
    assert words in one_line(risk("--trajectory", csv, *args))


def test_missing_files(risk, run, tmp_path, csv):
    assert "no such file" in one_line(risk("--trajectory", tmp_path / "none.csv"))
    assert "cannot be read" in one_line(risk("--trajectory", tmp_path))
    assert "cannot be written" in one_line(risk("--trajectory", csv, "--plot", tmp_path / "none" / "out.png"))
    assert "--trajectory" in one_line(risk())
    assert "no such file" in one_line(run("risk", tmp_path / "none.npz", "--trajectory", csv))
