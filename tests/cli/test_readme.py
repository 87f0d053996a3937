"""What the README tells people to type is what the commands take."""

import re
import shlex
from pathlib import Path

import click
import pytest

from hcnaf_cli.run import main as hcnaf_run
from hcnaf_cli.train import main as hcnaf

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
GROUPS = {"hcnaf": hcnaf, "hcnaf-run": hcnaf_run}


def _typed():
    """Every line of a shell block that runs one of ours, from the command's name on."""
    blocks = re.findall(r"```sh\n(.*?)```", README, re.DOTALL)
    parts = [part.strip() for block in blocks for line in block.splitlines() for part in line.split("&&")]
    return [re.sub(r"^\S*/bin/", "", part) for part in parts if re.match(r"(\S*/bin/)?hcnaf(-run)? ", part)]


@pytest.mark.parametrize("line", _typed())
def test_the_line_parses(line):
    name, *args = shlex.split(line, comments=True)
    command = GROUPS[name]
    while isinstance(command, click.Group):
        name, *args = args
        command = command.commands[name]
    assert command.make_context(name, args).command is command


def test_two_commands_need_nothing_else():
    found = re.findall(r"^python3\.11 -m venv .*$", README, re.MULTILINE)
    assert len(found) == 2
    assert "forecast --sample --plot" in found[0]
    assert found[1].endswith("pytest")
    assert all("-c constraints.txt" in line for line in found)
    assert "^python3" in (ROOT / ".ci" / "run").read_text(encoding="utf-8")


def test_the_python_examples_run(embedded, scene_path, tmp_path, monkeypatch):
    examples = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert len(examples) == 2
    scene_path.rename(tmp_path / "scene.npz")
    monkeypatch.chdir(tmp_path)
    names = {}
    for example in examples:
        exec(example, names)
    assert names["maps"].mass.shape == (2, 3, 200, 200)
    assert names["log_p"].shape == (2, 3, 1)
    assert names["paths"].points.shape == (2, 3, 100, 2)
    assert names["anybody"].probability.shape == (3, 200, 200)
    assert names["risk"].per_step.shape == (1, 3)


def test_links_lead_somewhere():
    targets = re.findall(r"\]\(([^)#]+)\)", README)
    local = [target for target in targets if "://" not in target]
    assert [target for target in local if not (ROOT / target).exists()] == []
