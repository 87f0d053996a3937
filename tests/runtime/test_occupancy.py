"""Occupancy of the whole scene: boxes on a grid, against rasters and against Monte Carlo."""

import math
from dataclasses import replace

import numpy as np
import pytest

from hcnaf_runtime import Condition, Forecaster, Grid, Scene
from hcnaf_runtime.centres import centres
from hcnaf_runtime.errors import InputError
from hcnaf_runtime.footprint import motion_headings, raster, spread, swept
from hcnaf_runtime.frames import to_scene
from hcnaf_runtime.occupancy import SAVED

GRID = Grid(120, 110, 0.5).at(-20.0, -25.0)
HORIZONS = [0.25, 1.0, 4.0]

DISCRETISED = 0.005
"""What cutting a density into cells may change a cell's probability by."""


class _Gaussian:
    """The flow of independent x and y, theta = (mean x, mean y, sigma x, sigma y)."""

    hidden = 20

    def marginal_cdf(self, theta, x):
        return _phi((x - theta[:, :1]) / theta[:, 2:3])

    def conditional_cdf(self, theta, x, y):
        return _phi((y - theta[:, 1, None, None]) / theta[:, 3, None, None])


@np.vectorize
def _erf(z):
    return math.erf(z)


def _phi(z):
    return (0.5 + 0.5 * _erf(z.astype(np.float64) / math.sqrt(2))).astype(np.float32)


def _inside(points, place, heading, size):
    """Whether a box covers the points [..., 2]."""
    d = points - place
    c, s = np.cos(heading), np.sin(heading)
    u, v = c * d[..., 0] + s * d[..., 1], c * d[..., 1] - s * d[..., 0]
    return (np.abs(u) <= size[0] / 2) & (np.abs(v) <= size[1] / 2)


def _certain(mean, pose, size, grid, sigma=1e-3):
    """Occupancy of an agent whose centre is at `mean` of its own frame, up to a millimetre."""
    theta = np.float32([[*mean, sigma, sigma]])
    window = np.full((1, 2), -200.0), np.full((1, 2), 200.0)
    (found,) = centres(_Gaussian(), theta, *window, grid.resolution / 16, 1e-5)
    turns = motion_headings(found.places, size[0])
    return spread(swept(found.places, found.extents, turns, 0.0, found.mass, pose), size, grid)


@pytest.mark.parametrize("heading", [0.0, 0.3, math.pi / 4, math.pi / 2, -2.0, 3.1])
@pytest.mark.parametrize("size", [(4.5, 1.8), (0.5, 0.6), (14.0, 2.5)])
def test_a_raster_is_1_where_the_box_is(heading, size):
    for x, y in [(0.1, 0.2), (-19.9, -24.8), (38.9, 29.4), (-21.1, 0.1), (300.0, 0.0)]:
        found = raster(x, y, heading, size, GRID)
        np.testing.assert_array_equal(found, _inside(GRID.centres.astype(np.float64), (x, y), heading, size))


def test_a_box_covers_the_centres_on_its_edge():
    grid = Grid(10, 10, 0.5).at(0.0, 0.0)
    assert raster(2.25, 2.25, 0.0, (2.0, 1.0), grid).sum() == 5 * 3


@pytest.mark.parametrize("size", [(4.5, 1.8), (0.6, 0.6), (12.0, 2.5)])
@pytest.mark.parametrize("mean", [(0.0, 0.0), (7.3, 2.1), (-3.2, 0.7)])
def test_one_certain_agent_is_its_raster(mean, size):
    pose = np.array([6.13, 2.27, 0.4])
    found = _certain(mean, pose, size, GRID)
    heading = pose[2] + motion_headings(np.array(mean), size[0])
    place = to_scene(np.array(mean), pose)
    points = GRID.centres.astype(np.float64)
    larger, smaller = (_inside(points, place, heading, np.array(size) + d) for d in (0.08, -0.08))
    np.testing.assert_allclose(found[smaller], 1.0, atol=1e-4)
    np.testing.assert_array_equal(found[~larger], 0.0)
    assert (larger & ~smaller).sum() <= 10  # the few centres on the edge itself


