import shutil

import numpy as np
import onnx
import pytest
import torch

from hcnaf_export import export
from hcnaf_export.checkpoint import save_checkpoint
from hcnaf_export.export import export_bundle
from hcnaf_export.graphs import graphs
from hcnaf_export.parity import run_torch
from hcnaf_export.probes import SceneSetting
from hcnaf_export.probes import scene as made_up
from hcnaf_models import planar
from hcnaf_models.geometry import pose_of
from hcnaf_runtime import Bundle, Condition, Forecaster, Grid, Scene
from hcnaf_runtime.errors import BundleError, CheckpointError, ParityError
from hcnaf_runtime.verify import verify


@pytest.fixture
def copied(line, monkeypatch):
    """Exports take their graphs from a bundle made before, so that they are quick."""

    def write(graph, path, metadata):
        shutil.copy(line.path / graph.file, path)

    monkeypatch.setattr(export, "write_onnx", write)
    return line


def test_every_output_agrees_with_pytorch(pom, line, space):
    for exported in (pom, line, space):
        assert all(row.passed for row in exported.result.rows), exported.result.rows
    outputs = {(row.graph, row.output) for row in pom.result.rows}
    assert {("hypernet", "theta"), ("flow", "log_prob"), ("cell_mass", "mass"), ("path", "log_prob")} <= outputs


def test_a_bundle_opens_and_verifies(pom, line, space):
    for exported in (pom, line, space):
        rows = verify(Bundle.open(exported.path), threads=1)
        assert rows
        assert all(row.passed for row in rows), rows


def test_files_of_a_bundle(pom, line):
    flow_only = {"hypernet.onnx", "flow.onnx", "golden.npz", "manifest.json", "README.md"}
    assert {f.name for f in line.path.iterdir()} == flow_only
    planar_graphs = {"marginal_cdf.onnx", "conditional_cdf.onnx", "cell_mass.onnx", "inverse.onnx"}
    planar_graphs |= {"forecast.onnx"}
    assert {f.name for f in pom.path.iterdir()} == flow_only | planar_graphs
    assert pom.result.bytes == sum(f.stat().st_size for f in pom.path.iterdir())
    assert list(pom.path.parent.iterdir()) == [pom.path]
    assert pom.path.stat().st_mode & 0o777 == 0o755


def test_manifest_of_a_scene_bundle(pom):
    m, config = Bundle.open(pom.path).manifest, pom.model.config
    assert (m.kind, m.name, m.opset, m.ir_version) == ("pom", "none", 18, 10)
    assert (m.flow.dims, m.flow.layers, m.flow.hidden, m.flow.weight_norm) == (2, 2, 20, "row")
    assert m.flow.parameters == config.flow.parameters
    assert (m.scene.history, m.scene.step, m.scene.stops) == (10, 0.1, True)
    assert m.scene.channels == ["drivable", "direction_x", "direction_y"]
    assert m.scene.optional_channels == ["drivable", "direction_y"]
    assert (m.horizons.min, m.horizons.max) == (0.0, 4.0)
    assert m.parity == list(pom.result.rows)
    assert m.scores["validation"] == {"0.5 s": 1.25, "1 s": 2.5}
    assert m.scores["test"]["1 s"] is None
    assert set(m.files) == {f.name for f in pom.path.iterdir()} - {"manifest.json"}


def test_manifest_of_a_condition_bundle(line, space):
    assert Bundle.open(line.path).manifest.condition.names == ["c1", "c2"]
    m = Bundle.open(space.path).manifest
    assert (m.kind, m.condition.names, m.flow.support) == ("condition", ["a", "b", "c"], "paper")
    assert m.scene is None


def test_the_card_has_scores_parity_limits_and_use(pom):
    text = (pom.path / "README.md").read_text()
    assert "| 0.5 s | 1.25 | 1.5 |" in text
    assert "| cell_mass | mass |" in text
    assert "Not validated for safety-critical use" in text
    assert "hcnaf-run forecast" in text
    assert "raster channels needed: direction_x\n" in text


