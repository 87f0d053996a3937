"""Windows and what training makes of them: frames, noise, shifts and maps."""

import dataclasses
import math

import msgspec
import numpy as np
import pytest
import torch

from hcnaf_export.data.tracks import FUTURE, HISTORY, NoiseModel
from hcnaf_export.recipe import Windows, read_recipe
from hcnaf_export.training.pom import FUSED_FROM, log_prob, loss
from hcnaf_export.training.sampling import FixedWindows, WindowSampler
from hcnaf_export.training.windows import Perception, WindowPool
from hcnaf_models.config import PomConfig
from hcnaf_models.geometry import from_frame, pose_of
from hcnaf_models.model import build
from hcnaf_models.raster import pixel_centres
from hcnaf_models.spec import FlowSpec
from hcnaf_runtime.errors import DataError
from tests.export import synthetic

CONFIG = read_recipe("pom-tiny").model
PLAIN = Windows(
    redraw=False, shift=0, lone=0.0, no_map=0.0, no_channel=0.0, short_map=0.0, horizons=4, neighbours=5
)
QUIET = msgspec.structs.replace(synthetic.NOISE, label=0.0)


@pytest.fixture(scope="module")
def sets():
    return [synthetic.tracks(1), synthetic.tracks(2)]


@pytest.fixture(scope="module")
def pool(sets):
    return WindowPool(sets, CONFIG, 5)


def sampler(pool, noise=synthetic.NOISE, batch=16, seed=0, **changes):
    return WindowSampler(pool, msgspec.structs.replace(PLAIN, **changes), noise, batch, seed)


def test_a_batch_follows_from_seed_and_step(pool):
    make = {"redraw": True, "shift": 4, "no_map": 0.2, "short_map": 0.5}
    one, other = sampler(pool, **make), sampler(pool, **make)
    other.batch(0)
    for a, b in zip(one.batch(3), other.batch(3), strict=True):
        assert (a is None and b is None) or torch.equal(a.nan_to_num(9.0), b.nan_to_num(9.0))
    assert not torch.equal(one.batch(3).points, one.batch(4).points)
    assert not torch.equal(one.batch(3).points, sampler(pool, seed=1, **make).batch(3).points)


def test_an_epoch_visits_every_window_at_most_once(pool):
    s = sampler(pool)
    visited = np.concatenate([s._windows(step) for step in range(s.per_epoch)])
    assert len(visited) == len(set(visited.tolist())) > len(pool) - s.size


def test_horizons_fill_the_trained_range(pool):
    horizons = torch.cat([sampler(pool).batch(step).horizons for step in range(30)])
    assert horizons.min() > 0.0
    assert horizons.max() <= CONFIG.horizon
    counts = torch.histc(horizons, 8, 0.0, CONFIG.horizon)
    assert (counts - counts.mean()).abs().max() < 5.0 * counts.mean().sqrt()


def test_fixed_windows_are_the_recording(sets, pool):
    batch = FixedWindows(pool, (0.1, 1.5, 4.0), batch=len(pool)).batch(0)
    track, step = sets[0].windows.T
    W = len(track)
    assert np.array_equal(batch.reference[:W].numpy(), sets[0].gather_histories(track, step), equal_nan=True)
    others = sets[0].neighbours(track, step, 5, seen_only=False)
    expected = sets[0].gather_histories(others, step[:, None])
    assert np.array_equal(batch.others[:W].numpy(), expected, equal_nan=True)
    label = sets[0].gather_futures(track, step)[:, [0, 14, 39]]
    back = from_frame(batch.points[:W, :, 0], pose_of(batch.reference[:W])[:, None])
    assert np.allclose(back.numpy(), label, atol=1e-4)


def test_labels_are_the_truth_between_rows(sets, pool):
    batch = sampler(pool, QUIET, draws=1, batch=len(pool)).batch(0)
    index = sampler(pool, QUIET, batch=len(pool))._windows(0)
    found = from_frame(batch.points[:, :, 0], pose_of(batch.reference)[:, None]).numpy()
    for i, w in enumerate(index[:20]):
        which, local = pool.set[w], w - (0 if pool.set[w] == 0 else len(sets[0].windows))
        track, now = sets[which].windows[local]
        rows = sets[which].rows(track, now + np.arange(FUTURE + 1))
        for d in range(2):
            truth = np.interp(batch.horizons[i], 0.1 * np.arange(FUTURE + 1), sets[which].truth[rows, d])
            assert np.allclose(found[i, :, d], truth, atol=1e-3)


def test_draws_of_a_label_have_the_recorded_noise(pool):
    points = sampler(pool, draws=64, batch=len(pool)).batch(0).points
    assert points.std(dim=2).mean() == pytest.approx(synthetic.NOISE.label, rel=0.03)


def moved(tracks, angle=2.1, shift=(40.0, -25.0)):
    """The same traffic in a frame turned and moved."""
    c, s = math.cos(angle), math.sin(angle)
    turn = lambda xy: (xy @ np.array([[c, s], [-s, c]]) + shift).astype(np.float32)  # noqa: E731

    def state(v):
        return np.column_stack([turn(v[:, :2]), v[:, 2] + angle, v[:, 3]]).astype(np.float32)

    return dataclasses.replace(
        tracks, truth=state(tracks.truth), observed=state(tracks.observed), label=turn(tracks.label)
    )


def test_scores_do_not_depend_on_the_frame(sets):
    config = PomConfig(actors="history", channels=(), draw_actors=False, trunk=(16, 8))
    model = build(config).eval()
    torch.nn.init.normal_(model.hypernet.head.units.weight, std=0.1)
    torch.nn.init.normal_(model.hypernet.head.weights.weight, std=0.1)
    one = sampler(WindowPool(sets, config, 5), QUIET).batch(0)
    other = sampler(WindowPool([moved(s) for s in sets], config, 5), QUIET).batch(0)
    assert torch.allclose(one.points, other.points, atol=1e-3)
    with torch.no_grad():
        assert torch.allclose(log_prob(model, one), log_prob(model, other), atol=5e-3)


