"""Bad input of every kind: one line on stderr, exit code 2, nothing written."""

import json
import shutil

import numpy as np
import pytest

from hcnaf_runtime import Scene

_FUTURE_FORMAT = 99


@pytest.fixture
def refused(run, bundle, tmp_path):
    """Forecast with everything that could be written, and see that nothing is. Returns the line."""

    def check(*args, model=None):
        out = tmp_path / "out"
        out.mkdir(exist_ok=True)
        targets = ("-o", out / "forecast.npz", "--plot", out / "forecast.png")
        result = run("forecast", "--grid", "20x20@1", "--model", model or bundle, *targets, *args)
        assert list(out.iterdir()) == []
        return one_line(result, 2)

    return check


def one_line(result, code):
    assert result.exit_code == code, result.output
    assert result.stdout == ""
    assert "Traceback" not in result.stderr
    lines = result.stderr.splitlines()
    assert len(lines) == 1, result.stderr
    assert lines[0].startswith("hcnaf")
    return lines[0]


def rewrite(path, **changes):
    """The scene file with some arrays replaced, unchecked."""
    with np.load(path) as file:
        arrays = dict(file)
    np.savez(path, **(arrays | changes))
    return path


def test_missing_file(refused, tmp_path):
    assert "no such file" in refused(tmp_path / "none.npz")


def test_directory(refused, tmp_path):
    assert "cannot be read" in refused(tmp_path)


def test_not_an_npz(refused, tmp_path):
    path = tmp_path / "scene.npz"
    path.write_text("nothing of the kind\n" * 100)
    assert "not a readable .npz" in refused(path)


def test_truncated(refused, scene_path):
    data = scene_path.read_bytes()
    scene_path.write_bytes(data[: len(data) // 2])
    assert "not a readable .npz" in refused(scene_path)


def test_pickled(refused, scene_path):
    assert "pickled" in refused(rewrite(scene_path, past=np.array([{}], dtype=object)))


def test_wrong_dtype(refused, scene_path):
    assert "past" in refused(rewrite(scene_path, past=np.zeros((2, 3, 5), np.float64)))


def test_wrong_shape(refused, scene_path):
    assert "size" in refused(rewrite(scene_path, size=np.ones((2, 3), np.float32)))


def test_nan_in_the_current_state_of_a_target(refused, scene_path, fields):
    past = fields["past"].copy()
    past[1, -1] = np.nan
    assert "target" in refused(rewrite(scene_path, past=past))


def test_no_observed_agent(refused, scene_path, fields):
    assert refused(rewrite(scene_path, past=np.full_like(fields["past"], np.nan)))


def test_no_target(refused, scene_path):
    assert "target" in refused(rewrite(scene_path, target=np.zeros(0, np.int64)))


def test_history_of_another_length(refused, tmp_path, fields):
    fields["past"] = fields["past"][:, 1:]
    Scene(**fields).save(tmp_path / "short.npz")
    line = refused(tmp_path / "short.npz")
    assert "2 rows" in line
    assert "3" in line


@pytest.mark.parametrize("horizons", ["0", "4.5", "1,9", "-1", "nan", "soon", ""])
def test_horizon(refused, scene_path, horizons):
    assert "horizon" in refused(scene_path, "--horizons", horizons)


@pytest.mark.parametrize("grid", ["200", "0x5@1", "5x5@0", "5x5@nan", "999999x2@1", ""])
def test_grid(refused, scene_path, grid):
    assert "grid" in refused(scene_path, "--grid", grid)


def test_bundle_that_is_not_there(refused, scene_path, tmp_path):
    assert "no such directory" in refused(scene_path, model=tmp_path / "none")


@pytest.mark.parametrize("name", ["flow.onnx", "manifest.json"])
def test_bundle_with_a_missing_file(refused, scene_path, own_bundle, name):
    (own_bundle / name).unlink()
    assert name in refused(scene_path, model=own_bundle)


def test_bundle_with_an_altered_file(refused, scene_path, own_bundle):
    data = bytearray((own_bundle / "flow.onnx").read_bytes())
    data[len(data) // 2] ^= 1
    (own_bundle / "flow.onnx").write_bytes(data)
    assert "altered" in refused(scene_path, model=own_bundle)


def test_bundle_of_a_future_format(refused, scene_path, own_bundle):
    path = own_bundle / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"format": _FUTURE_FORMAT}))
    line = refused(scene_path, model=own_bundle)
    assert str(_FUTURE_FORMAT) in line
    assert "update" in line


def test_bundle_without_golden_outputs(run, own_bundle):
    (own_bundle / "golden.npz").unlink()
    assert "golden.npz" in one_line(run("verify", own_bundle), 2)