def test_progress_names_every_step(pom):
    names, numbers, totals = zip(*pom.steps, strict=True)
    assert names[0] == "hypernet.onnx"
    assert numbers == tuple(range(len(names)))
    assert set(totals) == {len(names)}


def scene_of(exported, **setting):
    config = exported.model.config
    feeds = made_up(config, SceneSetting(**setting), np.random.default_rng(11))
    return Scene(
        past=feeds["past"],
        size=feeds["size"],
        kind=np.ones(len(feeds["past"]), np.uint8),
        target=feeds["target"],
        step=config.step,
        raster=feeds["raster"],
        channels=config.channels,
        origin=feeds["raster_origin"],
        stops=feeds["stops"],
    ), feeds


def test_forecast_densities_are_those_of_pytorch(pom):
    scene, feeds = scene_of(pom, agents=5, targets=2, horizons=(1.0, 2.5))
    hypernet, flow, *_ = graphs(pom.model)
    theta = run_torch(hypernet, feeds)[0]
    points = np.random.default_rng(3).normal((8.0, 0.0), 8.0, (200, 2)).astype(np.float32)
    found = Forecaster(pom.path, threads=1).log_prob(scene, points, horizons=[1.0, 2.5])
    flat = theta.reshape(4, -1)
    expected = run_torch(flow, {"theta": flat, "points": np.tile(points, (4, 1, 1))})[0].reshape(2, 2, 200)
    near = expected > -50.0
    assert near.mean() > 0.5
    assert np.abs(found - expected)[near].max() < 1e-4
    scene_frame = Forecaster(pom.path, threads=1).theta(scene, [1.0]).pose
    reference = torch.from_numpy(feeds["past"][feeds["target"]])
    np.testing.assert_allclose(scene_frame, pose_of(reference).numpy(), atol=1e-5)


def test_forecast_maps_are_those_of_pytorch(pom):
    scene, feeds = scene_of(pom, agents=5, targets=1, horizons=(2.0,))
    grid = Grid(12, 10, 2.0, (-4.0, -10.0))
    maps = Forecaster(pom.path, threads=1).pom(scene, grid, horizons=[2.0])
    theta = torch.from_numpy(run_torch(graphs(pom.model)[0], feeds)[0][0]).double()
    spec = pom.model.config.flow
    S = 400  # mid-points per column: fine enough to be a reference in float64
    edges = torch.linspace(-4.0, 20.0, 12 * S + 1, dtype=torch.float64)
    F = planar.marginal_cdf(spec, theta, edges[None])[0]
    weight = torch.zeros(1, 12 * S, 12, dtype=torch.float64)
    for c in range(12):
        weight[0, c * S : (c + 1) * S, c] = (F[1:] - F[:-1])[c * S : (c + 1) * S]
    middle = (edges[1:] + edges[:-1]) / 2
    y = torch.linspace(-10.0, 10.0, 11, dtype=torch.float64)
    expected = planar.cell_mass(spec, theta, middle[None], weight, 0.0 * weight, y[None]).mass[0].numpy()
    assert maps.mass[0, 0].sum() > 0.05
    np.testing.assert_allclose(maps.mass[0, 0], expected, atol=5e-6)


def test_forecast_of_a_condition(space):
    values = np.random.default_rng(4).normal(size=(3, 3)).astype(np.float32)
    points = np.random.default_rng(5).normal(size=(50, 3)).astype(np.float32)
    found = Forecaster(space.path, threads=1).log_prob(Condition(values), points)
    with torch.no_grad():
        theta = space.model.hypernet(torch.from_numpy(values))
        expected = space.model.log_prob(theta[:, 0], torch.from_numpy(points).expand(3, -1, -1)).numpy()
    assert np.abs(found[:, 0] - expected)[expected > -50.0].max() < 1e-4


def test_a_target_that_is_not_empty_is_refused_before_any_work(copied, tmp_path):
    (tmp_path / "mine.txt").write_text("keep")
    with pytest.raises(BundleError, match="not empty"):
        export_bundle(copied.checkpoint, tmp_path)
    with pytest.raises(BundleError, match="not a bundle"):
        export_bundle(copied.checkpoint, tmp_path, force=True)
    with pytest.raises(BundleError, match="is a file"):
        export_bundle(copied.checkpoint, tmp_path / "mine.txt", force=True)
    assert [f.name for f in tmp_path.iterdir()] == ["mine.txt"]


