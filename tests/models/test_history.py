"""The hyper-network of tracks: it sees a track, not where the track lies."""

import math

import pytest
import torch

from hcnaf_models.config import HistoryConfig, from_dict, to_dict
from hcnaf_models.history import features, pose_of_track
from hcnaf_models.model import build
from hcnaf_models.spec import FlowSpec

CONFIG = HistoryConfig(flow=FlowSpec(hidden=4), trunk=(16, 16), rank=8)


def model_and_tracks(seed: int = 0) -> tuple[torch.nn.Module, torch.Tensor, torch.Tensor]:
    torch.manual_seed(seed)
    model = build(CONFIG).eval()
    with torch.no_grad():
        for p in model.parameters():
            p.add_(0.1 * torch.randn_like(p))
    tracks = torch.cumsum(0.4 * torch.randn(5, 1, 2) + 0.1 * torch.randn(5, 8, 2), dim=1)
    return model, tracks, torch.tensor([0.4, 1.6, 4.8]).expand(5, -1)


@torch.no_grad()
def test_theta_does_not_depend_on_the_frame_of_the_track():
    model, tracks, horizons = model_and_tracks()
    c, s = math.cos(2.0), math.sin(2.0)
    moved = tracks @ torch.tensor([[c, s], [-s, c]]) + torch.tensor([30.0, -7.0])
    a, b = model.hypernet(tracks, horizons), model.hypernet(moved, horizons)
    torch.testing.assert_close(a, b, atol=2e-2, rtol=2e-3)


@torch.no_grad()
def test_a_batch_is_its_items_and_a_horizon_does_not_see_the_others():
    model, tracks, horizons = model_and_tracks()
    whole = model.hypernet(tracks, horizons)
    for i in range(5):
        for q in range(3):
            one = model.hypernet(tracks[i : i + 1], horizons[i : i + 1, q : q + 1])
            torch.testing.assert_close(one[0, 0], whole[i, q], atol=1e-4, rtol=1e-4)


@torch.no_grad()
def test_an_untrained_model_expects_constant_velocity():
    config = HistoryConfig()
    model = build(config).eval()
    track = torch.arange(8.0)[None, :, None] * torch.tensor([0.0, 0.5])
    theta = model.hypernet(track, torch.tensor([[0.4, 4.8]]))
    torch.testing.assert_close(theta[0, :, :2], torch.tensor([[0.5, 0.0], [6.0, 0.0]]), atol=1e-4, rtol=1e-4)


def test_the_frame_is_the_last_displacement():
    track = torch.tensor([[[0.0, 0.0], [1.0, 0.0], [1.0, 2.0]]])
    torch.testing.assert_close(pose_of_track(track), torch.tensor([[1.0, 2.0, math.pi / 2]]))


def test_features_tell_a_millimetre():
    straight = torch.arange(8.0)[None, :, None] * torch.tensor([0.4, 0.0])
    bent = straight.clone()
    bent[0, -1, 0] += 0.003
    assert (features(straight) - features(bent)).abs().max() > 0.2
    assert torch.isfinite(features(torch.zeros(1, 8, 2))).all()


def test_configurations_survive_checkpoints_and_refuse_nonsense():
    assert from_dict(to_dict(CONFIG)) == CONFIG
    with pytest.raises(ValueError, match="2 dimensions"):
        HistoryConfig(flow=FlowSpec(dims=3))
    with pytest.raises(ValueError, match="history must be"):
        HistoryConfig(history=2)
    with pytest.raises(ValueError, match="unknown keys"):
        from_dict(to_dict(CONFIG) | {"tail": 1})
