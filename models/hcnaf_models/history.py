"""The hyper-network of a track: positions so far and a horizon in, theta out.

    history in its own frame --features--> MLP (once per track) --+
    horizon t                --MLP-------------------------------+--> low-rank head --> theta

The frame has its origin at the last position and x along the last displacement; the density starts from the
constant-velocity prediction (v t, 0). Hand-made and interpolated tracks are exactly straight for some steps and
turn at once: what tells is whether the last displacements agree to a millimetre, so differences enter at
two magnitudes, plainly and as asinh of small units.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from hcnaf_models.config import HistoryConfig
from hcnaf_models.geometry import to_frame
from hcnaf_models.heads import HeadMaker, make_head

DISPLACEMENT_UNITS = 0.5, 0.02
"""m per step, what displacements are divided by; the second one under asinh."""

CHANGE_UNITS = 0.1, 0.003
"""m per step, what changes of displacements are divided by; the second one under asinh."""


class HistoryHyperNet(nn.Module):
    """Histories and horizons -> theta [B, Q, P] in each track's frame."""

    def __init__(self, config: HistoryConfig, make: HeadMaker = make_head) -> None:
        super().__init__()
        self.config = config
        layers: list[nn.Module] = []
        width = _features(config.history)
        for hidden in config.trunk:
            layers += [nn.Linear(width, hidden), nn.ReLU(), nn.Dropout(config.dropout)]
            width = hidden
        self.trunk = nn.Sequential(*layers)
        self.once = nn.Linear(width, width)
        self.time = nn.Sequential(nn.Linear(4, 32), nn.ReLU(), nn.Linear(32, 2 * width))
        self.joint = nn.Sequential(nn.ReLU(), nn.Linear(width, config.rank), nn.ReLU())
        self.head = make(config.head, config.flow, config.rank)

    def forward(self, history: Tensor, horizons: Tensor) -> Tensor:
        """theta for each track and horizon.

        Args:
            history: [B, T, 2] positions (m) in any frame, the last row is now; finite.
            horizons: [B, Q] (s).
        """
        pose = pose_of_track(history)
        local = to_frame(history, pose.unsqueeze(1))
        speed = -local[:, -2, 0] / self.config.step
        return self.emit(self.once(self.trunk(features(local))), speed, horizons)

    def emit(self, context: Tensor, speed: Tensor, horizons: Tensor) -> Tensor:
        """theta [B, Q, P] from context [B, F], speed now [B] (m/s) and horizons [B, Q] (s)."""
        tau = horizons.unsqueeze(-1) / self.config.horizon
        times = torch.cat([tau, torch.sqrt(tau), torch.cos(math.pi * tau), torch.sin(math.pi * tau)], dim=-1)
        gain, shift = self.time(times).chunk(2, dim=-1)
        joint = self.joint(context.unsqueeze(1) * (1.0 + gain) + shift)
        anchor = torch.stack([speed.unsqueeze(1) * horizons, torch.zeros_like(horizons)], dim=-1)
        a, b, c = self.config.spread
        spread = (a + b * horizons + c * horizons * horizons).unsqueeze(-1).expand_as(anchor)
        theta: Tensor = self.head(joint, anchor, spread)
        return theta


class TrackCondition(nn.Module):
    """A track and a horizon as a condition [A, 2 T + 1], x_1, y_1, .., x_T, y_T (m), t (s) -> theta [A, 1, P]."""

    def __init__(self, hypernet: HistoryHyperNet) -> None:
        super().__init__()
        self.hypernet, self.head = hypernet, hypernet.head

    def forward(self, condition: Tensor) -> Tensor:
        track = condition[:, :-1].reshape(-1, self.hypernet.config.history, 2)
        theta: Tensor = self.hypernet(track, condition[:, -1:])
        return theta


def pose_of_track(history: Tensor) -> Tensor:
    """Pose [B, 3] (x, y, yaw) of tracks [B, T, 2]: yaw along the last displacement, 0 where there is none."""
    d = history[:, -1] - history[:, -2]
    return torch.cat([history[:, -1], torch.atan2(d[:, 1:], d[:, :1])], dim=-1)


def features(local: Tensor) -> Tensor:
    """What the trunk sees of tracks [B, T, 2] in their own frames: displacements and their changes."""
    d = local[:, 1:] - local[:, :-1]
    change = d[:, 1:] - d[:, :-1]
    parts = [d / DISPLACEMENT_UNITS[0], torch.asinh(d / DISPLACEMENT_UNITS[1]) / 3.0]
    parts += [change / CHANGE_UNITS[0], torch.asinh(change / CHANGE_UNITS[1]) / 3.0]
    return torch.cat([part.flatten(1) for part in parts], dim=-1)


def _features(history: int) -> int:
    return 2 * 2 * (2 * history - 3)
