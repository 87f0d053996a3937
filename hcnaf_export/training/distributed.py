"""Several processes train one model: torchrun starts them, DistributedDataParallel joins their gradients.

    torchrun ──environment──> team(device) ──Team──> Loop
                                   every process: its share of each batch, the same step of the optimiser
                                   the leader (rank 0): validation, average, journal, checkpoints, progress

What all must decide alike (is a step good, how much time is spent, was there an interrupt) is agreed on at every
step.
"""

from __future__ import annotations

import datetime
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from hcnaf_export.training.norms import share_norms
from hcnaf_export.training.share import Share
from hcnaf_runtime.errors import RecipeError

T = TypeVar("T")

PATIENCE = datetime.timedelta(hours=1)
"""How long processes wait for one another: a validation is the leader's alone."""

_CPU = torch.device("cpu")


@dataclass(frozen=True)
class Team:
    """The processes of a run, seen from one of them; alone unless torchrun says otherwise.

    Attributes:
        rank: this process, from 0; the leader is 0. size: of how many.
        device: where this process computes.
    """

    rank: int = 0
    size: int = 1
    device: torch.device = _CPU

    @property
    def leads(self) -> bool:
        """Whether this process validates, writes and reports."""
        return self.rank == 0

    @property
    def share(self) -> Share:
        """The part of every batch that is this process's."""
        return Share(self.rank, self.size)

    @property
    def facts(self) -> dict[str, Any]:
        """What a model card says about it."""
        return {"processes": self.size} if self.size > 1 else {}

    def objective(self, model: nn.Module, loss: Callable[[Any, Any], Tensor]) -> Callable[[Any], Tensor]:
        """loss(model, batch) as a function of this process's part of a batch.

        Its derivative is the mean over processes, and batch norms inside `model` become those of all parts.
        """
        if self.size == 1:
            return lambda batch: loss(model, batch)
        share_norms(model, self.device)
        return DistributedDataParallel(_Objective(model, loss))

    def mean(self, value: Tensor) -> float:
        """The mean over processes of a number; not finite anywhere, not finite everywhere."""
        value = value.detach()
        if self.size > 1:
            value = value.double()
            dist.all_reduce(value)
            value /= self.size
        return float(value)

    def agree(self, seconds: float, stop: bool) -> tuple[float, bool]:
        """The leader's seconds, and whether any process wants to stop."""
        if self.size == 1:
            return seconds, stop
        both = torch.tensor([seconds if self.leads else 0.0, float(stop)], dtype=torch.float64).to(self.device)
        dist.all_reduce(both)
        return float(both[0]), bool(both[1] > 0.0)

    def lead(self, action: Callable[[], T]) -> T:
        """Have the leader do something that the others wait for. All get its result, or raise what it raised."""
        if self.size == 1:
            return action()
        outcome: list[Any] = [None, None]
        if self.leads:
            try:
                outcome[0] = action()
            except Exception as error:
                outcome[1] = error
        dist.broadcast_object_list(outcome, src=0, device=self.device)
        if outcome[1] is not None:
            raise outcome[1]
        result: T = outcome[0]
        return result


SOLO = Team()


class _Objective(nn.Module):
    """A loss as a module's forward pass, which is what DistributedDataParallel takes."""

    def __init__(self, model: nn.Module, loss: Callable[[Any, Any], Tensor]) -> None:
        super().__init__()
        self.model, self.loss = model, loss

    def forward(self, batch: Any) -> Tensor:
        return self.loss(self.model, batch)


def leads() -> bool:
    """Whether this process is the one that talks; without torchrun there is no other."""
    return os.environ.get("RANK", "0") == "0"


@contextmanager
def team(device: torch.device) -> Iterator[Team]:
    """The team that torchrun's environment describes, joined for the time of the block; alone without torchrun.

    On CPUs processes talk through gloo, on GPUs through nccl; each takes the GPU of its local rank. Random numbers
    that torch draws inside (dropout) differ between processes. A default process group that is there already is
    used and left: who trains several times under one torchrun makes it beforehand.

    Raises:
        RecipeError: a GPU that was chosen by number, or fewer GPUs than processes on this host.
    """
    size = int(os.environ.get("WORLD_SIZE", "1"))
    if size == 1:
        yield Team(device=device)
        return
    rank, place = int(os.environ["RANK"]), _own(device)
    on_gpu = place.type == "cuda"
    with (
        torch.cuda.device(place) if on_gpu else nullcontext(),
        _group(place),
        torch.random.fork_rng(devices=[place] if on_gpu else []),
    ):
        torch.manual_seed(rank)
        yield Team(rank, size, place)


@contextmanager
def _group(place: torch.device) -> Iterator[None]:
    if dist.is_initialized():
        yield
        return
    on_gpu = place.type == "cuda"
    dist.init_process_group("nccl" if on_gpu else "gloo", timeout=PATIENCE, device_id=place if on_gpu else None)
    try:
        yield
    finally:
        dist.destroy_process_group()


def _own(device: torch.device) -> torch.device:
    """The device of this process."""
    if device.type != "cuda":
        return device
    local = int(os.environ["LOCAL_RANK"])
    if device.index is not None:
        raise RecipeError(f"device is {device}, but each process takes a GPU of its own; give --device cuda")
    if local >= torch.cuda.device_count():
        raise RecipeError(
            f"process {local} of this host has no GPU, there are {torch.cuda.device_count()}; "
            "lower --nproc-per-node"
        )
    return torch.device("cuda", local)
