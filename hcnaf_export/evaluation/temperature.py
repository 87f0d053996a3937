r"""Temperature: one number that mends a forecast which is too sure of itself, or not sure enough.

    z -> z / c        log p_c(x) = log phi(z / c) + log dz/dx - log c - log(Phi(z(+) / c) - Phi(z(-) / c))

With c > 1 every density is flatter, with its modes where they were. A network that has seen few roads is as sure
of others as of these; c is fitted on roads held out from training, never on those of the test. It goes into the
last layer of the flow: a model with a temperature is a model like any other, and costs no more.

References:
    Guo et al., On calibration of modern neural networks, ICML 2017 (temperature scaling).
"""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from hcnaf_export.checkpoint import Checkpoint
from hcnaf_export.data.tracks import Dataset, Split
from hcnaf_export.evaluation.checkpoint_predictor import CheckpointPredictor
from hcnaf_export.evaluation.regions import denser
from hcnaf_export.evaluation.subset import Part, parts
from hcnaf_models.mlp import Head
from hcnaf_models.spec import FlowSpec
from hcnaf_runtime.errors import CheckpointError

HORIZONS = (1.0, 2.0, 4.0)
"""Seconds ahead at which coverage is set right, on average."""

LEVEL = 0.95
"""The highest-density region that is to hold its share."""

DRAWS = 39
"""Samples a label is ranked among: LEVEL of DRAWS + 1 is whole, so a calibrated model is told exactly."""

RANGE = 0.5, 2.0
STEPS = 8


class Drawn(NamedTuple):
    """Some windows: theta [B, Q, P], labels [B, Q, 1, 2] (m), and what samples are made of [B, Q, n, uniforms]."""

    theta: Tensor
    label: Tensor
    uniform: Tensor


class Fitted(NamedTuple):
    """The temperature, and the share of labels in the LEVEL regions at HORIZONS without and with it."""

    temperature: float
    before: float
    after: float


def fit_temperature(checkpoint: Checkpoint, dataset: Dataset, split: Split = "val", limit: int = 0) -> Fitted:
    """The c at which LEVEL regions hold LEVEL of a held-out split's labels, on about `limit` windows (0: all).

    Raises:
        CheckpointError: not a forecast by HCNAF.
        DataError: a split that is missing or cannot be read.
    """
    predictor, head = CheckpointPredictor(checkpoint), _head(checkpoint)
    drawn = [d for part in parts(dataset.split(split), limit) for d in _drawn(predictor, part)]
    low, high = RANGE
    for _ in range(STEPS):
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if _covered(head, drawn, middle) < LEVEL else (low, middle)
    c = float(np.sqrt(low * high))
    return Fitted(c, _covered(head, drawn, 1.0), _covered(head, drawn, c))


def with_temperature(checkpoint: Checkpoint, c: float) -> Checkpoint:
    """A copy of the checkpoint whose flow gives z / c; its training facts say so, its scores are left out.

    Raises:
        CheckpointError: not a model whose density is HCNAF, or c not above 0.
    """
    if not c > 0.0:
        raise CheckpointError(f"temperature is {c}, expected a number above 0")
    _head(checkpoint)
    changed = replace(checkpoint, model=copy.deepcopy(checkpoint.model), scores={})
    _fold(_head(changed), c)
    before = float(checkpoint.training.get("temperature", 1.0))
    return replace(changed, training={**checkpoint.training, "temperature": before * c})


def tempered(spec: FlowSpec, theta: Tensor, c: float) -> Tensor:
    """theta [..., P] whose last layer is divided by c."""
    last = sum(_sizes(spec))
    return torch.cat([theta[..., :-last], theta[..., -last:] / c], dim=-1)


@torch.no_grad()
def _drawn(predictor: CheckpointPredictor, part: Part) -> list[Drawn]:
    """What coverage is computed from at any temperature."""
    shape = len(HORIZONS), DRAWS
    return [
        Drawn(theta, batch.points, predictor.uniform(some, shape))
        for some, batch, theta in predictor.batches(part.tracks, part.windows, HORIZONS)
    ]


@torch.no_grad()
def _covered(head: Head, drawn: list[Drawn], c: float) -> float:
    """The share of labels in the LEVEL regions of the forecast at temperature c."""
    ranks = []
    for given in drawn:
        theta = tempered(head.spec, given.theta, c)
        at_samples = head.log_prob(theta, head.sample(theta, given.uniform))
        at_labels = head.log_prob(theta, given.label)[..., 0]
        ranks.append(denser(at_samples.cpu().numpy(), at_labels.double().cpu().numpy()))
    return float((np.concatenate(ranks) < round(LEVEL * (DRAWS + 1), 6)).mean())


@torch.no_grad()
def _fold(head: Head, c: float) -> None:
    """Divide what `head` emits for the last layer by c; in place."""
    diagonal, lower, bias = _sizes(head.spec)
    linear, log_c = head.weights, float(np.log(c))
    if head.spec.weight_norm == "none":
        linear.bias[-(diagonal + lower + bias) : -(lower + bias)] -= log_c  # emitted as logarithms
        scaled = slice(-(lower + bias), None)
    else:
        head.emission.log_gains[-1].sub_(log_c)
        scaled = slice(-bias, None)
    linear.weight[scaled] /= c
    linear.bias[scaled] /= c


def _sizes(spec: FlowSpec) -> tuple[int, int, int]:
    """Numbers of the last layer in theta: diagonal blocks, blocks below, biases."""
    diagonal, lower, bias = spec.groups[-3:]
    return diagonal, lower, bias


def _head(checkpoint: Checkpoint) -> Head:
    head = checkpoint.model.head
    if not isinstance(head, Head):
        raise CheckpointError("the model's density is not HCNAF's, only that has a temperature; give another")
    return head
