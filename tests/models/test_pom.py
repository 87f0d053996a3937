"""The POM hyper-network: equivariance, batching, absent inputs, every ablation condition."""

import math

import pytest
import torch

from hcnaf_models import Crop, FlowSpec, PomConfig, build, from_dict, to_dict
from hcnaf_models.config import MAP_CHANNELS
from hcnaf_models.geometry import from_frame, pose_of, to_frame
from hcnaf_models.raster import crop_raster, splat_boxes

SMALL = {"flow": FlowSpec(hidden=6), "crop": Crop(behind=8, ahead=24, side=8), "widths": (4, 6, 8)}
CONDITIONS = {
    "C1": PomConfig(channels=(), draw_actors=False, **SMALL),
    "C2": PomConfig(channels=(), draw_actors=False, actors="now", **SMALL),
    "C3": PomConfig(channels=(), draw_actors=False, actors="history", **SMALL),
    "C4": PomConfig(channels=(), draw_actors=False, actors="history", stops=True, **SMALL),
    "C5": PomConfig(**SMALL),
    "C6": PomConfig(actors="history", stops=True, **SMALL),
}


def states(yaw, x, y, speed, T=10):
    """[..., T, 5] of cars running straight at constant speed."""
    t = torch.arange(-T + 1, 1) * 0.1
    c, s = torch.cos(yaw), torch.sin(yaw)
    columns = (
        x[..., None] + (c * speed)[..., None] * t,
        y[..., None] + (s * speed)[..., None] * t,
        s[..., None].expand(*s.shape, T),
        c[..., None].expand(*s.shape, T),
        speed[..., None].expand(*s.shape, T),
    )
    return torch.stack(columns, dim=-1)


def scene(B=3, N=5, seed=0):
    g = torch.Generator().manual_seed(seed)

    def r(*shape):
        return torch.rand(*shape, generator=g)

    reference = states(6 * r(B), 20 * r(B) + 20, 20 * r(B) + 20, 10 * r(B))
    others = states(6 * r(B, N), 30 * r(B, N) + 15, 30 * r(B, N) + 15, 10 * r(B, N))
    return {
        "reference": reference,
        "reference_size": torch.tensor([[4.5, 1.9]]).expand(B, 2),
        "horizons": 4 * r(B, 4) + 0.1,
        "others": others,
        "others_size": torch.tensor([4.5, 1.9]).expand(B, N, 2),
        "stops": torch.cat([60 * r(B, 3, 2), 6 * r(B, 3, 1)], dim=-1),
        "raster": 2 * r(5, 120, 120) - 1,
    }


def run(model, s):
    config = model.config
    inputs = {k: v for k, v in s.items() if k != "raster"}
    if config.channels:
        pose = pose_of(s["reference"])
        inputs["crop"] = crop_raster(s["raster"], torch.zeros(2), torch.tensor([0.5]), pose, config.crop)
    return model.hypernet(**inputs)


@pytest.fixture(params=CONDITIONS, ids=str)
def model(request):
    torch.manual_seed(1)
    model = build(CONDITIONS[request.param]).eval()
    with torch.no_grad():
        for layer in (model.hypernet.head.weights, model.hypernet.head.units):
            layer.weight.normal_(std=0.05)
    return model


def test_theta_starts_independent_of_the_scene(model):
    """Zero-weight heads: before training, the weights differ between scenes by the base scale alone."""
    fresh = build(model.config).eval()
    s = scene()
    s["horizons"] = torch.full_like(s["horizons"], 2.0)
    theta = run(fresh, s)[..., 2:]
    torch.testing.assert_close(theta, theta[:1].expand_as(theta))


def test_batch_equals_stacked_singles(model):
    s = scene()
    whole = run(model, s)
    for b in range(3):
        one = {k: (v if k == "raster" else v[b : b + 1]) for k, v in s.items()}
        torch.testing.assert_close(run(model, one)[0], whole[b], rtol=1e-4, atol=1e-4)


def test_gradients_reach_every_parameter(model):
    model.train()
    s = scene()
    log_prob = model.log_prob(run(model, s), torch.randn(3, 4, 1, 2))
    log_prob.mean().backward()
    dead = [n for n, p in model.named_parameters() if p.grad is None or not torch.isfinite(p.grad).all()]
    assert dead == []


