"""Decorators for functions that numba compiles.

Numba is imported when a compiled function is first called, because its import takes half a second. Most commands import
modules with compiled functions that they never call.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from typing import Any, TypeVar, cast

# The options of numba below affect the machine code. This file must therefore be part of the hash that names the folder
# of the machine code. The hash covers all files with the text truesky.numerics.compiling.

Function = TypeVar("Function", bound=Callable[..., Any])
_LOCK = threading.RLock()


class CompiledFunction:
    """Function that numba compiles, or loads from the cache on disc, when it is first called.

    Compiled functions can call it, too.

    Parameters
    ----------
    function : callable
        The Python function.
    options : dict of str to object
        Options of numba.njit.
    """

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        functools.update_wrapper(self, function)
        self._function, self._options = function, options
        self._compiled: Callable[..., Any] | None = None

    def __call__(self, *arguments: Any, **named_arguments: Any) -> Any:
        return (self._compiled or self.load())(*arguments, **named_arguments)

    def load(self) -> Callable[..., Any]:
        """Return the function of numba, which the first call creates."""
        # Several threads may call the function for the first time. Without the lock each would compile it.
        with _LOCK:
            if self._compiled is None:
                from truesky.numerics import machine_code

                self._compiled = machine_code.compile_function(self._function, **self._options)
        return self._compiled

    @property
    def _numba_type_(self) -> Any:
        # Numba reads this attribute when it compiles a function that calls this one.
        function: Any = self.load()
        return function._numba_type_


def jit(function: Function) -> Function:
    """Compile a function with numba for speed: sums may be computed in any order, which changes their last bits.

    It is compiled when it is first called. Use `exact_jit` if every bit must be reproducible.
    """
    # Allow sums in any order, which is twice as fast; NaN and infinity remain valid. The order depends on the caller
    # into which a function is inlined. Always inline it. Otherwise a process that compiles the caller would round
    # differently from a process that loads the caller from the cache.
    fast = {"reassoc", "contract", "nsz"}
    return cast(Function, CompiledFunction(function, {"fastmath": fast, "forceinline": True}))


def exact_jit(function: Function) -> Function:
    """Compile a function with numba so that every operation is rounded as written, with the same bits on any processor.

    It is compiled when it is first called. It releases the GIL, so that other threads run at the same time.
    """
    return cast(Function, CompiledFunction(function, {"nogil": True}))
