"""The hyper-network of the occupancy forecast (paper: section 4, figure 5).

    reference history --LSTM--+
    other actors      --LSTM--+
    stop lines        --MLP---+--> joint MLP (once per horizon) --> low-rank head --> theta
    map + drawn boxes --CNN---+
    horizon t / t_max --MLP---+

Everything that depends on the scene is computed once per target; only the joint MLP and the head run per
horizon. States come in the scene frame and are made actor-centric here, so that nothing has to be ported.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from hcnaf_models.config import PomConfig
from hcnaf_models.encoder import Encoder
from hcnaf_models.geometry import pose_of, states_to_frame, to_frame
from hcnaf_models.heads import HeadMaker, make_head
from hcnaf_models.mlp import mlp
from hcnaf_models.raster import splat_boxes, turn_directions

POSITION_UNIT = 10.0  # m and m/s per unit of what the networks see
DRAWN_PLANES = 4


class HistoryEncoder(nn.Module):
    """States [B, T, 5] in the actor's frame and size [B, 2] -> features [B, out]; NaN rows enter as absent."""

    def __init__(self, out: int, hidden: int = 32) -> None:
        super().__init__()
        self.lstm = nn.LSTM(6, hidden, batch_first=True)
        self.out = nn.Linear(hidden + 2, out)

    def forward(self, states: Tensor, size: Tensor) -> Tensor:
        _, (h, _) = self.lstm(state_features(states))
        return torch.relu(self.out(torch.cat([h[-1], size / POSITION_UNIT], dim=-1)))


def state_features(states: Tensor) -> Tensor:
    """[..., 5] -> [..., 6]: positions and speed in tens, absent rows zero, and whether the row is present."""
    known = torch.isfinite(states[..., :1])
    units = states.new_tensor([POSITION_UNIT, POSITION_UNIT, 1.0, 1.0, POSITION_UNIT])
    values = torch.where(known, states / units, torch.zeros_like(states))
    return torch.cat([values, known.to(states.dtype)], dim=-1)


