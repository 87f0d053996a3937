"""PRECOG-CARLA episodes: handedness, resampling, headings, and the refusal of anything else."""

import json
from pathlib import Path

import numpy as np
import pytest

from hcnaf_export.data.precog import LIDAR_CHANNELS, convert_precog, read_episode, to_scene
from hcnaf_export.data.resample import headings, resample, speeds
from hcnaf_runtime.errors import DataError, SceneError
from hcnaf_runtime.scene import Scene

GENUINE = Path(__file__).parents[2] / ".." / "shared" / "data" / "precog_carla" / "ma_datum_00000000.json"
needs_data = pytest.mark.skipif(not GENUINE.is_file(), reason="no PRECOG-CARLA episode in ../shared/data")

STEP = 0.2
RADIUS = 12.0


def pose(x: float, y: float, yaw: float) -> np.ndarray:
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.array([[cos, -sin, 0, x], [sin, cos, 0, y], [0, 0, 1, 38.0], [0, 0, 0, 1]])


def circle(t: np.ndarray, speed: float) -> np.ndarray:
    """A car to the right (y = 6 in the file's frame) that turns right: clockwise seen from above."""
    angle = speed * t / RADIUS
    return np.stack([RADIUS * np.sin(angle), 6.0 + RADIUS * (1.0 - np.cos(angle)), 0.0 * t], axis=-1)


def episode_record(late: bool = True) -> dict:
    """Player straight ahead at 5 m/s, agent 0 in a right turn at 6 m/s, agent 1 standing, facing left."""
    past, future = STEP * np.arange(-9, 1), STEP * np.arange(1, 41)
    shift = STEP if late else 0.0
    world = pose(100.0, 50.0, 2.0)
    turning = circle(np.array([shift]), 6.0)[0]
    relative = [pose(turning[0], turning[1], 6.0 * shift / RADIUS), pose(4.0, -8.0, -0.5 * np.pi)]
    line = np.array([5.0, 0.0, 0.0])
    standing = np.array([4.0, -8.0, 0.0])
    overhead = np.zeros((200, 200, 4))
    overhead[130, 160, 1] = 1.0  # file frame: x = 30.25, y = 15.25 (right)
    overhead[..., 0] = 0.04
    return {
        "player_past": (past[:, None] * line).tolist(),
        "player_future": (future[:, None] * line).tolist(),
        "agent_pasts": [circle(past, 6.0).tolist(), [standing.tolist()] * 10],
        "agent_futures": [circle(future, 6.0).tolist(), [standing.tolist()] * 40],
        "overhead_features": overhead.tolist(),
        "player_transform": world.tolist(),
        "agent_transforms": [(world @ p).tolist() for p in relative],
        "lidar_params": {
            "pixels_per_meter": 2,
            "hist_max_per_pixel": 25,
            "meters_max": 50,
            "val_obstacle": 1.0,
        },
        "agent_yaws": [np.degrees(6.0 * shift / RADIUS) - 360.0, -90.0],
    }


@pytest.fixture(scope="module")
def record() -> dict:
    return episode_record()


def write(folder: Path, record: object) -> Path:
    path = folder / "ma_datum_1.json"
    path.write_text(json.dumps(record))
    return path


def yaws(scene: Scene) -> np.ndarray:
    return np.arctan2(scene.past[..., 2], scene.past[..., 3])


def test_a_scene_of_the_agreed_shape(tmp_path, record):
    scene = convert_precog(write(tmp_path, record), targets="all")
    assert scene.past.shape == (3, 10, 5)
    assert (scene.step, scene.target.tolist(), scene.channels) == (0.1, [0, 1, 2], LIDAR_CHANNELS)
    assert scene.future is not None
    assert scene.future.shape == (3, 80, 2)
    assert np.isfinite(scene.past).all()
    scene.save(tmp_path / "scene.npz")
    np.testing.assert_array_equal(Scene.load(tmp_path / "scene.npz").past, scene.past)


