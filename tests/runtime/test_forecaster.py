"""The forecaster on a Gaussian bundle: contract with the scene, densities, maps in both frames."""

import gc
import threading
import weakref

import numpy as np
import pytest
from gaussian_bundle import scene_fields
from scipy.stats import multivariate_normal

from hcnaf_runtime import Bundle, Condition, Forecaster, Grid, Scene
from hcnaf_runtime.errors import BundleError, GridError, HorizonError, InputError, SceneError

SHIFT = 3 * 10 / 127  # mean of channel `left` + 2 x mean of channel `shift`


def _gaussian(speed, t, shift=SHIFT):
    sx = 0.3 + 0.4 * t
    sy = 0.4 * sx
    return multivariate_normal([speed * t, shift], [[sx**2, 0.6 * sx * sy], [0.6 * sx * sy, sy**2]])


def test_log_prob_in_the_agents_frame(forecaster, scene):
    points = np.random.default_rng(0).uniform([-1, -1], [6, 2], (50, 2))
    found = forecaster.log_prob(scene, points, horizons=[0.5, 1.0])
    assert found.shape == (2, 2, 50)
    for a, speed in enumerate((5.0, 2.0)):
        for t, horizon in enumerate((0.5, 1.0)):
            expected = _gaussian(speed, horizon).logpdf(points)
            np.testing.assert_allclose(found[a, t], expected, rtol=1e-4, atol=1e-4)


def test_points_per_agent_and_horizon(forecaster, scene):
    points = np.random.default_rng(0).uniform(-2, 2, (2, 3, 7, 2)).astype(np.float32)
    found = forecaster.log_prob(scene, points, horizons=[1, 2, 3])
    for a in range(2):
        per_agent = forecaster.log_prob(scene, points[:, 0], horizons=[1, 2, 3])
        np.testing.assert_allclose(found[a, 0], per_agent[a, 0], atol=1e-5)
        for t in range(3):
            alone = forecaster.log_prob(scene, points[a, t], horizons=[1, 2, 3])
            np.testing.assert_allclose(found[a, t], alone[a, t], atol=1e-5)


def test_log_prob_is_the_same_in_the_scene_frame(forecaster, scene):
    own = np.random.default_rng(1).uniform(-3, 5, (2, 40, 2))
    placed = []
    for points, (x, y, yaw) in zip(own, scene.pose, strict=True):
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        placed.append(points @ turn.T + [x, y])
    expected = forecaster.log_prob(scene, own, horizons=[1.0])
    found = forecaster.log_prob(scene, np.stack(placed), horizons=[1.0], frame="scene")
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)


def test_many_points_equal_few(forecaster, scene):
    points = np.random.default_rng(2).uniform(-3, 5, (20_000, 2))
    found = forecaster.log_prob(scene, points, horizons=[1.0, 2.0])
    np.testing.assert_allclose(found[..., -5:], forecaster.log_prob(scene, points[-5:], [1.0, 2.0]), atol=1e-5)


def test_maps_are_the_density_integrated(forecaster, scene):
    grid = Grid(40, 30, 0.5).at(-4, -6)
    maps = forecaster.pom(scene, grid, horizons=[1.0, 2.0])
    assert maps.mass.shape == (2, 2, 30, 40)
    assert maps.mass.dtype == np.float32
    cumulative = [[_gaussian(v, t).cdf(grid_corners(grid)) for t in (1.0, 2.0)] for v in (5.0, 2.0)]
    expected = np.diff(np.diff(np.array(cumulative), axis=2), axis=3)
    np.testing.assert_allclose(maps.mass, expected, atol=1e-5)
    np.testing.assert_allclose(maps.window_mass, maps.mass.sum(axis=(2, 3)), atol=1e-6)
    np.testing.assert_allclose(maps.pose, scene.pose, atol=1e-5)
    assert maps.agents.tolist() == [0, 1]
    assert maps.origin.tolist() == [-4, -6]


def grid_corners(grid):
    return np.stack(np.meshgrid(grid.x_edges, grid.y_edges), axis=-1).astype(np.float64)


