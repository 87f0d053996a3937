"""HCNAF of the ETH/UCY experiment as it ships: exported, and scored by onnxruntime alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hcnaf_export.data.eth_ucy import Windows, split
from hcnaf_export.experiments.eth_ucy import Plan, cell_folder
from hcnaf_export.export import export_bundle
from hcnaf_export.training.eth_ucy import batches
from hcnaf_runtime.forecaster import Forecaster
from hcnaf_runtime.npz import write_npz
from hcnaf_runtime.scene import Condition

Float = NDArray[np.float64]

FILE = "bundle.npz"


def run_bundle(plan: Plan, split_name: str, seed: int) -> None:
    """Export HCNAF's cell to its folder `bundle` and score that on the split's test windows, unless it is done.

    Raises:
        ParityError: a graph does not agree with PyTorch.
    """
    folder = cell_folder(plan.out, split_name, "hcnaf", seed)
    if (folder / FILE).is_file():
        return
    export_bundle(folder / "model.pt", folder / "bundle", force=True)
    nll = score_bundle(Forecaster(folder / "bundle", threads=plan.threads), split(plan.data, split_name).test)
    write_npz(folder / FILE, {"nll": nll})


def score_bundle(forecaster: Forecaster, windows: Windows) -> Float:
    """NLL of every window and horizon [W, 12] in nats per m²: one condition per window and horizon."""
    parts = []
    for batch in batches(windows):
        B, Q = batch.horizons.shape
        tracks = np.repeat(batch.history.numpy().reshape(B, -1), Q, axis=0)
        condition = Condition(np.concatenate([tracks, batch.horizons.numpy().reshape(-1, 1)], axis=1))
        points = batch.points.numpy().reshape(B * Q, 1, 2)
        parts.append(-forecaster.log_prob(condition, points).reshape(B, Q).astype(np.float64))
    return np.concatenate(parts)


def load_bundle(folder: Path) -> Float:
    """What `run_bundle` found for a cell, [W, 12]."""
    with np.load(folder / FILE, allow_pickle=False) as found:
        return np.asarray(found["nll"])
