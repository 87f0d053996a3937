import numpy as np
import onnx
import pytest

from hcnaf_export import parity
from hcnaf_export.graphs import graphs
from hcnaf_export.parity import compare, require, row
from hcnaf_export.probes import flow_cases
from hcnaf_export.tolerances import TOLERANCES, Tolerance, tolerance
from hcnaf_models.config import ConditionConfig
from hcnaf_models.model import build
from hcnaf_models.spec import FlowSpec
from hcnaf_runtime.errors import ParityError

LIMIT = Tolerance(1e-4, 50.0, "a test")


def pair(found, expected):
    return [(np.array(found, np.float32), np.array(expected, np.float32))]


def test_equal_values_are_no_distance_apart():
    result = row("flow", "z", pair([1.0, -3e8], [1.0, -3e8]), LIMIT)
    assert (result.max_abs, result.max_rel, result.rms, result.passed) == (0.0, 0.0, 0.0, True)


def test_the_worst_value_is_named_with_its_place_on_both_sides():
    pairs = pair([0.0, 0.0], [0.0, 0.0]) + pair([[1.0, 2.0], [3.5, 4.0]], [[1.0, 2.0], [3.0, 4.0]])
    result = row("flow", "z", pairs, LIMIT)
    assert result.worst_index == [1, 1, 0]
    assert (result.onnx, result.torch, result.max_abs, result.passed) == (3.5, 3.0, 0.5, False)
    assert result.rms == pytest.approx(0.5 / np.sqrt(6))


@pytest.mark.parametrize(("value", "passed"), [(40.0, False), (4000.0, True)])
def test_beyond_the_knee_the_limit_is_relative(value, passed):
    assert row("flow", "log_prob", pair([value + 2e-3], [value]), LIMIT).passed is passed


@pytest.mark.parametrize(
    ("value", "most"), [(-40.0, 1e-4), (40.0, 1e-4), (-60.0, 6e-4), (60.0, 1.2e-4), (-744.0, 7.4e-3), (-8e6, 8e2)]
)
def test_the_fainter_a_density_the_more_its_logarithm_may_differ(value, most):
    limit = Tolerance(1e-4, 50.0, "a test", logarithm=True)
    assert row("path", "log_prob", pair([value + 0.9 * most], [value]), limit).passed
    assert not row("path", "log_prob", pair([value + 1.1 * most], [value]), limit).passed


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("side", [0, 1])
def test_what_is_not_finite_fails_even_on_both_sides(bad, side):
    values = [1.0, 1.0]
    values[side] = bad
    assert not row("flow", "z", pair([values[0]], [values[1]]), LIMIT).passed
    assert not row("flow", "z", pair([bad], [bad]), LIMIT).passed


def test_another_shape_is_an_error():
    with pytest.raises(ParityError, match=r"flow.z has shape \(2,\), PyTorch gives \(1,\)"):
        row("flow", "z", pair([1.0, 1.0], [1.0]), LIMIT)


def test_failures_name_the_output_and_both_values():
    good = row("flow", "z", pair([1.0], [1.0]), LIMIT)
    bad = row("flow", "log_prob", pair([2.0], [1.0]), LIMIT)
    require([good])
    worst = r"flow.log_prob at \[0, 0\] is 2 in onnxruntime and 1 in PyTorch.* 1 of 2 outputs"
    with pytest.raises(ParityError, match=worst):
        require([good, bad])


def test_every_output_has_a_tolerance_and_a_reason():
    parts = graphs(build(ConditionConfig())) + graphs(build(ConditionConfig(flow=FlowSpec(dims=3))))
    outputs = {(g.name, t.name) for g in parts for t in g.outputs}
    assert outputs <= set(TOLERANCES)
    assert all(t.limit > 0 and t.knee > 0 and len(t.reason) > 10 for t in TOLERANCES.values())


def test_probabilities_of_larger_flows_may_differ_by_the_root_of_their_units():
    assert (
        tolerance("conditional_cdf", "cdf")
        == tolerance("conditional_cdf", "cdf", 8)
        == TOLERANCES["conditional_cdf", "cdf"]
    )
    assert tolerance("conditional_cdf", "cdf", 80).limit == pytest.approx(4e-6)
    assert tolerance("cell_mass", "mass", 80).limit == 1e-6


