"""The virtual simulator: laws of its parts, and small data sets made end to end."""

import dataclasses
from pathlib import Path

import msgspec
import numpy as np
import pytest

from hcnaf_export.data.sim import SimSettings, generate, recording, roadmap, simulate, streets, traffic
from hcnaf_export.data.tracks import FUTURE, NoiseModel, TrackSet
from hcnaf_runtime.errors import DataError, MissingExtraError

MAPS = Path(__file__).parents[2] / ".." / "shared" / "data" / "maps"
TINY = SimSettings(
    seed=3,
    train_networks=1,
    val_networks=0,
    test_networks=0,
    train_windows=200,
    seconds=16.0,
    warm_up=10.0,
    density=5.0,
    max_vehicles=30,
)
needs_sumo = pytest.mark.skipif(generate.missing_module() is not None, reason="the extra `sim` is not installed")


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    told = []
    out = tmp_path_factory.mktemp("sim") / "tiny"
    dataset = simulate(out, TINY, lambda line, fraction: told.append((line, fraction)))
    return dataset, told


def one_lane_net(path, state="m", kind="priority"):
    """Two streets, east then north, meeting at a junction; a lane for pedestrians only beside the first."""
    path.write_text(f"""<net>
      <edge id=":b_0" function="internal">
        <lane id=":b_0_0" index="0" speed="7" length="6" shape="50,0 54,1 55,5"/></edge>
      <edge id="ab" from="a" to="b">
        <lane id="ab_0" index="0" allow="pedestrian" speed="2" length="50" width="2" shape="0,-3 50,-3"/>
        <lane id="ab_1" index="1" speed="10" length="50" width="3" shape="0,0 50,0"/></edge>
      <edge id="bc" from="b" to="c">
        <lane id="bc_0" index="0" speed="10" length="40" width="3" shape="55,5 55,45"/></edge>
      <junction id="a" type="dead_end" x="0" y="0" shape="0,-1 0,1 -1,0"/>
      <junction id="b" type="{kind}" x="53" y="2" shape="50,-4 57,-4 57,5 50,5"/>
      <connection from="ab" to="bc" fromLane="1" toLane="0" via=":b_0_0" dir="l" state="{state}"/>
      <connection from=":b_0" to="bc" fromLane="0" toLane="0" dir="l" state="M"/>
      <connection from="bc" to="ab" fromLane="0" toLane="1" dir="t" state="m"/></net>""")
    return path


# -- geometry -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("angle", "yaw", "centre"),
    [
        (90.0, 0.0, (8.0, 5.0)),
        (0.0, np.pi / 2, (10.0, 3.0)),
        (270.0, np.pi, (12.0, 5.0)),
        (180.0, -np.pi / 2, (10.0, 7.0)),
    ],
)
def test_front_and_navigational_angle_become_centre_and_yaw(angle, yaw, centre):
    found = traffic.box_centre(np.array([[10.0, 5.0, angle, 3.0]]), np.array([4.0]))
    assert found[0] == pytest.approx([*centre, yaw, 3.0], abs=1e-9)


def test_the_front_is_half_a_length_ahead_of_the_centre():
    rng = np.random.default_rng(0)
    state = np.column_stack([rng.normal(0, 50, (300, 2)), rng.uniform(-720, 720, 300), rng.uniform(0, 20, 300)])
    length = rng.uniform(1, 12, 300)
    x, y, yaw, speed = traffic.box_centre(state, length).T
    ahead = np.stack([x + 0.5 * length * np.cos(yaw), y + 0.5 * length * np.sin(yaw)], axis=1)
    assert np.allclose(ahead, state[:, :2])
    assert ((yaw > -np.pi) & (yaw <= np.pi)).all()
    assert np.allclose(np.sin(np.deg2rad(state[:, 2])), np.cos(yaw))
    assert np.array_equal(speed, state[:, 3])


def test_a_network_is_read_without_lanes_closed_to_cars(tmp_path):
    roads = roadmap.read_roadmap(one_lane_net(tmp_path / "n.net.xml"))
    assert [(lane.edge, lane.index, lane.internal) for lane in roads.lanes] == [
        (":b_0", 0, True),
        ("ab", 1, False),
        ("bc", 0, False),
    ]
    assert len(roads.junctions) == 1
    assert roads.successors == {"ab": ("bc",), "bc": ()}


