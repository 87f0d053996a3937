"""What the benchmark measures is what it says: counts, sizes, statistics; never how long anything took."""

import numpy as np
import pytest
from gaussian_bundle import scene_fields

from hcnaf_runtime import Forecaster, Grid, Scene, measure
from hcnaf_runtime.bench import HORIZONS, LOST_MASS, SECTIONS, Bench, Row, Serving, crowd, cut
from hcnaf_runtime.errors import InputError
from hcnaf_runtime.measure import Latency, Memory, latency, summary


@pytest.fixture
def bench(forecaster, scene):
    return Bench(forecaster, {"crossing": scene}, seconds=0.0, least=2, grid=Grid(12, 10, 1.0), agents=3)


class Clock:
    """A clock that moves only when something is called: `step` seconds each time it is told to."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now

    def spend(self, seconds):
        self.now += seconds


def test_summary_is_the_quantiles_of_the_list():
    found = summary([k / 1000 for k in range(1001)])
    assert (found.repetitions, found.max) == (1001, 1.0)
    assert (found.median, found.p95, found.p99) == pytest.approx((0.5, 0.95, 0.99))
    assert found.tail == pytest.approx(1.98)
    assert found.to_dict()["tail"] == found.tail


def test_latency_counts_the_call_and_not_its_preparation():
    clock = Clock()
    found = latency(lambda _: clock.spend(0.01), lambda: clock.spend(5.0), least=7, most=9, clock=clock)
    assert found == Latency(7, *[pytest.approx(0.01)] * 4)


@pytest.mark.parametrize(("seconds", "expected"), [(0.0, 10), (1.0, 100), (1e9, 150)])
def test_latency_repeats_for_the_time_it_is_given(seconds, expected):
    clock = Clock()
    found = latency(lambda _: clock.spend(0.01), lambda: None, seconds, least=10, most=150, clock=clock)
    assert found.repetitions == pytest.approx(expected, abs=1)


def test_every_call_gets_what_was_prepared_for_it():
    given = iter(range(1000))
    seen = []
    latency(seen.append, lambda: next(given), seconds=0.0, least=5)
    assert seen == list(range(len(seen)))
    assert len(seen) >= 5 + measure.WARM_UP


def test_memory_reads_what_the_system_says(tmp_path, monkeypatch):
    status = tmp_path / "status"
    status.write_text("Name:\tx\nVmHWM:\t    2048 kB\nVmRSS:\t    1024 kB\n")
    monkeypatch.setattr(measure, "STATUS", status)
    assert measure.memory() == Memory(1 << 20, 2 << 20)
    monkeypatch.setattr(measure, "STATUS", tmp_path / "none")
    assert measure.memory() is None


def test_the_machine_is_named():
    facts = measure.machine(3)
    assert facts["threads"] == 3
    assert all(facts.values())


def test_every_section_has_rows_that_are_measured(bench):
    rows = list(bench.rows())
    assert sorted({row.section for row in rows}) == sorted(set(SECTIONS) - {"memory"})
    assert len({row.name for row in rows}) == len(rows)
    for row in rows:
        t = row.latency
        assert 0 < t.median <= t.p95 <= t.p99 <= t.max
        assert t.repetitions >= 2
        assert row.per_map == t.median / row.maps


def test_a_whole_forecast_counts_all_its_maps_and_runs_the_hypernet(bench, monkeypatch):
    made = []
    plain = Forecaster.pom

    def watched(self, *args, **kwargs):
        maps = plain(self, *args, **kwargs)
        made.append((maps.mass.shape[:2], maps.timings.hypernet > 0))
        return maps

    monkeypatch.setattr(Forecaster, "pom", watched)
    assert [row.maps for row in bench.rows(["forecast"])] == [HORIZONS] * 2 + [3 * HORIZONS] * 2
    assert {shape for shape, _ in made} == {(1, HORIZONS), (3, HORIZONS)}
    assert all(ran for _, ran in made)


def test_maps_after_theta_do_not_run_the_hypernet(bench, monkeypatch):
    runs = []
    plain = Forecaster.pom

    def watched(self, *args, **kwargs):
        maps = plain(self, *args, **kwargs)
        runs.append(maps.timings.hypernet > 0)
        return maps

    monkeypatch.setattr(Forecaster, "pom", watched)
    assert [row.maps for row in bench.rows(["dense"])] == [1, HORIZONS]
    assert sum(runs) <= 2  # the first call of each case


def test_certified_rows_state_what_was_lost(bench):
    alone, together = bench.rows(["certified"])
    assert (alone.maps, together.maps) == (HORIZONS, len(bench.scenes["crossing"].target) * HORIZONS)
    for row in (alone, together):
        assert 0 <= row.facts["lost_mass"] <= LOST_MASS


def test_horizons_span_the_trained_range(bench):
    assert bench.horizons(4) == (1.0, 2.0, 3.0, 4.0)


def test_a_crowd_has_the_targets_asked_for(scene):
    for agents in (1, 2, 3, 10):
        many = crowd(scene, agents)
        assert len(many.target) == agents
        assert len(np.unique(many.pose, axis=0)) == agents
    np.testing.assert_array_equal(many.past[:2], scene.past)
    assert many.size[many.target].tolist() == [scene.size[0].tolist()] * 10


def test_a_cut_keeps_the_lowest_rows(scene):
    half = cut(scene, 0.5)
    np.testing.assert_array_equal(half.raster, scene.raster[:, :3])
    bare = Scene(**{k: v for k, v in scene_fields().items() if k not in ("raster", "channels")})
    assert cut(bare, 0.5) is bare


def test_serving_notes_memory_as_often_as_asked(bench):
    served = bench.serve(7, every=3)
    if served is None:
        pytest.skip("this system does not tell a process's memory")
    assert [done for done, _ in served.samples] == [3, 6, 7]
    assert served.latency.repetitions == served.scenes == 7
    assert served.peak >= max(resident for _, resident in served.samples) * 0.9


@pytest.mark.parametrize(
    ("resident", "expected"),
    [([5, 5, 5, 5], 0), ([3, 5, 4, 5], 0), ([1, 2, 3, 4], 2), ([5, 4, 3, 2], 0), ([9], 0)],
)
def test_growth_is_what_the_second_half_took_more(resident, expected):
    samples = tuple(enumerate(resident))
    served = Serving(4, Memory(0, 0), samples, 9, summary([1.0]))
    assert served.growth == expected


def test_serving_is_the_same_for_the_same_seed(bench, monkeypatch):
    seen = []
    plain = Forecaster.pom

    def watched(self, scene, grid=None, horizons=None, **kwargs):
        seen.append((len(scene.target), grid, horizons, scene.raster.shape))
        return plain(self, scene, grid, horizons, **kwargs)

    monkeypatch.setattr(Forecaster, "pom", watched)
    for _ in range(2):
        bench.serve(6, seed=4)
    assert seen[:6] == seen[6:]
    assert len(set(seen)) > 3


def test_conditions_and_no_scenes_are_refused(condition_path, forecaster, scene):
    with pytest.raises(InputError, match="takes conditions"):
        Bench(Forecaster(condition_path, 1), {"a": scene})
    with pytest.raises(InputError, match="name a scene file"):
        Bench(forecaster, {})


def test_per_map_is_a_share_of_the_median():
    assert Row("dense", "x", 20, summary([2.0]), {}).per_map == 0.1