@pytest.mark.parametrize("name", ["flow", "marginal_cdf", "conditional_cdf", "cell_mass"])
def test_probes_reach_tails_and_stay_finite(name):
    spec = FlowSpec(layers=2, hidden=20)
    graph = next(g for g in graphs(build(ConditionConfig(flow=spec))) if g.name == name)
    cases = flow_cases(name, spec, {})
    assert {"random", "single", "sharp", "wide", "saturated", "faint"} <= set(cases)
    assert max(np.abs(v).max() for feeds in cases.values() for k, v in feeds.items() if k != "theta") >= 1e6
    for feeds in cases.values():
        assert all(np.isfinite(v).all() for v in parity.run_torch(graph, feeds))


def test_probes_of_the_inverse_are_where_it_is_defined():
    spec = FlowSpec(layers=2, hidden=20)
    cases = flow_cases("inverse", spec, {})
    assert {"random", "single", "sharp", "wide"} == set(cases)
    for feeds in cases.values():
        assert ((feeds["uniform"] > 0.0) & (feeds["uniform"] < 1.0)).all()


def test_the_path_from_condition_to_density_is_compared(space):
    rows = compare(space.model, graphs(space.model), space.path)
    assert [(r.graph, r.output) for r in rows] == [
        ("hypernet", "theta"),
        ("flow", "log_prob"),
        ("flow", "z"),
        ("flow", "log_det"),
        ("path", "log_prob"),
    ]
    assert all(r.passed for r in rows), rows


def test_a_graph_that_is_off_by_a_thousandth_is_found(space, tmp_path):
    for file in ("hypernet.onnx", "flow.onnx"):
        (tmp_path / file).write_bytes((space.path / file).read_bytes())
    shift(tmp_path / "flow.onnx", "log_prob", 1e-3)
    failed = {(r.graph, r.output) for r in compare(space.model, graphs(space.model), tmp_path) if not r.passed}
    assert failed == {("flow", "log_prob"), ("path", "log_prob")}


def inverse_of(exported):
    graph = next(g for g in graphs(exported.model) if g.name == "inverse")
    return graph, flow_cases("inverse", exported.model.config.flow, {})


@pytest.mark.parametrize(
    ("output", "amount"), [("points", 0.02), ("points", 1e5), ("log_prob", 0.1), ("error", 2e-5)]
)
def test_samples_that_are_off_are_found(pom, tmp_path, output, amount):
    graph, cases = inverse_of(pom)
    (tmp_path / "inverse.onnx").write_bytes((pom.path / "inverse.onnx").read_bytes())
    rows = parity.compare_samples(pom.model.config.flow, graph, tmp_path, list(cases.values()))
    assert all(r.passed for r in rows), rows
    shift(tmp_path / "inverse.onnx", output, amount)
    rows = parity.compare_samples(pom.model.config.flow, graph, tmp_path, list(cases.values()))
    assert output in {r.output for r in rows if not r.passed}


def test_most_probes_of_the_inverse_count(pom):
    """Points are compared where float32 determines them, which is nearly everywhere."""
    graph, cases = inverse_of(pom)
    for name in ("random", "single", "sharp", "wide"):
        points = parity.run_torch(graph, cases[name])[0]
        log_p = parity._log_densities(pom.model.config.flow, cases[name]["theta"], points)
        assert parity._determined(log_p, points).mean() > 0.9


def test_samples_that_miss_are_drawn_alone():
    feeds = {
        "theta": np.arange(6.0, dtype=np.float32).reshape(2, 3),
        "uniform": np.linspace(0.1, 0.8, 8, dtype=np.float32).reshape(2, 2, 2),
    }

    def run(given):
        """Of several samples the second misses; points say whose they are."""
        first = given["theta"][:, None, :1] + given["uniform"]
        error = np.where(np.arange(given["uniform"].shape[1]) == 1, 0.5, 0.0)
        return [first, first[..., 0], np.broadcast_to(error, first.shape[:2])]

    points, log_prob, error = parity.draw(run, feeds)
    assert error.max() == 0.0
    np.testing.assert_array_equal(points, run(feeds)[0])
    np.testing.assert_array_equal(log_prob, run(feeds)[1])


def shift(path, output, amount):
    """Add `amount` to one output of the graph at `path`."""
    model = onnx.load(path)
    for node in model.graph.node:
        node.output[:] = [f"{name}_true" if name == output else name for name in node.output]
    model.graph.initializer.append(onnx.numpy_helper.from_array(np.array(amount, np.float32), "amount"))
    model.graph.node.append(onnx.helper.make_node("Add", [f"{output}_true", "amount"], [output]))
    onnx.save(model, path)
