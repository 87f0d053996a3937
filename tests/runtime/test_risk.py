"""Risk of trajectories: geometry against another formula, probabilities against draws, bounds and estimate."""

import numpy as np
import pytest
from gaussian_bundle import scene_fields

from hcnaf_runtime import Forecaster, Scene, embedded_scenes
from hcnaf_runtime.boxes import boxes_meet, octagons, reach
from hcnaf_runtime.errors import InputError
from hcnaf_runtime.footprint import motion_headings
from hcnaf_runtime.risk import Risk, collision_probability, medians

EGO = (4.6, 1.9)
HORIZONS = [0.5, 1.0, 2.0]
SHIFT = 3 * 10 / 127  # what the test bundle adds to y


def sigmas(t):
    return 0.3 + 0.4 * t, 0.4 * (0.3 + 0.4 * t)


def placed(places, pose):
    """Places [..., 2] of an agent's frame in the scene frame."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return places @ np.array([[c, s], [-s, c]]) + pose[:2]


def poses_about(scene, agent, speed, offset=(0.0, 0.0), turn=0.0, horizons=HORIZONS):
    """[T, 3]: the own box where the agent's forecast has its middle, off by `offset`, and turned by `turn`."""
    own = np.array([[speed * t + offset[0], SHIFT + offset[1]] for t in horizons])
    pose = scene.pose[agent]
    return np.column_stack([placed(own, pose), np.full(len(horizons), pose[2] + turn)])


def draws(scene, agent, speed, n, seed=0):
    """[T, n, 2]: places in the scene frame, the same base point at every horizon."""
    a, b = np.random.default_rng(seed).normal(size=(2, n))
    parts = []
    for t in HORIZONS:
        sx, sy = sigmas(t)
        parts.append(np.stack([speed * t + sx * a, SHIFT + sy * (0.6 * a + 0.8 * b)], axis=-1))
    return placed(np.stack(parts), scene.pose[agent])


def test_an_octagon_holds_the_centres_of_boxes_that_meet():
    rng = np.random.default_rng(0)
    n = 3000
    pose = np.stack([*rng.uniform(-3, 3, (2, n)), rng.uniform(-7, 7, n)])
    pose[2, :40] = np.repeat(np.arange(-5, 5), 4) * np.pi / 4  # sides that are parallel
    yaw = np.where(np.arange(n) < 40, 0.0, rng.uniform(-7, 7, n))
    size, others = np.array([4.0, 1.7]), rng.uniform(0.3, 5.0, (n, 2))
    corners = octagons(pose, size, yaw, others)
    assert corners.shape == (n, 8, 2)
    extent = reach(pose[2], size, yaw, others).T
    np.testing.assert_allclose(corners.max(axis=1), pose[:2].T + extent, atol=1e-9)
    np.testing.assert_allclose(corners.min(axis=1), pose[:2].T - extent, atol=1e-9)
    points = pose[:2].T + rng.uniform(-6, 6, (n, 2))
    edge = np.roll(corners, -1, axis=1) - corners
    to = points[:, None] - corners
    side = edge[..., 0] * to[..., 1] - edge[..., 1] * to[..., 0]
    assert (
        edge[..., 0] * np.roll(edge[..., 1], -1, 1) - edge[..., 1] * np.roll(edge[..., 0], -1, 1) > -1e-9
    ).all()
    found = boxes_meet(*(points.T - pose[:2]), pose[2], size, yaw, others)
    clear = np.abs(side).min(axis=1) > 1e-9
    np.testing.assert_array_equal(found[clear], (side > 0).all(axis=1)[clear])
    assert 0.1 < found.mean() < 0.9


def test_certain_and_impossible(forecaster, scene):
    """Through an agent that can be nowhere else; and far from everybody."""
    through = poses_about(scene, 0, 5.0, horizons=[0.05])
    away = through + np.array([0.0, 400.0, 0.0])
    found = forecaster.collision_probability(scene, np.stack([through, away]), EGO, [0.05], "present")
    assert found.per_agent.shape == (2, 1, 2)
    assert found.per_agent[0, 0, 0] >= 1 - 1e-6
    assert found.lower[0] >= 1 - 1e-6
    assert found.upper[0] == pytest.approx(1, abs=1e-6)
    assert found.upper[1] < 1e-6


@pytest.mark.parametrize("turn", [0.0, 0.7, 2.5])
def test_probabilities_against_draws(forecaster, scene, turn):
    n = 200_000
    poses = np.stack([poses_about(scene, 0, 5.0, offset, turn) for offset in ((0, 2), (3, 1.5), (-5, -1))])
    found = forecaster.collision_probability(scene, poses, EGO, HORIZONS, "present")
    points = draws(scene, 0, 5.0, n)
    size = scene.size[0].astype(np.float64)
    for k in range(3):
        for t in range(3):
            dx, dy = points[t].T - poses[k, t, :2, None]
            share = boxes_meet(dx, dy, poses[k, t, 2], np.array(EGO), scene.pose[0, 2], size).mean()
            p = found.per_agent[k, t, 0]
            assert abs(p - share) < 4 * np.sqrt(max(p * (1 - p), 1e-6) / n) + 1e-5


