"""Large results in memory of their own, which goes back to the system with them.

An allocator keeps what large arrays leave behind, and other arrays settle in it: a process whose results differ in
size grows to the largest there ever was, and beyond. Here one region of bounded size is kept, to be used again.
"""

import mmap
import weakref
from collections import deque
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

Float32 = npt.NDArray[np.float32]

LEAST, KEPT = 4 << 20, 32 << 20
"""Bytes from which an array gets a region of its own, and up to which its region is kept for the next.

Ten agents and twenty horizons on 200 x 200 cells fit.
"""

_PAGE = 2 << 20
_SETTING = Path("/sys/kernel/mm/transparent_hugepage/enabled")
_spare: deque[mmap.mmap] = deque(maxlen=1)


def zeros(shape: tuple[int, ...]) -> Float32:
    """As `numpy.zeros`, of float32."""
    array = empty(shape)
    array.fill(0.0)
    return array


def empty(shape: tuple[int, ...]) -> Float32:
    """As `numpy.empty`, of float32."""
    count = int(np.prod(shape, dtype=np.int64))
    if 4 * count >= LEAST and _large_pages():
        try:
            return _in_region(count).reshape(shape)
        except OSError:  # not to be had here: numpy tries, or says that memory ran out
            pass
    return np.empty(shape, np.float32)


def _in_region(count: int) -> Float32:
    """So many numbers, in the spare region if they fit. If not it goes back first: the new one takes its place."""
    region = _taken(4 * count) or _mapped(max(4 * count, KEPT))
    array = np.frombuffer(region, np.float32, count)
    if len(region) == KEPT:
        # Every view of the array holds on to it: when it is gone nobody sees the region any more.
        weakref.finalize(array, _spare.append, region).atexit = False
    return array


def _taken(size: int) -> mmap.mmap | None:
    """The spare region, if there is one and `size` bytes fit into it."""
    try:
        region = _spare.pop()
    except IndexError:  # asked for like this, since another thread may just take it
        return None
    return region if size <= KEPT else None


def _mapped(size: int) -> mmap.mmap:
    """At least `size` bytes: whole large pages, since the system aligns only those."""
    region = mmap.mmap(-1, -(-size // _PAGE) * _PAGE, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    region.madvise(mmap.MADV_HUGEPAGE)
    return region


@cache
def _large_pages() -> bool:
    """Whether the system has any: asking for small ones one by one would slow maps down by up to a half."""
    try:
        return hasattr(mmap, "MADV_HUGEPAGE") and "[never]" not in _SETTING.read_text()
    except OSError:
        return False
