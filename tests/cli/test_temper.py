"""`hcnaf temper`: from a checkpoint to one that is as sure of itself as it may be."""

import json

import pytest

pytest.importorskip("torch")

import torch

from hcnaf_export.checkpoint import load_checkpoint, save_checkpoint
from hcnaf_export.recipe import read_recipe
from hcnaf_models.config import ConditionConfig
from hcnaf_models.model import build
from tests.export import synthetic


@pytest.fixture
def checkpoint(tmp_path):
    def write(config):
        with torch.random.fork_rng():
            torch.manual_seed(0)
            state = build(config).state_dict()
        save_checkpoint(tmp_path / "model.pt", config, state, {"task": "pom"}, {"old": 1.0})
        return tmp_path / "model.pt"

    return write


def test_the_temperature_is_in_the_checkpoint_that_is_written(train, checkpoint, tmp_path):
    data = synthetic.write(tmp_path / "set")
    model, out = checkpoint(read_recipe("pom-tiny").model), tmp_path / "tempered.pt"
    result = train("temper", "--ckpt", model, "--data", data, "-o", out, "--limit", 8, "--threads", 1, "--json")
    assert result.exit_code == 0, result.output
    found, written = json.loads(result.stdout), load_checkpoint(out)
    assert 0.5 <= found["temperature"] <= 2.0
    assert written.training["temperature"] == found["temperature"]
    assert written.scores == {}
    assert load_checkpoint(model).scores == {"old": 1.0}


def test_a_model_of_conditions_is_refused(train, checkpoint, tmp_path):
    data = synthetic.write(tmp_path / "set")
    model = checkpoint(ConditionConfig(size=2))
    result = train("temper", "--ckpt", model, "--data", data, "-o", tmp_path / "tempered.pt")
    assert result.exit_code == 2
    assert "kind condition" in result.stderr
    assert not (tmp_path / "tempered.pt").exists()