def test_right_becomes_negative_y(tmp_path, record):
    scene = convert_precog(write(tmp_path, record))
    assert scene.past[1, -1, 1] == pytest.approx(-6.0)
    assert scene.past[2, -1, 1] == pytest.approx(8.0)
    assert yaws(scene)[2, -1] == pytest.approx(0.5 * np.pi)
    row, col = np.argwhere(scene.raster[1] == 127)[0]
    centre = scene.origin + scene.resolution * (np.array([col, row]) + 0.5)
    np.testing.assert_allclose(centre, [30.25, -15.25])
    assert (scene.raster[0] == 5).all()


def test_straight_motion_is_exact(tmp_path, record):
    scene = convert_precog(write(tmp_path, record))
    t = 0.1 * np.arange(-9, 1)
    expected = np.stack([5.0 * t, 0 * t, 0 * t, 0 * t + 1, 0 * t + 5], axis=1)
    np.testing.assert_allclose(scene.past[0], expected, atol=1e-5)
    assert scene.future is not None
    np.testing.assert_allclose(scene.future[0, :, 0], 0.5 * np.arange(1, 81), atol=1e-4)


@pytest.mark.parametrize("late", [True, False])
def test_headings_follow_the_turn_whenever_the_yaw_was_taken(tmp_path, late):
    scene = convert_precog(write(tmp_path, episode_record(late)))
    expected = -6.0 * 0.1 * np.arange(-9, 1) / RADIUS
    np.testing.assert_allclose(yaws(scene)[1], expected, atol=0.06)
    np.testing.assert_allclose(yaws(scene)[1, -1], 0.0, atol=1e-3)
    np.testing.assert_allclose(scene.past[1, :, 4], 6.0, rtol=0.01)


def test_standing_cars_keep_their_heading(tmp_path, record):
    scene = convert_precog(write(tmp_path, record))
    np.testing.assert_allclose(yaws(scene)[2], 0.5 * np.pi, atol=1e-6)
    np.testing.assert_allclose(scene.past[2, :, 4], 0.0, atol=1e-6)


def test_yaws_are_optional(tmp_path, record):
    short = {k: v for k, v in record.items() if k != "agent_yaws"}
    with_yaws, without = (convert_precog(write(tmp_path, r)) for r in (record, short))
    np.testing.assert_allclose(with_yaws.past, without.past, atol=1e-5)


def test_the_file_s_step_scales_time_alone(tmp_path, record):
    episode = read_episode(write(tmp_path, record))
    slow, fast = to_scene(episode, step=0.2), to_scene(episode, step=0.1)
    assert fast.future is not None
    assert fast.future.shape == (3, 40, 2)
    np.testing.assert_allclose(fast.past[0, :, 4], 10.0, rtol=1e-6)
    np.testing.assert_allclose(fast.past[0, :, 0], np.arange(-9, 1), atol=1e-5)
    np.testing.assert_array_equal(fast.past[:, -1, :4], slow.past[:, -1, :4])


def test_rows_before_the_recording_are_not_observed(tmp_path, record):
    scene = to_scene(read_episode(write(tmp_path, record)), step=0.1, history=12)
    assert np.isnan(scene.past[:, :2]).all()
    assert np.isfinite(scene.past[:, 2:]).all()


def test_resample_at_its_own_times_is_the_identity():
    track = np.random.default_rng(0).normal(size=(3, 7, 2))
    track[1, 3] = np.nan
    times = 0.3 * np.arange(-6, 1)
    np.testing.assert_array_equal(resample(track, times, times), track)
    middle = resample(track, times, times[:-1] + 0.15)
    np.testing.assert_allclose(middle[0], 0.5 * (track[0, 1:] + track[0, :-1]))
    assert np.isnan(middle[1, 2:4]).all()
    assert np.isnan(resample(track, times, [-2.0, 0.1])).all()


