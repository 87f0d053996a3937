import errno
import os
import subprocess
import sys

import click
import pytest
from click.testing import CliRunner

from hcnaf_cli.errors import EXTRAS, Commands
from hcnaf_cli.output import check_target, duration, table, writing
from hcnaf_runtime import errors


def _classes(base):
    return [base, *(c for child in base.__subclasses__() for c in _classes(child))]


def _fail(error):
    @click.group(cls=Commands)
    def main():
        pass

    @main.command()
    def work():
        raise error

    return CliRunner().invoke(main, ["work"], prog_name="hcnaf")


@pytest.mark.parametrize("kind", _classes(errors.InputError))
def test_bad_input_is_2(kind):
    result = _fail(kind("found this,\nexpected that"))
    assert (result.exit_code, result.stderr) == (2, "hcnaf: found this, expected that\n")


@pytest.mark.parametrize("kind", _classes(errors.FailedError))
def test_failure_is_1(kind):
    result = _fail(kind("it did not"))
    assert (result.exit_code, result.stderr) == (1, "hcnaf: it did not\n")


@pytest.mark.parametrize(("package", "extra"), EXTRAS.items())
def test_a_missing_package_names_the_extra(package, extra):
    result = _fail(ModuleNotFoundError("No module", name=f"{package}.part"))
    assert result.exit_code == 2
    assert f'pip install "hcnaf[{extra}]"' in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_interrupt_is_130():
    result = _fail(KeyboardInterrupt())
    assert result.exit_code == 130
    assert result.stderr.split() == ["hcnaf:", "interrupted"]


def test_a_full_disk_is_2():
    result = _fail(OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "model.pt"))
    assert (result.exit_code, result.stderr) == (2, f"hcnaf: model.pt: {os.strerror(errno.ENOSPC)}\n")


def test_no_memory_is_1():
    assert _fail(MemoryError()).exit_code == 1


def test_a_bug_keeps_its_traceback():
    result = _fail(ZeroDivisionError("a bug"))
    assert isinstance(result.exception, ZeroDivisionError)


def test_a_full_disk_names_the_target(tmp_path):
    with (
        pytest.raises(errors.InputError, match=r"out.npz: cannot be written \(No space"),
        writing(tmp_path / "out.npz"),
    ):
        raise OSError(errno.ENOSPC, "No space left on device", "/tmp/.out.npz.x1")


def test_targets(tmp_path):
    check_target(None)
    check_target(tmp_path / "new.npz")
    with pytest.raises(errors.InputError, match="no directory"):
        check_target(tmp_path / "none" / "new.npz")


def test_table_columns_line_up():
    assert table(["name ", "n"], [["a", "1"], ["bcd", "100"]]) == "name    n\na       1\nbcd   100"


@pytest.mark.parametrize(
    ("seconds", "text"), [(4.4, "4 s"), (65, "1 min 05 s"), (7260, "2 h 01 min"), (float("inf"), "?")]
)
def test_duration(seconds, text):
    assert duration(seconds) == text


_BLOCKED = """
import sys
for name in {blocked!r}:
    sys.modules[name] = None
from {module} import main
try:
    main({args!r}, prog_name="hcnaf")
except SystemExit as e:
    heavy = {{"torch", "onnx", "matplotlib"}} & {{n for n, m in sys.modules.items() if m is not None}}
    print("heavy", sorted(heavy))
    sys.exit(e.code)
"""


def _python(module, args, blocked=()):
    code = _BLOCKED.format(module=module, args=[str(a) for a in args], blocked=blocked)
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)


@pytest.mark.parametrize(
    "args",
    [
        ("train", "toy1", "--out", "run"),
        ("export", "--ckpt", "model.pt", "-o", "bundle"),
        ("evaluate", "--ckpt", "model.pt", "--data", "data"),
    ],
    ids=lambda args: args[0],
)
def test_without_the_extra_train(args, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = _python("hcnaf_cli.train", args, ("torch", "onnx", "onnxscript"))
    assert result.returncode == 2, result.stderr
    assert 'pip install "hcnaf[train]"' in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_without_the_extra_plot(bundle, scene_path, tmp_path):
    args = ("forecast", scene_path, "--model", bundle, "--plot", tmp_path / "out.png")
    result = _python("hcnaf_cli.run", args, ("matplotlib",))
    assert result.returncode == 2
    assert 'pip install "hcnaf[plot]"' in result.stderr


def test_a_forecast_imports_neither_torch_nor_matplotlib(bundle, scene_path):
    result = _python("hcnaf_cli.run", ("forecast", scene_path, "--model", bundle, "--grid", "20x20@1"))
    assert result.returncode == 0, result.stderr
    assert result.stdout.endswith("heavy []\n")


def test_a_closed_pipe_is_quiet(bundle, scene_path):
    code = "from hcnaf_cli.run import main; main()"
    args = [sys.executable, "-c", code, "forecast", str(scene_path), "--model", str(bundle), "--json"]
    process = subprocess.Popen(args, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    process.stdout.close()
    said = process.stderr.read()
    process.stderr.close()
    process.wait(timeout=60)
    assert "Traceback" not in said
    assert "Broken" not in said
