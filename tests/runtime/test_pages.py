"""Large results: zeros like numpy's, in memory that goes back to the system with them."""

import mmap

import numpy as np
import pytest

from hcnaf_runtime import measure, pages

SMALL, LARGE, LARGEST = (3, 5, 7), (5, 600, 701), (21, 600, 701)


@pytest.fixture(autouse=True)
def nothing_spare():
    pages._spare.clear()


@pytest.mark.parametrize("shape", [SMALL, LARGE, LARGEST, (0, 4, 4)])
def test_zeros_to_write_into(shape):
    found = pages.zeros(shape)
    assert found.shape == shape
    assert found.dtype == np.float32
    assert found.flags.c_contiguous
    assert not found.any()
    found += 1.0
    assert found.sum() == found.size


def test_arrays_do_not_share_memory():
    one, other = pages.zeros(LARGE), pages.zeros(LARGE)
    one.fill(1.0)
    assert not other.any()


def test_a_part_keeps_the_whole_alive():
    part = pages.zeros(LARGE)[1]
    part.fill(2.0)
    pages.zeros(LARGE).fill(3.0)
    assert (part == 2.0).all()


large_pages = pytest.mark.skipif(not pages._large_pages(), reason="the system has no large pages")


@large_pages
def test_a_region_is_used_again_once_nobody_sees_it():
    first = pages.zeros(LARGE)
    first.fill(1.0)
    part, place = first[2:, 1], first.ctypes.data
    del first
    assert pages.zeros(LARGE).ctypes.data != place
    assert (part == 1.0).all()
    pages.zeros(LARGEST)  # the spare one is too small and goes back
    del part
    again = pages.zeros(LARGE[::-1])
    assert again.ctypes.data == place
    assert not again.any()


@large_pages
@pytest.mark.skipif(measure.memory() is None, reason="the system does not tell a process's memory")
def test_memory_goes_back_to_the_system():
    """A C library that has seen large arrays come and go keeps what further ones took."""
    size = (pages.KEPT + (8 << 20)) // 4
    for _ in range(2):
        np.ones(size, np.float32)
    before, kept = measure.memory().resident, []
    for _ in range(4):
        held = pages.zeros((size,))
        held.fill(1.0)
        assert measure.memory().resident > before + 3 * size
        kept.append(np.ones(100))  # settles where the array was, if it was in the allocator's memory
        del held
    assert measure.memory().resident < before + size


@large_pages
@pytest.mark.skipif(measure.memory() is None, reason="the system does not tell a process's memory")
def test_no_more_than_one_region_is_kept():
    before = measure.memory().resident
    held = [pages.zeros((pages.KEPT // 4,)) for _ in range(5)]
    for array in held:
        array.fill(1.0)
    del held, array
    assert measure.memory().resident < before + 1.5 * pages.KEPT


@pytest.mark.parametrize("refuse", ["mmap", "MADV_HUGEPAGE"])
def test_numpy_serves_where_the_system_does_not(monkeypatch, refuse):
    def none(*_, **__):
        raise OSError

    if refuse == "mmap":
        monkeypatch.setattr(mmap, "mmap", none)
    else:
        monkeypatch.delattr(mmap, "MADV_HUGEPAGE", raising=False)
        pages._large_pages.cache_clear()
    found = pages.zeros(LARGE)
    pages._large_pages.cache_clear()
    assert found.flags.owndata
    assert found.shape == LARGE
    assert not found.any()
