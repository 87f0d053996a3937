"""The hyper-network in fewer bits: what is stored, what stays float32, what it costs and who says so."""

import shutil
from dataclasses import replace

import numpy as np
import onnx
import pytest
import torch
from onnx import numpy_helper

from hcnaf_cli.train import main
from hcnaf_export import cost, export
from hcnaf_export.calibration import feeds, scenes
from hcnaf_export.checkpoint import save_checkpoint
from hcnaf_export.export import export_bundle
from hcnaf_export.forecast import trace_map
from hcnaf_export.graphs import graphs
from hcnaf_export.onnx_file import save
from hcnaf_export.parity import open_graph
from hcnaf_export.precision import LEAST_HALVED, LEAST_INT8, check, convert
from hcnaf_export.probes import SCENES, hypernet_feeds, scene, thetas
from hcnaf_models import planar
from hcnaf_models.config import ConditionConfig, PomConfig
from hcnaf_models.spec import FlowSpec
from hcnaf_runtime import Bundle
from hcnaf_runtime.errors import DataError, InputError, ParityError, SceneError
from hcnaf_runtime.verify import verify
from tests.export import synthetic

FLOW_GRAPHS = ("flow.onnx", "marginal_cdf.onnx", "conditional_cdf.onnx", "cell_mass.onnx")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return synthetic.write(tmp_path_factory.mktemp("data") / "set")


@pytest.fixture(scope="module")
def one_map(pom):
    return trace_map(pom.model.config.flow)


@pytest.fixture
def quick(pom, one_map, monkeypatch):
    """Exports of the model of `pom` take their float32 graphs from its bundle."""

    def write(graph, path, metadata):
        shutil.copy(pom.path / graph.file, path)

    monkeypatch.setattr(export, "write_onnx", write)
    monkeypatch.setattr(export, "trace_map", lambda spec: one_map)
    return pom


@pytest.fixture(scope="module")
def hypernet(pom):
    return onnx.load(pom.path / "hypernet.onnx")


@pytest.fixture(scope="module")
def calibration(pom, data):
    return feeds(Bundle.open(pom.path).manifest, scenes(data, 8))[0]


def theta_of(pom, model, tmp_path, inputs):
    save(model, tmp_path / "hypernet.onnx")
    return open_graph(graphs(pom.model)[0], tmp_path).run(["theta"], inputs)[0]


def weights(model):
    return {t.name: numpy_helper.to_array(t) for t in model.graph.initializer}


def test_int8_needs_calibration_only_where_there_are_convolutions(data):
    with pytest.raises(InputError, match=r"int8 without calibration data.*--calibration"):
        check(PomConfig(), "int8", None)
    check(PomConfig(channels=(), draw_actors=False), "int8", None)
    check(ConditionConfig(), "int8", None)
    check(PomConfig(), "int8", data)
    check(PomConfig(), "fp16", None)


@pytest.mark.parametrize(("config", "precision"), [(PomConfig(), "fp32"), (ConditionConfig(), "int8")])
def test_calibration_for_nothing_is_refused(data, config, precision):
    with pytest.raises(InputError, match="leave out --calibration"):
        check(config, precision, data)


def test_fp16_is_float32_arithmetic_on_rounded_weights(pom, hypernet, tmp_path):
    inputs = scene(pom.model.config, SCENES["typical"], np.random.default_rng(0))
    small = convert(hypernet, "fp16", [])
    rounded = onnx.ModelProto()
    rounded.CopyFrom(hypernet)
    halved = {name.removesuffix(".fp16") for name in weights(small) if name.endswith(".fp16")}
    for tensor in rounded.graph.initializer:
        if tensor.name in halved:
            values = numpy_helper.to_array(tensor).astype(np.float16).astype(np.float32)
            tensor.CopyFrom(numpy_helper.from_array(values, tensor.name))
    assert sum(weights(hypernet)[name].size for name in halved) > 0.7 * sum(
        v.size for v in weights(hypernet).values() if v.dtype == np.float32
    )
    found = theta_of(pom, small, tmp_path, inputs)
    np.testing.assert_allclose(found, theta_of(pom, rounded, tmp_path, inputs), rtol=1e-5, atol=1e-5)
    assert np.abs(found - theta_of(pom, hypernet, tmp_path, inputs)).max() > 0.0


