"""`model.pt`: a model's configuration and weights, with how they came about; tensors and plain data only."""

from __future__ import annotations

import pickle
import zipfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from hcnaf_export.baselines import build
from hcnaf_export.training.state import replace
from hcnaf_models.config import ModelConfig, from_dict
from hcnaf_models.model import Hcnaf
from hcnaf_models.wide_config import WideConfig
from hcnaf_runtime.errors import CheckpointError

FORMAT = 1
"""Version of the checkpoint format this release reads and writes."""


@dataclass(frozen=True)
class Checkpoint:
    """A trained model.

    Attributes:
        config: what the model is made of.
        model: the model, in evaluation mode, on the CPU.
        training: recipe, data, steps, seconds, seed, versions, machine, date.
        scores: what was measured, by name of the measurement.
    """

    config: ModelConfig
    model: Hcnaf
    training: dict[str, Any]
    scores: dict[str, Any]


def save_checkpoint(
    path: Path,
    config: ModelConfig | WideConfig,
    state: Mapping[str, Tensor],
    training: dict[str, Any],
    scores: dict[str, Any],
) -> None:
    """Write a checkpoint that loads with weights_only; all of it appears, or nothing."""
    content = {
        "producer": "hcnaf",
        "format": FORMAT,
        "config": asdict(config),
        "state": {name: value.detach().cpu().contiguous() for name, value in state.items()},
        "training": training,
        "scores": scores,
    }
    replace(path, content)


def load_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint. Nothing in the file is executed.

    Raises:
        CheckpointError: missing, not a torch file, holding code, not ours, of a future format, or with weights
            that do not fit its configuration.
    """
    content = read_content(Path(path))
    try:
        config = from_dict(content["config"])
        model = _build(config)
        model.load_state_dict(content["state"])
    except (KeyError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        reason = " ".join(str(error).split())[:300]
        raise CheckpointError(f"{path}: weights do not fit the configuration ({reason}); train again") from error
    model.eval().requires_grad_(False)
    return Checkpoint(config, model, dict(content.get("training", {})), dict(content.get("scores", {})))


def read_content(path: Path) -> dict[str, Any]:
    """What `save_checkpoint` wrote, of whatever kind. Raises CheckpointError if that is not what the file is."""
    content: dict[str, Any] = _read(path)
    ours = isinstance(content, dict) and content.get("producer") == "hcnaf"
    if not ours or not isinstance(content.get("config"), dict):
        raise CheckpointError(f"{path} is not a checkpoint of hcnaf train; expected the model.pt of a run")
    if content.get("format") != FORMAT:
        raise CheckpointError(
            f"{path} has checkpoint format {content.get('format')!r}, this release reads {FORMAT}; update hcnaf"
        )
    return content


def _read(path: Path) -> Any:
    if not path.is_file():
        raise CheckpointError(f"{path} does not exist; give the model.pt of a training run")
    if not zipfile.is_zipfile(path):
        raise CheckpointError(f"{path} is not a torch file; give the model.pt of a training run")
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        raise CheckpointError(
            f"{path} holds more than tensors and plain data, which is not loaded; give a model.pt of hcnaf train"
        ) from error
    except (RuntimeError, OSError, EOFError, KeyError, ValueError) as error:
        raise CheckpointError(f"{path} is not a torch file; give the model.pt of a training run") from error


def _build(config: ModelConfig) -> Hcnaf:
    with torch.random.fork_rng(devices=[]):
        return build(config)
