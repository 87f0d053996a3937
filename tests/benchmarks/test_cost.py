"""The cost model's formulas against counting, and against the sizes that ship."""

import pytest

from hcnaf_models.spec import FlowSpec
from tests.benchmarks import cost


def _count(L, H, points):
    """Operations and tanh of the second dimension's own path, layer by layer."""
    sizes = [(1, H), *[(H, H)] * (L - 1), (H, 1)]
    inner = sum(2 * a * b for a, b in sizes[1:-1]) * points
    ends = sum(2 * a * b for a, b in (sizes[0], sizes[-1])) * points
    contexts = sum(b for _, b in sizes) * points
    return inner, ends + contexts, sum(b for _, b in sizes[:-1]) * points


@pytest.mark.parametrize(("L", "H"), [(1, 1), (1, 20), (2, 7), (3, 20), (3, 100)])
def test_formulas_count_layers(L, H):
    found = cost.dense(L, H, columns=30, rows=11, nodes=2)
    inner, thin, tanh = _count(L, H, 60 * 12)
    assert (found.gemm, found.thin) == (inner, thin)
    assert found.tanh == tanh + L * H * (60 + 31) + 2 * H * (L - 1) * 60
    assert found.activations == 4 * tanh
    assert found.flops == found.gemm + found.thin + found.per_x


@pytest.mark.parametrize(("L", "H"), [(1, 1), (2, 20), (3, 100)])
def test_a_map_of_all_edges_costs_what_its_points_do_and_a_little_for_x(L, H):
    whole, points = cost.dense(L, H, 200, 200), cost.evaluated(L, H, 200 * 201, 401)
    assert (whole.gemm, whole.thin) == (points.gemm - 2 * H * H * (L - 1) * 401, points.thin - 4 * H * 401)
    assert whole.tanh - points.tanh == 2 * H * (L - 1) * 200


@pytest.mark.parametrize(("L", "H"), [(1, 1), (2, 20), (3, 100)])
def test_theta_has_the_length_of_the_layout(L, H):
    assert cost.parameters(L, H) == FlowSpec(layers=L, hidden=H).parameters


def test_work_over_points_dominates_what_depends_on_x_alone():
    found = cost.dense(3, 20, 200, 200)
    assert found.per_x < 0.05 * found.gemm
    assert found.result == 4 * 200 * 200


def test_the_floor_of_the_first_prototype():
    """166 and 256 G operations/s and 6 G tanh/s gave 0.8 and 8.3 ms."""
    assert cost.floor(cost.dense(3, 20, 200, 200), 166e9, 6e9) == pytest.approx(0.8e-3, rel=0.03)
    assert cost.floor(cost.dense(3, 100, 200, 200), 256e9, 6e9) == pytest.approx(8.3e-3, rel=0.03)
