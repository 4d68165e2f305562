"""Keep the memory of freed arrays in the process, for tasks that create many large arrays.

By default, the C library requests memory for each large array from the operating system, and returns it when the array
is freed. Each new array then begins with pages that must be mapped and cleared. Mapping and clearing takes as long as a
simple detector effect. With this module, rendering a VIS detector takes 0.86 times the CPU time at draft accuracy and
0.99 times at survey accuracy (medians of 12 pairs of runs). It needs 0.07 GB more memory.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

# Numbers of two parameters of mallopt (malloc.h of the GNU C library). The trim threshold is the size of free memory
# (bytes) above which it is returned. The other is the largest number of arrays with separate memory mappings.
_TRIM_THRESHOLD, _MMAP_MAX = -1, -4
# Default trim threshold (bytes) and default number of separate mappings.
_DEFAULT_TRIM_THRESHOLD, _DEFAULT_MMAP_MAX = 128 * 1024, 65536
# Trim threshold so high that no memory is returned before the end of a task, bytes.
_MAX_THRESHOLD = 2**31 - 1


@contextmanager
def retain_freed_memory() -> Iterator[None]:
    """Keep freed memory for new arrays inside a `with` block, and return it to the operating system at its end.

    Before the block, the C library adapts the size above which it requests separate memory for an array. After the
    block this size is fixed: 128 kB, or the size to which the library had adapted it before. With other C libraries
    than GNU's, the block has no effect.
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
