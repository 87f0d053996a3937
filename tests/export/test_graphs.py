import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from hcnaf_export.graphs import LOG_ERF_FROM, graphs, shipped_log_interval, weighed_fraction
from hcnaf_export.onnx_file import EXAMPLE_SIZES, write_onnx
from hcnaf_export.parity import compare_graph, contract, draw, run_torch
from hcnaf_export.probes import SCENES, SceneSetting, flow_cases, scene
from hcnaf_models import flow, planar
from hcnaf_models.config import ConditionConfig
from hcnaf_models.model import build
from hcnaf_models.spec import FlowSpec
from hcnaf_runtime.bundle import EMBEDDED
from hcnaf_runtime.scene import Scene
from hcnaf_runtime.session import Session, Settings

POM_GRAPHS = ("hypernet", "flow", "marginal_cdf", "conditional_cdf", "cell_mass", "inverse")


def part(exported, name):
    return next(g for g in graphs(exported.model) if g.name == name)


def session(exported, name):
    graph = part(exported, name)
    return Session(exported.path / graph.file, contract(graph), Settings(1), "1.20")


def ones(graph, sizes):
    """An input of the given sizes for every tensor of the graph; the values are small and differ."""
    rng = np.random.default_rng(1)
    feeds = {}
    for tensor in graph.inputs:
        shape = [sizes.get(s, 1) if isinstance(s, str) else s for s in tensor.shape]
        if tensor.dtype == "int64":
            feeds[tensor.name] = np.arange(shape[0])
        elif tensor.dtype == "int8":
            feeds[tensor.name] = rng.integers(-127, 128, shape).astype(np.int8)
        else:
            feeds[tensor.name] = np.sort(rng.uniform(0.1, 1.0, shape), axis=-1).astype(np.float32)
    return feeds


def same(graph, found, feeds, limit=2e-5):
    for a, b in zip(found, run_torch(graph, feeds), strict=True):
        assert a.shape == b.shape
        assert np.isfinite(a).all()
        assert np.abs(a - b).max(initial=0.0) <= limit * max(1.0, np.abs(b).max(initial=0.0))


@pytest.mark.parametrize("name", POM_GRAPHS[:-1])
@pytest.mark.parametrize("sizes", [{"E": 2}, {"E": 3, "B": 2}, {"E": 9, "B": 4, "S": 2, "N": 3, "K": 5}])
def test_every_size_may_be_one(pom, name, sizes):
    graph = part(pom, name)
    feeds = ones(graph, sizes)
    same(graph, session(pom, name).run([t.name for t in graph.outputs], feeds), feeds)


@pytest.mark.parametrize(("maps", "samples"), [(1, 1), (4, 1), (1, 7), (2, 8), (4, 60)])
def test_any_number_of_samples_may_be_drawn(pom, maps, samples):
    """With the probes' weights: those of the test above make z a staircase, which has no inverse to agree on."""
    graph = part(pom, "inverse")
    feeds = flow_cases("inverse", pom.model.config.flow, {})["random"]
    feeds = {"theta": feeds["theta"][:maps], "uniform": feeds["uniform"][:maps, :samples]}
    same(graph, session(pom, "inverse").run([t.name for t in graph.outputs], feeds), feeds, 1e-4)


def test_samples_of_a_distribution_that_is_far_out_in_the_normal_tail(pom):
    """Where exp(log Phi(z)) is denormal or 0 in float32, as it is for flows that answer absurd scenes."""
    spec = pom.model.config.flow
    feeds = flow_cases("inverse", spec, {})["random"]
    theta = feeds["theta"].copy()
    theta[:, -spec.dims :] += np.linspace(10.0, 20.0, len(theta), dtype=np.float32)[:, None]
    drawing, outputs = session(pom, "inverse"), ["points", "log_prob", "error"]
    found = draw(lambda f: drawing.run(outputs, f), {"theta": theta, "uniform": feeds["uniform"]})
    image = flow.forward(spec, *(torch.from_numpy(v).double() for v in (theta, found[0])))
    F = flow.distribution(spec, image.z, image.z_minus, image.z_plus).numpy()
    assert image.z_minus.min() > 5.0
    assert image.z.max() > 15.0
    assert np.abs(F - feeds["uniform"]).max() < 1e-4
    assert found[2].max() < 1e-4


def test_a_scene_may_have_no_stops_and_nobody_else(pom):
    graph = part(pom, "hypernet")
    feeds = ones(graph, {"S": 0, "N": 1, "A": 1, "T": 1, "R": 1, "C": 1})
    same(graph, session(pom, "hypernet").run(["theta", "pose"], feeds), feeds)