def test_cells_hold_the_mass_and_its_moments():
    theta = np.float32([[10, -4, 0.02, 3], [60, 0, 8, 0.1], [0, 0, 40, 40]])
    low, high = np.full((3, 2), -300.0), np.full((3, 2), 300.0)
    for found, (mx, my, sx, sy) in zip(centres(_Gaussian(), theta, low, high, 1e-3, 1e-5), theta, strict=True):
        assert 1 - 1e-5 <= found.mass.sum() <= 1 + 1e-6
        mean = found.mass @ found.places / found.mass.sum()
        spread_ = np.sqrt(found.mass @ ((found.places - mean) ** 2 + found.extents**2 / 12) / found.mass.sum())
        np.testing.assert_allclose((mean - (mx, my)) / (sx, sy), 0.0, atol=0.01)
        np.testing.assert_allclose(spread_, (sx, sy), rtol=0.02)


def test_cells_are_those_of_the_window():
    theta = np.float32([[0, 0, 2, 2]])
    (found,) = centres(_Gaussian(), theta, np.array([[0.0, -50.0]]), np.array([[50.0, 0.0]]), 0.01, 1e-5)
    assert found.mass.sum() == pytest.approx(0.25, abs=1e-4)
    assert (found.places[:, 0] > 0).all()
    assert (found.places[:, 1] < 0).all()
    (none,) = centres(_Gaussian(), theta, np.array([[40.0, 40.0]]), np.array([[50.0, 50.0]]), 0.01, 1e-5)
    assert none.mass.sum() < 1e-5


def test_motion_headings():
    def degrees(x, y):
        return math.degrees(motion_headings(np.array([x, y]), 4.5))

    assert degrees(20.0, 0.0) == 0.0
    for angle in (0.1, 0.5, 0.7):  # on a circle that starts along x
        radius = 12.0 / angle
        assert degrees(radius * math.sin(angle), radius * (1 - math.cos(angle))) == pytest.approx(
            math.degrees(angle)
        )
    assert degrees(5.0, 9.0) == pytest.approx(90.0)
    assert degrees(0.0, 0.0) == degrees(0.0, 3.0) == 0.0
    for x, y in [(8.0, 2.0), (1.0, 0.4), (0.3, 2.0)]:
        assert degrees(x, -y) == pytest.approx(-degrees(x, y))
        assert degrees(-x, y) == pytest.approx(-degrees(x, y))  # backwards round the same circle
    assert 0.0 < degrees(1.0, 0.5) < degrees(2.25, 1.125)


@pytest.mark.parametrize("heading", ["motion", "present", 0.3])
@pytest.mark.parametrize("agent", [0, 1])
def test_probabilities_are_those_of_monte_carlo(forecaster, scene, agent, heading):
    found = forecaster.occupancy(scene, GRID, HORIZONS, heading, exclude=[1 - agent])
    theta = forecaster.theta(scene, HORIZONS)
    rng = np.random.default_rng(agent)
    draws, size = 40_000, scene.size[agent].astype(np.float64)
    points = GRID.centres.astype(np.float64)
    for t in range(len(HORIZONS)):
        mx, my, sx, sy, rho = theta.values[agent, t]
        z = rng.standard_normal((draws, 2))
        centre = np.column_stack([mx + sx * z[:, 0], my + sy * (rho * z[:, 0] + np.sqrt(1 - rho**2) * z[:, 1])])
        yaw = theta.pose[agent, 2] + (motion_headings(centre, size[0]) if heading == "motion" else 0.0)
        yaw = np.full(draws, heading) if isinstance(heading, float) else np.broadcast_to(yaw, draws)
        place = to_scene(centre, theta.pose[agent])
        p = found.probability[t]
        likely = rng.permutation(np.argwhere(p > 1e-3))[:60]
        for row, column in [*likely, *rng.permutation(np.argwhere(p == 0))[:10]]:
            share = _inside(points[row, column], place, yaw, size).mean()
            error = 4 * np.sqrt(max(share * (1 - share), 1 / draws) / draws)
            assert abs(p[row, column] - share) < error + DISCRETISED