def test_default_grid_and_horizons(forecaster, scene):
    maps = forecaster.pom(scene)
    assert maps.horizons.tolist() == [1, 2, 3, 4]
    assert maps.mass.shape == (2, 4, 200, 200)
    assert maps.origin.tolist() == [-25, -50]
    np.testing.assert_allclose(maps.window_mass, 1, atol=1e-5)
    x, y, mass = maps.peak(0, 3)
    assert (abs(x - 20) < 1, abs(y - SHIFT) < 0.6, mass > 0.02) == (True, True, True)


@pytest.mark.parametrize("yaw", [0.0, np.pi / 2, 0.7, -2.9])
def test_the_scene_frame_is_the_agents_frame_moved(forecaster, yaw):
    scene = Scene(**scene_fields(poses=((30.0, -8.0, yaw),), speeds=(4.0,)))
    own = forecaster.pom(scene, horizons=[1.0, 3.0])
    moved = forecaster.pom(scene, horizons=[1.0, 3.0], frame="scene")
    np.testing.assert_allclose(moved.window_mass, own.window_mass, atol=1e-5)
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    for t in range(2):
        mean = moments(own, t)[0] @ turn.T + [30, -8]
        found, covariance = moments(moved, t)
        np.testing.assert_allclose(found, mean, atol=0.02)
        expected = turn @ moments(own, t)[1] @ turn.T
        np.testing.assert_allclose(covariance, expected, atol=0.05)
    assert moved.frame == "scene"


def moments(maps, t):
    """Mean [2] and covariance [2, 2] of the first agent's map, cells taken as points."""
    grid = Grid(maps.mass.shape[3], maps.mass.shape[2], maps.resolution).at(*maps.origin)
    points, weight = grid.centres.reshape(-1, 2).astype(np.float64), maps.mass[0, t].ravel().astype(np.float64)
    return np.average(points, axis=0, weights=weight), np.cov(points.T, aweights=weight, ddof=0)


def test_a_scene_map_keeps_the_mass_of_its_window(forecaster, scene):
    """Half the forecast outside: what is inside agrees with the agent's own map of the same region."""
    scene = Scene(**scene_fields(poses=((0.0, 0.0, 0.0),), speeds=(5.0,)))
    grid = Grid(20, 20, 0.5).at(-5.0, -5.0)
    own, moved = (forecaster.pom(scene, grid, horizons=[1.0], frame=frame) for frame in ("agent", "scene"))
    np.testing.assert_allclose(moved.mass, own.mass, atol=4e-6)
    assert 0.4 < moved.window_mass[0, 0] < 0.6


def test_theta_is_computed_once(bundle, scene):
    forecaster = Forecaster(bundle, threads=1)
    first = forecaster.theta(scene, [1, 2])
    assert forecaster.theta(scene, (1.0, 2.0)) is first
    assert forecaster.theta(scene, [1]) is not first
    assert forecaster.pom(scene, horizons=[1, 2]).timings.hypernet == 0
    assert forecaster.theta(Scene(**scene_fields()), [1, 2]) is not first


def test_remembering_does_not_keep_scenes_alive(bundle):
    forecaster, scene = Forecaster(bundle, threads=1), Scene(**scene_fields())
    forecaster.theta(scene)
    watch = weakref.ref(scene)
    del scene
    gc.collect()
    assert watch() is None


def test_what_is_remembered_is_not_onnxruntimes_memory(bundle):
    """It would lie in the arena for long, and cut up what is free there."""
    theta = Forecaster(bundle, threads=1).theta(Scene(**scene_fields()))
    assert theta.values.flags.owndata
    assert theta.pose.flags.owndata


