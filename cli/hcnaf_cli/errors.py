"""The one place where errors become a line on stderr and an exit code.

    0    fine
    1    what was asked for was tried and failed (FailedError), or memory ran out
    2    bad usage, bad input, or a file that cannot be read or written
    130  interrupted

Anything else is a bug and keeps its traceback.
"""

import sys
from collections.abc import Sequence
from typing import Any, NoReturn

import click

EXTRAS = {
    "torch": "train",
    "onnx": "train",
    "onnxscript": "train",
    "libsumo": "sim",
    "sumo": "sim",
    "sumolib": "sim",
    "pyarrow": "data",
    "PIL": "data",
    "matplotlib": "plot",
    "zuko": "bench",
}
"""Which extra of the distribution brings a package."""

FAILED, UNUSABLE, INTERRUPTED = 1, 2, 130


class Commands(click.Group):
    """A group of commands whose errors are one line each."""

    def main(
        self,
        args: Sequence[str] | None = None,
        prog_name: str | None = None,
        complete_var: str | None = None,
        standalone_mode: bool = True,
        windows_expand_args: bool = True,
        **extra: Any,
    ) -> NoReturn:
        """Run the command line and exit."""
        name = prog_name or self.name or "hcnaf"
        try:
            code: Any = super().main(
                args, name, complete_var, standalone_mode=False, windows_expand_args=windows_expand_args, **extra
            )
        except Exception as error:
            line, code = explain(error)
            if line:
                click.echo(f"{name}: {line}", err=True)
        sys.exit(code if isinstance(code, int) else 0)


def explain(error: Exception) -> tuple[str, int]:
    """The line and the exit code for an error that a user can do something about. Raises all others again."""
    from hcnaf_runtime.errors import FailedError, HcnafError

    if isinstance(error, HcnafError):
        return one_line(str(error)), FAILED if isinstance(error, FailedError) else UNUSABLE
    if isinstance(error, click.ClickException):
        return _usage(error), error.exit_code
    if isinstance(error, click.Abort):
        return "interrupted", INTERRUPTED
    if isinstance(error, ModuleNotFoundError) and (line := _missing(error)):
        return line, UNUSABLE
    if isinstance(error, MemoryError):
        return "out of memory; ask for fewer or coarser maps, or fewer agents", FAILED
    if isinstance(error, OSError):
        place = f"{error.filename}: " if error.filename else ""
        return one_line(f"{place}{error.strerror or error}"), UNUSABLE
    raise error


def one_line(text: str) -> str:
    """`text` without line breaks."""
    return " ".join(text.split())


def _usage(error: click.ClickException) -> str:
    context = getattr(error, "ctx", None)
    if context is None:
        return one_line(error.format_message())
    if type(error).__name__ == "NoArgsIsHelpError":  # click 8.2 and later; its message is the whole help text
        error.show()
        return ""
    return f"{one_line(error.format_message()).rstrip('.')}; see `{context.command_path} --help`"


def _missing(error: ModuleNotFoundError) -> str:
    package = (error.name or "").split(".")[0]
    extra = EXTRAS.get(package)
    return f'this needs {package}, which is not installed; run: pip install "hcnaf[{extra}]"' if extra else ""
