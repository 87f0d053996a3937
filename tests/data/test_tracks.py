"""Laws of track sets: rows, histories, neighbours, scenes, files."""

import dataclasses

import msgspec
import numpy as np
import pytest

from hcnaf_export.data.raster import MAP_CHANNELS
from hcnaf_export.data.tracks import (
    FUTURE,
    HISTORY,
    Dataset,
    Manifest,
    NoiseModel,
    SetEntry,
    TrackSet,
    read_manifest,
)
from hcnaf_runtime.errors import DataError
from hcnaf_runtime.scene import Scene


def make(seed=0, count=30, width=300, height=260):
    """Straight tracks of different lengths and starts, some shorter than a window."""
    rng = np.random.default_rng(seed)
    length = rng.integers(5, 160, count)
    length[:4] = 150
    first = rng.integers(0, 60, count).astype(np.int32)
    start = np.append(0, np.cumsum(length))
    yaw = rng.uniform(-np.pi, np.pi, count)
    speed = rng.uniform(0.0, 8.0, count)
    place = rng.uniform(20.0, 110.0, (count, 2))
    track = np.repeat(np.arange(count), length)
    time = 0.1 * (np.arange(start[-1]) - start[track])[:, None]
    heading = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    position = place[track] + time * (speed[:, None] * heading)[track]
    truth = np.column_stack([position, yaw[track], speed[track]]).astype(np.float32)
    seen = rng.random(len(truth)) > 0.1
    steps = [(i, int(first[i]) + now) for i in range(count) for now in range(9, length[i] - FUTURE, 7)]
    windows = np.array([w for w in steps if seen[start[w[0]] + w[1] - first[w[0]]]], np.int32)
    return TrackSet(
        truth=truth,
        observed=truth + rng.normal(0.0, 0.05, truth.shape).astype(np.float32),
        seen=seen,
        label=truth[:, :2] + rng.normal(0.0, 0.1, (len(truth), 2)).astype(np.float32),
        track_start=start.astype(np.int64),
        track_step=first,
        size=rng.uniform(1.0, 5.0, (count, 2)).astype(np.float32),
        kind=np.ones(count, np.uint8),
        parked=np.zeros(count, bool),
        raster=rng.integers(-127, 128, (5, height, width)).astype(np.int8),
        channels=MAP_CHANNELS,
        origin=np.array([-10.0, -12.5], np.float32),
        resolution=0.5,
        stops=np.array([[50.0, 50.0, 0.3], [500.0, 0.0, 1.0]], np.float32),
        windows=windows,
        name="made",
    )


@pytest.fixture(scope="module")
def tracks():
    return make()


def state(tracks, track, step):
    """By brute force: the row of a track at a step, None where absent."""
    offset = step - tracks.track_step[track]
    inside = 0 <= offset < tracks.track_start[track + 1] - tracks.track_start[track]
    return int(tracks.track_start[track] + offset) if inside else None


@pytest.mark.parametrize("step", [-5, 0, 17, 60, 120, 10_000])
def test_agents_at_a_step_are_those_with_a_row(tracks, step):
    expected = [i for i in range(tracks.count) if state(tracks, i, step) is not None]
    assert tracks.agents_at(step).tolist() == expected


def test_rows_agree_with_brute_force(tracks):
    rng = np.random.default_rng(1)
    track, step = rng.integers(-1, tracks.count, 500), rng.integers(-10, 250, 500)
    expected = [
        -1 if i < 0 or state(tracks, i, s) is None else state(tracks, i, s)
        for i, s in zip(track, step, strict=True)
    ]
    assert tracks.rows(track, step).tolist() == expected


def test_histories_hold_what_was_observed_and_nan_elsewhere(tracks):
    rng = np.random.default_rng(2)
    track, step = rng.integers(0, tracks.count, 50), rng.integers(0, 200, 50)
    past = tracks.gather_histories(track, step, 7)
    assert past.shape == (50, 7, 5)
    assert past.dtype == np.float32
    for b, t in np.ndindex(50, 7):
        row = state(tracks, track[b], step[b] - 6 + t)
        if row is None or not tracks.seen[row]:
            assert np.isnan(past[b, t]).all()
        else:
            x, y, yaw, speed = tracks.observed[row]
            assert past[b, t] == pytest.approx([x, y, np.sin(yaw), np.cos(yaw), speed], abs=1e-6)


