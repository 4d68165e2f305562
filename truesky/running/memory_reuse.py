"""Memory of large arrays, kept by the process while it makes many of them.

The C library asks the operating system for each large array, and gives it back with the array: each then begins with
pages that must be found and cleared, which takes as long as a simple effect of a detector does. A VIS detector at
draft takes 0.86 of the CPU time so, at survey 0.99 (medians of 12 pairs), and 0.07 GB more.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

# Parameters of mallopt, and what they are by themselves (malloc.h of the GNU C library).
_TRIM_THRESHOLD, _MMAP_MAX = -1, -4
_DEFAULT_TRIM_THRESHOLD, _DEFAULT_MMAP_MAX = 128 * 1024, 65536
# Nothing that a task may use is given back before its end.
_MAX_THRESHOLD = 2**31 - 1


@contextmanager
def retain_freed_memory() -> Iterator[None]:
    """While this is open, memory of arrays that are no more is there for the next; then it is given back.

    Afterwards the library no longer learns from which size on to ask the operating system: it does so from 128 kB.
    Does nothing where the C library is another than GNU's.
    """
    library = _library()
    if library is None:
        yield
        return
    library.mallopt(_MMAP_MAX, 0)
    library.mallopt(_TRIM_THRESHOLD, _MAX_THRESHOLD)
    try:
        yield
    finally:
        library.mallopt(_MMAP_MAX, _DEFAULT_MMAP_MAX)
        library.mallopt(_TRIM_THRESHOLD, _DEFAULT_TRIM_THRESHOLD)
        library.malloc_trim(0)


@cache
def _library() -> Any:
    try:
        library = ctypes.CDLL(None)
        return library if library.gnu_get_libc_version and library.mallopt and library.malloc_trim else None
    except (AttributeError, OSError, TypeError):
        return None