def nearest(others: Tensor, size: Tensor, pose: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The `count` others nearest to each pose now, nearest first, padded with NaN.

    Args:
        others: [B, N, T, 5]; absent now (NaN) means not chosen. size: [B, N, 2]. pose: [B, 3].

    Returns:
        states [B, count, T, 5] and sizes [B, count, 2].
    """
    B, _, T, F = others.shape
    others = torch.cat([others, others.new_full((B, count, T, F), math.nan)], dim=1)
    size = torch.cat([size, size.new_ones(B, count, 2)], dim=1)
    squares = (others[:, :, -1, :2] - pose[:, None, :2]).square().sum(-1)
    far = torch.where(torch.isnan(squares), torch.full_like(squares, 1e12), squares)
    index = torch.topk(far, count, dim=1, largest=False).indices
    rows = index[:, :, None].expand(-1, -1, T * F)
    chosen = torch.gather(others.reshape(B, -1, T * F), 1, rows).reshape(B, count, T, F)
    seen = torch.isfinite(chosen[:, :, -1:, :1])
    chosen = torch.where(seen, chosen, torch.full_like(chosen, math.nan))
    return chosen, torch.gather(size, 1, index[:, :, None].expand(-1, -1, 2))


class ActorsEncoder(nn.Module):
    """The nearest others, one shared LSTM, nearest first -> features [B, out]."""

    def __init__(self, config: PomConfig, hidden: int = 24, each: int = 10) -> None:
        super().__init__()
        self.rows = 1 if config.actors == "now" else config.history
        self.each = HistoryEncoder(each, hidden)
        self.out = nn.Linear(config.max_actors * each, config.actors_size)

    def forward(self, states: Tensor, size: Tensor) -> Tensor:
        B, K = states.shape[:2]
        recent = states[:, :, -self.rows :, :]
        each = self.each(recent.reshape(B * K, self.rows, 5), size.reshape(B * K, 2)).reshape(B, K, -1)
        present = torch.isfinite(states[:, :, -1, :1]).to(each.dtype)
        return torch.relu(self.out((each * present).reshape(B, -1)))


class StopsEncoder(nn.Module):
    """The nearest stop lines (x, y, yaw) -> features [B, out]."""

    def __init__(self, config: PomConfig, out: int = 12) -> None:
        super().__init__()
        self.count = config.max_stops
        self.out = nn.Sequential(nn.Linear(6 * config.max_stops, 32), nn.ReLU(), nn.Linear(32, out), nn.ReLU())

    def forward(self, stops: Tensor, pose: Tensor) -> Tensor:
        zero = torch.zeros_like(stops[..., :1])
        yaw = stops[..., 2:3]
        states = torch.cat([stops[..., :2], torch.sin(yaw), torch.cos(yaw), zero], dim=-1)
        chosen, _ = nearest(states.unsqueeze(-2), stops[..., :2], pose, self.count)
        local = states_to_frame(chosen.squeeze(-2), pose.unsqueeze(-2))
        features: Tensor = self.out(state_features(local).flatten(1))
        return features


class SceneEncoder(nn.Module):
    """Map planes and drawn boxes -> features [B, out]."""

    def __init__(self, config: PomConfig) -> None:
        super().__init__()
        self.config = config
        planes = len(config.channels) + 1 + (DRAWN_PLANES if config.draw_actors else 0)
        crop = config.crop
        self.encoder = Encoder(planes, crop.rows, crop.columns, config.widths, config.map_size)

    def forward(self, crop: Tensor, pose: Tensor, others: Tensor | None, size: Tensor | None) -> Tensor:
        """crop [B, C + 1, rows, columns]; others [B, K, T, 5] in the actor's frame."""
        image = turn_directions(crop, self.config.channels, pose)
        if self.config.draw_actors and others is not None and size is not None:
            image = torch.cat([image, self._boxes(others, size)], dim=1)
        features: Tensor = self.encoder(image)
        return features

    def _boxes(self, others: Tensor, size: Tensor) -> Tensor:
        """Where others are now, where they were at the first row, and their velocity: [B, 4, rows, columns]."""
        now, before = others[:, :, -1], others[:, :, 0]
        known = torch.where(torch.isfinite(now), now, torch.zeros_like(now))
        speed = known[..., 4] / POSITION_UNIT
        one, none = torch.ones_like(speed), torch.zeros_like(speed)
        present = torch.stack([one, none, speed * known[..., 3], speed * known[..., 2]], dim=-1)
        past = torch.stack([none, one, none, none], dim=-1)
        states = torch.cat([now, before], dim=1)
        values = torch.cat([present, past], dim=1)
        return splat_boxes(states, torch.cat([size, size], dim=1), values, self.config.crop)


class PomHyperNet(nn.Module):
    """Scene and horizons -> theta [B, Q, P] in each target's frame (origin at its box centre now, x forward).

    The flow starts from the constant-velocity prediction: location (v t, 0), scale s(t) of the configuration; the
    head learns the rest.
    """

    def __init__(self, config: PomConfig, make: HeadMaker = make_head) -> None:
        super().__init__()
        self.config = config
        self.reference = HistoryEncoder(config.reference_size)
        self.actors = ActorsEncoder(config) if config.actors != "none" else None
        self.stops = StopsEncoder(config) if config.stops else None
        self.scene = SceneEncoder(config) if config.channels else None
        self.time = nn.Sequential(nn.Linear(3, 32), nn.ReLU(), nn.Linear(32, config.time_size))
        widths = config.reference_size + config.time_size
        widths += config.actors_size * bool(self.actors) + 12 * bool(self.stops)
        widths += config.map_size * bool(self.scene)
        self.trunk = mlp(widths, config.trunk)
        self.head = make(config.head, config.flow, config.trunk[-1])

    def forward(
        self,
        reference: Tensor,
        reference_size: Tensor,
        horizons: Tensor,
        *,
        others: Tensor | None = None,
        others_size: Tensor | None = None,
        stops: Tensor | None = None,
        crop: Tensor | None = None,
    ) -> Tensor:
        """theta for each target and horizon.

        Args:
            reference: [B, T, 5] states of the targets (scene frame), finite now.
            reference_size: [B, 2], length and width (m).
            horizons: [B, Q] (s).
            others, others_size: [B, N, T, 5] and [B, N, 2], without the target; NaN rows are not observed.
            stops: [B, S, 3], x, y, yaw of stop lines (scene frame).
            crop: [B, C + 1, rows, columns] from `hcnaf_models.raster.crop_raster`.
        """
        context = self.encode(reference, reference_size, others, others_size, stops, crop)
        return self.emit(context, reference[:, -1, 4], horizons)

    def encode(
        self,
        reference: Tensor,
        reference_size: Tensor,
        others: Tensor | None,
        others_size: Tensor | None,
        stops: Tensor | None,
        crop: Tensor | None,
    ) -> Tensor:
        """Everything about the scene that does not depend on the horizon: [B, F]."""
        pose = pose_of(reference)
        parts = [self.reference(states_to_frame(reference, pose[:, None]), reference_size)]
        if others is not None and others_size is not None:
            count = max(self.config.max_actors, self.config.max_drawn)
            others, others_size = nearest(others, others_size, pose, count)
            others = states_to_frame(others, pose[:, None, None])
        if self.actors is not None:
            others, others_size = _given(others, "others"), _given(others_size, "others_size")
            K = self.config.max_actors
            parts.append(self.actors(others[:, :K], others_size[:, :K]))
        if self.stops is not None:
            parts.append(self.stops(_given(stops, "stops"), pose))
        if self.scene is not None:
            parts.append(self.scene(_given(crop, "crop"), pose, others, others_size))
        return torch.cat(parts, dim=-1)

    def emit(self, context: Tensor, speed: Tensor, horizons: Tensor) -> Tensor:
        """theta [B, Q, P] from context [B, F], speed now [B] (m/s) and horizons [B, Q] (s)."""
        tau = horizons.unsqueeze(-1) / self.config.horizon
        time = self.time(torch.cat([tau, torch.cos(math.pi * tau), torch.sin(math.pi * tau)], dim=-1))
        joint = torch.cat([context.unsqueeze(1).expand(-1, tau.shape[1], -1), time], dim=-1)
        anchor = torch.stack([speed.unsqueeze(1) * horizons, torch.zeros_like(horizons)], dim=-1)
        a, b, c = self.config.spread
        spread = (a + b * horizons + c * horizons * horizons).unsqueeze(-1).expand_as(anchor)
        theta: Tensor = self.head(self.trunk(joint), anchor, spread)
        return theta


def to_target_frame(points: Tensor, reference: Tensor) -> Tensor:
    """Points [B, ..., 2] of the scene frame in the frame of each target [B, T, 5], where theta lives."""
    pose = pose_of(reference)
    return to_frame(points, pose.reshape(pose.shape[0], *[1] * (points.dim() - 2), 3))


def _given(value: Tensor | None, name: str) -> Tensor:
    if value is None:
        raise ValueError(f"this hyper-network reads {name}, but none were given")
    return value