def test_backing_up_does_not_turn_the_car_about():
    x = np.array([0.0, -1.0, -2.0, -2.0, -1.0, 0.0, 1.0])
    track = np.stack([x, 0 * x], axis=1)
    np.testing.assert_allclose(headings(track, 0.1, 0.5), 0.1, atol=1e-12)
    np.testing.assert_allclose(headings(track[::-1], 0.1, 0.5), 0.1, atol=1e-12)
    np.testing.assert_allclose(speeds(track, 0.5)[[0, -1]], 2.0)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("player_past", None),
        ("player_past", [[0, 0, 0]]),
        ("player_past", [[0, 0], [1, 1]]),
        ("agent_pasts", [[[0, 0, 0]] * 9] * 2),
        ("agent_futures", [[[0, 0, 0]] * 40] * 3),
        ("agent_futures", "here"),
        ("agent_yaws", [0.0]),
        ("agent_yaws", [0.0, 1e300]),
        ("overhead_features", [[[0, 0, 0, 0]] * 200] * 100),
        ("player_transform", [[0, 0, 0, 0]] * 4),
        ("lidar_params", {"pixels_per_meter": -1, "meters_max": 50}),
        ("lidar_params", []),
        ("agent_transforms", [[[1, 2], [3]]]),
    ],
)
def test_a_bad_field_is_named_in_one_line(tmp_path, record, field, value):
    bad = {**record, field: value}
    with pytest.raises(DataError, match=field) as caught:
        read_episode(write(tmp_path, bad))
    assert "\n" not in str(caught.value)


def test_a_missing_field_is_named(tmp_path, record):
    for field in set(record) - {"agent_yaws"}:
        with pytest.raises(DataError, match=field):
            read_episode(write(tmp_path, {k: v for k, v in record.items() if k != field}))


@pytest.mark.parametrize("content", [b"", b"[1, 2]", b"{", b"\xff\xfe", b"[" * 100_000, b'{"a": NaN}'])
def test_what_is_no_episode_is_refused(tmp_path, content):
    path = tmp_path / "x.json"
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"x\.json"):
        read_episode(path)


def test_missing_file_and_directory_are_refused(tmp_path):
    for path in (tmp_path / "absent.json", tmp_path):
        with pytest.raises(DataError, match="cannot be read"):
            read_episode(path)


@pytest.mark.parametrize("step", [0.0, -0.2, float("nan"), 1e9])
def test_an_impossible_step_is_refused(tmp_path, record, step):
    with pytest.raises((DataError, SceneError), match="step"):
        convert_precog(write(tmp_path, record), step=step)


@needs_data
def test_genuine_episode_converts():
    scene = convert_precog(GENUINE, targets="all")
    assert scene.past.shape == (5, 10, 5)
    assert np.isfinite(scene.past).all()
    np.testing.assert_allclose(scene.pose[0], 0.0, atol=1e-3)
    np.testing.assert_allclose(scene.past[1, -1, :2], [16.407, 5.287], atol=1e-3)
    moving = scene.past[..., 4] > 2.0
    step = np.diff(scene.past[..., :2], axis=1)
    along = (step * scene.past[:, 1:, [3, 2]]).sum(axis=-1) / np.maximum(np.linalg.norm(step, axis=-1), 1e-9)
    assert along[moving[:, 1:]].min() > 0.97


@needs_data
def test_genuine_yaws_are_relative_degrees_one_row_late():
    episode = read_episode(GENUINE)
    relative = np.linalg.inv(episode.player_transform) @ episode.agent_transforms
    yaw = np.degrees(np.arctan2(relative[:, 1, 0], relative[:, 0, 0]))
    assert episode.agent_yaws is not None
    assert (np.abs((episode.agent_yaws - yaw + 180.0) % 360.0 - 180.0) < 0.1).all()
    np.testing.assert_allclose(relative[:, :2, 3], episode.agent_futures[:, 0, :2], atol=2e-3)


@needs_data
def test_genuine_cars_reflect_the_lidar():
    """Obstacle points cluster where the other cars are, and not where a mirrored raster would have them."""
    scene = convert_precog(GENUINE, targets="all")
    row, col = np.nonzero(scene.raster[LIDAR_CHANNELS.index("lidar_above")])
    points = scene.origin + scene.resolution * (np.stack([col, row], axis=1) + 0.5)
    cars = scene.past[1:4, -1, :2]
    hits, mirrored = (
        (np.linalg.norm(points[:, None] - cars * [1.0, sign], axis=2) < 3.5).sum(axis=0) for sign in (1.0, -1.0)
    )
    assert (hits >= 5).all()
    assert hits.sum() > 2 * mirrored.sum()
