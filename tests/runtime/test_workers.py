"""Work shared out to threads: all of it done once, failures raised, no waiting for each other."""

import gc
import threading

import pytest

from hcnaf_runtime.workers import Workers


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_every_item_is_done_once(threads):
    done, lock = [], threading.Lock()

    def work(item):
        with lock:
            done.append(item)

    Workers(threads).each(work, range(100))
    assert sorted(done) == list(range(100))


def test_threads_work_at_the_same_time():
    """Two calls that wait for each other can only both end if both run."""
    meeting = threading.Barrier(2, timeout=10.0)
    Workers(2).each(lambda _: meeting.wait(), range(2))


@pytest.mark.parametrize("threads", [1, 2])
def test_a_failure_is_raised_and_the_workers_go_on(threads):
    workers = Workers(threads)

    def fail(item):
        if item == 3:
            raise KeyError(item)

    with pytest.raises(KeyError):
        workers.each(fail, range(6))
    done = []
    workers.each(done.append, range(4))
    assert sorted(done) == [0, 1, 2, 3]


@pytest.mark.parametrize("threads", [1, 2])
def test_work_inside_of_work_does_not_wait(threads):
    workers = Workers(threads)
    inner = []

    def work(item):
        assert workers.busy
        workers.each(inner.append, [item] * 3)

    workers.each(work, range(4))
    assert sorted(inner) == sorted([0, 1, 2, 3] * 3)
    assert not workers.busy


@pytest.mark.parametrize("threads", [1, 2, 4])
def test_every_thread_has_a_lane_of_its_own(threads):
    workers, lanes = Workers(threads), {}
    meeting = threading.Barrier(threads, timeout=10.0)

    def work(_):
        meeting.wait()  # each thread takes one item
        lanes[threading.get_ident()] = workers.lane

    for _ in range(3):
        workers.each(work, range(threads))
    assert sorted(lanes.values()) == list(range(threads))
    assert lanes[threading.get_ident()] == workers.lane == 0


def test_threads_end_with_their_workers():
    workers, seen = Workers(3), set()
    meeting = threading.Barrier(3, timeout=10.0)

    def work(_):
        meeting.wait()
        seen.add(threading.current_thread())

    workers.each(work, range(3))
    others = seen - {threading.current_thread()}
    assert len(others) == 2
    del workers
    gc.collect()
    for thread in others:
        thread.join(10.0)
        assert not thread.is_alive()


def test_nothing_to_do():
    Workers(2).each(pytest.fail, [])