@pytest.mark.parametrize("name", POM_GRAPHS)
def test_files_are_plain_single_and_named(pom, name):
    graph = part(pom, name)
    model = onnx.load(pom.path / graph.file, load_external_data=False)
    onnx.checker.check_model(model, full_check=True)
    assert model.ir_version <= 10
    assert [(o.domain, o.version) for o in model.opset_import] == [("", 18)]
    assert not any(t.external_data for t in model.graph.initializer)
    for value, tensor in zip(
        [*model.graph.input, *model.graph.output], [*graph.inputs, *graph.outputs], strict=True
    ):
        shape = [d.dim_param or d.dim_value for d in value.type.tensor_type.shape.dim]
        assert (value.name, shape) == (tensor.name, tensor.shape)


def test_metadata_says_what_a_program_without_json_needs(pom):
    facts = {p.key: p.value for p in onnx.load(pom.path / "hypernet.onnx").metadata_props}
    flow = pom.model.config.flow
    assert facts["hcnaf.format"] == "1"
    assert facts["hcnaf.graph"] == "hypernet"
    assert facts["hcnaf.kind"] == "pom"
    assert facts["hcnaf.parameters"] == str(flow.parameters)
    assert facts["hcnaf.channels"] == "drivable,direction_x,direction_y"
    assert facts["hcnaf.optional_channels"] == "drivable,direction_y"
    assert (facts["hcnaf.history"], float(facts["hcnaf.step"]), float(facts["hcnaf.horizon_max"])) == (
        "10",
        0.1,
        4.0,
    )


def test_recurrent_networks_stay_recurrent_networks(pom):
    operators = [node.op_type for node in onnx.load(pom.path / "hypernet.onnx").graph.node]
    assert operators.count("LSTM") == 2
    assert not {"Loop", "Scan", "If"} & set(operators)


def test_one_horizon_at_a_time_is_all_at_once(pom):
    feeds = scene(pom.model.config, SCENES["typical"], np.random.default_rng(5))
    run = session(pom, "hypernet")
    whole, _ = run.run(["theta", "pose"], feeds)
    for k in range(len(feeds["horizons"])):
        one, _ = run.run(["theta", "pose"], feeds | {"horizons": feeds["horizons"][k : k + 1]})
        np.testing.assert_allclose(one[:, 0], whole[:, k], rtol=1e-5, atol=1e-5)