@pytest.mark.parametrize(("state", "strength"), [("m", 0.5), ("=", 0.5), ("s", 1.0), ("w", 1.0), ("M", None)])
def test_stop_lines_stand_where_traffic_yields(tmp_path, state, strength):
    roads = roadmap.read_roadmap(one_lane_net(tmp_path / "n.net.xml", state))
    expected = [] if strength is None else [[50.0, 0.0, 0.0, 3.0, strength]]
    assert roads.stops.tolist() == expected


def test_a_map_shows_lanes_directions_and_junctions_where_they_are(tmp_path):
    canvas = roadmap.draw(roadmap.read_roadmap(one_lane_net(tmp_path / "n.net.xml", "s")), 0.5)

    def at(channel, x, y):
        col, row = ((np.array([x, y]) - canvas.origin) / 0.5).astype(int)
        return float(canvas.channel(channel)[row, col])

    assert at("drivable", 25.2, 0.3) == 1.0
    assert at("drivable", 25.2, -3.2) == 0.0
    assert (at("direction_x", 25.2, 0.3), at("direction_y", 25.2, 0.3)) == pytest.approx((1.0, 0.0))
    assert (at("direction_x", 55.2, 30.2), at("direction_y", 55.2, 30.2)) == pytest.approx((0.0, 1.0))
    assert at("junction", 56.2, -2.7) == 1.0
    assert at("junction", 30.2, 0.2) == 0.0
    assert at("stop_line", 49.8, 0.2) == 1.0
    assert at("stop_line", 45.2, 0.2) == 0.0
    assert (canvas.origin / 0.5 == np.rint(canvas.origin / 0.5)).all()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("not xml", "cannot be read"),
        ("<routes/>", "expected <net>"),
        ("<net><edge id='e'><lane id='e_0' index='0' allow='rail' shape='0,0 9,0'/></edge></net>", "no lane open"),
        ("<net><edge id='e'><lane id='e_0' index='0' shape='0,0 99999,0'/></edge></net>", "spans 99999 m"),
    ],
)
def test_files_that_are_no_road_network_are_refused(tmp_path, content, message):
    path = tmp_path / "bad.net.xml"
    path.write_text(content)
    with pytest.raises(DataError, match=message):
        roadmap.read_roadmap(path)


# -- tracks, noise, windows -----------------------------------------------------------------------------------


def reported(steps, xs, vehicle=0):
    rows = len(steps)
    state = np.column_stack([xs, np.zeros(rows), np.full(rows, 90.0), np.full(rows, 10.0)])
    return np.array(steps), np.full(rows, vehicle), state


def test_tracks_are_cut_at_jumps_and_gaps():
    steps = [*range(30), *range(40, 80)]
    xs = np.array(steps, float)
    xs[50:] += 25.0
    step, vehicle, state = reported(steps, xs)
    tracks = recording.cut_tracks(traffic.Recording(step, vehicle, state, np.array([[4.0, 2.0]])))
    assert tracks.step.tolist() == [2, 42, 62]
    assert np.diff(tracks.start).tolist() == [26, 16, 16]
    for i in range(3):
        x = tracks.state[tracks.start[i] : tracks.start[i + 1], 0]
        assert np.allclose(np.diff(x), 1.0)
    assert tracks.state[0, 0] == pytest.approx(2.0 - 2.0)


def test_smoothing_keeps_constant_turns_across_the_seam():
    yaw = np.linspace(3.0, 3.5, 40)
    state = np.column_stack([np.arange(40.0), np.zeros(40), recording.wrapped(yaw), np.ones(40)])
    smooth, start = recording.smoothed(state, np.array([0, 15, 40]))
    assert start.tolist() == [0, 11, 32]
    kept = np.r_[2:13, 17:38]
    assert np.allclose(smooth[:, 2], recording.wrapped(yaw[kept]))
    assert np.allclose(smooth[:, 0], kept)


