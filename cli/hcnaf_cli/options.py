"""Options that commands of `hcnaf-run` have in common."""

from pathlib import Path

import click

FILE = click.Path(path_type=Path)

scene = click.argument("scene", type=FILE, required=False)
sample = click.option(
    "--sample",
    is_flag=False,
    flag_value="*",
    metavar="[NAME]",
    help="A scene that comes with the package: the first, or the one of that name.",
)
model = click.option("--model", type=FILE, metavar="BUNDLE", help="Bundle directory [default: the embedded one].")
horizons = click.option("--horizons", metavar="1,2,4", help="Seconds ahead [default: every whole second].")
frame = click.option("--frame", type=click.Choice(["agent", "scene"]), default="agent", show_default=True)
exclude = click.option("--exclude", metavar="0,3", help="Agents to leave out, such as the own vehicle.")
threads = click.option("--threads", type=click.IntRange(min=1), help="CPU threads [default: at most 4].")
as_json = click.option("--json", "as_json", is_flag=True, help="Print JSON instead of text.")
