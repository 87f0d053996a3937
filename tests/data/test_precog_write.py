"""Simulated episodes: the released layout, the same traffic, overhead channels that show roads and cars."""

import json
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from hcnaf_export.data import precog_write
from hcnaf_export.data.manifest import NoiseModel
from hcnaf_export.data.precog import read_episode, to_scene
from hcnaf_export.data.precog_overhead import PIXELS, SETBACK, Surroundings, grown
from hcnaf_export.data.precog_write import SOURCE, agents_of, episodes, simulate_precog
from hcnaf_export.data.sim import SimSettings, generate
from hcnaf_runtime.errors import DataError
from tests.data.episodes import traffic

GENUINE = Path(__file__).parents[2] / ".." / "shared" / "data" / "precog_carla" / "ma_datum_00000000.json"
needs_sumo = pytest.mark.skipif(generate.missing_module() is not None, reason="the extra `sim` is not installed")

ROAD_WIDTH = 8.0


@pytest.fixture(scope="module")
def tracks():
    return traffic()


@pytest.fixture(scope="module")
def record(tracks):
    return next(episodes(tracks, 1, np.random.default_rng(0)))


def street(tracks):
    """One road along x at y = 65 in place of the random map."""
    raster = np.zeros((1, 240, 300), np.int8)
    centre = 240 // 2
    half = int(0.5 * ROAD_WIDTH / tracks.resolution)
    raster[0, centre - half : centre + half] = 127
    return replace(tracks, raster=raster, channels=("drivable",))


def test_an_episode_has_the_released_fields_and_says_that_it_is_simulated(record):
    assert record["source"] == SOURCE
    shapes = {name: np.shape(value) for name, value in record.items() if isinstance(value, list)}
    assert shapes == {
        "player_past": (10, 3), "player_future": (40, 3), "agent_pasts": (4, 10, 3), "agent_futures": (4, 40, 3),
        "overhead_features": (200, 200, 4), "player_transform": (4, 4), "agent_transforms": (4, 4, 4),
        "agent_yaws": (4,),
    }  # fmt: skip
    assert record["player_past"][-1] == [0.0, 0.0, 0.0]


@pytest.mark.skipif(not GENUINE.is_file(), reason="no PRECOG-CARLA episode in ../shared/data")
def test_its_fields_are_those_of_a_genuine_one(record):
    genuine = json.loads(GENUINE.read_bytes())
    assert set(record) - {"source"} == set(genuine)
    for name, value in genuine.items():
        assert type(record[name]) is type(value), name
        assert np.shape(record[name]) == np.shape(value), name
    assert record["lidar_params"] == genuine["lidar_params"]


def test_reading_one_back_gives_the_traffic_it_was_made_of(tracks, tmp_path):
    record = next(episodes(tracks, 1, np.random.default_rng(3)))
    (tmp_path / "ma.json").write_bytes(msgspec.json.encode(record))
    scene = to_scene(read_episode(tmp_path / "ma.json"), target_step=0.2, targets="all")
    step = record["frame"]
    track = int(tracks.windows[np.random.default_rng(3).permutation(len(tracks.windows))[0], 0])
    agents = agents_of(tracks, track, step)
    rows = tracks.rows(agents[:, None], step + 2 * np.arange(-9, 41))
    x, y, yaw, speed = np.moveaxis(tracks.truth[rows].astype(np.float64), -1, 0)
    x0, y0, yaw0 = x[0, 9], y[0, 9], yaw[0, 9]
    cos, sin = np.cos(yaw0), np.sin(yaw0)
    local = np.stack([cos * (x - x0) + sin * (y - y0), cos * (y - y0) - sin * (x - x0)], axis=-1)
    np.testing.assert_allclose(scene.past[..., :2], local[:, :10], atol=1e-4)
    np.testing.assert_allclose(scene.future[:, 1::2], local[:, 11::2], atol=1e-4)
    heading = np.stack([np.sin(yaw - yaw0), np.cos(yaw - yaw0)], axis=-1)[:, 9]
    np.testing.assert_allclose(scene.past[:, -1, 2:4], heading, atol=1e-5)
    np.testing.assert_allclose(scene.past[:, -1, 4], speed[:, 9], atol=0.02)