def test_a_batch_of_histories_is_the_stacked_singles(tracks):
    track, step = tracks.windows[:20].T
    batch = tracks.gather_histories(track, step)
    singles = np.concatenate([tracks.history([i], s) for i, s in zip(track, step, strict=True)])
    assert np.array_equal(batch, singles, equal_nan=True)
    nested = tracks.gather_histories(track.reshape(4, 5), step.reshape(4, 5))
    assert np.array_equal(nested.reshape(batch.shape), batch, equal_nan=True)


def test_windows_have_a_whole_future_starting_one_step_after_now(tracks):
    track, step = tracks.windows.T
    future = tracks.gather_futures(track, step)
    assert future.shape == (len(track), FUTURE, 2)
    assert np.isfinite(future).all()
    i, s = int(track[3]), int(step[3])
    assert np.array_equal(tracks.label_future(i, s)[0], tracks.label[state(tracks, i, s + 1)])
    assert np.array_equal(tracks.truth_future(i, s)[-1], tracks.truth[state(tracks, i, s + FUTURE), :2])


def test_futures_beyond_the_end_are_unknown(tracks):
    last = int(tracks.track_step[0] + tracks.length[0] - 1)
    assert np.isnan(tracks.label_future(0, last)).all()
    assert np.isfinite(tracks.label_future(0, last - 3)[:3]).all()
    assert np.isnan(tracks.label_future(0, last - 3)[3:]).all()


@pytest.mark.parametrize("seen_only", [True, False])
@pytest.mark.parametrize("k", [1, 4, 50])
def test_neighbours_agree_with_brute_force(tracks, k, seen_only):
    track, step = tracks.windows[::5].T
    found = tracks.neighbours(track, step, k, seen_only)
    assert found.shape == (len(track), k)
    for b in range(len(track)):
        centre = tracks.observed[state(tracks, track[b], step[b]), :2]
        rows = {i: state(tracks, i, step[b]) for i in range(tracks.count) if i != track[b]}
        rows = {i: r for i, r in rows.items() if r is not None and (tracks.seen[r] or not seen_only)}
        order = sorted(rows, key=lambda i: np.square(tracks.observed[rows[i], :2] - centre).sum())[:k]
        assert found[b].tolist() == order + [-1] * (k - len(order))


def test_a_scene_is_the_windows_history_and_future_around_the_ego(tracks):
    track, step = (int(v) for v in tracks.windows[10])
    scene = tracks.scene(track, step)
    centre = tracks.observed[state(tracks, track, step), :2].astype(np.float64)
    assert isinstance(scene, Scene)
    assert scene.frame == "local"
    assert scene.step == pytest.approx(0.1)
    assert scene.past[0, -1, :2] == pytest.approx([0.0, 0.0], abs=1e-6)
    moved = tracks.history([track], step)[0]
    moved[:, :2] -= centre
    assert np.allclose(scene.past[0], moved, atol=1e-4, equal_nan=True)
    assert np.allclose(scene.future[0], tracks.label_future(track, step) - centre, atol=1e-4)
    distance = np.hypot(*scene.past[:, -1, :2].T)
    known = distance[np.isfinite(distance)]
    assert (known[:-1] <= known[1:] + 0.3).all()
    assert known.max() <= 60.0


def test_a_scenes_targets_are_seen_and_have_whole_futures(tracks):
    for track, step in tracks.windows[::40]:
        scene = tracks.scene(int(track), int(step), max_targets=3)
        assert scene.target[0] == 0
        assert 1 <= len(scene.target) <= 3
        assert np.isfinite(scene.future[scene.target]).all()
        assert np.isfinite(scene.past[scene.target, -1]).all()
        assert np.isfinite(scene.past).any(axis=(1, 2)).all()


@pytest.mark.parametrize("which", [0, 17, 33])
def test_a_scenes_raster_shows_the_network_at_the_same_places(tracks, which):
    track, step = (int(v) for v in tracks.windows[which])
    scene = tracks.scene(track, step, extent=120.0)
    centre = tracks.observed[state(tracks, track, step), :2].astype(np.float64)
    assert scene.raster.shape == (5, 240, 240)
    rng = np.random.default_rng(which)
    for row, col in rng.integers(0, 240, (200, 2)):
        point = scene.origin + 0.5 * (np.array([col, row]) + 0.5) + centre
        at = np.floor((point - tracks.origin) / 0.5).astype(int)
        inside = (at >= 0).all() and at[0] < tracks.raster.shape[2] and at[1] < tracks.raster.shape[1]
        expected = tracks.raster[:, at[1], at[0]] if inside else np.zeros(5, np.int8)
        assert np.array_equal(scene.raster[:, row, col], expected)
    assert np.abs(scene.origin + 60.0).max() <= 0.5 + 1e-4
    assert np.allclose(scene.stops, [[50.0 - centre[0], 50.0 - centre[1], 0.3]], atol=1e-4)