def test_noise_has_the_recorded_size():
    noise = NoiseModel(position=0.1, yaw=0.02, speed=0.2)
    truth = np.tile(np.array([[100.0, -40.0, 3.13, 9.0]], np.float32), (100_000, 1))
    observed = recording.perceive(truth, noise, np.random.default_rng(0))
    error = observed - truth
    error[:, 2] = recording.wrapped(error[:, 2])
    assert error.std(axis=0) == pytest.approx([0.1, 0.1, 0.02, 0.2], rel=0.02)
    assert np.abs(error.mean(axis=0)).max() < 0.003
    assert np.abs(np.corrcoef(error.T) - np.eye(4)).max() < 0.02


@pytest.mark.parametrize(("drop", "length"), [(0.05, 2.0), (0.2, 4.0)])
def test_detections_drop_out_in_gaps(drop, length):
    seen = recording.detections(400_000, NoiseModel(drop=drop, drop_length=length), np.random.default_rng(0))
    assert len(seen) == 400_000
    assert 1.0 - seen.mean() == pytest.approx(drop, rel=0.05)
    gaps = (np.diff(seen.astype(int)) == -1).sum()
    assert (~seen).sum() / gaps == pytest.approx(length, rel=0.05)
    assert recording.detections(50, NoiseModel(drop=0.0), np.random.default_rng(0)).all()


# -- whole data sets ------------------------------------------------------------------------------------------


@needs_sumo
def test_a_small_data_set_is_made_and_told_about(tiny):
    dataset, told = tiny
    assert [fraction for _, fraction in told] == [1.0]
    assert dataset.manifest.seed == 3
    assert dataset.manifest.nll_floor == pytest.approx(1 + np.log(2 * np.pi * 0.01))
    assert msgspec.convert(dataset.manifest.settings, SimSettings) == TINY
    (tracks,) = dataset.split("train")
    (entry,) = dataset.manifest.splits["train"]
    assert (entry.tracks, entry.windows) == (tracks.count, len(tracks.windows))
    assert len(tracks.windows) > 50
    assert sorted(p.name for p in dataset.directory.iterdir()) == ["dataset.json", "train-00.npz"]


@needs_sumo
def test_vehicles_move_where_they_head_on_the_road_without_jumps(tiny):
    (tracks,) = tiny[0].split("train")
    track = np.repeat(np.arange(tracks.count), tracks.length)
    pairs = (np.diff(track) == 0) & ~tracks.parked[track[1:]]
    step = np.diff(tracks.truth[:, :2], axis=0)[pairs]
    moved, now = np.hypot(*step.T), tracks.truth[1:][pairs]
    assert np.abs(moved - 0.1 * now[:, 3]).max() < 0.4
    fast = moved > 0.3
    off = recording.wrapped(np.arctan2(step[fast, 1], step[fast, 0]) - now[fast, 2])
    assert np.median(np.abs(off)) < 0.02
    assert np.quantile(np.abs(off), 0.99) < 0.35
    pixel = ((now[:, :2] - tracks.origin) / tracks.resolution).astype(int)
    map_ = tracks.raster[:, pixel[:, 1], pixel[:, 0]] / 127.0
    assert (map_[0] > 0.5).mean() > 0.98
    ahead = map_[1] * np.cos(now[:, 2]) + map_[2] * np.sin(now[:, 2])
    lane = (np.hypot(map_[1], map_[2]) > 0.8) & (map_[4] == 0.0)
    assert lane.sum() > 1000
    assert (ahead[lane] > 0.7).mean() > 0.98


@needs_sumo
def test_parked_vehicles_stand_off_the_road(tiny):
    (tracks,) = tiny[0].split("train")
    rows = tracks.track_start[:-1][tracks.parked]
    assert len(rows) > 5
    pixel = ((tracks.truth[rows, :2] - tracks.origin) / tracks.resolution).astype(int)
    assert (tracks.raster[0, pixel[:, 1], pixel[:, 0]] == 0).all()
    assert (tracks.length[tracks.parked] == 160).all()
    assert (tracks.truth[rows, 3] == 0.0).all()


@needs_sumo
def test_windows_are_whole_and_seldom_stand(tiny):
    (tracks,) = tiny[0].split("train")
    track, step = tracks.windows.T
    now = tracks.rows(track, step)
    assert tracks.seen[now].all()
    assert np.isfinite(tracks.gather_futures(track, step)).all()
    assert (tracks.rows(track, step - 9) >= 0).all()
    assert len(np.unique(tracks.windows, axis=0)) == len(tracks.windows)
    moved = np.hypot(*(tracks.truth[now + FUTURE] - tracks.truth[now])[:, :2].T)
    assert (moved < 0.5).sum() <= 0.15 * TINY.train_windows
    scene = tracks.scene(int(track[0]), int(step[0]))
    assert scene.raster.shape == (5, 320, 320)