def test_weights_that_float16_cannot_hold_stay(hypernet):
    model = onnx.ModelProto()
    model.CopyFrom(hypernet)
    read = {n.input[1] for n in model.graph.node if n.op_type in ("MatMul", "Gemm")}
    large = next(t for t in model.graph.initializer if t.name in read and np.prod(t.dims) >= LEAST_HALVED)
    name = large.name
    large.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(large) + np.float32(1e5), name))
    assert weights(convert(hypernet, "fp16", []))[f"{name}.fp16"].dtype == np.float16
    assert weights(convert(model, "fp16", []))[name].dtype == np.float32


def test_int8_is_in_the_large_layers_only_and_in_standard_operators(hypernet, calibration):
    found = convert(hypernet, "int8", calibration)
    assert {o.domain for o in found.opset_import} == {""}
    assert {n.domain for n in found.graph.node} <= {"", "ai.onnx"}
    kinds = [n.op_type for n in found.graph.node]
    before = [n.op_type for n in hypernet.graph.node]
    sizes = {name: value.size for name, value in weights(hypernet).items()}
    large = [
        n
        for n in hypernet.graph.node
        if n.op_type in ("MatMul", "Gemm") and sizes.get(n.input[1], 0) >= LEAST_INT8
    ]
    assert large
    assert kinds.count("MatMulInteger") == len(large)
    assert kinds.count("LSTM") == before.count("LSTM") == 2
    eight = [v for v in weights(found).values() if v.dtype == np.int8 and v.size > 1]
    assert all(np.abs(v.astype(int)).max() <= 64 for v in eight)  # seven bits: no 16-bit saturation anywhere


def test_convolutions_become_int8_on_calibration_scenes(hypernet, calibration, monkeypatch):
    from hcnaf_export import precision

    monkeypatch.setattr(precision, "LEAST_INT8", 500)
    found = convert(hypernet, "int8", calibration)
    kinds = [n.op_type for n in found.graph.node]
    assert "QuantizeLinear" in kinds
    eight = [v for v in weights(found).values() if v.dtype == np.int8 and v.ndim == 4]
    assert eight


@pytest.mark.parametrize("precision", ["fp16", "int8"])
def test_a_bundle_of_another_precision(quick, data, tmp_path, precision):
    calibration = data if precision == "int8" else None
    names = []
    result = export_bundle(
        quick.checkpoint,
        tmp_path / "bundle",
        precision=precision,
        calibration=calibration,
        progress=lambda name, *_: names.append(name),
    )
    assert f"precision {precision}" in names
    bundle = Bundle.open(tmp_path / "bundle")
    rows = verify(bundle, threads=1)
    assert {r.graph for r in rows} == set(bundle.manifest.graphs)
    assert all(r.passed for r in rows), rows
    for file in FLOW_GRAPHS:
        assert (bundle.path / file).read_bytes() == (quick.path / file).read_bytes()
    m = bundle.manifest
    assert (m.precision, m.precision_cost) == (precision, result.cost)
    for file in ("hypernet.onnx", "forecast.onnx"):
        size = (bundle.path / file).stat().st_size
        assert (m.precision_cost["bytes"][file], m.files[file].bytes, result.files[file]) == (size, size, size)
        assert size < m.precision_cost["bytes_fp32"][file] == (quick.path / file).stat().st_size
        facts = {p.key: p.value for p in onnx.load(bundle.path / file).metadata_props}
        assert facts["hcnaf.precision"] == precision
    assert 0.0 < m.precision_cost["nats"]["mean"] <= m.precision_cost["nats"]["max"]
    assert 0.0 < m.precision_cost["cell_mass"]["max"] < 1.0
    card = (bundle.path / "README.md").read_text()
    assert f"stored as {precision}" in card
    assert "change of log p (nats)" in card
    assert all(row.passed for row in result.rows)


def test_float32_is_the_default_and_its_size_is_stated(pom):
    m = Bundle.open(pom.path).manifest
    assert (m.precision, m.precision_cost, pom.result.precision) == ("fp32", {}, "fp32")
    assert sum(pom.result.files.values()) == pom.result.bytes
    card = (pom.path / "README.md").read_text()
    assert f"| hypernet.onnx | {m.files['hypernet.onnx'].bytes:,} |" in card