def test_an_empty_target_is_taken(copied, tmp_path):
    (tmp_path / "b").mkdir()
    export_bundle(copied.checkpoint, tmp_path / "b")
    assert all(row.passed for row in verify(Bundle.open(tmp_path / "b"), threads=1))
    assert [f.name for f in tmp_path.iterdir()] == ["b"]


def test_force_replaces_a_bundle_whole(copied, tmp_path):
    out = tmp_path / "b"
    export_bundle(copied.checkpoint, out)
    (out / "stray.txt").write_text("old")
    export_bundle(copied.checkpoint, out, force=True)
    assert not (out / "stray.txt").exists()
    assert Bundle.open(out).manifest.kind == "condition"
    assert [f.name for f in tmp_path.iterdir()] == ["b"]


def test_a_parity_failure_leaves_nothing_and_keeps_the_old(copied, tmp_path, monkeypatch):
    out = tmp_path / "b"
    export_bundle(copied.checkpoint, out)
    before = {f.name: f.read_bytes() for f in out.iterdir()}
    with torch.no_grad():
        state = {name: value * 1.01 for name, value in copied.model.state_dict().items()}
    other = tmp_path / "other.pt"
    save_checkpoint(other, copied.model.config, state, {}, {})  # its graphs are those of the first model
    for target, force in ((tmp_path / "new", False), (out, True)):
        with pytest.raises(ParityError, match="no bundle was written"):
            export_bundle(other, target, force=force)
    assert sorted(f.name for f in tmp_path.iterdir()) == ["b", "other.pt"]
    assert {f.name: f.read_bytes() for f in out.iterdir()} == before


def test_an_interrupted_export_leaves_nothing(copied, tmp_path):
    def stop(name, step, steps):
        if name == "parity":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export_bundle(copied.checkpoint, tmp_path / "b", progress=stop)
    assert list(tmp_path.iterdir()) == []


def test_a_swap_that_fails_puts_the_old_bundle_back(copied, tmp_path, monkeypatch):
    out = tmp_path / "b"
    export_bundle(copied.checkpoint, out)
    rename = export.os.rename

    def refuse(source, target):
        if target == out and source.name != "old":
            raise OSError("no")
        rename(source, target)

    monkeypatch.setattr(export.os, "rename", refuse)
    with pytest.raises(OSError, match="no"):
        export_bundle(copied.checkpoint, out, force=True)
    assert Bundle.open(out).manifest.kind == "condition"
    assert [f.name for f in tmp_path.iterdir()] == ["b"]


@pytest.mark.parametrize("content", [None, b"", b"not a checkpoint"])
def test_what_is_no_checkpoint_is_refused(tmp_path, content):
    if content is not None:
        (tmp_path / "model.pt").write_bytes(content)
    with pytest.raises(CheckpointError):
        export_bundle(tmp_path / "model.pt", tmp_path / "b")
    assert not (tmp_path / "b").exists()


def test_a_foreign_or_altered_checkpoint_is_refused(line, tmp_path):
    path = tmp_path / "model.pt"
    torch.save({"weights": torch.zeros(3)}, path)
    with pytest.raises(CheckpointError, match="not a checkpoint"):
        export_bundle(path, tmp_path / "b")
    state = dict(line.model.state_dict())
    state.pop(next(iter(state)))
    save_checkpoint(path, line.model.config, state, {}, {})
    with pytest.raises(CheckpointError, match="do not fit"):
        export_bundle(path, tmp_path / "b")
    assert [f.name for f in tmp_path.iterdir()] == ["model.pt"]


def test_an_altered_graph_is_refused_by_the_runtime(line, tmp_path):
    shutil.copytree(line.path, tmp_path / "b")
    model = onnx.load(tmp_path / "b" / "flow.onnx")
    model.producer_name = "someone else"
    onnx.save(model, tmp_path / "b" / "flow.onnx")
    with pytest.raises(BundleError, match="altered"):
        Bundle.open(tmp_path / "b")