def test_agents_are_combined_as_if_independent(forecaster, fields):
    fields |= gaussian_pair(fields)
    scene = Scene(**fields)
    both = forecaster.occupancy(scene, GRID, HORIZONS)
    first, second = (forecaster.occupancy(scene, GRID, HORIZONS, exclude=[i]) for i in (1, 0))
    p, q = first.probability.astype(np.float64), second.probability.astype(np.float64)
    assert (np.minimum(p, q) > 0.01).any()
    np.testing.assert_allclose(both.probability, 1 - (1 - p) * (1 - q), atol=1e-6)
    np.testing.assert_allclose(both.expected, p + q, atol=1e-6)
    np.testing.assert_allclose(first.expected, p, atol=1e-6)
    assert both.forecast.tolist() == [0, 1]
    assert first.forecast.tolist() == [0]


def gaussian_pair(fields):
    """The second agent close to the first, so that their ways cross."""
    past = fields["past"].copy()
    past[1, :, :2] += past[0, -1, :2] + np.float32([6, 3]) - past[1, -1, :2]
    return {"past": past}


@pytest.mark.parametrize("heading", ["motion", "present"])
def test_the_expected_number_integrates_to_the_boxes_area(forecaster, scene, heading):
    found = forecaster.occupancy(scene, GRID, [1.0, 4.0], heading)
    area = found.expected.sum(axis=(1, 2), dtype=np.float64) * GRID.resolution**2
    np.testing.assert_allclose(area, scene.size.prod(axis=1).sum(), rtol=0.01)


def test_a_quarter_turn_of_the_scene_turns_the_result(forecaster, fields):
    grid = Grid(100, 100, 0.5).at(-25.0, -25.0)
    turned = {k: np.array(v) if isinstance(v, np.ndarray) else v for k, v in fields.items()}
    x, y, sin, cos = (fields["past"][..., k] for k in range(4))
    turned["past"][..., :4] = np.stack([-y, x, cos, -sin], axis=-1)
    one = forecaster.occupancy(Scene(**fields), grid, HORIZONS)
    other = forecaster.occupancy(Scene(**turned), grid, HORIZONS)
    np.testing.assert_allclose(np.rot90(one.probability, -1, axes=(1, 2)), other.probability, atol=DISCRETISED)


def test_moving_scene_and_grid_changes_nothing(forecaster, fields):
    one = forecaster.occupancy(Scene(**fields), GRID, HORIZONS)
    fields["past"][..., :2] += np.float32([64, -32])
    fields["origin"] += np.float32([64, -32])
    other = forecaster.occupancy(Scene(**fields), GRID.at(44.0, -57.0), HORIZONS)
    np.testing.assert_allclose(one.probability, other.probability, atol=DISCRETISED)
    assert other.info["origin"] == {"x": 44.0, "y": -57.0, "yaw": 0.0}


def test_a_part_of_the_grid_is_that_part_of_the_occupancy(forecaster, scene):
    whole = forecaster.occupancy(scene, GRID, HORIZONS)
    part = forecaster.occupancy(scene, Grid(20, 16, 0.5).at(2.0, -5.0), HORIZONS)
    np.testing.assert_allclose(whole.probability[:, 40:56, 44:64], part.probability, atol=DISCRETISED)