def test_the_actors_are_the_nearest_that_move_and_stay(tracks):
    step = 20
    agents = agents_of(tracks, 2, step)
    place = tracks.truth[tracks.rows(np.arange(tracks.count), step), :2]
    order = np.argsort(np.hypot(*(place - place[2]).T))
    assert agents.tolist() == order[:5].tolist()
    parked = replace(tracks, parked=np.arange(tracks.count) == order[1])
    assert agents_of(parked, 2, step).tolist() == np.delete(order, 1)[:5].tolist()
    assert agents_of(tracks, 2, 10) is None  # the past is too short
    assert agents_of(tracks, 2, 60) is None  # the future is
    assert agents_of(replace(tracks, parked=np.arange(tracks.count) != 2), 2, step) is None


@pytest.mark.parametrize("yaw", [0.0, 0.4, -2.0])
def test_the_overhead_channels_show_road_cars_and_facades(tracks, yaw):
    surroundings = Surroundings(street(tracks))
    centre = np.array([65.0, 65.0])
    pose = np.array([*centre, yaw])
    box = np.array([[centre[0] + 9.0, centre[1] + 2.0, 0.0, 4.0, 2.0]])
    image = surroundings.channels(pose, box, np.random.default_rng(0))
    hits, above, below, higher = np.moveaxis(image, -1, 0)
    assert set(np.unique(image[..., 1:])) == {0.0, 1.0}
    np.testing.assert_allclose(hits * 25, np.rint(hits * 25))
    assert ((hits > 0) == (above + below > 0)).all()
    x, right = np.meshgrid((np.arange(PIXELS) + 0.5) / 2 - 50, (np.arange(PIXELS) + 0.5) / 2 - 50)
    dx = np.cos(yaw) * x + np.sin(yaw) * right  # network axes; the file's y is to the right
    dy = np.sin(yaw) * x - np.cos(yaw) * right
    car = (np.abs(dx - 9.0) < 1.7) & (np.abs(dy - 2.0) < 0.7)
    assert above[car].all()
    assert not below[car].any()
    near = np.hypot(dx, dy) < 11.0
    far_from_car = np.hypot(dx - 9.0, dy - 2.0) > 3.5
    road = np.abs(dy) < 0.5 * ROAD_WIDTH - 0.7
    assert below[near & road & far_from_car].all()
    assert not below[np.abs(dy) > 0.5 * ROAD_WIDTH + 0.7].any()
    assert higher.any()
    beside = np.abs(dy)[higher > 0] - 0.5 * ROAD_WIDTH
    assert beside.min() > SETBACK[0] - 0.8
    assert beside.max() < SETBACK[1] + 0.8
    assert below[np.hypot(dx, dy) > 40.0].mean() < 0.2 * below[near].mean()


def test_growing_reaches_as_far_as_it_says():
    mask = np.zeros((41, 41), bool)
    mask[20, 20] = True
    wide = grown(mask, 12)
    y, x = np.nonzero(wide)
    assert (x.min(), x.max(), y.min(), y.max()) == (8, 32, 8, 32)
    assert 0.9 * np.pi * 12**2 < wide.sum() < 1.2 * np.pi * 13**2


def test_too_little_traffic_is_refused(tracks):
    with pytest.raises(DataError, match=r"episodes of .* too few; simulate more --seconds"):
        list(episodes(replace(tracks, windows=tracks.windows[:1]), 2, np.random.default_rng(0)))


def test_a_directory_in_use_is_refused(tmp_path):
    (tmp_path / "mine.txt").write_text("keep")
    with pytest.raises(DataError, match="already exists"):
        simulate_precog(tmp_path)


@needs_sumo
def test_simulated_episodes_follow_from_the_seed(tmp_path):
    settings = SimSettings(
        seed=5, train_networks=1, val_networks=1, test_networks=1, train_windows=4, val_windows=2, test_windows=1,
        seconds=16.0, warm_up=10.0, density=15.0, noise=NoiseModel(),
    )  # fmt: skip
    told: list[float] = []
    counts = simulate_precog(tmp_path / "one", settings, lambda _, share: told.append(share))
    assert counts == {"train": 4, "val": 2, "test": 1}
    assert told[-1] == 1.0
    simulate_precog(tmp_path / "two", settings)
    files = sorted(p.relative_to(tmp_path / "one") for p in (tmp_path / "one").rglob("*") if p.is_file())
    assert len(files) == 8
    for file in files:
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes()
    assert "rendered" in (tmp_path / "one" / "SOURCE.txt").read_text()
    assert precog_write.STEP == 0.2
    read_episode(tmp_path / "one" / "test" / "ma_datum_00000000.json")
