"""Checkpoints: what was saved comes back, and nothing else is believed."""

import pickle

import pytest
import torch

from hcnaf_export.checkpoint import load_checkpoint, save_checkpoint
from hcnaf_models.config import ConditionConfig
from hcnaf_models.model import build
from hcnaf_models.spec import FlowSpec
from hcnaf_runtime.errors import CheckpointError

CONFIG = ConditionConfig(flow=FlowSpec(hidden=6), size=3, names=("a", "b", "c"), hidden=(8,))


class Trap:
    """Runs code when unpickled."""

    def __reduce__(self):
        return (print, ("a checkpoint ran code",))


@pytest.fixture
def saved(tmp_path):
    model = build(CONFIG)
    path = tmp_path / "model.pt"
    save_checkpoint(
        path, CONFIG, model.state_dict(), {"recipe": "none", "steps": 3}, {"validation": {"mean": 1.5}}
    )
    return model, path


def altered(path, **changes):
    content = torch.load(path, weights_only=True)
    torch.save({**content, **changes}, path)
    return content


def test_a_checkpoint_gives_back_the_same_model(saved):
    model, path = saved
    loaded = load_checkpoint(path)
    assert loaded.config == CONFIG
    assert loaded.training == {"recipe": "none", "steps": 3}
    assert loaded.scores == {"validation": {"mean": 1.5}}
    condition = torch.randn(5, 3)
    assert torch.equal(loaded.model.hypernet(condition), model.hypernet(condition))
    assert not loaded.model.training


def test_a_checkpoint_is_tensors_and_plain_data(saved):
    content = torch.load(saved[1], weights_only=True)
    assert content["producer"] == "hcnaf"
    assert content["format"] == 1
    assert isinstance(content["config"], dict)


def test_loading_leaves_the_random_generator_alone(saved):
    before = torch.random.get_rng_state()
    load_checkpoint(saved[1])
    assert torch.equal(before, torch.random.get_rng_state())


def test_a_missing_file(tmp_path):
    with pytest.raises(CheckpointError, match="does not exist"):
        load_checkpoint(tmp_path / "none.pt")


def test_a_file_of_something_else(tmp_path):
    path = tmp_path / "model.pt"
    for content in (b"", b"not a checkpoint", pickle.dumps({"producer": "hcnaf"})):
        path.write_bytes(content)
        with pytest.raises(CheckpointError, match="not a torch file"):
            load_checkpoint(path)


def test_a_damaged_file(saved):
    path = saved[1]
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(CheckpointError, match="not a torch file"):
        load_checkpoint(path)


def test_code_is_not_run(tmp_path, capsys):
    path = tmp_path / "model.pt"
    torch.save({"producer": "hcnaf", "format": 1, "config": Trap()}, path)
    with pytest.raises(CheckpointError, match="more than tensors"):
        load_checkpoint(path)
    assert capsys.readouterr().out == ""


def test_a_checkpoint_of_others(tmp_path):
    path = tmp_path / "model.pt"
    for content in ({"state_dict": {"a": torch.zeros(2)}}, torch.zeros(3), {"producer": "hcnaf"}):
        torch.save(content, path)
        with pytest.raises(CheckpointError, match="not a checkpoint of hcnaf train"):
            load_checkpoint(path)


def test_a_future_format_says_what_is_read(saved):
    altered(saved[1], format=2)
    with pytest.raises(CheckpointError, match=r"format 2.* reads 1"):
        load_checkpoint(saved[1])


def test_weights_of_another_shape_are_one_line(saved):
    content = altered(saved[1])
    altered(saved[1], config={**content["config"], "hidden": [9]})
    with pytest.raises(CheckpointError, match="do not fit") as caught:
        load_checkpoint(saved[1])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("change", [{"depth": 3}, {"kind": "other"}, {"flow": {"hidden": 0}}, {"flow": 3}])
def test_an_unknown_configuration(saved, change):
    content = altered(saved[1])
    altered(saved[1], config={**content["config"], **change})
    with pytest.raises(CheckpointError, match="do not fit"):
        load_checkpoint(saved[1])


def test_a_failed_write_leaves_nothing(tmp_path):
    with pytest.raises((pickle.PicklingError, AttributeError, TypeError)):
        save_checkpoint(tmp_path / "model.pt", CONFIG, {}, {"made": lambda: 0}, {})
    assert list(tmp_path.iterdir()) == []