def test_an_ego_that_is_not_observed_is_refused(tracks):
    with pytest.raises(DataError, match="choose one of `windows`"):
        tracks.scene(0, 10_000)
    hidden = int(np.flatnonzero(~tracks.seen[: tracks.length[0]])[0])
    with pytest.raises(DataError, match="not observed"):
        tracks.scene(0, int(tracks.track_step[0]) + hidden)


def test_round_trip(tracks, tmp_path):
    tracks.save(tmp_path / "set.npz")
    again = TrackSet.load(tmp_path / "set.npz")
    for field in dataclasses.fields(TrackSet):
        one, other = getattr(tracks, field.name), getattr(again, field.name)
        assert np.array_equal(one, other), field.name
        assert type(one) is type(other)


def test_arrays_that_do_not_fit_are_refused(tracks):
    for name, bad in {
        "truth": tracks.truth.astype(np.float64),
        "seen": tracks.seen[:-1],
        "raster": tracks.raster[:3],
        "track_start": tracks.track_start + 1,
        "windows": np.array([[tracks.count, 10]], np.int32),
    }.items():
        with pytest.raises(DataError, match=name):
            dataclasses.replace(tracks, **{name: bad})


def test_files_that_are_not_track_sets_are_refused(tmp_path):
    with pytest.raises(DataError, match="no such file"):
        TrackSet.load(tmp_path / "missing.npz")
    (tmp_path / "text.npz").write_text("hello")
    with pytest.raises(DataError, match=r"text\.npz"):
        TrackSet.load(tmp_path / "text.npz")
    np.savez(tmp_path / "other.npz", truth=np.zeros((3, 4)))
    with pytest.raises(DataError, match="format none"):
        TrackSet.load(tmp_path / "other.npz")
    np.savez(tmp_path / "pickled.npz", format=np.array([{}], dtype=object))
    with pytest.raises(DataError, match=r"pickled\.npz"):
        TrackSet.load(tmp_path / "pickled.npz")


def manifest(**changes):
    entry = SetEntry("made.npz", "made", 1, 2, 3)
    content = {
        "format": "hcnaf-tracks",
        "version": 1,
        "seed": 0,
        "splits": {"train": [entry], "val": []},
        "noise": NoiseModel(),
        "nll_floor": NoiseModel().label_entropy,
        "step": 0.1,
        "history": HISTORY,
        "future": FUTURE,
        "settings": {},
        "software": {},
    }
    return msgspec.json.encode(Manifest(**(content | changes)))


def test_a_dataset_reads_its_splits(tracks, tmp_path):
    tracks.save(tmp_path / "made.npz")
    (tmp_path / "dataset.json").write_bytes(manifest())
    dataset = Dataset(tmp_path)
    assert [t.name for t in dataset.split("train")] == ["made"]
    assert dataset.split("val") == []
    with pytest.raises(DataError, match="no split 'test'"):
        dataset.split("test")


def test_bad_manifests_are_refused(tmp_path):
    path = tmp_path / "dataset.json"
    with pytest.raises(DataError, match="cannot be read"):
        Dataset(tmp_path)
    for content, message in [
        (b"{}", "not a data set manifest"),
        (b"not json", "not a data set manifest"),
        (manifest()[:-1] + b',"extra":1}', "extra"),
        (manifest(version=2), "version 2"),
    ]:
        path.write_bytes(content)
        with pytest.raises(DataError, match=message):
            read_manifest(path)


def test_the_floor_is_the_entropy_of_the_label_noise():
    noise = NoiseModel(label=0.1)
    draws = np.random.default_rng(0).normal(0.0, 0.1, (200_000, 2))
    log_density = -np.square(draws).sum(axis=1) / (2 * 0.01) - np.log(2 * np.pi * 0.01)
    assert noise.label_entropy == pytest.approx(-log_density.mean(), abs=0.01)
    assert NoiseModel(label=0.0).label_entropy is None