def test_threads_share_a_forecaster(bundle, scene):
    forecaster = Forecaster(bundle, threads=1)
    expected = forecaster.pom(scene, horizons=[1.0]).mass
    found = []

    def work():
        for _ in range(5):
            other = Scene(**scene_fields())
            found.append(forecaster.pom(other, horizons=[1.0]).mass)

    workers = [threading.Thread(target=work) for _ in range(4)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert len(found) == 20
    assert all(np.array_equal(mass, expected) for mass in found)


def test_saved_forecast(forecaster, scene, tmp_path):
    maps = forecaster.pom(scene, Grid(20, 10, 1.0), horizons=[1.0])
    maps.save(tmp_path / "forecast.npz")
    with np.load(tmp_path / "forecast.npz", allow_pickle=False) as saved:
        wanted = {"mass", "horizons", "agents", "pose", "origin", "resolution", "frame", "window_mass"}
        assert wanted <= set(saved.files)
        np.testing.assert_array_equal(saved["mass"], maps.mass)
        assert saved["frame"] == "agent"
        assert saved["resolution"] == 1.0
    assert [p.name for p in tmp_path.iterdir()] == ["forecast.npz"]


@pytest.mark.parametrize("horizons", [[0], [-1], [4.001], [1, 5], [np.nan], [], [[1, 2]]])
def test_horizons_outside(forecaster, scene, horizons):
    with pytest.raises(HorizonError, match=r"expected|outside"):
        forecaster.pom(scene, horizons=horizons)


def test_contract_with_the_scene(forecaster, fields):
    with pytest.raises(SceneError, match=r"step is 0.2 s, the bundle expects 0.1 s"):
        forecaster.theta(Scene(**fields | {"step": 0.2}))
    with pytest.raises(SceneError, match="past has 2 rows, the bundle expects 3"):
        forecaster.theta(Scene(**fields | {"past": fields["past"][:, 1:]}))
    with pytest.raises(SceneError, match="raster channel 'left' is missing, found shift, other"):
        forecaster.theta(Scene(**fields | {"channels": ("shift", "other")}))


def test_channels_are_matched_by_name(forecaster, fields):
    fields["raster"] = np.stack([np.full((6, 8), v, np.int8) for v in (100, 50, 20)])
    fields["channels"] = ("shift", "unused", "left")
    theta = forecaster.theta(Scene(**fields), [1.0])
    np.testing.assert_allclose(theta.values[:, 0, 1], (20 + 2 * 100) / 127, rtol=1e-5)
    assert theta.notes == ()


def test_an_absent_optional_channel_is_zero_and_noted(forecaster, fields):
    fields["raster"], fields["channels"] = fields["raster"][:1], ("left",)
    maps = forecaster.pom(Scene(**fields), Grid(10, 10, 1.0), horizons=[1.0])
    assert maps.notes == ("raster channel 'shift' is absent and was taken as 0",)
    np.testing.assert_allclose(forecaster.theta(Scene(**fields), [1.0]).values[:, 0, 1], 10 / 127, rtol=1e-5)


@pytest.mark.parametrize(
    "points", [np.zeros(2), np.zeros((3, 3)), np.zeros((5, 4, 2)), np.zeros((2, 5, 4, 2)), np.array([["a", "b"]])]
)
def test_bad_points(forecaster, scene, points):
    with pytest.raises(InputError, match="points is"):
        forecaster.log_prob(scene, points, horizons=[1.0])


def test_other_bad_input(forecaster, bundle, scene, tmp_path):
    with pytest.raises(InputError, match="NaN or infinity"):
        forecaster.log_prob(scene, np.array([[np.nan, 0.0]]))
    with pytest.raises(InputError, match="frame is 'world'"):
        forecaster.pom(scene, frame="world")
    with pytest.raises(InputError, match="threads is 0"):
        Forecaster(bundle, threads=0)
    with pytest.raises(GridError, match="at most"):
        forecaster.pom(scene, Grid(4096, 4096, 0.1), horizons=np.linspace(0.1, 4, 40))
    with pytest.raises(BundleError, match="no such directory"):
        Forecaster(tmp_path / "absent")


def test_scene_maps_in_strips_equal_whole(forecaster, scene, monkeypatch):
    grid = Grid(60, 40, 0.5)
    whole = forecaster.pom(scene, grid, horizons=[1.0], frame="scene").mass
    monkeypatch.setattr("hcnaf_runtime.forecaster._STRIP", 500)
    np.testing.assert_allclose(forecaster.pom(scene, grid, horizons=[1.0], frame="scene").mass, whole, atol=1e-6)


def test_no_map_from_what_is_not_finite(forecaster, fields):
    fields["past"][:, :, 4] = 3e38
    with pytest.raises(SceneError, match="gave NaN or infinity"):
        forecaster.pom(Scene(**fields), horizons=[4.0])


def test_conditions(condition_path):
    forecaster = Forecaster(condition_path, threads=1)
    condition = Condition(np.float32([[0, 0, 1, 1, 0], [3, 1, 0.5, 0.5, 0.9]]))
    maps = forecaster.pom(condition, Grid(100, 100, 0.2))
    assert maps.mass.shape == (2, 1, 100, 100)
    np.testing.assert_allclose(maps.window_mass, 1, atol=1e-5)
    assert maps.origin.tolist() == [-10, -10]
    expected = multivariate_normal([0, 0], np.eye(2)).logpdf([[0.5, 0.5], [1, 2]])
    found = forecaster.log_prob(condition, np.array([[0.5, 0.5], [1, 2]]))
    np.testing.assert_allclose(found[0, 0], expected, atol=1e-5)


def test_conditions_and_scenes_are_not_confused(condition_path, forecaster, scene):
    toy = Forecaster(Bundle.open(condition_path))
    with pytest.raises(SceneError, match="give a Condition"):
        toy.pom(scene)
    with pytest.raises(SceneError, match="give a Scene"):
        forecaster.pom(Condition(np.zeros((1, 5), np.float32)))
    with pytest.raises(SceneError, match="condition has 4 values per row, the bundle expects 5"):
        toy.pom(Condition(np.zeros((1, 4), np.float32)))
    with pytest.raises(HorizonError, match="has no time"):
        toy.pom(Condition(np.zeros((1, 5), np.float32)), horizons=[1.0])
    with pytest.raises(InputError, match="a condition has none"):
        toy.pom(Condition(np.zeros((1, 5), np.float32)), frame="scene")


def test_cdf_at_points_is_the_mass_below_them(forecaster, scene):
    """F_1 against the mass left of a point, F_2 against that of its column below it."""
    grid = Grid(200, 200, 0.5).ahead()
    maps = forecaster.pom(scene, grid, horizons=[2.0])
    x, y = grid.x_edges[90], grid.y_edges[104]
    F = forecaster.cdf(scene, np.float32([[x, y]]), horizons=[2.0])
    assert F.shape == (*maps.mass.shape[:2], 1, 2)
    for a in range(len(maps.agents)):
        left = maps.mass[a, 0, :, :90].sum(dtype=np.float64)
        assert F[a, 0, 0, 0] == pytest.approx(left, abs=2e-4)
        middle = (x + grid.x_edges[91]) / 2
        column = maps.mass[a, 0, :, 90]
        below = forecaster.cdf(scene, np.float32([[middle, y]]), horizons=[2.0])[a, 0, 0, 1]
        if column.sum() > 1e-3:
            assert below == pytest.approx(column[:104].sum() / column.sum(), abs=0.02)


@pytest.mark.parametrize("lost_mass", [1e-2, 1e-4, 1e-6])
@pytest.mark.parametrize("frame", ["agent", "scene"])
def test_a_certified_map_misses_no_more_than_it_says(forecaster, scene, lost_mass, frame):
    dense = forecaster.pom(scene, horizons=[0.5, 2.0], frame=frame)
    sparse = forecaster.pom(scene, horizons=[0.5, 2.0], frame=frame, lost_mass=lost_mass)
    assert (sparse.lost_mass <= lost_mass).all()
    missing = dense.window_mass - sparse.window_mass
    assert np.abs(missing - (sparse.lost_mass - dense.lost_mass)).max() < 3e-6
    assert (np.count_nonzero(sparse.mass, axis=(2, 3)) <= np.count_nonzero(dense.mass, axis=(2, 3))).all()
    rows, columns, mass = sparse.sparse(0, 0)
    again = np.zeros_like(sparse.mass[0, 0])
    again[rows, columns] = mass
    np.testing.assert_array_equal(again, sparse.mass[0, 0])


def test_accuracies_out_of_range_are_refused(forecaster, scene):
    for wrong in ({"tolerance": 0.0}, {"tolerance": float("nan")}, {"lost_mass": -0.1}, {"lost_mass": 1.0}):
        with pytest.raises(InputError, match="expected"):
            forecaster.pom(scene, **wrong)


@pytest.mark.parametrize("settings", [{}, {"spinning": True}, {"threads": 1}, {"threads": 3, "spinning": True}])
def test_settings_change_no_result(bundle_path, scene, settings):
    fast = Forecaster(bundle_path, **settings)
    fast.warm_up(scene)
    expected = Forecaster(bundle_path, threads=2).pom(scene, horizons=[1.0, 3.0]).mass
    np.testing.assert_array_equal(fast.pom(scene, horizons=[1.0, 3.0]).mass, expected)
