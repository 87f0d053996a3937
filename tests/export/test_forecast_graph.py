"""forecast.onnx: scene to maps in one session run."""

import numpy as np
import onnx
import pytest

from hcnaf_export.describe import HYPERNET_IN
from hcnaf_export.forecast import all_graphs, compose, trace_map
from hcnaf_export.onnx_file import save, trace
from hcnaf_export.parity import compare_graph, open_graph
from hcnaf_export.probes import SCENES, SceneSetting, edges, scene
from hcnaf_models.config import PomConfig
from hcnaf_models.spec import FlowSpec
from hcnaf_runtime import Bundle, Forecaster, Grid, Scene
from tests.export.conftest import fresh_model

OUTPUTS = ["mass", "window_mass", "pose"]
FAR = np.float32(1e6)


@pytest.fixture(scope="module")
def graph(pom):
    return next(g for g in all_graphs(pom.model) if g.name == "forecast")


@pytest.fixture(scope="module")
def run(pom, graph):
    session = open_graph(graph, pom.path)
    return lambda feeds: session.run(OUTPUTS, feeds)


@pytest.fixture(scope="module")
def typical(pom):
    return scene(pom.model.config, SCENES["typical"], np.random.default_rng(2))


def test_it_is_in_the_bundle_checked_and_described(pom):
    manifest = Bundle.open(pom.path).manifest
    assert [t.name for t in manifest.graphs["forecast"].outputs] == OUTPUTS
    assert {r.output for r in manifest.parity if r.graph == "forecast"} == set(OUTPUTS)
    assert all(r.passed for r in manifest.parity)
    text = manifest.graphs["forecast"].outputs[0].description
    assert "one node per column" in text
    assert set(HYPERNET_IN) <= set(manifest.graphs)


def test_the_file_is_plain_single_and_named(pom, graph):
    model = onnx.load(pom.path / "forecast.onnx", load_external_data=False)
    onnx.checker.check_model(model, full_check=True)
    assert model.ir_version <= 10
    assert [(o.domain, o.version) for o in model.opset_import] == [("", 18)]
    values = [*model.graph.input, *model.graph.output]
    for value, tensor in zip(values, [*graph.inputs, *graph.outputs], strict=True):
        shape = [d.dim_param or d.dim_value for d in value.type.tensor_type.shape.dim]
        assert (value.name, shape) == (tensor.name, tensor.shape)
    facts = {p.key: p.value for p in model.metadata_props}
    assert facts["hcnaf.graph"] == "forecast"
    assert facts["hcnaf.inputs"].endswith("x_edges,y_edges")


def test_no_graph_tells_where_it_was_made(pom):
    for file in pom.path.glob("*.onnx"):
        assert b".py" not in file.read_bytes(), file.name


@pytest.mark.parametrize("count", [2, 3, 8])
@pytest.mark.parametrize("horizons", [(1.0,), (0.5, 2.0, 4.0)])
def test_columns_sum_to_their_increment_of_the_marginal(pom, run, count, horizons):
    setting = SceneSetting(agents=3, targets=1, horizons=horizons)
    feeds = scene(pom.model.config, setting, np.random.default_rng(count))
    x = np.linspace(-10.0, 40.0, count).astype(np.float32)
    mass, window, pose = run(feeds | {"x_edges": x, "y_edges": np.array([-FAR, FAR])})
    assert mass.shape == (1, len(horizons), 1, count - 1)
    assert (window.shape, pose.shape) == ((1, len(horizons)), (1, 3))
    forecaster = Forecaster(pom.path, threads=1)
    theta = forecaster.theta(made(pom, feeds), list(horizons)).values[0]
    F = forecaster.flow.marginal_cdf(theta, np.tile(x, (len(theta), 1)))
    np.testing.assert_allclose(mass[0, :, 0], np.diff(F), atol=2e-6)


def test_everywhere_holds_everything_and_parts_add_up(run, typical):
    everywhere = edges()
    mass, window, _ = run(typical | everywhere)
    np.testing.assert_allclose(window, 1.0, atol=1e-5)
    np.testing.assert_allclose(mass.sum((2, 3)), window, atol=1e-5)
    assert mass.min() >= 0.0
    coarse, _, _ = run(typical | {"x_edges": everywhere["x_edges"], "y_edges": np.array([-FAR, FAR])})
    np.testing.assert_allclose(mass.sum(2, keepdims=True), coarse, atol=1e-5)


def test_maps_do_not_depend_on_each_other(run, typical):
    grid = edges()
    mass, _, _ = run(typical | grid)
    for a, agent in enumerate(typical["target"]):
        for t, horizon in enumerate(typical["horizons"]):
            one = {"target": np.array([agent]), "horizons": np.array([horizon])}
            np.testing.assert_allclose(run(typical | grid | one)[0][0, 0], mass[a, t], atol=1e-5)


def made(exported, feeds):
    return Scene(
        past=feeds["past"],
        size=feeds["size"],
        kind=np.ones(len(feeds["past"]), np.uint8),
        target=feeds["target"],
        step=exported.model.config.step,
        raster=feeds["raster"],
        channels=exported.model.config.channels,
        origin=feeds["raster_origin"],
        stops=feeds["stops"],
    )


def test_it_nears_the_refined_maps_as_cells_shrink(pom, run, typical):
    errors = []
    for resolution in (4.0, 1.0, 0.25):
        size = round(32 / resolution)
        grid = Grid(size, size, resolution, (-8.0, -16.0))
        refined = Forecaster(pom.path, threads=1).pom(made(pom, typical), grid, list(typical["horizons"]))
        mass, window, _ = run(typical | {"x_edges": grid.x_edges, "y_edges": grid.y_edges})
        errors.append(np.abs(mass - refined.mass).sum((2, 3)).max())
        assert np.abs(window - refined.window_mass).max() <= errors[-1] + 1e-5
    assert errors[2] < 0.02
    assert errors[0] > errors[1] > errors[2]


def test_paper_support_and_no_encoder(tmp_path):
    config = PomConfig(
        flow=FlowSpec(layers=1, hidden=6, support="paper"), channels=(), draw_actors=False, trunk=(8, 8)
    )
    model = fresh_model(config)
    parts = all_graphs(model)
    hypernet = trace(parts[0], {})
    save(compose(parts[-1], hypernet, trace_map(config.flow), {}), tmp_path / "forecast.onnx")
    cases = [scene(config, SCENES[name], np.random.default_rng(4)) | edges() for name in ("typical", "single")]
    rows = compare_graph(parts[-1], tmp_path, cases)
    assert [r.output for r in rows] == OUTPUTS
    assert all(r.passed for r in rows), rows
