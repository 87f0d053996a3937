"""Bundles that take long to make, once per session. Tests that need a variant of one copy its graphs."""

from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

from hcnaf_export.checkpoint import save_checkpoint
from hcnaf_export.export import ExportResult, export_bundle
from hcnaf_models.config import ConditionConfig, Crop, ModelConfig, PomConfig
from hcnaf_models.model import Hcnaf, build
from hcnaf_models.spec import FlowSpec

POM = PomConfig(
    flow=FlowSpec(layers=2, hidden=20, weight_norm="row"),
    actors="history",
    stops=True,
    channels=("drivable", "direction_x", "direction_y"),
    crop=Crop(behind=8.0, ahead=24.0, side=8.0, resolution=1.0),
    widths=(6, 8),
    trunk=(24, 16),
)
LINE = ConditionConfig(flow=FlowSpec(dims=1, layers=1, hidden=8), size=2, hidden=(8,))
SPACE = ConditionConfig(
    flow=FlowSpec(dims=3, layers=2, hidden=6, support="paper", weight_norm="frobenius"),
    size=3,
    names=("a", "b", "c"),
    hidden=(16,),
)
TRAINING = {"recipe": "none", "seed": 3, "optional_channels": ["direction_y", "drivable", "elsewhere"]}
SCORES = {"validation": {"0.5 s": 1.25, "1 s": 2.5}, "test": {"0.5 s": 1.5, "1 s": float("nan")}, "floor": 0.5}


@dataclass(frozen=True)
class Exported:
    """A checkpoint and the bundle made of it."""

    model: Hcnaf
    checkpoint: Path
    result: ExportResult
    steps: list[tuple[str, int, int]]

    @property
    def path(self) -> Path:
        return self.result.path


def fresh_model(config: ModelConfig, seed: int = 0) -> Hcnaf:
    """A random model whose theta depends on its condition (heads start at zero) and whose norms do something."""
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        torch.manual_seed(seed)
        model = build(config)
        for linear in (model.hypernet.head.weights, model.hypernet.head.units):
            linear.weight.normal_(0.0, 0.2)
        for module in model.modules():
            if isinstance(module, torch.nn.BatchNorm2d):
                module.running_mean.normal_(0.0, 0.1)
                module.running_var.uniform_(0.5, 2.0)
    return model.eval()


def _export(config: ModelConfig, folder: Path) -> Exported:
    model = fresh_model(config)
    checkpoint = folder / "model.pt"
    save_checkpoint(checkpoint, config, model.state_dict(), TRAINING, SCORES)
    steps: list[tuple[str, int, int]] = []
    result = export_bundle(checkpoint, folder / "made" / "bundle", progress=lambda *step: steps.append(step))
    return Exported(model, checkpoint, result, steps)


@pytest.fixture(scope="session")
def pom(tmp_path_factory):
    return _export(POM, tmp_path_factory.mktemp("pom"))


@pytest.fixture(scope="session")
def line(tmp_path_factory):
    return _export(LINE, tmp_path_factory.mktemp("line"))


@pytest.fixture(scope="session")
def space(tmp_path_factory):
    return _export(SPACE, tmp_path_factory.mktemp("space"))