def test_agents_without_a_forecast_stay_and_unseen_ones_are_left_out(forecaster, fields):
    past = np.concatenate([fields["past"], fields["past"] + np.float32([-9, 9, 0, 0, 0])])
    past[2, :-1] = np.nan  # a history that was not seen
    past[3, -1] = np.nan  # not seen now
    fields |= {
        "past": past,
        "size": np.tile(fields["size"], (2, 1)),
        "kind": np.tile(fields["kind"], 2),
        "target": np.array([1]),
    }
    scene = Scene(**fields)
    found = forecaster.occupancy(scene, GRID, HORIZONS)
    assert (found.forecast.tolist(), found.present.tolist()) == ([1], [0, 2])
    assert found.notes[-2:] == (
        "agents without a forecast are taken to stay where they are: 0, 2",
        "agents not observed now are left out: 3",
    )
    for i in found.present:
        x, y, sin, cos = past[i, -1, :4].astype(np.float64)
        box = raster(x, y, math.atan2(sin, cos), scene.size[i], GRID) > 0
        assert (found.probability[:, box] == 1.0).all()
    alone = forecaster.occupancy(scene, GRID, HORIZONS, exclude=[1, 0])
    np.testing.assert_array_equal(alone.probability, np.broadcast_to(box, alone.probability.shape))
    assert (len(alone.forecast), alone.present.tolist()) == (0, [2])


def test_int8_is_a_message_of_percent(forecaster, scene, tmp_path):
    found = forecaster.occupancy(scene, GRID, HORIZONS)
    p = found.probability.copy()
    p[0, 0, :6] = [0.0, 0.004, 0.006, 0.994, 1.0, np.nan]
    message = replace(found, probability=p).to_int8()
    assert (message.dtype, message.shape) == (np.int8, (3, 110 * 120))
    assert message[0, :6].tolist() == [0, 0, 1, 99, 100, -1]
    assert message.min() == -1
    np.testing.assert_allclose(message[1].reshape(110, 120) / 100, found.probability[1], atol=0.00501)
    assert found.info == {
        "resolution": 0.5,
        "width": 120,
        "height": 110,
        "origin": {"x": -20.0, "y": -25.0, "yaw": 0.0},
    }
    found.save(tmp_path / "o.npz")
    with np.load(tmp_path / "o.npz", allow_pickle=False) as saved:
        assert set(saved.files) == set(SAVED)
        np.testing.assert_array_equal(saved["probability"], found.probability)


def test_given_headings_are_those_of_each_map(forecaster, scene):
    yaw = np.array([[0.1, 0.2, 0.3], [1.0, 1.1, 1.2]])
    together = forecaster.occupancy(scene, GRID, HORIZONS, yaw)
    for t in range(3):
        alone = forecaster.occupancy(scene, GRID, HORIZONS, yaw[:, t : t + 1])
        np.testing.assert_array_equal(together.probability[t], alone.probability[t])
    present = forecaster.occupancy(scene, GRID, HORIZONS, "present")
    given = forecaster.occupancy(scene, GRID, HORIZONS, scene.pose[:, 2:])
    np.testing.assert_allclose(given.probability, present.probability, atol=1e-4)


def test_a_grid_without_an_origin_lies_about_the_agents(forecaster, scene):
    found = forecaster.occupancy(scene, Grid(40, 40, 1.0), 1.0)
    middle = (scene.pose[:, :2].min(axis=0) + scene.pose[:, :2].max(axis=0)) / 2
    np.testing.assert_allclose(found.origin + 20.0, middle, atol=1.0)
    assert found.lost_mass == 1e-4
    assert found.timings.maps > 0


@pytest.mark.parametrize(
    "change",
    [
        {"heading": "ahead"},
        {"heading": np.zeros((3, 3))},
        {"heading": math.nan},
        {"lost_mass": -1.0},
        {"exclude": [2]},
        {"exclude": [-1]},
        {"exclude": [0.5]},
    ],
)
def test_what_makes_no_occupancy_is_refused(forecaster, scene, change):
    with pytest.raises(InputError, match=r"^\w+ is .*, expected"):
        forecaster.occupancy(scene, GRID, 1.0, **change)


def test_a_condition_has_no_occupancy(condition_path):
    with pytest.raises(InputError, match="a condition has none"):
        Forecaster(condition_path).occupancy(Condition(np.zeros((1, 5), np.float32)))