def test_unobserved_rows_and_padding_change_nothing(model):
    s = scene()
    before = run(model, s)
    nothing = torch.full((3, 4, 10, 5), math.nan)
    s["others"] = torch.cat([nothing, s["others"]], dim=1)
    s["others_size"] = torch.cat([torch.ones(3, 4, 2), s["others_size"]], dim=1)
    torch.testing.assert_close(run(model, s), before, rtol=1e-5, atol=1e-5)
    s["others"] = torch.full_like(s["others"], math.nan)
    s["reference"][:, :4] = math.nan
    assert torch.isfinite(run(model, s)).all()


def test_theta_does_not_depend_on_the_frame():
    """Moving and turning the whole scene leaves theta, which lives in the target's frame, as it was."""
    torch.manual_seed(2)
    model = build(CONDITIONS["C4"]).eval()
    torch.nn.init.normal_(model.hypernet.head.weights.weight, std=0.05)
    s = scene()
    before = run(model, s)
    motion = torch.tensor([30.0, -12.0, 0.8])
    for key in ("reference", "others"):
        v = s[key].clone()
        yaw = torch.atan2(v[..., 2], v[..., 3]) + motion[2]
        s[key] = torch.cat(
            [from_frame(v[..., :2], motion), yaw.sin()[..., None], yaw.cos()[..., None], v[..., 4:]], -1
        )
    s["stops"] = torch.cat([from_frame(s["stops"][..., :2], motion), s["stops"][..., 2:] + motion[2]], -1)
    torch.testing.assert_close(run(model, s), before, rtol=1e-3, atol=1e-3)


def test_crop_shows_what_lies_ahead():
    crop = Crop(behind=8, ahead=24, side=8)
    raster = torch.zeros(1, 100, 100)
    raster[0, 60:64, 40:44] = 1.0  # a square of 2 m around (21, 31)
    pose = torch.tensor([[21.0, 21.0, math.pi / 2]])  # looking along +y: the square is 10 m ahead
    image = crop_raster(raster, torch.zeros(2), torch.tensor([0.5]), pose, crop)[0]
    rows, columns = torch.nonzero(image[0] > 0.5, as_tuple=True)
    assert float(columns.float().mean()) + 0.5 - 8 == pytest.approx(10.0, abs=0.1)
    assert float(rows.float().mean()) + 0.5 - 8 == pytest.approx(0.0, abs=0.1)
    assert image[1, 8, 10] == 1.0
    assert crop_raster(raster, torch.zeros(2), torch.tensor([0.5]), pose + 500, crop).abs().max() == 0.0


def test_splatted_boxes_hold_their_area_at_their_place():
    crop = Crop(behind=8, ahead=24, side=8)
    state = torch.tensor([[[10.3, -2.2, math.sin(0.4), math.cos(0.4), 3.0], [200.0, 0, 0, 1, 0]]])
    size = torch.tensor([[[4.0, 2.0], [4.0, 2.0]]])
    image = splat_boxes(state, size, torch.ones(1, 2, 1), crop)[0, 0]
    y, x = torch.meshgrid(torch.arange(16) + 0.5 - 8, torch.arange(32) + 0.5 - 8, indexing="ij")
    assert float(image.sum()) == pytest.approx(8.0, abs=1e-4)
    assert float((image * x).sum() / image.sum()) == pytest.approx(10.3, abs=1e-3)
    assert float((image * y).sum() / image.sum()) == pytest.approx(-2.2, abs=1e-3)
    assert float(image.max()) < 1.6


def test_frames_are_inverse_of_each_other():
    pose, points = torch.tensor([3.0, -1.0, 2.5]), torch.randn(7, 2)
    torch.testing.assert_close(to_frame(from_frame(points, pose), pose), points, rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", CONDITIONS)
def test_configurations_travel_as_plain_data(name):
    config = CONDITIONS[name]
    assert from_dict(to_dict(config)) == config
    with pytest.raises(ValueError, match="unknown keys"):
        from_dict({**to_dict(config), "chanels": MAP_CHANNELS})