def test_bounds_hold_the_estimate_of_coupled_draws(forecaster, scene):
    n = 20_000
    poses = np.stack([poses_about(scene, 0, 5.0, (dx, dy), 0.4) for dx in (-6, 0, 4) for dy in (-2.6, 1.9)])
    theta = forecaster.theta(scene, HORIZONS)
    points = np.stack([draws(scene, a, speed, n, seed=a) for a, speed in ((0, 5.0), (1, 2.0))])
    found = collision_probability(forecaster.flow, scene, theta, poses, EGO, "present", points=points)
    slack = 4 * np.sqrt(0.25 / n)
    assert (found.agent_lower - slack <= found.agent_estimate).all()
    assert (found.agent_estimate <= found.agent_upper + slack).all()
    assert (found.lower - slack <= found.estimate).all()
    assert (found.estimate <= found.upper + slack).all()
    assert found.agent_estimate.max() > 0.1
    hits = np.zeros((len(poses), n), bool)
    for t in range(3):
        dx, dy = np.moveaxis(points[0, t] - poses[:, t, None, :2], -1, 0)
        hits |= boxes_meet(dx, dy, poses[:, t, 2:], np.array(EGO), scene.pose[0, 2], scene.size[0].astype(float))
    np.testing.assert_allclose(found.agent_estimate[:, 0], hits.mean(axis=1), atol=1e-9)


def test_what_follows_from_the_probabilities():
    rng = np.random.default_rng(0)
    p = rng.uniform(0, 0.4, (5, 4, 3))
    arguments = {"horizons": None, "agents": None, "forecast": None, "error": p, "notes": (), "timings": None}
    found = Risk(per_agent=p, agent_estimate=None, **arguments)
    np.testing.assert_allclose(found.per_step, 1 - (1 - p).prod(axis=2))
    np.testing.assert_allclose(found.lower, 1 - (1 - p.max(axis=1)).prod(axis=1))
    np.testing.assert_allclose(found.upper, np.minimum(p.sum(axis=(1, 2)), 1))
    assert (found.lower >= found.per_step.max(axis=1) - 1e-12).all()
    assert (found.upper >= found.lower).all()
    assert found.estimate is None


def test_batch_equals_stacked_singles(forecaster, scene):
    rng = np.random.default_rng(3)
    poses = np.stack([poses_about(scene, 0, 5.0, rng.normal(0, 2, 2), rng.uniform(-3, 3)) for _ in range(20)])
    together = forecaster.collision_probability(scene, poses, EGO, HORIZONS, tolerance=1e-5)
    for k in range(20):
        alone = forecaster.collision_probability(scene, poses[k], EGO, HORIZONS, tolerance=1e-5)
        np.testing.assert_allclose(alone.per_agent[0], together.per_agent[k], atol=3e-5)


def test_nothing_depends_on_how_the_scene_frame_lies(forecaster, scene):
    fields = scene_fields()
    motion = np.array([40.0, -25.0, 2.1])
    past = fields["past"].astype(np.float64)
    yaw = np.arctan2(past[..., 2], past[..., 3]) + motion[2]
    moved = np.concatenate(
        [placed(past[..., :2], motion), np.stack([np.sin(yaw), np.cos(yaw), past[..., 4]], -1)], -1
    )
    other = Scene(**fields | {"past": moved.astype(np.float32)})
    poses = np.stack([poses_about(scene, 0, 5.0, (dx, 1.5), 0.4) for dx in (-4, 0, 4)])
    turned = np.concatenate([placed(poses[..., :2], motion), poses[..., 2:] + motion[2]], axis=-1)
    expected = forecaster.collision_probability(scene, poses, EGO, HORIZONS)
    found = forecaster.collision_probability(other, turned, EGO, HORIZONS)
    np.testing.assert_allclose(found.per_agent, expected.per_agent, atol=4e-5)