def test_scene_and_sample(refused, scene_path):
    assert "one scene" in refused(scene_path, "--sample")
    assert "one scene" in refused()


def test_unknown_sample(run, embedded):
    line = one_line(run("forecast", "--sample", "moon"), 2)
    assert "moon" in line
    assert "bend, crossing" in line


@pytest.mark.parametrize("option", ["-o", "--plot"])
def test_target_that_cannot_be_written(run, bundle, scene_path, tmp_path, option):
    for target in (tmp_path / "none" / "out.png", tmp_path / "dir.png", "/dev/null"):
        (tmp_path / "dir.png").mkdir(exist_ok=True)
        args = ("forecast", scene_path, "--model", bundle, option, target)
        assert "cannot be written" in one_line(run(*args), 2)


def test_picture_of_an_unknown_format(run, bundle, scene_path, tmp_path):
    args = ("forecast", scene_path, "--model", bundle, "--plot", tmp_path / "out.bmp")
    assert ".png" in one_line(run(*args), 2)


@pytest.mark.parametrize(
    "content", [b"", b"a,b\n", b"1,2\n3\n", b"\xff\xfe", b"1,2,3\n", b"1,nan\n", b"1;2\n"], ids=repr
)
def test_points(run, bundle, scene_path, tmp_path, content):
    (tmp_path / "points.csv").write_bytes(content)
    one_line(run("logprob", scene_path, "--model", bundle, "--points", tmp_path / "points.csv"), 2)


@pytest.mark.parametrize(
    "array", [np.array([{}], dtype=object), np.array("text"), np.zeros((0, 2)), np.float32(1)], ids=repr
)
def test_points_that_are_no_numbers(run, bundle, scene_path, tmp_path, array):
    np.save(tmp_path / "points.npy", array, allow_pickle=True)
    one_line(run("logprob", scene_path, "--model", bundle, "--points", tmp_path / "points.npy"), 2)


def test_points_that_claim_more_than_they_hold(run, bundle, scene_path, tmp_path):
    path = tmp_path / "points.npy"
    np.save(path, np.zeros((9, 2)))
    path.write_bytes(path.read_bytes().replace(b"(9, 2)", b"(9999999, 2)")[:200])
    one_line(run("logprob", scene_path, "--model", bundle, "--points", path), 2)
    one_line(run("logprob", scene_path, "--model", bundle, "--points", tmp_path / "none.npy"), 2)


@pytest.mark.parametrize("args", [("--nope",), ("nope",), ("forecast", "a", "b"), ("verify", "--threads", "0")])
def test_usage(run, args):
    assert "--help" in one_line(run(*args), 2)


def test_unknown_recipe_key(train, tmp_path):
    pytest.importorskip("torch")
    path = tmp_path / "recipe.toml"
    path.write_text('name = "a"\nabout = "b"\ntask = "toy1"\nspeed = 3\n[optimiser]\nsteps = 1\n')
    line = one_line(train("train", path, "--out", tmp_path / "run"), 2)
    assert "speed" in line
    assert not (tmp_path / "run").exists()


def test_unknown_recipe(train, tmp_path):
    pytest.importorskip("torch")
    assert "pom-sim" in one_line(train("train", "nothing", "--out", tmp_path / "run"), 2)
    assert not (tmp_path / "run").exists()


def test_unknown_simulator_setting(train, tmp_path):
    (tmp_path / "sim.toml").write_text("seeds = 3\n")
    line = one_line(train("simulate", "-o", tmp_path / "data", "--settings", tmp_path / "sim.toml"), 2)
    assert "seeds" in line
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize("content", ["text", "tensor", "missing"])
def test_checkpoint_that_is_not_ours(train, tmp_path, content):
    torch = pytest.importorskip("torch")
    pytest.importorskip("onnx")
    path = tmp_path / "model.pt"
    if content == "text":
        path.write_text("nothing of the kind")
    elif content == "tensor":
        torch.save({"weights": torch.zeros(3)}, path)
    one_line(train("export", "--ckpt", path, "-o", tmp_path / "bundle"), 2)
    assert not (tmp_path / "bundle").exists()


@pytest.mark.parametrize("kind", ["precog", "argoverse2"])
def test_recording_that_is_none(train, tmp_path, kind):
    path = tmp_path / "recording.json"
    path.write_text("[1, 2")
    one_line(train("convert", kind, path, "-o", tmp_path / "scene.npz"), 2)
    one_line(train("convert", kind, tmp_path / "none", "-o", tmp_path / "scene.npz"), 2)
    assert not (tmp_path / "scene.npz").exists()
    shutil.rmtree(tmp_path)