def test_a_precision_that_ruins_the_forecast_leaves_no_bundle(quick, tmp_path, monkeypatch):
    def ruin(model, precision, calibration):
        for tensor in model.graph.initializer:
            if tensor.name.endswith("head.weights.bias"):
                values = numpy_helper.to_array(tensor)
                tensor.CopyFrom(numpy_helper.from_array(values + np.float32(0.5), tensor.name))
        return model

    monkeypatch.setattr(export.precisions, "convert", ruin)
    with pytest.raises(ParityError, match=r"fp16 changes log p by .* nats on average.*no bundle"):
        export_bundle(quick.checkpoint, tmp_path / "b", precision="fp16")
    assert list(tmp_path.iterdir()) == []


def test_a_data_set_that_is_none_is_refused(pom, tmp_path, capsys):
    with pytest.raises(DataError):
        export_bundle(pom.checkpoint, tmp_path / "b", precision="int8", calibration=tmp_path / "nowhere")
    with pytest.raises(SystemExit) as end:
        main(["export", "--ckpt", str(pom.checkpoint), "-o", str(tmp_path / "b"), "--precision", "int8"])
    assert end.value.code == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    assert "--calibration" in said.err


def test_scenes_that_do_not_fit_are_refused_before_any_work(pom, data, tmp_path, monkeypatch):
    state = pom.model.state_dict()
    save_checkpoint(tmp_path / "model.pt", replace(pom.model.config, step=0.2), state, {}, {})
    monkeypatch.setattr(export, "write_onnx", None)
    with pytest.raises(SceneError, match=r"step is 0.1 s, the bundle expects 0.2 s"):
        export_bundle(tmp_path / "model.pt", tmp_path / "b", precision="int8", calibration=data)
    assert [f.name for f in tmp_path.iterdir()] == ["model.pt"]


def test_calibration_and_measurement_see_different_scenes(pom, data):
    calibrate, probe = feeds(Bundle.open(pom.path).manifest, scenes(data, 8))
    assert len(calibrate) == len(probe) == 4
    seen = {each["past"].tobytes() for each in calibrate}
    assert not seen & {each["past"].tobytes() for each in probe}


@pytest.mark.parametrize("support", ["normalised", "paper"])
def test_points_are_drawn_from_the_forecasts(support):
    spec = FlowSpec(layers=2, hidden=8, support=support)
    theta = torch.from_numpy(thetas(spec, {})["random"])
    points = cost._draw(spec, theta)
    F = planar.marginal_cdf(spec, theta, points[..., 0])
    far = planar.marginal_cdf(spec, theta, torch.tensor([[-1e4, 1e4]]).expand(len(theta), -1))
    share = ((F - far[:, :1]) / (far[:, 1:] - far[:, :1])).flatten().sort().values
    expected = torch.linspace(0, 1, len(share))
    assert (share - expected).abs().max() < 1.63 / np.sqrt(len(share))  # Kolmogorov-Smirnov at 1 %


def test_no_difference_costs_nothing_and_more_costs_more():
    spec = FlowSpec(layers=1, hidden=6)
    theta = thetas(spec, {})["random"]
    rng = np.random.default_rng(0)
    noise = rng.normal(size=theta.shape).astype(np.float32)
    same, small, large = (cost.measure(spec, [theta], [theta + s * noise], None) for s in (0.0, 1e-4, 1e-2))
    assert same["nats"]["max"] == same["cell_mass"]["max"] == same["total_variation"]["max"] == 0.0
    for what in ("nats", "cell_mass", "total_variation"):
        assert 0.0 < small[what]["max"] < large[what]["max"] <= (np.inf if what == "nats" else 1.0)


def test_a_line_has_nats_and_no_maps(line):
    inputs = list(hypernet_feeds(line.model).values())
    run = open_graph(graphs(line.model)[0], line.path)
    theta = [run.run(["theta"], each)[0] for each in inputs]
    found = cost.measure(line.model.config.flow, theta, theta, None)
    assert set(found) == {"maps", "points", "nats"}