def test_headings(forecaster, scene):
    poses = np.stack([poses_about(scene, 0, 5.0, (dx, 2.0)) for dx in (-4, 0, 4)])

    def risk(heading):
        return forecaster.collision_probability(scene, poses, EGO, HORIZONS, heading).per_agent

    present = risk("present")
    np.testing.assert_allclose(risk(np.tile(scene.pose[:, 2:], (1, 3))), present, atol=1e-6)
    theta = forecaster.theta(scene, HORIZONS)
    middle = medians(forecaster.flow, theta.values.reshape(6, -1)).reshape(2, 3, 2)
    expected = np.array([[[v * t, SHIFT] for t in HORIZONS] for v in (5.0, 2.0)])
    np.testing.assert_allclose(middle, expected, atol=0.02)
    turns = np.stack([motion_headings(m, 4.5) for m in middle])
    np.testing.assert_allclose(risk("motion"), risk(turns + scene.pose[:, 2:]), atol=1e-6)
    assert np.abs(risk("motion") - present).max() > 1e-3
    across = risk(np.tile(scene.pose[:, 2:] + np.pi / 2, (1, 3)))
    assert (across[0, :, 0] != present[0, :, 0]).all()


@pytest.fixture
def parked():
    """One agent is forecast, one is parked, one was not observed."""
    fields = scene_fields(poses=((0.0, 0.0, 0.0), (20.0, 5.0, 1.2), (0.0, 30.0, 0.0)), speeds=(5.0, 0.0, 1.0))
    fields["past"][2, -1] = np.nan
    fields["target"] = np.array([0])
    return Scene(**fields)


def test_agents_without_a_forecast_stay(forecaster, parked):
    poses = np.array([[[20.0, 2.0, 0.3]], [[20.0, -3.0, 0.3]], [[0.0, 30.0, 0.0]]])
    found = forecaster.collision_probability(parked, poses, EGO, [0.5])
    assert found.agents.tolist() == [0, 1]
    assert found.forecast.tolist() == [True, False]
    np.testing.assert_array_equal(found.per_agent[:, 0, 1], [1, 0, 0])
    assert "stay where they are: 1" in found.notes[-2]
    assert "left out: 2" in found.notes[-1]
    without = forecaster.collision_probability(parked, poses, EGO, [0.5], include_others=False)
    assert without.agents.tolist() == [0]
    np.testing.assert_allclose(without.upper, found.per_agent[:, 0, 0], atol=1e-6)
    excluded = forecaster.collision_probability(parked, poses, EGO, [0.5], exclude=[0])
    assert excluded.agents.tolist() == [1]
    nobody = forecaster.collision_probability(parked, poses, EGO, [0.5], exclude=[0, 1])
    np.testing.assert_array_equal(nobody.upper, 0)
    np.testing.assert_array_equal(nobody.per_step, 0)


def test_more_columns_are_allowed(forecaster, scene):
    poses = poses_about(scene, 0, 5.0)[None]
    more = np.concatenate([poses, np.full((1, 3, 2), np.nan)], axis=-1)
    found = forecaster.collision_probability(scene, more, EGO, HORIZONS)
    expected = forecaster.collision_probability(scene, poses, EGO, HORIZONS)
    np.testing.assert_array_equal(found.per_agent, expected.per_agent)


def test_the_error_covers_what_a_finer_tolerance_changes():
    """Under the embedded model, a fan of ways through a junction."""
    forecaster, scene = Forecaster(threads=2), Scene.load(embedded_scenes()["junction"])
    times = np.array([0.5, 1.0, 2.0, 3.0])
    fan = [
        np.column_stack([v * times * np.cos(a), v * times * np.sin(a), np.full(4, a)])
        for v in (2, 5, 8)
        for a in np.arange(0.0, 6.2, 0.5)
    ]
    rough, fine = (
        forecaster.collision_probability(scene, np.stack(fan), EGO, times, exclude=[0], tolerance=tolerance)
        for tolerance in (1e-4, 2e-6)
    )
    change = np.abs(rough.per_agent - fine.per_agent)
    assert change.max() < 3e-4
    assert (change < rough.error + 2e-6).mean() > 0.995
    assert fine.per_agent.max() > 0.3


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"trajectories": np.zeros((2, 2, 3))}, "each of the 3 horizons"),
        ({"trajectories": np.zeros((3, 2))}, "trajectories"),
        ({"trajectories": np.full((3, 3), np.nan)}, "NaN"),
        ({"trajectories": np.array([["a"] * 3] * 3)}, "trajectories"),
        ({"ego_size": (4.0,)}, "length and width"),
        ({"ego_size": (4.0, -1.0)}, "length and width"),
        ({"heading": "north"}, "heading"),
        ({"heading": np.zeros((3, 3))}, "heading"),
        ({"exclude": [7]}, "exclude"),
        ({"tolerance": 0.0}, "tolerance"),
    ],
)
def test_what_is_refused(forecaster, scene, changes, message):
    arguments = {"trajectories": np.zeros((1, 3, 3)), "ego_size": EGO, "horizons": HORIZONS} | changes
    with pytest.raises(InputError, match=message):
        forecaster.collision_probability(scene, **arguments)
