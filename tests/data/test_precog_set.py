"""A folder of episodes: packed once, without loss, and refused by name where a file is bad."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from hcnaf_export.data import precog_set
from hcnaf_export.data.precog import LIDAR_CHANNELS, read_episode, to_scene
from hcnaf_export.data.precog_pack import packed, tables
from hcnaf_export.data.precog_set import episode_files, is_precog, load_episodes
from hcnaf_runtime.errors import DataError
from tests.data import episodes

GENUINE = Path(__file__).parents[2] / ".." / "shared" / "data" / "precog_carla" / "ma_datum_00000000.json"

STEP = 0.2


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return episodes.write(tmp_path_factory.mktemp("precog") / "set")


@pytest.fixture
def root(made, tmp_path):
    """A copy of the set, without what was packed of it."""
    return Path(shutil.copytree(made, tmp_path / "set", ignore=shutil.ignore_patterns(".hcnaf")))


def assert_same_as_the_files(root, split):
    found = load_episodes(root, split, STEP)
    files = episode_files(root, split)
    assert len(found) == len(files)
    for k, file in enumerate(files):
        scene = to_scene(read_episode(file), target_step=STEP)
        np.testing.assert_array_equal(found.past[k], scene.past)
        np.testing.assert_array_equal(found.future[k], scene.future)
        np.testing.assert_array_equal(tables(LIDAR_CHANNELS)[:, found.overhead[k]], scene.raster)


def test_packed_episodes_are_the_scenes_of_their_files(made):
    for split in ("train", "val", "test"):
        assert_same_as_the_files(made, split)


@pytest.mark.skipif(not GENUINE.is_file(), reason="no PRECOG-CARLA episode in ../shared/data")
def test_a_genuine_episode_goes_the_same_way(tmp_path):
    (tmp_path / "test").mkdir()
    shutil.copy(GENUINE, tmp_path / "test")
    assert_same_as_the_files(tmp_path, "test")


def test_packing_loses_nothing_that_a_file_can_hold():
    rng = np.random.default_rng(0)
    overhead = np.concatenate([rng.integers(0, 26, (20, 20, 1)) / 25, rng.integers(0, 2, (20, 20, 3))], axis=-1)
    raster = np.rint(127 * np.moveaxis(overhead[::-1], -1, 0)).astype(np.int8)
    np.testing.assert_array_equal(tables(LIDAR_CHANNELS)[:, packed(overhead)], raster)
    np.testing.assert_array_equal(tables(("lidar_below",))[:, packed(overhead)], raster[2:3])


def test_several_processes_pack_the_same(root, monkeypatch, made):
    one = load_episodes(made, "train", STEP)
    monkeypatch.setattr(precog_set, "_CHUNK", 4)
    several = load_episodes(root, "train", STEP, jobs=2)
    for name in ("past", "future", "overhead", "cluster"):
        np.testing.assert_array_equal(getattr(one, name), getattr(several, name))
    assert not list((root / ".hcnaf").glob("*/tracks-*"))


def test_a_split_is_packed_once_and_again_when_a_file_changes(root, monkeypatch):
    before = load_episodes(root, "train", STEP)
    with monkeypatch.context() as context:
        context.setattr(precog_set, "_pack_all", None)
        np.testing.assert_array_equal(load_episodes(root, "train", STEP).past, before.past)
    episode_files(root, "train")[0].unlink()
    after = load_episodes(root, "train", STEP)
    np.testing.assert_array_equal(after.past, before.past[1:])


def test_the_time_step_scales_speeds_alone(made):
    slow, fast = load_episodes(made, "test", 0.2), load_episodes(made, "test", 0.1)
    np.testing.assert_array_equal(slow.past[..., :2], fast.past[..., :2])
    np.testing.assert_allclose(2.0 * slow.past[..., 4], fast.past[..., 4], rtol=1e-5)


def test_where_the_data_cannot_be_written_the_cache_of_the_user_is(root, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (root / ".hcnaf").write_text("in the way")
    load_episodes(root, "val", STEP)
    assert list((tmp_path / "cache" / "hcnaf" / "precog").glob("val-*/overhead.npy"))


@pytest.mark.parametrize("parts", [1, 2])
def test_a_broken_file_is_named(root, monkeypatch, parts):
    if parts > 1:
        monkeypatch.setattr(precog_set, "_CHUNK", 4)
    file = episode_files(root, "train")[4]
    record = json.loads(file.read_bytes())
    del record["agent_pasts"]
    file.write_text(json.dumps(record))
    with pytest.raises(DataError, match=rf"{file.name}: episode without `agent_pasts`"):
        load_episodes(root, "train", STEP)
    file.write_bytes(file.read_bytes()[:1000])
    with pytest.raises(DataError, match=rf"{file.name}: not valid JSON"):
        load_episodes(root, "train", STEP)
    assert not list((root / ".hcnaf").glob("train-*"))


def test_a_file_unlike_the_others_is_named(root):
    file = episode_files(root, "train")[2]
    record = json.loads(file.read_bytes())
    for name in ("agent_pasts", "agent_futures", "agent_transforms", "agent_yaws"):
        record[name] = record[name][:3]
    file.write_text(json.dumps(record))
    with pytest.raises(DataError, match=rf"{file.name} has .*\(3, 10, 40, 200\).*\(4, 10, 40, 200\)"):
        load_episodes(root, "train", STEP)


def test_scenes_of_one_drive_form_a_cluster(made):
    found = load_episodes(made, "train", STEP)
    names = [read_episode(file).episode for file in episode_files(made, "train")]
    for i, one in enumerate(names):
        for j, other in enumerate(names):
            assert (found.cluster[i] == found.cluster[j]) == (one == other)


def test_a_folder_of_episodes_is_known_by_its_layout(made, tmp_path):
    assert is_precog(made)
    assert not is_precog(tmp_path)
    assert not is_precog(tmp_path / "nowhere")
    with pytest.raises(DataError, match=r"has no ma\*\.json; expected PRECOG-CARLA as DIR/train/ma\*\.json"):
        load_episodes(tmp_path, "train", STEP)
