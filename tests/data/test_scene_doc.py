"""docs/scene.md: the code block runs as printed, and the tables say what the code does."""

import re
from dataclasses import fields
from pathlib import Path

import numpy as np

from hcnaf_export.data.argoverse2 import OBJECTS
from hcnaf_export.data.precog import LIDAR_CHANNELS
from hcnaf_export.data.raster import MAP_CHANNELS
from hcnaf_runtime.scene import Scene

DOC = (Path(__file__).parents[2] / "docs" / "scene.md").read_text(encoding="utf-8")


def test_code_block_writes_a_scene_that_loads(tmp_path, monkeypatch):
    (block,) = re.findall(r"```python\n(.*?)```", DOC, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    exec(compile(block, "docs/scene.md", "exec"), {})
    scene = Scene.load(tmp_path / "scene.npz")
    assert scene.past.shape == (2, 10, 5)
    np.testing.assert_allclose(scene.past[0, :, 0], 0.8 * np.arange(-9, 1), atol=1e-6)
    assert np.isnan(scene.past[1, :4]).all()
    assert np.isfinite(scene.past[1, 4:]).all()
    np.testing.assert_allclose(scene.pose, [[0.0, 0.0, 0.0]], atol=1e-6)


def test_field_table_names_every_field():
    rows = re.findall(r"^\| \*?`(\w+)`\*? \| (?:u?int|float|C names|text)", DOC, re.MULTILINE)
    assert set(rows) == {field.name for field in fields(Scene)}


def test_channel_names_are_ours():
    for name in (*MAP_CHANNELS, *LIDAR_CHANNELS):
        assert f"`{name}`" in DOC


def test_size_table_is_the_converters():
    table = DOC[DOC.index("| object type |") :]
    for name, (kind, (length, width)) in OBJECTS.items():
        (row,) = [line for line in table.splitlines() if re.search(rf"\b{name}\b", line.split("|")[1])]
        assert [cell.strip() for cell in row.split("|")[2:4]] == [kind, f"{length} x {width}"]
