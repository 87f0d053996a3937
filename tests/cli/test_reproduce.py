"""`hcnaf reproduce`: the quick versions, as continuous integration runs them."""

import json

import pytest

pytest.importorskip("torch")
pytest.importorskip("matplotlib")


@pytest.mark.parametrize(("name", "conditions"), [("toy1", 3), ("toy2", 9)])
def test_a_quick_run_meets_its_bounds(train, tmp_path, name, conditions):
    out = tmp_path / name
    result = train("reproduce", name, "--quick", "--out", out, "--json")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert found == json.loads((out / "record.json").read_text())
    assert (found["experiment"], found["quick"]) == (name, True)
    assert all(bound["found"] <= bound["most"] for bound in found["bounds"])
    scored = [row for row in found["rows"] if not row["on"].startswith("mean")]
    assert len(scored) == conditions
    assert all(row["figures"]["KL (nats)"]["error"] > 0.0 for row in scored)
    assert {"training", "export", "evaluation"} <= set(found["seconds"])
    assert (out / "figure.png").stat().st_size > 10_000
    (bundle,) = out.glob("**/bundle")
    assert {path.name for path in bundle.glob("*.onnx")} == {"hypernet.onnx", "flow.onnx"}

    again = train("reproduce", name, "--quick", "--out", out)
    assert (again.exit_code, len(again.stderr.splitlines())) == (2, 1)
    assert "not empty" in again.stderr


def test_there_is_nothing_to_resume(train, tmp_path):
    result = train("reproduce", "toy2", "--quick", "--out", tmp_path / "none", "--resume")
    assert result.exit_code == 2
    assert "not there to go on with" in result.stderr


@pytest.mark.parametrize("as_json", [False, True])
def test_a_broken_bound_is_exit_code_1_and_the_record_is_kept(train, tmp_path, monkeypatch, as_json):
    from hcnaf_export.reproduce import toy2
    from hcnaf_export.reproduce.record import Bound, Figure, Record, Row

    def run(request):
        assert (request.seed, request.threads, request.quick) == (5, 2, False)
        return Record(
            experiment="toy2",
            about="a test",
            quick=False,
            settings={},
            machine={},
            rows=(Row("HCNAF", "(4, 4)", {"KL (nats)": Figure(0.5, 0.01, 0.037)}),),
            bounds=(Bound("mean KL", 0.5, 0.01),),
            notes=("a note",),
        )

    monkeypatch.setattr(toy2, "run", run)
    arguments = ["reproduce", "toy2", "--out", tmp_path, "--seed", "5", "--threads", "2"]
    result = train(*arguments, *(["--json"] if as_json else []))
    assert result.exit_code == 1
    assert "mean KL is 0.5, expected at most 0.01" in result.stderr
    assert (tmp_path / "record.json").is_file()
    if not as_json:
        assert "BROKEN" in result.stdout
        assert "0.500 ± 0.010" in result.stdout
        assert "a note" in result.stdout


def test_an_interrupted_experiment_says_how_to_go_on(train, tmp_path, monkeypatch):
    from hcnaf_export.reproduce import toy2
    from hcnaf_export.reproduce.record import Stopped

    def run(request):
        raise Stopped(request.out)

    monkeypatch.setattr(toy2, "run", run)
    result = train("reproduce", "toy2", "--out", tmp_path / "new")
    assert result.exit_code == 130
    assert "--resume" in result.stderr
