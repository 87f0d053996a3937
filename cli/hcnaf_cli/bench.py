"""`hcnaf-run bench`: how fast a bundle forecasts on this machine, and in how much memory."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from hcnaf_runtime import Scene
    from hcnaf_runtime.bench import Bench, Row, Serving

_FILE = click.Path(path_type=Path)
_MIB = 1 << 20


@click.command()
@click.argument("bundle", type=_FILE, required=False)
@click.option("--scene", "files", type=_FILE, multiple=True, metavar="SCENE.npz", help="Instead of the samples.")
@click.option(
    "--only", metavar="A,B", help="Sections: hypernet, dense, certified, forecast, points, samples, risk, memory."
)
@click.option(
    "--seconds", type=click.FloatRange(min=0.0, max=600.0), default=1.0, show_default=True, help="Per case."
)
@click.option(
    "--scenes", "count", type=click.IntRange(min=1), default=500, show_default=True, help="Served in `memory`."
)
@click.option("--threads", type=click.IntRange(min=1), help="CPU threads [default: at most 4].")
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of text.")
def bench(
    bundle: Path | None,
    files: tuple[Path, ...],
    only: str | None,
    seconds: float,
    count: int,
    threads: int | None,
    as_json: bool,
) -> None:
    """Time BUNDLE (default: the embedded model) on this machine, which should do nothing else meanwhile.

    Interrupted, it prints what it has.
    """
    from hcnaf_runtime import Forecaster
    from hcnaf_runtime.bench import Bench
    from hcnaf_runtime.measure import machine

    sections = _sections(only)
    forecaster = Forecaster(bundle, threads)
    facts = machine(forecaster.threads) | {"model": forecaster.bundle.manifest.name}
    rows: list[Row] = []
    served: list[Serving] = []
    try:
        _run(Bench(forecaster, _scenes(files), seconds), sections, count, rows, served)
    finally:  # an interrupt too: what was measured is worth having
        _show(facts, rows, served, as_json)


def _run(
    subject: "Bench", sections: tuple[str, ...], count: int, rows: list["Row"], served: list["Serving"]
) -> None:
    from hcnaf_cli.output import talk

    for row in subject.rows(sections):
        rows.append(row)
        talk(f"{row.name}: {_ms(row.latency.median)} ms")
    if "memory" in sections:
        talk(f"memory: serving {count} scenes")
        result = subject.serve(count)
        if result is None:
            talk("note: this system does not tell a process's memory")
        else:
            served.append(result)


def _sections(only: str | None) -> tuple[str, ...]:
    from hcnaf_runtime.bench import SECTIONS
    from hcnaf_runtime.errors import InputError

    asked = SECTIONS if only is None else tuple(part.strip() for part in only.split(","))
    for name in asked:
        if name not in SECTIONS:
            raise InputError(f"no section '{name}' in the benchmark; there are {', '.join(SECTIONS)}")
    return asked


def _scenes(files: tuple[Path, ...]) -> dict[str, "Scene"]:
    from hcnaf_runtime import Scene, embedded_scenes

    paths = {path.stem: path for path in files} if files else embedded_scenes()
    return {name: Scene.load(path) for name, path in paths.items()}


def _show(facts: dict[str, Any], rows: list["Row"], served: list["Serving"], as_json: bool) -> None:
    from hcnaf_cli.output import show_json

    if not rows and not served:
        return
    if as_json:
        show_json(_json(facts, rows, served))
    else:
        click.echo(_text(facts, rows, served))


def _json(facts: dict[str, Any], rows: list["Row"], served: list["Serving"]) -> dict[str, Any]:
    """Seconds and bytes; `memory` is null where it was not measured."""
    cases = [
        {"section": r.section, "name": r.name, "maps": r.maps, "per_map": r.per_map}
        | {"seconds": r.latency.to_dict(), "facts": r.facts}
        for r in rows
    ]
    return {"machine": facts, "cases": cases, "memory": _serving_json(served[0]) if served else None}


def _serving_json(served: "Serving") -> dict[str, Any]:
    return {
        "scenes": served.scenes,
        "before": served.before.resident,
        "peak": served.peak,
        "growth": served.growth,
        "samples": [list(sample) for sample in served.samples],
        "seconds": served.latency.to_dict(),
    }


def _text(facts: dict[str, Any], rows: list["Row"], served: list["Serving"]) -> str:
    from hcnaf_cli.output import table

    parts = [
        f"{facts['model']} on {facts['cpu']}, {facts['threads']} threads of {facts['cores']} cores, "
        f"onnxruntime {facts['onnxruntime']}, numpy {facts['numpy']}, {facts['date']}"
    ]
    if rows:
        head = ["milliseconds ", "calls", "median", "p95", "p99", "max", "p99/median", "per map", "lost mass"]
        parts.append(table(head, [_cells(row) for row in rows]))
    return "\n".join(parts + [_serving_text(one) for one in served])


def _cells(row: "Row") -> list[str]:
    t = row.latency
    lost = f"{row.facts['lost_mass']:.1e}" if "lost_mass" in row.facts else ""
    per_map = f"{row.per_map * 1e3:.3f}" if row.maps > 1 or row.section in ("dense", "certified") else ""
    times = [_ms(s) for s in (t.median, t.p95, t.p99, t.max)]
    return [row.name, str(t.repetitions), *times, f"{t.tail:.2f}", per_map, lost]


def _serving_text(served: "Serving") -> str:
    before, last, peak, growth = (
        b / _MIB for b in (served.before.resident, served.samples[-1][1], served.peak, served.growth)
    )
    return (
        f"memory: {before:.0f} MiB before, {last:.0f} MiB after {served.scenes} scenes of changing size, "
        f"at most {peak:.0f} MiB; the second half took {growth:.1f} MiB more than the first"
    )


def _ms(seconds: float) -> str:
    return f"{seconds * 1e3:.2f}"