@needs_sumo
def test_the_same_seed_gives_the_same_tracks_and_another_seed_others(tiny, tmp_path):
    (first,) = tiny[0].split("train")
    again = simulate(tmp_path / "again", TINY).split("train")[0]
    for field in dataclasses.fields(TrackSet):
        assert np.array_equal(getattr(first, field.name), getattr(again, field.name)), field.name


@needs_sumo
@pytest.mark.parametrize("layout", streets.LAYOUTS)
def test_generated_networks_follow_the_seed_and_have_a_fitting_size(tmp_path, layout):
    def build(name, seed):
        folder = tmp_path / name
        folder.mkdir()
        plan = streets.StreetPlan(layout, "mixed")
        return roadmap.read_roadmap(streets.build_streets(plan, folder, np.random.default_rng(seed)))

    one, same, other = build("one", 0), build("same", 0), build("other", 1)
    assert [lane.shape.tolist() for lane in one.lanes] == [lane.shape.tolist() for lane in same.lanes]
    assert [lane.shape.tolist() for lane in one.lanes] != [lane.shape.tolist() for lane in other.lanes]
    span = np.ptp(np.concatenate([lane.shape for lane in one.lanes]), axis=0)
    assert 200.0 < span.max() < 1200.0
    assert len(one.stops) > 4


@needs_sumo
@pytest.mark.skipif(not (MAPS / "Town01.net.xml").exists(), reason="shared/data/maps/Town01.net.xml is absent")
def test_a_given_network_is_driven_on(tmp_path):
    settings = msgspec.structs.replace(
        TINY, train_nets=(str(MAPS / "Town01.net.xml"),), seconds=8.0, warm_up=5.0, train_windows=50
    )
    (entry,) = simulate(tmp_path / "town", settings).manifest.splits["train"]
    tracks = TrackSet.load(tmp_path / "town" / entry.file)
    assert entry.network == "Town01.net.xml"
    assert len(tracks.stops) > 10
    assert (~tracks.parked).sum() > 10
    assert len(tracks.windows) > 10


@needs_sumo
def test_bad_input_leaves_nothing_behind(tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "keep.txt").write_text("mine")
    with pytest.raises(DataError, match="already exists"):
        simulate(tmp_path / "full", TINY)
    with pytest.raises(DataError, match="at least 5"):
        simulate(tmp_path / "short", msgspec.structs.replace(TINY, seconds=2.0))
    bad = tmp_path / "bad.net.xml"
    bad.write_text("<routes/>")
    with pytest.raises(DataError, match=r"train-00 .*expected <net>"):
        simulate(tmp_path / "new", msgspec.structs.replace(TINY, train_nets=(str(bad),)))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bad.net.xml", "full"]


@pytest.mark.parametrize(
    "bad", [{"density": -1.0}, {"seconds": float("inf")}, {"violators": 1.5}, {"train_windows": -3}]
)
def test_impossible_settings_are_refused(bad):
    with pytest.raises(DataError, match=next(iter(bad))):
        SimSettings(**bad)


def test_without_sumo_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(generate, "missing_module", lambda: "libsumo")
    with pytest.raises(MissingExtraError, match=r"libsumo.*hcnaf\[sim\]"):
        simulate(tmp_path / "new", TINY)


def test_every_split_has_its_own_seeds_and_all_windows(tmp_path):
    settings = SimSettings()
    tasks = {split: generate.plan_tasks(split, settings, tmp_path) for split in generate.SPLITS}
    assert [len(tasks[split]) for split in generate.SPLITS] == [16, 4, 4]
    assert [sum(t.windows for t in tasks[split]) for split in generate.SPLITS] == [50_000, 5_000, 5_000]
    seeds = [task.seeds for split in generate.SPLITS for task in tasks[split]]
    assert len(set(seeds)) == len(seeds)
    assert len({(t.layout, t.junction) for t in tasks["train"]}) == 15
