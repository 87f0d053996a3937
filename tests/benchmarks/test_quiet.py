"""What counts is measured when the machine is quiet, whatever it says."""

import pytest

from tests.benchmarks.quiet import PAUSE, Quiet, speed


class Machine:
    """Has the given speeds, one after the other, then the last for ever; measuring takes a minute."""

    def __init__(self, *speeds):
        self.speeds, self.now, self.slept = list(speeds), 0.0, 0.0

    def probe(self):
        return self.speeds.pop(0) if len(self.speeds) > 1 else self.speeds[0]

    def sleep(self, seconds):
        self.now += seconds
        self.slept += seconds

    def section(self):
        self.now += 60.0
        return {"at": self.now}

    def quiet(self, fastest=1.0, patience=1000.0):
        return Quiet(self.probe, fastest, patience, self.sleep, lambda: self.now)


def test_a_quiet_machine_is_not_waited_for():
    machine = Machine(0.99, 0.97)
    assert machine.quiet().measure(machine.section) == ({"at": 60.0}, 0.97)
    assert machine.slept == 0.0


def test_a_busy_one_is_until_it_is_quiet():
    machine = Machine(0.5, 0.6, 0.95, 0.98)
    assert machine.quiet().measure(machine.section) == ({"at": 60.0 + 2 * PAUSE}, 0.95)


def test_what_was_measured_while_it_got_busy_is_measured_again():
    machine = Machine(1.0, 0.5, 1.0, 0.96)
    assert machine.quiet().measure(machine.section) == ({"at": 120.0}, 0.96)


def test_out_of_patience_the_quietest_counts():
    machine = Machine(0.7, 0.8, 0.8, 0.6, 0.5)
    quiet = machine.quiet(patience=2 * PAUSE)
    assert quiet.measure(machine.section) == ({"at": 60.0 + 2 * PAUSE}, 0.6)
    assert quiet.patience <= 0.0
    machine = Machine(1.0, 0.8, 1.0, 0.7, 0.7)
    assert machine.quiet(patience=60.0).measure(machine.section) == ({"at": 60.0}, 0.8)


def test_without_patience_there_is_one_measurement():
    machine = Machine(0.2)
    assert machine.quiet(patience=0.0).measure(machine.section) == ({"at": 60.0}, pytest.approx(0.2))


def test_a_machine_faster_than_ever_sets_the_standard():
    machine = Machine(2.0, 1.0, 2.0, 2.0)
    quiet = machine.quiet()
    assert quiet.measure(machine.section) == ({"at": 120.0}, 2.0)
    assert quiet.fastest == 2.0
    assert quiet.worth_another(1.0)


def test_the_piece_of_work_takes_time():
    assert 1.0 < speed(1) < 1e7