def test_shifted_windows_stay_on_their_tracks(sets):
    pool = WindowPool(sets, CONFIG, 5)
    index = np.arange(len(pool))
    rows = pool.rows(index, 6, np.random.default_rng(0))
    moved_by = rows.now - pool.rows(index).now
    assert set(moved_by.tolist()) == set(range(-6, 7))
    owner = np.concatenate([np.repeat(np.arange(s.count), s.length) + 1000 * i for i, s in enumerate(sets)])
    home = owner[pool.rows(index).now]
    assert (owner[rows.now + FUTURE] == home).all()
    assert (owner[rows.past[:, 0]] == home[:, None]).all()
    others = rows.past[:, 1:]
    home = owner[pool.rows(index).past[:, 1:, -1]]
    assert (owner[others] == home[..., None])[others >= 0].all()


def test_perception_has_the_statistics_of_the_recording():
    noise = NoiseModel(position=0.3, yaw=0.1, speed=0.0, drop=0.2, drop_length=3.0)
    truth = np.tile(np.float32([5.0, -3.0, 0.0, 4.0]), (4000, 3, HISTORY, 1))
    past = Perception(noise).draw(truth, np.ones(truth.shape[:3], bool), np.random.default_rng(0))
    seen = np.isfinite(past[..., 0])
    assert seen[:, 0, -1].all()
    others = seen[:, 1:]
    assert (~others).mean(axis=(0, 1)) == pytest.approx(np.full(HISTORY, 0.2), abs=0.02)
    stays = (~others[..., :-1] & ~others[..., 1:]).sum() / (~others[..., :-1]).sum()
    assert stays == pytest.approx(1.0 - 1.0 / 3.0, abs=0.02)
    assert np.nanstd(past[..., 0]) == pytest.approx(0.3, rel=0.02)
    assert np.nanstd(past[..., 2]) == pytest.approx(0.1, rel=0.02)
    assert np.nanmax(np.abs(past[..., 4] - 4.0)) == 0.0


def test_maps_are_left_out_as_asked(pool):
    full = sampler(pool).batch(0).crop
    assert (sampler(pool, no_map=1.0).batch(0).crop[:, :-1] == 0.0).all()
    inside = sampler(pool, no_map=1.0).batch(0).crop[:, -1]
    assert 0 < sum(bool(plane.any()) for plane in inside) < len(inside)
    bare = sampler(pool, no_channel=1.0, optional=("junction",)).batch(0).crop
    gone = CONFIG.channels.index("junction")
    assert (bare[:, gone] == 0.0).all()
    kept = [c for c in range(full.shape[1]) if c != gone]
    assert torch.equal(bare[:, kept], full[:, kept])


def test_a_short_map_ends_at_its_reach(pool):
    full = sampler(pool).batch(0)
    short = sampler(pool, short_map=1.0, map_shift=0.0, map_reach=15.0).batch(0)
    pose = pose_of(full.reference)
    x, y = pixel_centres(CONFIG.crop, pose)
    local = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
    away = (from_frame(local, pose[:, None, None]) - pose[:, None, None, :2]).abs().amax(-1)
    near = (away <= 15.0)[:, None]
    clear = ((away - 15.0).abs() > 1e-3)[:, None].expand_as(full.crop)
    assert torch.equal(short.crop[clear], (full.crop * near)[clear])
    assert 0 < near.sum() < near.numel()


def test_lone_windows_have_no_neighbours(pool):
    assert torch.isnan(sampler(pool, lone=1.0).batch(0).others).all()


def test_stop_lines_come_padded(sets):
    more = dataclasses.replace(sets[1], stops=np.zeros((3, 3), np.float32))
    config = PomConfig(stops=True, crop=CONFIG.crop, widths=CONFIG.widths)
    pool = WindowPool([sets[0], more], config, 2)
    batch = sampler(pool, batch=len(pool)).batch(0)
    assert batch.stops.shape[1:] == (3, 3)
    assert torch.isfinite(batch.stops[..., 0]).sum(1).unique().tolist() == [1, 3]


def test_what_does_not_fit_the_model_is_named(sets):
    poor = dataclasses.replace(sets[0], raster=sets[0].raster[:2], channels=sets[0].channels[:2])
    with pytest.raises(DataError, match="'direction_y'"):
        WindowPool([poor], CONFIG, 5)
    with pytest.raises(DataError, match=r"0\.2 s"):
        WindowPool(sets, dataclasses.replace(CONFIG, step=0.2), 5)
    with pytest.raises(DataError, match="no windows"):
        WindowPool([dataclasses.replace(sets[0], windows=sets[0].windows[:0])], CONFIG, 5)


@pytest.mark.parametrize("hidden", [4, FUSED_FROM])
def test_the_loss_of_wide_flows_has_the_same_value_and_derivative(pool, hidden):
    config = dataclasses.replace(CONFIG, flow=FlowSpec(hidden=hidden))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = build(config).eval()
        model.hypernet.head.weights.weight.data.normal_(0.0, 0.05)
    batch = sampler(pool, batch=4).batch(0)
    found, expected = loss(model, batch), -log_prob(model, batch).mean()
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)
    weights = model.hypernet.head.weights.weight
    gradients = [torch.autograd.grad(v, weights)[0] for v in (found, expected)]
    torch.testing.assert_close(*gradients, rtol=1e-3, atol=1e-5)
