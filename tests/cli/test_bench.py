"""`hcnaf-run bench`: what it prints, and what it refuses."""

import json

import pytest

from hcnaf_runtime.bench import Bench

QUICK = ("--seconds", "0", "--scenes", "3", "--threads", "1")


def test_json_has_the_machine_the_cases_and_the_memory(run, bundle, scene_path):
    result = run("bench", bundle, "--scene", scene_path, *QUICK, "--only", "hypernet,points,memory", "--json")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert found["machine"]["threads"] == 1
    assert found["machine"]["model"] == "gaussian"
    assert {case["section"] for case in found["cases"]} == {"hypernet", "points"}
    for case in found["cases"]:
        assert 0 < case["seconds"]["median"] <= case["seconds"]["max"]
        assert case["per_map"] == case["seconds"]["median"] / case["maps"]
    assert found["memory"]["scenes"] == 3
    assert found["memory"]["samples"][-1][0] == 3
    assert found["memory"]["peak"] >= found["memory"]["before"]


def test_text_has_a_line_per_case(run, bundle, scene_path):
    result = run("bench", bundle, "--scene", scene_path, *QUICK, "--only", "hypernet,memory")
    lines = result.stdout.splitlines()
    assert lines[0].startswith("gaussian on ")
    assert len(lines) == 2 + 2 + 1
    assert "1 agent x 20 horizons" in lines[2]
    assert "3 scenes" in lines[-1]
    assert "hyper-network" in result.stderr


def test_the_samples_are_measured_by_default(run, embedded):
    result = run("bench", *QUICK, "--only", "certified", "--json")
    assert result.exit_code == 0, result.output
    names = [case["name"] for case in json.loads(result.stdout)["cases"]]
    assert list(dict.fromkeys(name.split(", ")[1] for name in names)) == ["bend", "crossing"]


def test_an_interrupt_prints_what_there_is(run, bundle, scene_path, monkeypatch):
    plain = Bench.rows

    def interrupted(self, sections):
        yield next(iter(plain(self, sections)))
        raise KeyboardInterrupt

    monkeypatch.setattr(Bench, "rows", interrupted)
    result = run("bench", bundle, "--scene", scene_path, *QUICK, "--json")
    assert result.exit_code == 130
    assert len(json.loads(result.stdout)["cases"]) == 1


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (("--only", "dense,speed"), "no section 'speed'"),
        (("--scene", "none.npz"), "none.npz"),
        (("--threads", "0"), "threads"),
    ],
)
def test_bad_usage_is_one_line(run, bundle, args, says):
    result = run("bench", bundle, *args)
    assert result.exit_code == 2, result.output
    assert says in result.stderr
    assert result.stdout == ""
    assert len(result.stderr.splitlines()) == 1
