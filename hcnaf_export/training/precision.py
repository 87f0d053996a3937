"""Mixed precision: the networks that read the scene in 16 bits, everything that makes the density in 32.

    scene ─ geometry (float32) ─> encoders, trunk (16 bits) ─> head ─> theta ─> flow ─> log p    (float32)

What is lowered are the parts of the hyper-network beside its head, each under `torch.autocast` with its output
brought back to float32. Positions in metres, theta and the flow never see 16 bits: bfloat16 would put a location
60 m away off by up to 0.125 m. Weights, gradients and the optimiser are float32 throughout.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Literal

import torch
from torch import Tensor, nn

from hcnaf_runtime.errors import RecipeError

PrecisionName = Literal["float32", "bfloat16", "float16"]


def check_precision(name: PrecisionName, device: torch.device) -> None:
    """Raise RecipeError for 16 bits on a device that is no CUDA device."""
    if name != "float32" and device.type != "cuda":
        raise RecipeError(
            f"optimiser.precision is {name!r}, which is for CUDA devices, and the device is {device}; train with "
            "--device cuda, or set it to float32"
        )


class Precision:
    """What the loop asks of a precision; with float32 all of it is as without.

    `float16` has a narrow range, so its losses are multiplied before the derivative is taken
    (`torch.amp.GradScaler`). Steps whose gradients overflow are left out and lower the factor.
    """

    def __init__(self, name: PrecisionName, device: torch.device) -> None:
        self.device = device
        self.dtype: torch.dtype = getattr(torch, name)
        self._scaler = torch.amp.GradScaler(device.type, enabled=name == "float16")

    @contextmanager
    def lowered(self, model: nn.Module) -> Iterator[None]:
        """The parts of `model.hypernet` beside its head compute in 16 bits inside the block."""
        parts = [] if self.dtype == torch.float32 else _encoders(model)
        for part in parts:
            setattr(part, "forward", self._lower(part.forward))  # noqa: B010  (a method, to mypy)
        try:
            yield
        finally:
            for part in parts:
                delattr(part, "forward")  # the class's own again

    def _lower(self, forward: Callable[..., Tensor]) -> Callable[..., Tensor]:
        def lowered(*inputs: Any) -> Tensor:
            with torch.autocast(self.device.type, self.dtype):
                out = forward(*inputs)
            return out.float()

        return lowered

    def backward(self, loss: Tensor, optimiser: torch.optim.Optimizer) -> None:
        """Gradients of the loss, in its own scale."""
        self._scaler.scale(loss).backward()  # type: ignore[no-untyped-call]
        self._scaler.unscale_(optimiser)

    def step(self, optimiser: torch.optim.Optimizer, good: bool) -> None:
        """A step of the optimiser, unless the gradients are no good."""
        if good:
            self._scaler.step(optimiser)
        if self._scaler.is_enabled():
            self._scaler.update()

    @property
    def state(self) -> dict[str, Any]:
        """What a run needs to go on: the factor; empty where there is none."""
        return self._scaler.state_dict()

    @state.setter
    def state(self, state: dict[str, Any]) -> None:
        if state and self._scaler.is_enabled():
            self._scaler.load_state_dict(state)


def _encoders(model: nn.Module) -> list[nn.Module]:
    hypernet = model.get_submodule("hypernet")
    return [part for name, part in hypernet.named_children() if name != "head"]
