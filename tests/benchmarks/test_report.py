"""Tables say met only of what was measured and is within its limit, and leave the rest of a page alone."""

import pytest

from tests.benchmarks import report
from tests.benchmarks.targets import TARGETS, Target


def _latency(median):
    return {"repetitions": 10, "median": median, "p95": median, "p99": median * 1.2, "max": 1.0, "tail": 1.2}


def _peer(median, ours=1e-3):
    return _latency(median) | {"ours": ours}


def _maps(per_map):
    return {"dense x20": _latency(20 * per_map), "certified x20": _latency(per_map), "maps": 20, "lost_mass": 1e-5}


POINTS = {"cells": 10_000.0, "meshes": 1_000.0, "checks": 0.0, "F_1": 1_000.0}


@pytest.fixture
def results():
    """One millisecond per map, peers 2, 70 and 2000 times slower."""
    names = ("zuko NSF (3 transforms)", "zuko MAF (3 transforms)", "nflows NSF (3 transforms)")
    return {
        "machine": dict.fromkeys(("onnxruntime", "numpy", "torch", "zuko", "nflows", "openvino", "date"), "1")
        | {"cpu": "a CPU", "threads": 2, "cores": 2},
        "rates": {"gemm": {"20": {"a": 1e11, "b": 1.6e11}, "100": {"a": 2.5e11}}, "tanh": 6e9},
        "dense": {
            f"H={H} wide": _maps(1e-3)
            | {"occupied": 0.5, "evaluations": POINTS, "errors": {"cell": 1e-6, "map": 1e-4}}
            for H in (20, 100)
        },
        "published": {f"H={H}": {"log-sum-exp, eager": _peer(2.0), "agreement": 1e-5} for H in (20, 100)},
        "libraries": {name: _peer(0.002) for name in names}
        | {"nflows MAF (3 transforms)": {"absent": "nflows"}, "zuko NAF (1 transform)": _peer(0.035, 0.0005)},
    }


def _row(results, name):
    (row,) = (t.row(results) for t in TARGETS if t.name == name)
    return row


@pytest.mark.parametrize(
    ("name", "found", "met"),
    [
        ("dense exact map, L=3 H=20", 1.0, True),
        ("against eager log-sum-exp, H=100", 2000.0, True),
        ("against zuko NAF(64)", 70.0, True),
        ("against the fastest of NSF, MAF, nflows", 2.0, False),
        ("resident memory while serving", None, None),
    ],
)
def test_a_target_is_met_missed_or_not_measured(results, name, found, met):
    row = _row(results, name)
    assert row["met"] is met
    assert row["found"] == (None if found is None else pytest.approx(found))


def test_the_limit_itself_is_met_from_either_side():
    for least in (True, False):
        target = Target("x", "", 5.0, "-", lambda r: r["x"], least)
        assert [target.row({"x": x})["met"] for x in (4.0, 5.0, 6.0)] == [not least, True, least]
        assert target.row({})["met"] is None


def test_the_floor_uses_the_best_rate(results):
    row = report.floors(results).splitlines()[2].split(" | ")
    assert row[6] == "160"
    assert float(row[8]) == pytest.approx(0.81, abs=0.01)


def test_what_is_evaluated_has_a_floor_of_its_own(results):
    row = report.floors(results).splitlines()[-2].split(" | ")
    assert row[0] == "| H=20 wide"
    assert float(row[5]) == pytest.approx(1e3 * 12_000 * (1600 / 1.6e11 + 60 / 6e9), abs=0.01)
    assert float(row[7].split()[0]) == pytest.approx(1.0 / 0.24, abs=0.1)
    assert "evaluated" not in report.floors({"rates": results["rates"]})


def test_markdown_has_the_sections_that_were_measured(results):
    text = report.markdown(results)
    assert "## PyTorch at the 40,000 cell centres" in text
    assert "not installed" in text
    assert "## Memory" not in text
    assert all(len({line.count("|") for line in t.splitlines()}) == 1 for t in text.split("\n\n") if t[:1] == "|")


def test_splicing_replaces_only_what_is_between_the_markers(results, tmp_path):
    page = tmp_path / "performance.md"
    page.write_text(f"before\n\n{report.BEGIN}\nold\n{report.END}\n\nafter\n")
    report.splice(page, results)
    first = page.read_text()
    assert first.startswith("before\n\n" + report.BEGIN)
    assert first.endswith(report.END + "\n\nafter\n")
    assert "old" not in first
    report.splice(page, results)
    assert page.read_text() == first
