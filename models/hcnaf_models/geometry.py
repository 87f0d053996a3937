"""Rigid motions of the plane: poses (x, y, yaw) and the actor-centric frame (x forward, y left)."""

from __future__ import annotations

import torch
from torch import Tensor


def pose_of(states: Tensor) -> Tensor:
    """Pose [..., 3] (x, y, yaw) now from states [..., T, 5] (x, y, sin, cos, speed)."""
    now = states[..., -1, :]
    return torch.cat([now[..., :2], torch.atan2(now[..., 2:3], now[..., 3:4])], dim=-1)


def to_frame(points: Tensor, pose: Tensor) -> Tensor:
    """Points [..., 2] of the outer frame, seen from pose [..., 3]."""
    d = points - pose[..., :2]
    c, s = torch.cos(pose[..., 2]), torch.sin(pose[..., 2])
    return torch.stack([c * d[..., 0] + s * d[..., 1], c * d[..., 1] - s * d[..., 0]], dim=-1)


def from_frame(points: Tensor, pose: Tensor) -> Tensor:
    """Points [..., 2] of the frame of pose [..., 3], in the outer frame."""
    c, s = torch.cos(pose[..., 2]), torch.sin(pose[..., 2])
    x = c * points[..., 0] - s * points[..., 1]
    y = s * points[..., 0] + c * points[..., 1]
    return torch.stack([x, y], dim=-1) + pose[..., :2]


def states_to_frame(states: Tensor, pose: Tensor) -> Tensor:
    """States [..., 5] (x, y, sin, cos, speed) seen from pose [..., 3]: position and heading turn, speed stays."""
    c, s = torch.cos(pose[..., 2]), torch.sin(pose[..., 2])
    sine = states[..., 2] * c - states[..., 3] * s
    cosine = states[..., 3] * c + states[..., 2] * s
    heading = torch.stack([sine, cosine], dim=-1)
    return torch.cat([to_frame(states[..., :2], pose), heading, states[..., 4:]], dim=-1)
