"""Memory is kept between arrays and then returned, by the counters of the C library instead of the machine."""

import ctypes
import functools
import mmap
import platform
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest

from truesky.running import memory_reuse

# More than 32 MB, the limit to which the library may adapt its threshold for keeping memory.
SIZE = 64 << 20


@pytest.fixture(scope="module", autouse=True)
def _memory_is_reused():
    """Disable the fixture that keeps memory, because these tests measure memory."""


class Counted(ctypes.Structure):
    """Structure that mallinfo2 of malloc.h returns.

    arena    : bytes of the heap, of which uordblks are in use and fordblks are free
    hblkhd   : bytes that were requested directly from the operating system
    keepcost : free bytes at the end of the heap, which could be returned
    """

    _fields_ = tuple(
        (name, ctypes.c_size_t)
        for name in (
            "arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "uordblks", "fordblks", "keepcost",
        )
    )  # fmt: skip


def counts():
    """Return mallinfo2, or None if the C library does not contain it."""
    try:
        function = ctypes.CDLL(None).mallinfo2
    except (AttributeError, OSError, TypeError):
        return None
    function.restype = Counted
    return function


COUNTS = counts()
# The condition uses the platform instead of the tested module, so that tests fail if it no longer finds the library.
on_gnu = pytest.mark.skipif(
    platform.libc_ver()[0] != "glibc" or COUNTS is None,
    reason="only GNU's C library, from 2.33 on, says where memory is; that others are left alone is tested below",
)


def alone(test):
    """Run a test in a separate process: in a used heap, even a large array may find free memory."""

    @functools.wraps(test)
    def in_a_process(**arguments):
        with ProcessPoolExecutor(1, get_context("spawn")) as pool:
            pool.submit(_called, test.__name__, arguments).result(300)

    return in_a_process


def _called(name, arguments):
    globals()[name].__wrapped__(**arguments)


def heap_and_mapped():
    now = COUNTS()
    return now.arena, now.hblkhd


def resident():
    """Return the bytes of this process that are in memory.

    The size of the heap is not sufficient: one small block at its end keeps it long, even if no page before that block
    is in memory any more.
    """
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * mmap.PAGESIZE


@on_gnu
@alone
def test_without_it_each_array_is_asked_for():
    heap_before, mapped_before = heap_and_mapped()
    array = np.ones(SIZE, np.uint8)
    size, mapped = heap_and_mapped()
    assert size < heap_before + SIZE // 8
    assert mapped >= mapped_before + SIZE
    del array
    assert heap_and_mapped()[1] == mapped_before


@on_gnu
@alone
def test_later_arrays_find_the_memory_of_those_before():
    mapped_before = heap_and_mapped()[1]
    with memory_reuse.retain_freed_memory():
        places, sizes = set(), set()
        for _ in range(5):
            array = np.ones(SIZE, np.uint8)
            places.add(array.ctypes.data)
            del array
            # The process keeps the memory when the array is deleted, and none is requested directly.
            assert COUNTS().fordblks >= SIZE
            size, mapped = heap_and_mapped()
            assert mapped == mapped_before
            sizes.add(size)
        assert len(places) == len(sizes) == 1


@on_gnu
@alone
def test_it_is_given_back():
    before, mapped = resident(), heap_and_mapped()[1]
    with memory_reuse.retain_freed_memory():
        np.ones(SIZE, np.uint8)
        assert COUNTS().fordblks >= SIZE
        assert resident() >= before + SIZE * 7 // 8
    assert resident() < before + SIZE // 8
    # The library has its usual behaviour again: the next array is requested from the system, and returned.
    array = np.ones(SIZE, np.uint8)
    assert heap_and_mapped()[1] >= mapped + SIZE
    del array
    # Smaller arrays are in the heap. They leave no free memory at its end.
    many = [np.ones(100_000, np.uint8) for _ in range(SIZE // 100_000)]
    assert COUNTS().uordblks >= SIZE - 100_000
    del many
    assert COUNTS().keepcost < SIZE // 8


@on_gnu
@alone
def test_it_is_given_back_after_an_error():
    before = resident()

    @memory_reuse.retain_freed_memory()
    def fails():
        np.ones(SIZE, np.uint8)
        raise KeyError("of the work")

    with pytest.raises(KeyError, match="of the work"):
        fails()
    assert resident() < before + SIZE // 8


def library_without_functions(name):
    return object()


def no_such_library(name):
    raise OSError(f"{name}: not found")


@pytest.mark.parametrize("opened", [library_without_functions, no_such_library])
@alone
def test_another_library_is_left_alone(opened):
    """The library does not have GNU's functions, or does not exist."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(memory_reuse.ctypes, "CDLL", opened)
        monkeypatch.setattr(memory_reuse, "_library", memory_reuse._library.__wrapped__)
        with memory_reuse.retain_freed_memory():
            assert memory_reuse._library() is None
            if COUNTS is not None:
                mapped = heap_and_mapped()[1]
                array = np.ones(SIZE, np.uint8)
                assert heap_and_mapped()[1] >= mapped + SIZE
                del array
