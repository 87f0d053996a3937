"""Argoverse 2: tracks cut at "now", the frame moved to the focal agent, the map drawn right way round."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from hcnaf_export.data.argoverse2 import OBJECTS, convert_argoverse2, read_scenario, to_scene
from hcnaf_export.data.argoverse2_map import CHANNELS
from hcnaf_runtime.errors import DataError, MissingExtraError
from hcnaf_runtime.scene import KINDS, Scene

pyarrow = pytest.importorskip("pyarrow", reason="pyarrow (extra data) is not installed")
parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow (extra data) is not installed")
pytest.importorskip("PIL", reason="Pillow (extra data) is not installed")

GENUINE = Path(__file__).parents[2] / ".." / "shared" / "data" / "argoverse2"
needs_data = pytest.mark.skipif(not GENUINE.is_dir(), reason="no Argoverse 2 scenario in ../shared/data")

CITY = np.array([-4000.0, 1200.0])
"""Where the focal agent is at step 49."""


def track(name: str, kind: str, category: int, steps: range, start: tuple, velocity: tuple) -> list[dict]:
    """A track at constant velocity that is at CITY + start at step 49."""
    heading = float(np.arctan2(velocity[1], velocity[0]))
    rows = []
    for step in steps:
        x, y = CITY + start + 0.1 * (step - 49) * np.asarray(velocity)
        rows.append(
            {
                "track_id": name, "object_type": kind, "object_category": category, "timestep": step,
                "position_x": x, "position_y": y, "heading": heading,
                "velocity_x": float(velocity[0]), "velocity_y": float(velocity[1]), "observed": step < 50,
            }
        )  # fmt: skip
    return rows


TRACKS = [
    track("11", "vehicle", 3, range(110), (0, 0), (0, 8)),
    track("12", "bus", 2, range(20, 110), (-3, 90), (0, -6)),
    track("13", "pedestrian", 2, range(45, 60), (8, 2), (1, 0)),
    track("14", "cyclist", 0, range(46), (5, -4), (0, 4)),
    track("15", "vehicle", 0, range(30), (2, -30), (0, 5)),
    track("16", "vehicle", 1, range(110), (300, 0), (1, 0)),
    track("AV", "vehicle", 1, range(110), (0, -20), (0, 8)),
]


def line(x: float, low: float, high: float) -> list[dict]:
    return [{"x": CITY[0] + x, "y": CITY[1] + y, "z": 1.0} for y in np.linspace(low, high, 5)]


def lane(left: list, right: list, kind: str = "VEHICLE", crossing: bool = False) -> dict:
    sides = {"left_lane_boundary": left, "right_lane_boundary": right}
    return {**sides, "lane_type": kind, "is_intersection": crossing}


MAP = {
    "lane_segments": {
        "1": lane(line(-1.8, -60, 20), line(1.8, -60, 20)),
        "2": lane(line(-1.8, 20, 40), line(1.8, 20, 40), crossing=True),
        "3": lane(line(-1.8, 40, -60), line(-5.4, 40, -60)),
        "4": lane(line(1.8, -60, 40), line(3.0, -60, 40), kind="BIKE"),
    },
    "drivable_areas": {"7": {"area_boundary": line(30, -10, 10) + line(50, 10, -10)}},
}


def write(folder: Path, tracks: list[list[dict]] = TRACKS, vector_map: object = MAP, name: str = "a1") -> Path:
    rows = [row for one in tracks for row in one]
    path = folder / f"scenario_{name}.parquet"
    parquet.write_table(pyarrow.Table.from_pylist(rows), path)
    (folder / f"log_map_archive_{name}.json").write_text(json.dumps(vector_map))
    return path


def pixel(scene: Scene, channel: str, x: float, y: float) -> float:
    col, row = np.floor((np.array([x, y]) - scene.origin) / scene.resolution).astype(int)
    return float(scene.raster[scene.channels.index(channel), row, col]) / 127.0


def test_tracks_are_cut_at_now_and_moved_to_the_focal_agent(tmp_path):
    write(tmp_path)
    scene = convert_argoverse2(tmp_path)
    assert (scene.step, scene.frame, scene.channels) == (0.1, "city-local", CHANNELS)
    t = 0.1 * np.arange(-9, 1)
    expected = np.stack([0 * t, 8 * t, 0 * t + 1, 0 * t, 0 * t + 8], axis=1)
    np.testing.assert_allclose(scene.past[0], expected, atol=1e-4)
    assert scene.future is not None
    np.testing.assert_allclose(scene.future[0, :, 1], 0.8 * np.arange(1, 61), atol=1e-4)


def test_agents_kinds_targets_and_gaps(tmp_path):
    scene = convert_argoverse2(write(tmp_path))
    names = ["11", "14", "13", "AV", "12"]  # by distance from the focal one where last seen
    types = {one[0]["track_id"]: one[0]["object_type"] for one in TRACKS}
    expected = [OBJECTS[types[name]] for name in names]
    assert [KINDS[k] for k in scene.kind] == [kind for kind, _ in expected]
    np.testing.assert_allclose(scene.size, [size for _, size in expected])
    assert scene.target.tolist() == [0, 4]  # the pedestrian is scored, but no vehicle
    assert np.isnan(scene.past[1, :, 0]).tolist() == [False] * 6 + [True] * 4
    assert np.isnan(scene.past[2, :, 0]).tolist() == [True] * 5 + [False] * 5
    assert scene.future is not None
    assert np.isfinite(scene.future[2, :, 0]).sum() == 10
    assert np.isnan(scene.future[1]).all()


def test_choice_of_targets(tmp_path):
    scenario = read_scenario(write(tmp_path))
    assert to_scene(scenario, targets="focal").target.tolist() == [0]
    vehicles = to_scene(scenario, targets="vehicles")
    assert [KINDS[vehicles.kind[i]] for i in vehicles.target] == ["vehicle", "vehicle"]
    assert len(to_scene(scenario, targets="focal", radius=10.0).past) == 3


def test_raster_covers_the_radius_around_every_target(tmp_path):
    scenario = read_scenario(write(tmp_path))
    focal, both = to_scene(scenario, targets="focal"), to_scene(scenario)
    assert focal.raster.shape == (4, 320, 320)
    np.testing.assert_allclose(focal.origin, [-80.0, -80.0])
    assert both.raster.shape == (4, 500, 326)
    for where in ((0.0, -30.0), (40.0, 5.0), (0.0, 30.0), (-3.5, 0.0)):
        for channel in CHANNELS:
            assert pixel(focal, channel, *where) == pixel(both, channel, *where)


def test_map_is_drawn_right_way_round(tmp_path):
    scene = convert_argoverse2(write(tmp_path))
    values = {
        where: [round(pixel(scene, channel, *where), 2) for channel in CHANNELS]
        for where in ((0.2, -30.2), (-3.6, -30.2), (0.2, 30.2), (2.4, -30.2), (40.0, 5.0), (-40.0, 5.0))
    }
    assert values == {
        (0.2, -30.2): [1, 0, 1, 0],  # northbound lane
        (-3.6, -30.2): [1, 0, -1, 0],  # southbound lane, to its left
        (0.2, 30.2): [1, 0, 1, 1],  # in the junction
        (2.4, -30.2): [0, 0, 0, 0],  # bicycle lane outside the drivable area
        (40.0, 5.0): [1, 0, 0, 0],  # drivable area without lanes
        (-40.0, 5.0): [0, 0, 0, 0],
    }


def test_other_moments_and_lengths(tmp_path):
    scenario = read_scenario(write(tmp_path))
    early = to_scene(scenario, now_step=3, history=6)
    assert np.isnan(early.past[0, :, 0]).tolist() == [True] * 2 + [False] * 4
    np.testing.assert_allclose(early.past[0, -1, :2], 0.0, atol=1e-4)
    assert to_scene(scenario, now_step=109).future is None
    for bad in ({"now_step": 110}, {"now_step": -1}, {"history": 0}, {"radius": 0.1}, {"resolution": 0.0}):
        with pytest.raises(DataError, match="expected a step of the recording"):
            to_scene(scenario, **bad)
    with pytest.raises(DataError, match="at most 4096"):
        to_scene(scenario, radius=1e6)


def test_focal_track_must_be_observed(tmp_path):
    with pytest.raises(DataError, match="not observed at step 49"):
        convert_argoverse2(write(tmp_path, [TRACKS[6], track("11", "vehicle", 3, range(40), (0, 0), (0, 8))]))
    with pytest.raises(DataError, match="0 focal tracks"):
        convert_argoverse2(write(tmp_path, TRACKS[1:]))


def test_bad_tracks_are_refused(tmp_path):
    odd = [{**row, "object_type": "spaceship"} for row in TRACKS[0]]
    with pytest.raises(DataError, match="spaceship"):
        convert_argoverse2(write(tmp_path, [odd]))
    with pytest.raises(DataError, match="time steps"):
        convert_argoverse2(write(tmp_path, [[{**TRACKS[0][0], "timestep": -1}]]))
    with pytest.raises(DataError, match="position_x"):
        convert_argoverse2(write(tmp_path, [[{**TRACKS[0][0], "position_x": float("nan")}]]))
    with pytest.raises(DataError, match="no Argoverse 2 scenario"):
        convert_argoverse2(write(tmp_path, [[{"track_id": "1"}]]))
    path = tmp_path / "scenario_a1.parquet"
    path.write_bytes(b"PAR1 but not really")
    with pytest.raises(DataError, match="no Argoverse 2 scenario") as caught:
        convert_argoverse2(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "vector_map", [[], {}, {"lane_segments": {"1": {}}, "drivable_areas": {}}, {"lane_segments": 3}]
)
def test_bad_maps_are_refused(tmp_path, vector_map):
    with pytest.raises(DataError, match="no Argoverse 2 map"):
        convert_argoverse2(write(tmp_path, vector_map=vector_map))


def test_files_that_are_missing_or_ambiguous(tmp_path):
    with pytest.raises(DataError, match="no such file"):
        convert_argoverse2(tmp_path / "scenario_x.parquet")
    with pytest.raises(DataError, match="0 files"):
        convert_argoverse2(tmp_path)
    path = write(tmp_path)
    (tmp_path / "log_map_archive_a1.json").rename(tmp_path / "log_map_archive_b.json")
    assert len(convert_argoverse2(path).past) == 5
    (tmp_path / "log_map_archive_b.json").unlink()
    with pytest.raises(DataError, match=r"log_map_archive_\*\.json"):
        convert_argoverse2(path)
    write(tmp_path, name="a1")
    write(tmp_path, name="a2")
    assert len(convert_argoverse2(path).past) == 5
    with pytest.raises(DataError, match="2 files"):
        convert_argoverse2(tmp_path)


def test_missing_pyarrow_names_the_extra(tmp_path, monkeypatch):
    path = write(tmp_path)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(MissingExtraError, match=r"hcnaf\[data\]"):
        convert_argoverse2(path)


@needs_data
def test_genuine_scenario_converts():
    scene = convert_argoverse2(GENUINE)
    assert scene.past.shape == (24, 10, 5)
    assert scene.target.tolist() == [0, 9]
    np.testing.assert_allclose(scene.pose[0, :2], 0.0, atol=1e-5)
    assert scene.future is not None
    assert np.isfinite(scene.future[scene.target]).all()


@needs_data
def test_genuine_cars_drive_on_the_road_and_along_its_lanes():
    scene = convert_argoverse2(GENUINE)
    vehicle, now = scene.kind == KINDS.index("vehicle"), scene.past[:, -1]
    moving = np.flatnonzero(vehicle & (now[:, 4] > 1.0))
    on_lane = 0
    for x, y, sin, cos, _ in now[moving]:
        direction = [pixel(scene, f"direction_{axis}", x, y) for axis in "xy"]
        if np.hypot(*direction) > 0.5:
            on_lane += 1
            assert pixel(scene, "drivable", x, y) == 1.0
            assert direction[0] * cos + direction[1] * sin > 0.9
    assert on_lane >= 3
