"""numba, with its machine code in the project's cache: compiled once a machine and version, not once a process."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, TypeVar

from lake_schema import instruction_set
from truesky.numerics import cache

# numba reads these when it is imported, and processes begun from here have them.
instruction_set.limit_numba()
os.environ["NUMBA_CACHE_DIR"] = str(cache.machine_code_dir())

import numba  # noqa: E402

Function = TypeVar("Function", bound=Callable[..., Any])


def jit(function: Function) -> Function:
    """The function, compiled when it is first called."""
    # Sums may be taken in any order, which makes them twice as fast; NaN and infinity keep their meaning.  In which
    # order depends on what a function is compiled into: always into its caller, or a process that compiles would round
    # otherwise than one that finds the caller in the cache.
    fast = {"reassoc", "contract", "nsz"}
    decorate: Any = numba.njit(cache=True, error_model="numpy", fastmath=fast, forceinline=True)
    compiled: Function = decorate(function)
    return compiled


def exact_jit(function: Function) -> Function:
    """The function, compiled with every operation rounded as it is written: the same bits on any processor.

    It lets other threads run beside it.
    """
    decorate: Any = numba.njit(cache=True, error_model="numpy", nogil=True)
    compiled: Function = decorate(function)
    return compiled
