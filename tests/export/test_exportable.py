"""Models of tracks ship as bundles of a condition; baselines do not ship."""

import numpy as np
import pytest
import torch

from hcnaf_export.baselines import build
from hcnaf_export.checkpoint import Checkpoint
from hcnaf_export.data.eth_ucy import Windows
from hcnaf_export.experiments.eth_ucy_bundle import score_bundle
from hcnaf_export.exportable import exportable, track_condition
from hcnaf_export.graphs import graphs
from hcnaf_export.onnx_file import write_onnx
from hcnaf_export.parity import open_graph
from hcnaf_export.training.eth_ucy import score
from hcnaf_models.config import ConditionConfig, HistoryConfig
from hcnaf_models.spec import FlowSpec
from hcnaf_runtime.errors import CheckpointError

CONFIG = HistoryConfig(flow=FlowSpec(layers=1, hidden=4), trunk=(16,), rank=8)


def trained() -> torch.nn.Module:
    torch.manual_seed(0)
    model = build(CONFIG).eval().requires_grad_(False)
    for p in model.parameters():
        p.add_(0.05 * torch.randn_like(p))
    return model


def test_a_condition_is_a_track_and_a_horizon():
    model = trained()
    found = exportable(Checkpoint(CONFIG, model, {}, {}))
    assert isinstance(found.config, ConditionConfig)
    condition = torch.tensor(found.config.examples)
    expected = model.hypernet(condition[:, :-1].reshape(-1, 8, 2), condition[:, -1:])
    torch.testing.assert_close(found.model.hypernet(condition), expected)
    assert track_condition(CONFIG).names[:3] == ("x1", "y1", "x2")


def test_baselines_are_refused():
    config = HistoryConfig(head="mixture")
    with pytest.raises(CheckpointError, match=r"'mixture', a baseline; only hcnaf"):
        exportable(Checkpoint(config, build(config), {}, {}))


def test_the_graph_is_the_hyper_network(tmp_path):
    found = exportable(Checkpoint(CONFIG, trained(), {}, {}))
    graph = graphs(found.model)[0]
    write_onnx(graph, tmp_path / graph.file, {})
    condition = np.array(found.config.examples, np.float32)
    (theta,) = open_graph(graph, tmp_path).run(["theta"], {"condition": condition})
    expected = found.model.hypernet(torch.from_numpy(condition)).numpy()
    np.testing.assert_allclose(theta, expected, atol=1e-4, rtol=1e-4)


def test_a_bundle_is_scored_on_the_same_labels_as_a_checkpoint():
    model = trained()
    condition_model = exportable(Checkpoint(CONFIG, model, {}, {})).model

    class Forecasts:
        def log_prob(self, condition, points):
            theta = condition_model.hypernet(torch.from_numpy(condition.values.copy()))
            return condition_model.log_prob(theta, torch.from_numpy(points).unsqueeze(1)).numpy()

    rng = np.random.default_rng(0)
    step = 0.4 * rng.normal(size=(9, 1, 2)) + 0.05 * rng.normal(size=(9, 20, 2))
    track = np.cumsum(step, axis=1).astype(np.float32)
    number = np.arange(9)
    windows = Windows(history=track[:, :8], future=track[:, 8:], scene=number, pedestrian=number, frame=number)
    np.testing.assert_allclose(score_bundle(Forecasts(), windows), score(model, windows), atol=2e-4, rtol=1e-4)
