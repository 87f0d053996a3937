"""`hcnaf evaluate`, from the options to what is printed, drawn and refused."""

import json

import pytest

pytest.importorskip("torch")

from hcnaf_cli import picture_evaluation
from hcnaf_cli.scores_text import scores_text
from hcnaf_export.evaluation import Scores
from tests.export import synthetic

FEW = ("--limit", 12, "--calibration-windows", 8, "--samples-windows", 4, "--threads", 1)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return synthetic.write(tmp_path_factory.mktemp("data") / "set")


@pytest.fixture
def scored(train, data):
    """Scores of the embedded model on a few windows."""

    def call(*args):
        result = train("evaluate", "--data", data, *FEW, "--horizons", "1,2", *args)
        assert result.exit_code == 0, result.output
        return result

    return call


def test_the_embedded_model_is_scored_in_full(scored, tmp_path):
    result = scored("--json", "--plot", tmp_path / "scores.png")
    found = json.loads(result.stdout)
    assert (found["predictor"], found["windows"]) == ("bundle", 12)
    assert [row["horizon"] for row in found["rows"]] == [1.0, 2.0]
    assert {e["protocol"]: e["sigma"] for e in found["extra_nats"]} == {"normalised": 0.5, "metres": 0.01}
    assert all(e["definition"] for e in found["extra_nats"])
    assert [found[k]["windows"] for k in ("pit", "hdr_coverage", "reliability", "samples")] == [8, 8, 8, 4]
    assert {row["level"] for row in found["hdr_coverage"]["rows"]} == {0.5, 0.8, 0.95}
    assert all(0.0 <= row["ece"] <= 1.0 for row in found["reliability"]["rows"])
    assert (tmp_path / "scores.png").read_bytes()[:4] == b"\x89PNG"
    assert "scores.png" in result.stderr


def test_the_text_has_a_table_for_every_question(scored):
    text = scored().stdout
    for words in ("NLL", "extra nats", "Kolmogorov-Smirnov", "highest-density", "calibration error", "min_ade"):
        assert words in text
    less = scored("--no-extra-nats", "--calibration-windows", 0, "--samples-windows", 0).stdout
    assert len(less.splitlines()) == 5
    assert "NLL" in less


def test_pictures_have_a_panel_for_what_there_is(scored):
    import msgspec

    scores = msgspec.json.decode(scored("--json").stdout, type=Scores)
    assert len(picture_evaluation.paint(scores).axes) == 6
    bare = replace_struct(scores, extra_nats=(), pit=None, hdr_coverage=None, reliability=None, samples=None)
    assert sum(axes.get_visible() for axes in picture_evaluation.paint(bare).axes) == 1
    free = replace_struct(bare, floor=None)
    assert "label noise" not in scores_text(free)
    assert picture_evaluation.paint(free)


def replace_struct(scores, **changes):
    import msgspec

    return msgspec.structs.replace(scores, **changes)


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (("--bundle", "a", "--ckpt", "b"), "not both"),
        (("--record",), "needs --ckpt"),
        ((), "--data"),
        (("--data", "nowhere"), "dataset.json"),
        (("--plot", "scores.txt"), "pictures end with"),
        (("--plot", "no/where.png"), "make it first"),
    ],
)
def test_what_cannot_be_done_is_one_line(train, args, words):
    result = train("evaluate", *args)
    assert result.exit_code == 2
    assert len(result.stderr.splitlines()) == 1
    assert words in result.stderr
    assert result.stdout == ""
