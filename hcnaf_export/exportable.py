"""Checkpoints as exports see them: what has no graphs is refused, a track's model becomes one of a condition."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hcnaf_export.checkpoint import Checkpoint
from hcnaf_models.config import ConditionConfig, HistoryConfig
from hcnaf_models.history import HistoryHyperNet, TrackCondition
from hcnaf_models.model import build
from hcnaf_runtime.errors import CheckpointError


def exportable(loaded: Checkpoint) -> Checkpoint:
    """The checkpoint, fit for graphs.

    A model of tracks becomes one of a condition x_1, y_1, .., x_T, y_T, t; theta stays in the frame of the track
    (origin at its last position, x along its last displacement), which is not the frame of the condition.

    Raises:
        CheckpointError: the head is a baseline.
    """
    config = loaded.config
    head = getattr(config, "head", "hcnaf")
    if head != "hcnaf":
        raise CheckpointError(f"the checkpoint's head is {head!r}, a baseline; only hcnaf can be exported")
    if not isinstance(config, HistoryConfig):
        return loaded
    condition = track_condition(config)
    model, hypernet = build(condition), loaded.model.hypernet
    assert isinstance(hypernet, HistoryHyperNet)
    model.hypernet = TrackCondition(hypernet)
    return replace(loaded, config=condition, model=model.eval().requires_grad_(False))


def track_condition(config: HistoryConfig) -> ConditionConfig:
    """A track and a horizon as a condition, with examples: standing, walking, speeding up, turning."""
    T, step = config.history, config.step
    names = [f"{axis}{row}" for row in range(1, T + 1) for axis in "xy"]
    back = (np.arange(T) - T + 1.0) * step
    wobble = 0.01 * np.random.default_rng(0).normal(size=(4, T, 2))
    paths = [
        np.stack([0.0 * back, 0.0 * back], axis=-1),
        np.stack([1.2 * back, 0.1 * back], axis=-1),
        np.stack([0.8 * back + 0.1 * back**2, -0.3 * back], axis=-1),
        np.stack([1.5 * np.sin(0.4 * back) / 0.4, 1.5 * (1.0 - np.cos(0.4 * back)) / 0.4], axis=-1),
    ]
    examples = [
        (*(float(v) for v in (path + noise).ravel()), t * config.horizon)
        for path, noise in zip(paths, wobble, strict=True)
        for t in (1.0 / 12.0, 0.5, 1.0)
    ]
    return ConditionConfig(flow=config.flow, size=2 * T + 1, names=(*names, "t"), examples=tuple(examples))
