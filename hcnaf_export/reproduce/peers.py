"""The flows that the paper compares with, from zuko (extra `bench`): one model per class, as in the paper.

AAF is an affine autoregressive flow: z_d = (x_d - mu_d) / sigma_d with mu_d, sigma_d from x_<d. NAF is a neural
autoregressive flow: a monotonic network per dimension, its signal from x_<d. Both have a single transformation and
the paper's two hidden layers of 64 units.

References:
    Papamakarios et al., Masked autoregressive flow, 2017 (arXiv 1705.07057).
    Huang et al., Neural autoregressive flows, 2018 (arXiv 1804.00779).
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hcnaf_export.data.toys import Toy, even
from hcnaf_runtime.errors import MissingExtraError

Array = NDArray[np.float64]
Kind = Literal["AAF", "NAF"]

KINDS: tuple[Kind, ...] = ("AAF", "NAF")
HIDDEN = (64, 64)
SIGNAL = 16
RATE = 5e-3
"""The paper's learning rate; here it decays with half a cosine."""
SCALE = 3.0
"""Peers work on x / SCALE, as ours does on x over a scale that starts there."""


def check_zuko() -> None:
    """Raise MissingExtraError where it is not installed."""
    if importlib.util.find_spec("zuko") is None:
        raise MissingExtraError(
            'AAF and NAF need zuko, which is not installed; run: pip install "hcnaf[bench]", or leave them out'
        )


@dataclass(frozen=True)
class Peers:
    """One trained flow per condition."""

    models: Sequence[Any]

    @torch.no_grad()
    def log_prob(self, index: int, x: Array) -> Array:
        """log p [N] at points [N, 2] under condition `index`, nats."""
        found: Tensor = self.models[index]().log_prob(torch.from_numpy(x / SCALE).float())
        return found.double().numpy() - 2.0 * math.log(SCALE)


def train_peers(
    kind: Kind, toy: Toy, steps: int, batch: int, seed: int, threads: int, say: Callable[[str], None]
) -> Peers:
    """A model per condition, each trained for so many steps of so many samples of it."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        return Peers([_train(kind, toy, i, steps, batch, seed, say) for i in toy.seen])
    finally:
        torch.set_num_threads(before)


def _train(kind: Kind, toy: Toy, index: int, steps: int, batch: int, seed: int, say: Callable[[str], None]) -> Any:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model = _build(kind)
    optimiser = torch.optim.Adam(model.parameters(), lr=RATE)
    for step in range(steps):
        rate = RATE * min(1.0, (step + 1) / 100) * 0.5 * (1.0 + math.cos(math.pi * step / steps))
        optimiser.param_groups[0]["lr"] = rate
        rng = np.random.default_rng((seed, 4, index, step))
        x = torch.from_numpy(toy.quantiles(index, even(rng, batch)) / SCALE).float()
        loss = -model().log_prob(x).mean()
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimiser.step()
        if step % 100 == 0:
            say(f"{kind}, model {index + 1} of {len(toy.seen)}: step {step}/{steps}")
    return model.eval()


def _build(kind: Kind) -> Any:
    import zuko

    if kind == "AAF":
        return zuko.flows.MAF(2, transforms=1, hidden_features=HIDDEN)
    return zuko.flows.NAF(
        2, transforms=1, signal=SIGNAL, hidden_features=HIDDEN, network={"hidden_features": HIDDEN}
    )