def test_one_target_at_a_time_is_all_at_once(pom):
    feeds = scene(pom.model.config, SCENES["gaps"], np.random.default_rng(6))
    run = session(pom, "hypernet")
    whole, poses = run.run(["theta", "pose"], feeds)
    for k in range(len(feeds["target"])):
        one, pose = run.run(["theta", "pose"], feeds | {"target": feeds["target"][k : k + 1]})
        np.testing.assert_allclose(one[0], whole[k], rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(pose[0], poses[k], rtol=1e-6)


def test_a_target_does_not_see_itself_among_the_others(pom):
    config = pom.model.config
    feeds = scene(config, SceneSetting(agents=4, targets=1), np.random.default_rng(7))
    found, _ = session(pom, "hypernet").run(["theta", "pose"], feeds)
    alone = feeds["target"][0]
    rest = [n for n in range(4) if n != alone]
    moved = {"past": feeds["past"][[alone, *rest]], "size": feeds["size"][[alone, *rest]]}
    again, _ = session(pom, "hypernet").run(["theta", "pose"], feeds | moved | {"target": np.array([0])})
    np.testing.assert_allclose(again, found, rtol=1e-5, atol=1e-5)
    empty = {"past": feeds["past"][[alone]], "size": feeds["size"][[alone]], "target": np.array([0])}
    nobody, _ = session(pom, "hypernet").run(["theta", "pose"], feeds | empty)
    assert np.abs(nobody - found).max() > 1e-3  # the others do matter


def test_theta_does_not_depend_on_where_the_scene_lies(pom):
    feeds = scene(pom.model.config, SceneSetting(), np.random.default_rng(8))
    shift = np.array([64.0, -32.0], np.float32)  # exact in float32
    moved = {name: feeds[name].copy() for name in ("past", "raster_origin", "stops")}
    moved["past"][..., :2] += shift
    moved["raster_origin"] += shift
    moved["stops"][:, :2] += shift
    run = session(pom, "hypernet")
    a, pose = run.run(["theta", "pose"], feeds)
    b, away = run.run(["theta", "pose"], feeds | moved)
    np.testing.assert_allclose(b, a, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(away[:, :2], pose[:, :2] + shift, atol=1e-4)


@pytest.mark.parametrize(
    ("spec", "name"),
    [
        (FlowSpec(layers=3, hidden=100), "flow"),
        (FlowSpec(layers=3, hidden=100), "cell_mass"),
        (FlowSpec(layers=2, hidden=20, support="paper"), "conditional_cdf"),
    ],
    ids=lambda v: v if isinstance(v, str) else f"H{v.hidden}L{v.layers}-{v.support}",
)
def test_other_flows_agree_with_pytorch(tmp_path, spec, name):
    model = build(ConditionConfig(flow=spec))
    graph = next(g for g in graphs(model) if g.name == name)
    write_onnx(graph, tmp_path / graph.file, {})
    rows = compare_graph(graph, tmp_path, list(flow_cases(name, spec, {}).values()))
    assert [r.output for r in rows] == [t.name for t in graph.outputs]
    assert all(r.passed for r in rows), rows


def test_cells_are_by_erf_only_where_that_is_accurate_enough():
    """Limits of z that hold 0.003 of the normal mass: erf tells F_2 to some 2e-5, enough for a column of 0.01."""
    z = torch.cat([torch.linspace(2.0, 2.05, 40), torch.tensor([2.0, 2.05])])[None, :, None]
    heavy, light = (weighed_fraction(torch.full((1, 1, 1), share))(z) for share in (1.0, 0.01))
    torch.testing.assert_close(heavy, planar.stable_fraction(z), atol=1e-7, rtol=0.0)
    assert 1e-6 < (light - planar.stable_fraction(z.double())).abs().max() < 5e-5


@pytest.mark.parametrize(("held", "last", "most"), [(1.02, 2.0, 2e-5), (0.98, -3.0, 1e-6)])
def test_logarithms_are_by_erf_only_where_that_is_accurate_enough(held, last, most):
    """Intervals that hold a little more than erf does for, anywhere, and a little less, out in the tail."""
    a = torch.linspace(-6.0, last, 400).double()
    b = torch.special.ndtri(torch.special.ndtr(a) + held * LOG_ERF_FROM).float()
    found = shipped_log_interval(a.float(), b).double()
    expected = torch.log(torch.special.ndtr(b.double()) - torch.special.ndtr(a.float().double()))
    assert (found - expected).abs().max() < most


def test_maps_with_close_limits_do_not_slow_the_others_down():
    """Of maps side by side each gets what it gets alone: erf for all but those that it does not do for."""
    share = torch.tensor([0.01, 1.0, 0.01, 1.0])[:, None, None]
    z = torch.cat([torch.linspace(2.0, 2.05, 40), torch.tensor([2.0, 2.05])])[None, :, None].expand(4, -1, -1)
    together = weighed_fraction(share)(z)
    alone = torch.cat([weighed_fraction(share[b : b + 1])(z[b : b + 1]) for b in range(4)])
    torch.testing.assert_close(together, alone, atol=0.0, rtol=0.0)
    torch.testing.assert_close(together[1::2], planar.stable_fraction(z[1::2]), atol=0.0, rtol=0.0)
    assert (together[::2] - together[1::2]).abs().max() > 1e-7


def test_examples_are_never_of_size_one_and_tell_sizes_apart():
    assert min(EXAMPLE_SIZES.values()) > 1
    assert len(set(EXAMPLE_SIZES.values())) == len(EXAMPLE_SIZES)


def test_a_graph_is_in_evaluation_mode(pom):
    assert not any(m.training for g in graphs(pom.model) for m in g.module.modules())
    assert torch.is_grad_enabled()


def test_the_encoder_runs_once_per_target_whatever_the_horizons(tmp_path):
    """Every convolution of the embedded model sees one image per target, or the one of its places."""
    model = onnx.load(EMBEDDED / "model" / "hypernet.onnx")
    outputs = [node.output[0] for node in model.graph.node if node.op_type == "Conv"]
    assert len(outputs) > 5
    model.graph.output.extend(onnx.ValueInfoProto(name=name) for name in outputs)
    onnx.save(model, tmp_path / "seen.onnx")
    run = onnxruntime.InferenceSession(tmp_path / "seen.onnx", providers=["CPUExecutionProvider"])
    scene = Scene.load(EMBEDDED / "scenes" / "junction.npz")
    feeds = {
        "past": scene.past,
        "size": scene.size,
        "target": scene.target[:3],
        "raster": scene.raster,
        "raster_origin": scene.origin,
        "raster_resolution": np.float32([scene.resolution]),
    }
    for horizons in ([1.0], np.linspace(0.2, 4.0, 20)):
        found = run.run(outputs, feeds | {"horizons": np.float32(horizons)})
        assert {len(images) for images in found} <= {1, 3}
        assert sum(len(images) == 3 for images in found) >= len(found) / 2
